"""``voronerf view``: a trained run in a browser."""

from __future__ import annotations

import contextlib
import importlib
from pathlib import Path
from types import ModuleType

from voronerf.app.cli.display import say
from voronerf.app.cli.opening import AS_IN_TRAINING, Opening


def view(run: Path, /, host: str = "127.0.0.1", port: int = 8080, opening: Opening = AS_IN_TRAINING) -> int:
    """Look at a trained run in a browser, until Ctrl-C.

    Args:
        run: The run directory.
        host: Address to listen on; the default is for this machine only, 0.0.0.0 lets others in.
        port: Port to listen on; 0 is any free port.
        opening: The settings with which the run is opened.
    """
    viewers = import_viewer()
    viewers.check_address(host, port)
    viewer = viewers.view_run(opening.open_without_images(run), host=host, port=port)
    say(f"{viewer.audience}; Ctrl-C ends")
    with contextlib.closing(viewer), contextlib.suppress(KeyboardInterrupt):
        viewer.warm_up()
        viewer.serve()
    return 0


def import_viewer() -> ModuleType:
    """Imports and returns the viewer, which needs viser."""
    try:
        return importlib.import_module("voronerf.app.viewer")
    except ImportError as error:
        raise ImportError(f"the viewer needs viser: pip install 'voronerf[viewer]' ({error})") from None
