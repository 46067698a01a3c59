"""Raw data of Polycam: `keyframes/images` with a JSON for each image in `keyframes/cameras`.

The JSON has `fx`, `fy`, `cx`, `cy`, `width`, `height` in pixels and `t_00` to `t_23`, the rows of the pose in metres, y
up, with OpenGL's axes. Where Polycam has refined its cameras, `corrected_images` and `corrected_cameras` are read.
"""

from __future__ import annotations

from pathlib import Path

import torch

from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.folders import listed_images, stay_inside
from voronerf.app.scenes.photographs import Reading, hold_out
from voronerf.app.scenes.scene import Scene
from voronerf.app.scenes.transforms import Frame, Listed, capture_scene, pose_of, read_object

NAMES = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy", "w": "width", "h": "height"}
#: From y up to z up.
UPRIGHT = torch.tensor([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)


def find_polycam(folder: Path) -> Path | None:
    """The folder of cameras, or None."""
    places = [folder / "keyframes" / name for name in ("corrected_cameras", "cameras")]
    return next((place for place in places if place.is_dir()), None)


def load_polycam(folder: Path, reading: Reading) -> Scene:
    """Loads a capture; every 8th image in the order of their names is held out for testing.

    Raises:
        SceneError: no image has a camera, or a file is broken.
    """
    cameras = find_polycam(folder)
    assert cameras is not None
    images = cameras.with_name(cameras.name.replace("cameras", "images"))
    if not images.is_dir():
        raise SceneError(f"{images}: there is no such folder")
    listed = []
    for image in listed_images(images):
        path = cameras / f"{image.stem}.json"
        for file in (image, path):
            stay_inside(file, folder, reading.allow_outside)
        if path.is_file():
            listed.append(_read(path, image))
    if len(listed) < 2:
        raise SceneError(f"{cameras}: has cameras of {len(listed)} images of {images}, there must be at least two")
    refined = "as Polycam refined them" if cameras.name.startswith("corrected") else "as the phone tracked them"
    about = f"Polycam's cameras of {len(listed)} images, {refined}"
    return capture_scene(folder, listed, hold_out(len(listed)), reading, about)


def _read(path: Path, image: Path) -> Listed:
    values = read_object(path)
    rows = [[values.get(f"t_{row}{column}") for column in range(4)] for row in range(3)]
    entries = {key: values.get(name) for key, name in NAMES.items()}
    return Listed(path, {}, Frame(image, UPRIGHT @ pose_of(rows, str(path), "t_00 to t_23"), entries))
