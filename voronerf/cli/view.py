"""``voronerf view``: a trained run in a browser."""

from __future__ import annotations

import contextlib
import threading
from pathlib import Path

from voronerf.cli.commands import import_viewer, say
from voronerf.cli.opening import AS_IN_TRAINING, Opening
from voronerf.data import load_scene
from voronerf.data.record import read_scene
from voronerf.training.config import ConfigError
from voronerf.training.run_directory import check_stored_paths


def view(
    run: Path,
    /,
    host: str = "127.0.0.1",
    port: int = 8080,
    opening: Opening = AS_IN_TRAINING,
) -> int:
    """Look at a trained run in a browser, until Ctrl-C.

    Args:
        run: The run directory.
        host: Address to listen at; the default is for this machine only, 0.0.0.0 lets others in.
        port: Port to listen at; 0 is any that is free.
        opening: How the run is opened.
    """
    viewers = import_viewer()
    viewers.check_address(host, port)
    record = run / "scene.json"
    scene = read_scene(record) if record.is_file() else None
    opened = opening.open(run, scene=scene, pictures=True)
    viewer = viewers.view_run(opened, host=host, port=port)
    say(f"{viewer.audience}; Ctrl-C ends")

    def read_images() -> None:
        try:
            if opening.data is None:
                check_stored_paths(run, data=opened.config.data)
            whole = load_scene(opened.config.data, allow_outside=opening.allow_outside, **opened.config.reading)
        except (ConfigError, ValueError, OSError) as error:
            say(f"without the images of the scene: {error}")
        else:
            viewer.do(lambda: viewer.take_images(whole))

    with contextlib.suppress(KeyboardInterrupt), contextlib.closing(viewer):
        viewer.warm_up()
        if scene is not None and opening.memory is None:
            threading.Thread(target=read_images, daemon=True).start()
        viewer.serve()
    return 0
