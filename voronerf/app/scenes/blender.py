"""Blender synthetic scenes (Mildenhall et al. 2020): `transforms_train.json`, `transforms_test.json`, RGBA images.

Cameras look at the object, in the usual files from about 4 units away, and the background is white.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import torch

from voronerf.app.scenes.carving import carve_box
from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.images import read_images
from voronerf.app.scenes.photographs import HOLD_OUT, Reading, distinct_names
from voronerf.app.scenes.scene import Scene, Split
from voronerf.app.scenes.transforms import (
    ListedImage,
    capture_scene,
    focal_length,
    has_lens,
    number,
    read_transforms,
    time_notes,
)
from voronerf.nerf.cameras import Cameras, focus_point

log = logging.getLogger(__name__)

#: The usual distances of cameras from the object.
USUAL = (3.0, 5.0)


def load_blender(folder: Path, reading: Reading) -> Scene:
    """Loads a Blender synthetic scene.

    `transforms_test.json` lists the test views, or `transforms_val.json` if the former is missing or has no image.
    If both files are missing, as in exports of BlenderNeRF, every 8th training view is held out. A file with entries
    such as `fl_x`, `cx` or `k1`, which Blender's files do not have, is a capture with a predefined split. It is loaded
    as in `load_transforms`, with this split.

    Returns:
        The scene, with the file's `near` and `far`, or 2 and 6, or half and 1.5 times the distance of the cameras from
        the point they look at, if it is not 3 to 5; and a box carved from the alpha masks of the training views;
        without alpha the box is None. For a capture see `load_transforms`.
    """
    train_file = folder / "transforms_train.json"
    entries, train_frames, notes = read_transforms(train_file, reading.allow_outside)
    train_frames = list({frame.path.resolve(): frame for frame in train_frames}.values())
    test_frames, more = _test_frames(folder, train_frames, reading)
    notes += more
    if not test_frames:
        notes += ("no test images, as in BlenderNeRF's exports: every 8th image is held out",)
        train_frames.sort(key=lambda frame: frame.path.as_posix())
        test_frames = train_frames[::HOLD_OUT]
        train_frames = [frame for number, frame in enumerate(train_frames) if number % HOLD_OUT]
        if not train_frames:
            raise SceneError(f"{train_file}: needs at least two images, since one is held out for testing")

    if has_lens((*train_frames, *test_frames)):
        if "near" in entries or "far" in entries:
            log.warning("%s: near and far are not used, since the scene of a capture is moved and scaled", train_file)
        frames = [*train_frames, *test_frames]
        held_out = torch.arange(len(frames), device="cpu") >= len(train_frames)
        return capture_scene(folder, entries, frames, held_out, reading, notes)

    if reading.kind not in ("auto", "object"):
        raise SceneError(f"{train_file}: --kind must be auto or object for a Blender scene, got {reading.kind}")
    downscale = reading.downscale or 1
    paths = [frame.path for frame in (*train_frames, *test_frames)]
    images, sizes, on_disk, _ = read_images(paths, downscale, keep=reading.images, name=folder.resolve().name)
    count = len(train_frames)
    train = _split(train_frames, images[:count], sizes[:count], downscale, on_disk)
    test = _split(test_frames, images[count:], sizes[count:], downscale, on_disk)
    focus = focus_point(train.cameras)
    distance = 4.0 if focus is None else float((train.cameras.origins - focus).norm(dim=-1).median())
    distance = 4.0 if USUAL[0] <= distance <= USUAL[1] else distance
    near = number(entries, "near", train_file, positive=True) or 0.5 * distance
    far = number(entries, "far", train_file, positive=True) or 1.5 * distance
    if near >= far:
        raise SceneError(f"{train_file}: near must be below far, got {near} and {far}")
    box = carve_box(train.cameras, train.images[..., 3], near, far) if images.shape[-1] == 4 else None
    frames = [*train_frames, *test_frames]
    masks = ("its masks are not used, only the alpha channel",) * any(frame.mask for frame in frames)
    notes = ("Blender scene, an object on white", *notes, *time_notes(frames), *masks)
    name = folder.resolve().name
    return Scene(name=name, train=train, test=test, near=near, far=far, box=box, background="white", notes=notes)


def _test_frames(
    folder: Path, train_frames: Sequence[ListedImage], reading: Reading
) -> tuple[list[ListedImage], tuple[str, ...]]:
    """Returns the test images of `transforms_test.json` or, if it has none, of `transforms_val.json`, and notes.

    Training images in these files are left out, with a warning. The list is empty if neither file has test images.
    """
    training = {frame.path.resolve() for frame in train_frames}
    for name in ("transforms_test.json", "transforms_val.json"):
        if (folder / name).is_file():
            _, frames, notes = read_transforms(folder / name, reading.allow_outside, all_may_miss=True)
            others = [frame for frame in frames if frame.path.resolve() not in training]
            if shared := len(frames) - len(others):
                log.warning("%s: %d of its images are for training, and are not tested", folder / name, shared)
            if others:
                return others, notes
    return [], ()


def _split(
    frames: Sequence[ListedImage], images: torch.Tensor, sizes: torch.Tensor, downscale: int, on_disk: bool
) -> Split:
    path, intrinsics = frames[0].source, []
    for frame, (width, height) in zip(frames, sizes.tolist()):
        focal = focal_length(frame.values, "camera_angle_x", width, path)
        if focal is None:
            raise SceneError(f"{path}: camera_angle_x must be an angle between 0 and pi, got None")
        intrinsics.append((focal, focal, width / 2, height / 2))
    poses = torch.stack([frame.pose for frame in frames]).float()
    cameras = Cameras.of_images(poses, poses.new_tensor(intrinsics), sizes).downscaled(downscale)
    return Split(cameras, images, tuple(distinct_names([frame.path for frame in frames], path.parent)), on_disk=on_disk)
