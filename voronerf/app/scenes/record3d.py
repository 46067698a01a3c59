"""Record3D's export of a video: `metadata.json`, and `rgb` with an image for each of its poses, named by its number.

`poses` has a quaternion x, y, z, w and a position in metres for each image, y up, with OpenGL's axes; `K` is the matrix
of the camera, column by column, for images of `w` x `h` pixels.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch.nn.functional import normalize

from voronerf.app.render.paths import rotations
from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.folders import listed_images, stay_inside
from voronerf.app.scenes.photographs import Reading, hold_out
from voronerf.app.scenes.polycam import UPRIGHT
from voronerf.app.scenes.scene import Scene
from voronerf.app.scenes.transforms import LARGEST, Frame, Listed, capture_scene, is_number, number, read_object

FILE = "metadata.json"


def find_record3d(folder: Path) -> Path | None:
    """The file, if the folder of images is beside it: others have a file of that name too."""
    return folder / FILE if (folder / FILE).is_file() and (folder / "rgb").is_dir() else None


def load_record3d(folder: Path, reading: Reading) -> Scene:
    """Loads a capture; every 8th image in the order of their numbers is held out for testing.

    Raises:
        SceneError: the file is broken, or an image has no pose.
    """
    path = folder / FILE
    stay_inside(path, folder, reading.allow_outside)
    values = read_object(path)
    poses = _rows(values.get("poses"), 7, f"{path}: poses")
    (matrix,) = _rows([values.get("K")], 9, f"{path}: K")
    images = {}
    for image in listed_images(folder / "rgb"):
        stay_inside(image, folder, reading.allow_outside)
        if image.stem.isdecimal():
            images[int(image.stem)] = image
    if len(images) < 2 or max(images) >= len(poses):
        raise SceneError(
            f"{path}: has poses of {len(poses)} images, rgb has {len(images)}, numbered to {max(images, default=0)}"
        )
    # The principal point is for another orientation in some versions; the middle is what other readers take too.
    entries = {"fl_x": matrix[0], "fl_y": matrix[4], **{key: number(values, key, path) for key in ("w", "h")}}
    listed = [Listed(path, entries, Frame(images[index], _pose(poses[index], path), {})) for index in sorted(images)]
    return capture_scene(folder, listed, hold_out(len(listed)), reading, f"Record3D's {FILE} of {len(listed)} images")


def _rows(rows: Any, each: int, where: str) -> list[list[float]]:
    """Checks that a value of JSON is rows of so many numbers."""
    wanted = isinstance(rows, list) and all(isinstance(row, list) and len(row) == each for row in rows)
    if not wanted or not all(is_number(value) and abs(value) <= LARGEST for row in rows for value in row):
        raise SceneError(f"{where} must be lists of {each} numbers")
    return rows


def _pose(row: list[float], path: Path) -> torch.Tensor:
    x, y, z, w, *position = row
    turn = torch.tensor((w, x, y, z), dtype=torch.float64)
    if not 0.5 < float(turn.norm()) < 2:
        raise SceneError(f"{path}: poses must begin with a quaternion of length 1, got one of {float(turn.norm()):.3g}")
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotations(normalize(turn, dim=0)[None])[0]
    pose[:3, 3] = torch.tensor(position, dtype=torch.float64)
    return UPRIGHT @ pose
