"""Writes a run as one HTML page: its networks, their shader, and a turntable for browsers without WebGPU."""

from __future__ import annotations

import base64
import hashlib
import html
import io
import json
import re
import zlib
from dataclasses import replace
from importlib import resources
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from voronerf.app.evaluate.panels import picture_of_colour
from voronerf.app.files import write_bytes
from voronerf.app.render.paths import capture_path, resized
from voronerf.app.run import Run
from voronerf.app.web.packing import Packed, pack
from voronerf.nerf.cameras import Cameras

SUFFIXES = (".html",)
#: The turntable: number of frames, milliseconds per frame, and pixels along the longer side.
FRAMES, FRAME, SIDE = 24, 125, 240


def export_web(run: Run, path: Path | str) -> tuple[Packed, int]:
    """Writes a run as a page that draws it in a browser with WebGPU; one file, which loads nothing from elsewhere.

    Args:
        run: The run. It must have one network per cell and an occupancy grid.
        path: File to write, .html.

    Returns:
        The contents of the page, and the size of the file in bytes.

    Raises:
        ConfigError: A page cannot draw the run.
        ValueError: The suffix is not .html.
        OSError: The file cannot be written.

    Examples:
        >>> from voronerf.app import Run
        >>> from voronerf.app.web import export_web
        >>> def size(run: Run) -> int:
        ...     return export_web(run, "scene.html")[1]
    """
    path = Path(path)
    check_page(path)
    packed = pack(run)
    page = page_of(packed, turntable(run)).encode()
    write_bytes(path, page)
    return packed, len(page)


def check_page(path: Path) -> None:
    """Raises ValueError for a suffix other than .html; makes the folder of the page."""
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path}: the file must end in {' or '.join(SUFFIXES)}")
    path.parent.mkdir(parents=True, exist_ok=True)


def page_of(packed: Packed, still: bytes) -> str:
    """Returns the HTML of the page; `still` is the turntable, a WebP picture."""
    style, script = _file("page.css"), _file("renderer.js") + "\n" + _file("page.js")
    # The browser runs only this script and style, even if the name of a run contains HTML.
    policy = (
        f"default-src 'none'; script-src '{_digest(script)}'; style-src '{_digest(style)}'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )
    parts = {
        "policy": policy,
        "title": html.escape(packed.scene["name"]),
        "style": style,
        "still": "data:image/webp;base64," + base64.b64encode(still).decode(),
        "scene": json.dumps(packed.scene).replace("<", "\\u003c"),  # a name cannot end the script element
        "march": packed.shader,
        "screen": _file("screen.wgsl"),
        "data": base64.b64encode(zlib.compress(packed.data)).decode(),
        "script": script,
    }
    # One pass over the template, so that placeholders in an inserted part are not replaced.
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _file("page.html"))


def turntable(run: Run, frames: int = FRAMES) -> bytes:
    """Renders a turntable of the scene as an animated WebP picture; a frame may take a second."""
    scene = run.scene
    cameras = scene.train.cameras
    around = capture_path(cameras, frames, near=scene.near, far=scene.far)
    scale = SIDE / max(around.width, around.height)
    around = resized(around, (max(1, round(scale * around.width)), max(1, round(scale * around.height))))
    grid = run.renderer.occupancy
    if grid is not None and grid.contraction is None:
        around = wide_enough(around, grid.points(grid.occupied.view(-1).nonzero()[:, 0]).cpu())
    first, *others = (
        Image.fromarray(picture_of_colour(run.render(around, number, heaviest=False).colour).numpy())
        for number in range(frames)
    )
    file = io.BytesIO()
    first.save(file, "WEBP", save_all=True, append_images=others, duration=FRAME, loop=0, quality=60)
    return file.getvalue()


def wide_enough(cameras: Cameras, points: Tensor) -> Cameras:
    """Divides focal lengths by the least factor with which all cameras show all points [n, 3], clamped to 1..2."""
    x, y, z = ((points - cameras.origins[:, None]) @ cameras.poses[:, :3, :3]).unbind(-1)  # [frames, n] each
    fx, fy, cx, cy = cameras.intrinsics[:, :, None].unbind(1)
    share = torch.where(z < 0, torch.maximum(x.abs() * fx / cx, y.abs() * fy / cy) / -z, 0).amax()
    intrinsics = cameras.intrinsics.clone()
    intrinsics[:, :2] /= share.clamp(1, 2)
    return replace(cameras, intrinsics=intrinsics)


def _file(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text("utf-8")


def _digest(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
