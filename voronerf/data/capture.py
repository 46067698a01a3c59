"""Real captures: `transforms.json` with intrinsics, lens distortion and poses (instant-ngp, nerfstudio).

Poses are OpenGL's, as everywhere. The scene is moved, turned and scaled: the point that the cameras look at becomes the
origin, their mean up direction the z axis, and the farthest camera is at distance 1.
"""

from __future__ import annotations

import logging
import posixpath
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.data.carving import carve_box
from voronerf.data.images import read_images
from voronerf.data.scene import Scene, SceneError, Split
from voronerf.data.transforms import Frame, distinct_names, focal_length, number, read_transforms
from voronerf.rendering.cameras import Cameras, distort, focus_point, undistort

log = logging.getLogger(__name__)

HOLD_OUT = 8
SPLITS = ("train_filenames", "test_filenames", "val_filenames")
# Near bound as a share of the distance from the focus to the nearest camera; closer things are rarely in focus.
NEAR = 0.35
# Smallest near bound, as a share of the distance of the farthest camera; disparity needs a near bound above 0.
NEAREST = 0.05
FAR = 4.0
PINHOLE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", "OPENCV", "PERSPECTIVE")
LENS = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "distortion_params", "camera_model", "is_fisheye")
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")  # the order of nerfstudio's distortion_params
UNSUPPORTED = ("k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty")


def load_capture(folder: Path, downscale: int, allow_outside: bool = False) -> Scene:
    """Loads a capture; every 8th image in the order of their names is held out for testing.

    Where the file has nerfstudio's `train_filenames`, `test_filenames` or `val_filenames`, they decide instead.
    Validation images are for testing if there are no others, and are else left out.

    Rays of an opaque capture end at four times the distance of the farthest camera and are sampled in disparity. A
    plain network then learns the object and, coarsely, the room. The near bound is 0.35 of the distance to the nearest
    camera and at least 0.05 of that to the farthest one, because cameras that look outwards or in parallel may stand at
    the origin. A capture with alpha is an object on white, in a box carved from the masks.

    Args:
        folder: holds `transforms.json`.
        downscale: factor by which images are reduced.
        allow_outside: also read images that lie outside of the folder.

    Raises:
        SceneError: the file is broken, its lens model is not supported, or it has fewer than two images.
    """
    path = folder / "transforms.json"
    entries, frames = read_transforms(path, allow_outside)
    frames = sorted(frames, key=lambda frame: frame.path.as_posix())
    if len(frames) < 2:
        raise SceneError(f"{path}: one image is too few, one is held out for testing")
    declared = _declared_split(path, entries, frames)
    if declared is None:
        held_out = torch.arange(len(frames)) % HOLD_OUT == 0
    else:
        frames, held_out = declared
    return capture_scene(folder, [Listed(path, entries, frame) for frame in frames], held_out, downscale)


def _declared_split(path: Path, entries: dict[str, Any], frames: list[Frame]) -> tuple[list[Frame], Tensor] | None:
    """The frames that nerfstudio's lists of file names choose, and which are held out; None without such lists.

    Where one list is missing or empty, the images of no other list take its place.
    """
    lists: dict[str, set[str]] = {}
    for key in SPLITS:
        names = entries.get(key)
        if names is not None and not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
            raise SceneError(f"{path}: {key} must be a list of file names, got {names!r:.60}")
        lists[key] = {_plain(name) for name in names or ()}
    every = {_plain(frame["file_path"]) for frame in entries["frames"]}
    for key, names in lists.items():
        if unknown := sorted(names - every):
            raise SceneError(f"{path}: {key} has {unknown[0]}, which is no file_path of a frame")
    train, test, validation = lists.values()
    if not (train or test or validation):
        return None
    test = test or validation
    train, test = train or every - test - validation, test or every - train
    if both := sorted(train & test):
        raise SceneError(f"{path}: train_filenames and the images for testing must differ, both have {both[0]}")
    if unused := len(every - train - test - validation):
        log.warning("%s: %d images are in none of %s and are left out", path, unused, ", ".join(SPLITS))
    names = [_plain(frame.entries["file_path"]) for frame in frames]
    chosen = [(frame, name in test) for frame, name in zip(frames, names) if name in train | test]
    held_out = torch.tensor([held for _, held in chosen], dtype=torch.bool)
    for part, there in (("training", bool((~held_out).any())), ("testing", bool(held_out.any()))):
        if not there:
            raise SceneError(f"{path}: {', '.join(SPLITS)} leave no image for {part}")
    return [frame for frame, _ in chosen], held_out


def _plain(name: str) -> str:
    """A file name in one spelling, so that ./images/a.png is images/a.png."""
    return posixpath.normpath(name.replace("\\", "/"))


class Listed(NamedTuple):
    """A frame, the file that lists it, and the entries of that file, which the frame may override."""

    path: Path
    entries: dict[str, Any]
    frame: Frame


def has_lens(entries: dict[str, Any], frames: Sequence[Frame]) -> bool:
    """Whether a transforms file describes lenses as captures do; Blender's files give the field of view alone."""
    return any(given.get(key) is not None for given in (entries, *(f.entries for f in frames)) for key in LENS)


def capture_scene(folder: Path, listed: Sequence[Listed], held_out: Tensor, downscale: int) -> Scene:
    """Makes the scene of a capture from its frames, see :func:`load_capture`.

    Args:
        folder: of the scene.
        listed: its c images.
        held_out: bool [c], the test views.
        downscale: factor by which images are reduced.

    Raises:
        SceneError: as :func:`load_capture`.
    """
    frames = [entry.frame for entry in listed]
    # Training views first, so that the images of either part are a slice and no copy.
    order = torch.cat(((~held_out).nonzero()[:, 0], held_out.nonzero()[:, 0])).tolist()
    images, size = read_images([frames[index].path for index in order], downscale)
    parts = images.split([int((~held_out).sum()), int(held_out.sum())])

    intrinsics, distortion = [], []
    for path, entries, frame in listed:
        values = {**_named_distortion(entries, path), **_named_distortion(frame.entries, path)}
        _check_lens_model(values, path)
        intrinsics.append(_intrinsics(values, size, path, frame))
        distortion.append([number(values, key, path) or 0.0 for key in ("k1", "k2", "p1", "p2")])
    path = listed[0].path
    bent = torch.tensor(distortion)
    cameras = Cameras(
        normalise_poses(torch.stack([frame.pose for frame in frames])).float(),
        torch.tensor(intrinsics),
        size[0],
        size[1],
        bent if bool(bent.any()) else None,
    )
    _check_lens_inverts(cameras, path)
    cameras = cameras.downscaled(downscale)

    nearest = float(cameras.origins.norm(dim=-1).min())
    near, far, box, spacing, background = max(NEAR * nearest, NEAREST), FAR, None, "disparity", None
    if images.shape[-1] == 4 and bool((images[..., 3] < 255).any()):
        spacing, background = "linear", "white"
        near, far = 0.05 * nearest, 2.0
        box = carve_box(cameras[~held_out], parts[0][..., 3], near, far)
    else:
        parts = tuple(part[..., :3].contiguous() for part in parts)

    names = distinct_names([frame.path for frame in frames], folder)
    return Scene(
        folder.resolve().name,
        _split(cameras, parts[0], names, ~held_out),
        _split(cameras, parts[1], names, held_out),
        near,
        far,
        box,
        spacing,
        background,
    )


def normalise_poses(poses: Tensor) -> Tensor:
    """Moves the cameras' focus to the origin, their mean up direction to +z, and the farthest camera to distance 1.

    Cameras without a common focus (parallel axes, looking outwards) are centred on themselves.

    Args:
        poses: float64 [c, 4, 4].
    """
    cameras = Cameras(poses, torch.ones(len(poses), 4), 1, 1)
    centre = focus_point(cameras)
    if centre is None:
        centre = cameras.origins.mean(0)
    result = poses.clone()
    result[:, :3, 3] -= centre
    up = poses[:, :3, 1].mean(0)
    if up.norm() > 0.1:
        z = up / up.norm()
        spare = torch.eye(3, dtype=poses.dtype)[int(z.abs().argmin())]
        x = torch.nn.functional.normalize(torch.linalg.cross(spare, z), dim=0)
        turn = torch.stack((x, torch.linalg.cross(z, x), z))
        result[:, :3] = turn @ result[:, :3]
    extent = float(result[:, :3, 3].norm(dim=-1).max())
    result[:, :3, 3] /= extent if extent > 0 else 1.0
    return result


def _split(cameras: Cameras, images: Tensor, names: list[str], chosen: Tensor) -> Split:
    kept = tuple(name for name, wanted in zip(names, chosen.tolist()) if wanted)
    return Split(cameras[chosen], images, kept)


def _intrinsics(values: dict[str, Any], size: tuple[int, int], path: Path, frame: Frame) -> list[float]:
    """(fx, fy, cx, cy) in pixels."""
    width, height = size
    for key, actual in (("w", width), ("h", height)):
        stated = number(values, key, path, positive=True)
        if stated is not None and abs(stated - actual) >= 1:  # exporters that scale images may write fractions
            raise SceneError(f"{frame.path}: is {width} x {height} pixels, but {path} says {key} = {stated:g}")
    fx, fy = (
        focal_length(values, f"fl_{axis}", side, path) or focal_length(values, f"camera_angle_{axis}", side, path)
        for axis, side in zip("xy", size)
    )
    if fx is None and fy is None:
        raise SceneError(f"{path}: has no focal length (fl_x or camera_angle_x)")
    fx, fy = fx or fy, fy or fx
    cx, cy = number(values, "cx", path), number(values, "cy", path)
    assert fx is not None and fy is not None
    return [fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy]


def _named_distortion(entries: dict[str, Any], path: Path) -> dict[str, Any]:
    """The entries with k1, k2... in the place of nerfstudio's distortion_params."""
    given = entries.get("distortion_params")
    if given is None or given == []:
        return entries
    if not isinstance(given, list) or len(given) != len(DISTORTION):
        raise SceneError(f"{path}: distortion_params must be six numbers, {', '.join(DISTORTION)}, got {given!r:.60}")
    return {**entries, **dict(zip(DISTORTION, given))}


def _check_lens_model(values: dict[str, Any], path: Path) -> None:
    model = values.get("camera_model", "OPENCV")
    if values.get("is_fisheye") or model not in PINHOLE_MODELS:
        name = "fisheye" if values.get("is_fisheye") else model
        raise SceneError(f"{path}: camera model {name!s:.60} is not supported, only {', '.join(PINHOLE_MODELS)}")
    used = [key for key in UNSUPPORTED if number(values, key, path)]
    if used:
        raise SceneError(f"{path}: lens distortion {', '.join(used)} is not supported, only k1, k2, p1, p2")


def _check_lens_inverts(cameras: Cameras, path: Path) -> None:
    """Checks that every pixel of the border has a ray; a lens model that folds over inside the image has none there."""
    if cameras.distortion is None:
        return
    edge = torch.linspace(0, 1, 33, dtype=torch.float64)
    x = torch.cat((edge, edge, torch.zeros(33), torch.ones(33)))[None] * cameras.width
    y = torch.cat((torch.zeros(33), torch.ones(33), edge, edge))[None] * cameras.height
    fx, fy, cx, cy = cameras.intrinsics.double()[:, :, None].unbind(1)
    coefficients = cameras.distortion.double()[:, None, :]
    u, v = (x - cx) / fx, (y - cy) / fy
    again, and_again = distort(*undistort(u, v, coefficients), coefficients)
    error = torch.maximum((again - u).abs() * fx, (and_again - v).abs() * fy)
    if not bool((error < 1e-3).all()):
        raise SceneError(f"{path}: the lens distortion k1, k2, p1, p2 cannot be inverted inside the image")
