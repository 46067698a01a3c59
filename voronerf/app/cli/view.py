"""``voronerf view``: a trained run in a browser."""

from __future__ import annotations

import contextlib
from pathlib import Path

from voronerf.app.cli.commands import import_viewer, say, serve_runs
from voronerf.app.cli.opening import AS_IN_TRAINING, Opening
from voronerf.app.scenes.record import read_scene


def view(run: Path, /, host: str = "127.0.0.1", port: int = 8080, opening: Opening = AS_IN_TRAINING) -> int:
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
    with contextlib.closing(viewer):
        serve_runs(viewer, opening)
    return 0
