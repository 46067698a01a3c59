"""Attacks on the viewer with hostile messages, which its page never sends."""

from __future__ import annotations

import contextlib
import io
import logging
import math
import random
import sys
from pathlib import Path
from typing import Any

import torch
from attempts import REFUSED, RIGHT, Failed
from hostile import VALUES, damaged
from input_files import FIELDS

from voronerf.app import open_run

sys.path.append(str(Path(__file__).parents[1] / "app" / "viewer"))

#: The number of messages of a client in an attempt.
MESSAGES = 20


def hostile_client(rng: random.Random, folder: Path, inputs: Path) -> str:
    """Sends hostile messages from one client: the viewer must log each in a line and keep serving another client."""
    import msgspec  # imported here, since the viewer's packages are optional
    from tab import Tab
    from websockets.exceptions import ConnectionClosed

    from voronerf.app.viewer import view_run

    said: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: said.append(record.getMessage())  # type: ignore[method-assign]
    logging.getLogger("voronerf").addHandler(handler)
    torch.set_num_threads(1)
    viewer = view_run(open_run(inputs / rng.choice(list(FIELDS)), data=inputs / "blender"), port=0)
    cameras = viewer.subject.scene.test.cameras
    printed = io.StringIO()
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.redirect_stderr(printed))
        stack.enter_context(contextlib.closing(viewer))
        other = stack.enter_context(contextlib.closing(Tab(viewer, cameras)))
        other.rest()
        other.set("Pixels", 128)
        bad = Tab(viewer, cameras, number=1)
        bad.rest()
        bad.set("Crop", True)  # so that its sliders have an effect
        with contextlib.suppress(ConnectionClosed):
            for _ in range(MESSAGES):
                data = msgspec.msgpack.encode(message(rng, bad.gui))
                bad.socket.send(damaged(rng, data) if rng.random() < 0.1 else data)
                viewer.render_next()
                bad.read()
        other.set("Show", "depth")
        other.rest()
        if 0 not in viewer.clients:
            raise Failed(f"another client was disconnected: {said}")
        verdict = RIGHT if 1 in viewer.clients else REFUSED
        bad.close()
    if "Traceback" in printed.getvalue() or any("\n" in line or len(line) > 500 for line in said):
        raise Failed(f"not in lines: {said} {printed.getvalue()[-200:]}")
    return verdict


def message(rng: random.Random, gui: dict[str, Any]) -> dict[str, Any]:
    """Returns a hostile message."""
    from tab import CAMERA, CLICK

    part = rng.choice([part for part in gui.values() if part.get("value") is not None or "options" in part] or [{}])
    kinds = {
        "GuiUpdateMessage": {"uuid": part.get("uuid"), "updates": {"value": value(rng)}},
        "ViewerCameraMessage": CAMERA,
        "ScenePointerMessage": {**CLICK, "screen_pos": [[0.5, 0.5]]},
        "FileTransferStartUpload": {"size_bytes": 2**60, "part_count": 2**60, "filename": "x", "mime_type": "x"},
        "ShareUrlRequest": {},
    }
    kind = rng.choice(("GuiUpdateMessage", "GuiUpdateMessage", "ViewerCameraMessage", *kinds))
    result = {"type": kind, **kinds[kind]}
    if kind != "GuiUpdateMessage" or rng.random() < 0.3:
        result[rng.choice(list(result))] = value(rng)
    return result


def value(rng: random.Random) -> Any:
    """Returns a random value for a message."""
    found = rng.choice((*VALUES, [1.0], [math.nan] * 2, [1e300] * 3, [[1.0], [2.0, 3.0]], {"update_cb": 3}, -1.0))
    large = isinstance(found, int) and abs(found) > 2**63
    return str(found) if large else found
