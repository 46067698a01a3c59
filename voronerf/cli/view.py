"""``voronerf view``: a trained run in a browser."""

from __future__ import annotations

import contextlib
import threading
from pathlib import Path

from voronerf.cli.commands import check_counts, import_viewer, say
from voronerf.data import load_scene
from voronerf.data.record import read_scene
from voronerf.run import open_run
from voronerf.training.config import ConfigError
from voronerf.training.run_directory import check_stored_paths


def view(
    run: Path,
    /,
    host: str = "127.0.0.1",
    port: int = 8080,
    data: str | None = None,
    downscale: int | None = None,
    allow_outside: bool = False,
    samples: int | None = None,
    fine_samples: int | None = None,
    occupancy: bool = False,
    blend: float | None = None,
    device: str = "cpu",
    backend: str = "auto",
) -> int:
    """Look at a trained run in a browser, until Ctrl-C.

    Args:
        run: The run directory.
        host: Address to listen at; the default is for this machine only, 0.0.0.0 lets others in.
        port: Port to listen at; 0 is any that is free.
        data: Scene folder; default as in training, if that lies in the run directory, the working directory or
            VORONERF_DATA, since a run may be another person's.
        downscale: Factor on the images; default as in training.
        allow_outside: Also read images that lie outside of the scene folder.
        samples: Samples per ray in the first pass; default as in training.
        fine_samples: Samples per ray in the second pass; default as in training.
        occupancy: Skip empty space, found by evaluating the field once; a run trained with --occupancy always uses
            its own grid.
        blend: Margin in scene units within which neighbouring cells are blended; default as in training, 0 is off.
        device: Torch device.
        backend: Backend of the operations.
    """
    check_counts(samples=samples, fine_samples=fine_samples, downscale=downscale)
    viewers = import_viewer()
    viewers.check_address(host, port)
    record = run / "scene.json"
    scene = read_scene(record) if record.is_file() else None
    opened = open_run(
        run,
        scene=scene,
        data=data,
        downscale=downscale,
        allow_outside=allow_outside,
        samples=samples,
        fine_samples=fine_samples,
        occupancy=occupancy,
        blend=blend,
        device=device,
        backend=backend,
    )
    viewer = viewers.view_run(opened, host=host, port=port)
    say(f"open {viewer.address} in a browser; Ctrl-C ends")

    def read_images() -> None:
        try:
            if data is None:
                check_stored_paths(run, data=opened.config.data)
            whole = load_scene(opened.config.data, allow_outside=allow_outside, **opened.config.reading)
        except (ConfigError, ValueError, OSError) as error:
            say(f"without the images of the scene: {error}")
        else:
            viewer.do(lambda: viewer.take_images(whole))

    with contextlib.suppress(KeyboardInterrupt), contextlib.closing(viewer):
        viewer.warm_up()
        if scene is not None:
            threading.Thread(target=read_images, daemon=True).start()
        viewer.serve()
    return 0
