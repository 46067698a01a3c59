"""Captures as `transforms.json`, with intrinsics, lens distortion and poses (instant-ngp, nerfstudio).

Blender's `transforms_*.json` store frames, poses and numeric entries in the same format. Poses have OpenGL's axes, as
everywhere in voronerf.
"""

from __future__ import annotations

import json
import logging
import math
import os
import posixpath
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from voronerf.app.files import read_json, write_text
from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.folders import stay_inside
from voronerf.app.scenes.images import Header, read_header
from voronerf.app.scenes.lenses import COEFFICIENTS, EQUIRECTANGULAR, FISHEYE, FOV, PERSPECTIVE, Lens
from voronerf.app.scenes.photographs import ROUNDED, Reading, View, least_factor, photograph_scene
from voronerf.app.scenes.scene import Scene

log = logging.getLogger(__name__)

SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG")
ORTHONORMAL = 2e-3
#: The largest magnitude of a number in a file; its inverse is the smallest value of a number that must be positive.
#: Then float32 can represent the squares of these numbers.
LARGEST = 1e9
#: The largest focal length in units of the image's side; its inverse is the smallest one. The fields of view are then
#: 0.06 to 179.9 degrees.
LONGEST = 1000
SPLITS = ("train_filenames", "test_filenames", "val_filenames")
PERSPECTIVE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", "OPENCV", "PERSPECTIVE")
FISHEYE_MODELS = ("OPENCV_FISHEYE",)
MODELS = (*PERSPECTIVE_MODELS, *FISHEYE_MODELS, "EQUIRECTANGULAR")
#: Entries of instant-ngp that change rays in ways that `Cameras` does not support.
OTHER_RAYS = ("orthographic", "from_mitsuba", *(f"ftheta_p{power}" for power in range(5)))
LENS = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "distortion_params", "camera_model", "is_fisheye")
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")  # the order of nerfstudio's distortion_params
UNSUPPORTED = ("k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty")
#: The supported distortion coefficients of each lens model, and the words that name the model in error messages.
KNOWN = {
    # In nerfstudio, k4 of a perspective camera is the coefficient of r^8; in OpenCV, k4 belongs to the divisor.
    PERSPECTIVE: (("k1", "k2", "k3", "p1", "p2"), ""),
    FISHEYE: (("k1", "k2", "k3", "k4"), " of a fisheye"),
    EQUIRECTANGULAR: ((), " of an EQUIRECTANGULAR image"),
}


class ListedImage(NamedTuple):
    """An image of a transforms file.

    Attributes:
        path: the image file.
        pose: float64 [4, 4], camera to world.
        source: the transforms file.
        values: the entries of the image's frame, and the file's entries that the frame lacks.
        mask: the mask file, or None.
    """

    path: Path
    pose: Tensor
    source: Path
    values: dict[str, Any]
    mask: Path | None = None


def read_transforms(
    path: Path, allow_outside: bool = False, *, all_may_miss: bool = False
) -> tuple[dict[str, Any], list[ListedImage]]:
    """Reads a transforms file and finds its images.

    Listed images that are missing are left out, with a warning that tells their number. It is an error if all images
    are missing, unless ``all_may_miss`` is set.

    Returns:
        (the file's entries, the frames with an existing image, in the file's order).
    """
    try:
        entries = read_json(path)
    except ValueError as error:
        raise SceneError(str(error)) from None
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}") from None
    frames = entries.get("frames") if isinstance(entries, dict) else None
    if not isinstance(frames, list) or not (frames or all_may_miss):
        raise SceneError(f"{path}: has no frames")
    shared = _named_distortion(entries, path)
    present = []
    for position, frame in enumerate(frames):
        name = frame.get("file_path") if isinstance(frame, dict) else None
        if not isinstance(name, str) or "\0" in name:
            raise SceneError(f"{path}: frame {position} has no file_path")
        if not is_text(name):
            raise SceneError(f"{path}: frame {position}: file_path must be text without surrogates, got {name!r:.60}")
        where = f"{path}: frame {position} ({name})"
        pose = pose_of(frame.get("transform_matrix"), where)
        image = _find_image(path.parent, name, allow_outside, where)
        if image is not None:
            mask = _mask(path.parent, frame.get("mask_path"), allow_outside, where)
            present.append(ListedImage(image, pose, path, {**shared, **_named_distortion(frame, path)}, mask))
    if not present and not all_may_miss:
        raise SceneError(
            f"{path}: none of its {len(frames)} images exists, the first is {path.parent / frames[0]['file_path']}"
        )
    missing = len(frames) - len(present)
    if missing and present:
        log.warning("%s: %d of %d listed images are missing and are skipped", path, missing, len(frames))
    return entries, present


def number(entries: dict[str, Any], key: str, path: Path, *, positive: bool = False) -> float | None:
    """Returns a finite number of a transforms file; None if the entry is missing."""
    value = entries.get(key)
    if value is None:
        return None
    # The comparisons work for integers of any size, and fail for NaN.
    if not is_number(value) or not abs(value) <= LARGEST:
        raise SceneError(f"{path}: {key} must be a finite number up to {LARGEST:.0e}, got {value!r:.60}")
    if positive and not value >= 1 / LARGEST:
        raise SceneError(f"{path}: {key} must be positive, got {value!r}")
    return float(value)


def is_number(value: object) -> bool:
    """Returns whether a JSON value is a number; Python's bool, a subclass of int, is not."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def focal_length(entries: dict[str, Any], key: str, side: float, path: Path) -> float | None:
    """Returns a focal length in pixels, from its entry or from an angle of view; None if the entry is missing.

    Args:
        entries: entries of the file or a frame.
        key: "fl_x" or "fl_y", "camera_angle_x" or "camera_angle_y".
        side: pixels of the image along that axis.
        path: the file, for error messages.
    """
    value = number(entries, key, path, positive=True)
    if value is None:
        return None
    if key.startswith("camera_angle"):
        if value >= math.pi:
            raise SceneError(f"{path}: {key} must be an angle between 0 and pi, got {value}")
        focal = 0.5 * side / math.tan(0.5 * value)
    else:
        focal = value
    if not 1 / LONGEST <= focal / side <= LONGEST:
        raise SceneError(
            f"{path}: {key} must give a focal length of {1 / LONGEST:g} to {LONGEST} times the {side:g} pixels of the "
            f"image, got {value:g}"
        )
    return focal


def is_text(name: str) -> bool:
    """Returns whether a name has no lone surrogates, which JSON allows but file names do not."""
    return not any("\ud800" <= char <= "\udfff" for char in name)


def _find_image(folder: Path, name: str, allow_outside: bool, where: str) -> Path | None:
    """Finds an image file; Blender's files lack the suffix, and files from Windows may have backslashes."""
    for spelling in dict.fromkeys((name, name.replace("\\", "/"))):
        for suffix in SUFFIXES:
            path = Path(f"{folder / spelling}{suffix}")
            stay_inside(path, folder, allow_outside, f"{where}: file_path")
            if os.path.isfile(path):
                return path
    return None


def _mask(folder: Path, name: object, allow_outside: bool, where: str) -> Path | None:
    """Returns the mask file of a frame; None if the frame has no mask."""
    if name is None:
        return None
    if not isinstance(name, str) or "\0" in name or not is_text(name):
        raise SceneError(f"{where}: mask_path must be a file name, got {name!r:.60}")
    mask = folder / name.replace("\\", "/")
    stay_inside(mask, folder, allow_outside, f"{where}: mask_path")
    if not mask.is_file():
        raise SceneError(f"{where}: its mask {mask} does not exist")
    return mask


def pose_of(matrix: object, where: str, key: str = "transform_matrix") -> Tensor:
    """Returns a pose float64 [4, 4], after checking that ``matrix`` is a rigid motion, 4 x 4 or 3 x 4."""
    rows = matrix if isinstance(matrix, list) else [None]
    try:
        if not all(isinstance(row, list) and all(map(is_number, row)) for row in rows):
            raise TypeError
        values = np.array(rows, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise SceneError(f"{where}: {key} is not a matrix of numbers") from None
    if values.shape not in ((4, 4), (3, 4)):
        raise SceneError(f"{where}: {key} must be 4 x 4, got shape {list(values.shape)}")
    if not (np.abs(values) <= LARGEST).all():
        raise SceneError(f"{where}: {key} has values that are not finite, or above {LARGEST:.0e}")
    rotation = values[:3, :3]
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if error > ORTHONORMAL or np.linalg.det(rotation) < 0:
        raise SceneError(
            f"{where}: {key} is not a pose, its upper left 3 x 3 is not a rotation "
            f"(determinant {np.linalg.det(rotation):.3g}, off orthonormal by {error:.2g})"
        )
    if values.shape[0] == 4 and np.abs(values[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise SceneError(f"{where}: {key} is not a pose, its last row must be 0 0 0 1")
    pose = np.eye(4)
    pose[:3] = values[:3]
    return torch.from_numpy(pose)


def load_transforms(folder: Path, reading: Reading) -> Scene:
    """Loads a capture; every 8th image in the order of names is held out for testing.

    If the file has nerfstudio's `train_filenames`, `test_filenames` or `val_filenames`, these lists decide instead.
    Validation images are used for testing if there are no test images; otherwise they are left out.
    """
    path = folder / "transforms.json"
    entries, frames = read_transforms(path, reading.allow_outside)
    frames = sorted(frames, key=lambda frame: frame.path.as_posix())
    if len(frames) < 2:
        raise SceneError(f"{path}: needs at least two images, since one is held out for testing")
    declared = _declared_split(path, entries, frames)
    frames, held_out = (frames, None) if declared is None else declared
    return capture_scene(folder, entries, frames, held_out, reading)


def _declared_split(
    path: Path, entries: dict[str, Any], frames: list[ListedImage]
) -> tuple[list[ListedImage], Tensor] | None:
    """Returns the frames in nerfstudio's lists of file names, and bool held_out; None if the file has no lists.

    An empty or missing list is filled with the images that are in no other list.
    """
    lists: dict[str, set[str]] = {}
    for key in SPLITS:
        names = entries.get(key)
        if names is not None and not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
            raise SceneError(f"{path}: {key} must be a list of file names, got {names!r:.60}")
        lists[key] = {_plain(name) for name in names or ()}
    all_names = {_plain(frame["file_path"]) for frame in entries["frames"]}
    for key, names in lists.items():
        if unknown := sorted(names - all_names):
            raise SceneError(f"{path}: {key} lists {unknown[0]}, but no frame has this file_path")
    train, test, validation = lists.values()
    if not (train or test or validation):
        return None
    test = test or validation
    train, test = train or all_names - test - validation, test or all_names - train
    if shared := sorted(train & test):
        raise SceneError(f"{path}: train_filenames and the images for testing must differ, both have {shared[0]}")
    if unused := len(all_names - train - test - validation):
        log.warning("%s: %d images are in none of %s and are left out", path, unused, ", ".join(SPLITS))
    names = [_plain(frame.values["file_path"]) for frame in frames]
    chosen = [(frame, name in test) for frame, name in zip(frames, names) if name in train | test]
    held_out = torch.tensor([held for _, held in chosen], dtype=torch.bool, device="cpu")
    for part, present in (("training", bool((~held_out).any())), ("testing", bool(held_out.any()))):
        if not present:
            raise SceneError(f"{path}: {', '.join(SPLITS)} leave no image for {part}")
    return [frame for frame, _ in chosen], held_out


def _plain(name: str) -> str:
    """Returns a normalised file name, so that ./images/a.png equals images/a.png."""
    return posixpath.normpath(name.replace("\\", "/"))


def has_lens(frames: Sequence[ListedImage]) -> bool:
    """Returns whether any frame has lens entries, as in captures; Blender's files have only the field of view."""
    flags = ("latlong", "fisheye_crop_radius", *OTHER_RAYS)
    return any(
        any(frame.values.get(key) is not None for key in LENS) or any(frame.values.get(key) for key in flags)
        for frame in frames
    )


def capture_scene(
    folder: Path,
    entries: dict[str, Any],
    frames: Sequence[ListedImage],
    held_out: Tensor | None,
    reading: Reading,
    notes: Sequence[str] = (),
) -> Scene:
    """Makes the scene of a capture from its frames, see `load_transforms`."""
    path = frames[0].source
    notes = [f"{path.name} of {len(frames)} images", *notes]
    if any(frame.values.get("depth_file_path") is not None for frame in frames):
        notes.append("its depth images are not used")
    applied = entries.get("applied_transform")
    transform = (
        torch.eye(4, dtype=torch.float64, device="cpu")
        if applied is None
        else pose_of(applied, str(path), "applied_transform")
    )
    transform[:3] *= number(entries, "applied_scale", path, positive=True) or 1.0
    headers = [read_header(frame.path) for frame in frames]
    views = [_view(frame, header) for frame, header in zip(frames, headers)]
    scaled = [(*header.size, path.name, *view.size) for view, header in zip(views, headers) if view.size != header.size]
    if scaled:
        sizes = "{} x {} pixels, where {} says {:g} x {:g}".format(*scaled[0])
        notes.append(f"images have {sizes}: their lenses are scaled")
    factor = reading.downscale or least_factor(max(max(header.size) for header in headers))
    return photograph_scene(path, folder, views, held_out, reading, factor=factor, notes=notes, transform=transform)


def _view(frame: ListedImage, header: Header) -> View:
    """Returns the view of a frame, with its lens; raises SceneError for an unsupported lens or distortion."""
    values, path = frame.values, frame.source
    model = values.get("camera_model", "OPENCV")
    if model not in MODELS:
        raise SceneError(f"{path}: camera model {model!s:.60} is not supported, only {', '.join(MODELS)}")
    if other := [key for key in OTHER_RAYS if values.get(key)]:
        raise SceneError(f"{path}: {other[0]} is not supported, only lenses that are {', '.join(MODELS)}")
    kind = FISHEYE if model in FISHEYE_MODELS or bool(values.get("is_fisheye")) else PERSPECTIVE
    kind = EQUIRECTANGULAR if model == "EQUIRECTANGULAR" or values.get("latlong") else kind
    supported, of_lens = KNOWN[kind]
    if unsupported := [key for key in DISTORTION + UNSUPPORTED if key not in supported and number(values, key, path)]:
        only = f"only {', '.join(supported)}{of_lens}" if supported else f"there is none{of_lens}"
        raise SceneError(f"{path}: lens distortion {', '.join(unsupported)} is not supported, {only}")
    width, height = size = _lens_size(frame, header.size)
    if kind == EQUIRECTANGULAR:  # nerfstudio writes half of the width as fl_x, which is ignored
        if width != 2 * height:
            raise SceneError(f"{frame.path}: an EQUIRECTANGULAR image must be 2 to 1, got {width} x {height} pixels")
        scale = height / math.pi
        lens = Lens((scale, scale, width / 2, height / 2), 8 * (0.0,), kind)
        return View(frame.path, frame.pose, lens, size, frame.mask, header=header)
    fx, fy = (
        focal_length(values, f"fl_{axis}", side, path) or focal_length(values, f"camera_angle_{axis}", side, path)
        for axis, side in zip("xy", size)
    )
    if fx is None and fy is None:
        raise SceneError(f"{path}: has no focal length (fl_x or camera_angle_x)")
    cx, cy = number(values, "cx", path), number(values, "cy", path)
    intrinsics = (fx or fy or 0, fy or fx or 0, width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    distortion = {key: number(values, key, path) or 0.0 for key in DISTORTION}
    lens = Lens(intrinsics, tuple(distortion.get(key, 0.0) for key in COEFFICIENTS[kind]), kind)
    circle = number(values, "fisheye_crop_radius", path, positive=True)
    return View(frame.path, frame.pose, lens, size, frame.mask, header=header, circle=circle)


def _lens_size(frame: ListedImage, size: tuple[int, int]) -> tuple[float, float]:
    """Returns the (width, height) to which a frame's lens refers, for an image file of ``size``.

    This is ``size`` or, if the image was scaled after its lens was calibrated, ``w`` and ``h`` of the frame, which must
    have the same aspect ratio.
    """
    stated = [number(frame.values, key, frame.source, positive=True) for key in ("w", "h")]
    # Exporters that scale images may write fractional sizes.
    wrong = [key for key, want, got in zip("wh", stated, size) if want is not None and abs(want - got) >= 1]
    w, h = stated
    if not wrong:
        return size
    cropped = w is not None and abs(size[0] - w) <= ROUNDED
    if cropped or w is None or h is None or abs(size[0] / w - size[1] / h) * max(w, h) > ROUNDED:
        says = " and ".join(f"{key} = {want:g}" for key, want in zip("wh", stated) if want is not None)
        raise SceneError(f"{frame.path}: is {size[0]} x {size[1]} pixels, but {frame.source} says {says}")
    return w, h


def _named_distortion(entries: dict[str, Any], path: Path) -> dict[str, Any]:
    """Returns the entries with nerfstudio's distortion_params, if any, as k1, k2, ..."""
    numbers = entries.get("distortion_params")
    if numbers is None or numbers == []:
        return entries
    if not isinstance(numbers, list) or len(numbers) != len(DISTORTION):
        raise SceneError(f"{path}: distortion_params must be six numbers, {', '.join(DISTORTION)}, got {numbers!r:.60}")
    return {**entries, **dict(zip(DISTORTION, numbers))}


class Shot(NamedTuple):
    """An image to write: its file, its pose [4, 4], its lens, its width and height, and its mask file, or ""."""

    file: str
    pose: Tensor
    lens: Lens
    width: int
    height: int
    mask: str = ""


def write_transforms(path: Path, shots: Sequence[Shot]) -> None:
    """Writes cameras in the format of nerfstudio and instant-ngp."""
    frames = []
    for shot in shots:
        (fx, fy, cx, cy), coefficients, model = shot.lens
        values = {name: value for name, value in zip(COEFFICIENTS[model], coefficients) if value}
        supported = ("k1", "k2", "k3", "k4") if model == FISHEYE else ("k1", "k2", "p1", "p2", "k3")
        if model in (FOV, EQUIRECTANGULAR) or not values.keys() <= set(supported):
            raise SceneError(f"{path}: transforms.json cannot describe the lens of {shot.file}")
        lens = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": shot.width, "h": shot.height}
        lens |= {name: values.get(name, 0.0) for name in supported}
        kind = {"camera_model": "OPENCV_FISHEYE" if model == FISHEYE else "OPENCV"}
        mask = {"mask_path": shot.mask} if shot.mask else {}
        frames.append({"file_path": shot.file, **mask, "transform_matrix": shot.pose.tolist(), **lens, **kind})
    shared = {key: value for key, value in frames[0].items() if all(frame.get(key) == value for frame in frames)}
    rest = [{key: value for key, value in frame.items() if key not in shared} for frame in frames]
    write_text(path, json.dumps({**shared, "frames": rest}, indent=1))
