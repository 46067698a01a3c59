"""Captures with LLFF's `poses_bounds.npy` (Mildenhall et al. 2019), and `images` or `images_N` beside it.

The file has a row for each image, in the order of the images' names. A row begins with a 3 x 5 matrix, whose columns
are the axes down, right and backwards, the position, and height, width and focal length in pixels of `images`. The
smallest and the largest depth of the image's points follow.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.folders import choose_images, listed_images
from voronerf.app.scenes.images import read_header
from voronerf.app.scenes.lenses import PERSPECTIVE, Lens
from voronerf.app.scenes.names import stay_inside
from voronerf.app.scenes.photographs import Reading, View, photograph_scene
from voronerf.app.scenes.scene import Scene
from voronerf.app.scenes.transforms import LARGEST, ORTHONORMAL

FILE = "poses_bounds.npy"
COLUMNS = 17
#: The maximum number of rows in a file, one for each image.
MOST = 1_000_000


def load_llff(folder: Path, reading: Reading) -> Scene:
    """Loads an LLFF capture; every 8th image is held out for testing, see `photograph_scene`."""
    path = folder / FILE
    stay_inside(path, folder, reading.allow_outside)
    rows = _read(path)
    chosen = choose_images(folder, reading.downscale)
    stay_inside(chosen.path, folder, reading.allow_outside)
    files = listed_images(chosen.path)
    if len(files) != len(rows):
        raise SceneError(f"{path}: has poses of {len(rows)} images, {chosen.path} has {len(files)} images")
    headers, views = [], []
    for number, (file, row) in enumerate(zip(files, rows)):
        stay_inside(file, folder, reading.allow_outside)
        matrix, (near, far) = row[:15].reshape(3, 5), row[15:].tolist()
        height, width, focal = matrix[:, 4].tolist()
        pose = np.eye(4)
        pose[:3] = np.stack((matrix[:, 1], -matrix[:, 0], matrix[:, 2], matrix[:, 3]), axis=1)
        turn = pose[:3, :3]
        if np.abs(turn.T @ turn - np.eye(3)).max() > ORTHONORMAL or np.linalg.det(turn) < 0:
            raise SceneError(f"{path}: row {number} is not a pose, its axes are no rotation")
        if not (min(height, width, focal) >= 1 and 0 < near < far):
            actual = ", ".join(f"{value:g}" for value in row[[4, 9, 14, 15, 16]])
            raise SceneError(f"{path}: row {number} must have a size, a focal length and 0 < near < far, got {actual}")
        lens = Lens((focal, focal, width / 2, height / 2), (0.0,) * 8, PERSPECTIVE)
        headers.append(read_header(file))
        views.append(View(file, torch.from_numpy(pose), lens, (width, height), bounds=(near, far), header=headers[-1]))
    about = (f"LLFF's {FILE} of {len(views)} images", *chosen.notes)
    factor = chosen.reduction(headers)
    return photograph_scene(path, folder, views, None, reading, factor=factor, notes=about)


def _read(path: Path) -> np.ndarray:
    try:
        rows = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # the header is Python syntax; parsing may raise any error
        raise SceneError(f"{path}: is not a readable NumPy array: {error!s:.80}") from None
    if not (isinstance(rows, np.ndarray) and rows.ndim == 2 and rows.shape[1] == COLUMNS and 0 < len(rows) <= MOST):
        raise SceneError(
            f"{path}: must have {COLUMNS} numbers for each image, got shape {list(getattr(rows, 'shape', []))}"
        )
    if rows.dtype.kind != "f":
        raise SceneError(f"{path}: must have floating-point numbers, got {rows.dtype}")
    rows = np.array(rows, dtype=np.float64)
    if not (np.abs(rows) <= LARGEST).all():
        raise SceneError(f"{path}: has values that are not finite, or above {LARGEST:.0e}")
    return rows
