"""Captures as `transforms.json`, with intrinsics, lens distortion and poses (instant-ngp, nerfstudio).

Blender's `transforms_*.json` store frames, poses and numeric entries in the same format. Poses have OpenGL's axes, as
everywhere in voronerf.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from voronerf.app.files import leads_outside, read_json, write_text
from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.folders import find_files, none_exists
from voronerf.app.scenes.images import Header, read_header
from voronerf.app.scenes.lenses import COEFFICIENTS, EQUIRECTANGULAR, FISHEYE, FOV, PERSPECTIVE, Lens
from voronerf.app.scenes.names import SUFFIX, has_masks, plain, split_by_lists, stay_inside
from voronerf.app.scenes.photographs import (
    CROPPED,
    ROUNDED,
    Reading,
    View,
    least_factor,
    photograph_scene,
    stored_views,
)
from voronerf.app.scenes.scene import Scene
from voronerf.app.scenes.soundness import some_of

log = logging.getLogger(__name__)

SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG")
#: Tolerance of a rotation times its transpose against the identity, and of a pose's last row against 0 0 0 1.
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


class Listing(NamedTuple):
    """The contents of a transforms file: its entries, its frames with a pose and an image, and lines for the user."""

    entries: dict[str, Any]
    frames: list[ListedImage]
    notes: tuple[str, ...]


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


def read_transforms(path: Path, allow_outside: bool = False, *, all_may_miss: bool = False) -> Listing:
    """Reads a transforms file and finds its images, see `find_files`.

    Listed images that are missing are left out, with a warning that tells their number; if all are missing, it is an
    error unless ``all_may_miss`` is set. Frames without a pose are left out, with a note; if all frames lack a pose, it
    is an error. The frames stay in the file's order.
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
    folder, where = path.parent, []
    for position, frame in enumerate(frames):
        name = frame.get("file_path") if isinstance(frame, dict) else None
        if not isinstance(name, str) or "\0" in name:
            raise SceneError(f"{path}: frame {position} has no file_path")
        if not is_text(name):
            raise SceneError(f"{path}: frame {position}: file_path must be text without surrogates, got {name!r:.60}")
        where.append(f"{path}: frame {position} ({name})")
    matrices = [frame.get("transform_matrix") for frame in frames]
    lost = [_is_unknown(matrix) for matrix in matrices]
    if all(lost):
        lost = [False] * len(frames)  # the error for the first of them follows
    poses = [None if unknown else _scaled_pose(matrix, name) for matrix, name, unknown in zip(matrices, where, lost)]
    names = [plain(frame["file_path"]) for frame in frames]
    exact = {name: file for frame, name in zip(frames, names) if (file := _exact_file(folder, frame["file_path"]))}
    inside = {name: file for name, file in exact.items() if allow_outside or not leads_outside(file, folder)}
    split = path.name != "transforms.json"  # otherwise a missing test/r_0.png might be taken for train/r_0.png
    files = find_files(path, folder, names, inside, of_one_folder=split)
    images = [files.get(name) for name in names]
    for image, name, text in zip(images, names, where):  # a copy inside of the folder replaces a file outside
        if file := image or exact.get(name):
            stay_inside(file, folder, allow_outside, f"{text}: file_path")
    if not any(images) and not all_may_miss:
        raise none_exists(path, folder, [frame["file_path"] for frame in frames])
    views = [
        (frame, name, image, pose[0])
        for frame, name, image, pose in zip(frames, where, images, poses)
        if image is not None and pose is not None
    ]
    masks = _find_masks(path, [view[:2] for view in views], [*files.values()], allow_outside)
    present = [
        ListedImage(image, pose, path, {**shared, **_named_distortion(frame, path)}, mask)
        for (frame, _, image, pose), mask in zip(views, masks)
    ]
    missing = images.count(None)
    if missing and present:
        log.warning("%s: %d of %d listed images are missing and are skipped", path, missing, len(frames))
    notes = []
    if files and not inside:
        name = next(name for name in names if name in files)
        notes.append(f"no image exists as it is named: {name} is {files[name].relative_to(folder)}, and so on")
    if any(lost):
        without = some_of([names[place] for place, unknown in enumerate(lost) if unknown])
        notes.append(f"{sum(lost)} of {len(frames)} frames have no pose and are left out: {without}")
    if scales := [pose[1] for pose in poses if pose is not None and pose[1] != 1]:
        length = " to ".join(dict.fromkeys(f"{scale:.4g}" for scale in (min(scales), max(scales))))
        notes.append(f"the axes of {len(scales)} of {len(frames)} poses have length {length}, and are scaled to 1")
    return Listing(entries, present, tuple(notes))


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


def _exact_file(folder: Path, name: str) -> Path | None:
    """Returns the file of a name, or None; Blender's names lack a suffix, and names from Windows have backslashes."""
    spellings = dict.fromkeys((name, name.replace("\\", "/")))
    suffixes = SUFFIXES[:1] if SUFFIX.search(name) else SUFFIXES  # 0.jpg.png is a mask of 0.jpg
    paths = (Path(f"{folder / spelling}{suffix}") for spelling in spellings for suffix in suffixes)
    return next((path for path in paths if os.path.isfile(path)), None)


def _find_masks(
    source: Path, frames: Sequence[tuple[dict[str, Any], str]], images: Sequence[Path], allow_outside: bool
) -> list[Path | None]:
    """Returns the mask file of each frame; None if the frame has no mask.

    Args:
        source: the transforms file.
        frames: each frame, and its name for error messages.
        images: the image files, which are not taken as masks.
        allow_outside: whether masks may lie outside of the scene's folder.
    """
    folder, exact, names = source.parent, dict[str, Path](), []
    for frame, where in frames:
        name = frame.get("mask_path")
        if name is not None and (not isinstance(name, str) or "\0" in name or not is_text(name)):
            raise SceneError(f"{where}: mask_path must be a file name, got {name!r:.60}")
        names.append(None if name is None else plain(name))
        if name is not None and os.path.isfile(file := folder / name.replace("\\", "/")):
            stay_inside(file, folder, allow_outside, f"{where}: mask_path")
            exact[plain(name)] = file
    listed = [name for name in names if name is not None]
    files = (
        find_files(source, folder, listed, exact, of_one_folder=False, accepts=has_masks, but=images) if listed else {}
    )
    for (_, where), name in zip(frames, names):
        if name is not None:
            file = files.get(name, folder / name)
            stay_inside(file, folder, allow_outside, f"{where}: mask_path")
            if name not in files:
                raise SceneError(f"{where}: its mask {file} does not exist")
    return [None if name is None else files[name] for name in names]


def _is_unknown(matrix: object) -> bool:
    """Returns whether a pose is missing, or has entries that are null or not finite, as for an unknown camera."""
    rows = matrix if isinstance(matrix, list) else []
    values = [value for row in rows for value in (row if isinstance(row, list) else ())]
    return matrix is None or any(
        value is None or (isinstance(value, float) and not math.isfinite(value)) for value in values
    )


def pose_of(matrix: object, where: str, key: str) -> Tensor:
    """Returns a pose float64 [4, 4], after checking that ``matrix`` is a rigid motion, 4 x 4 or 3 x 4."""
    return _checked_pose(_matrix_of(matrix, where, key), where, key)


def _scaled_pose(matrix: object, where: str) -> tuple[Tensor, float]:
    """Returns the pose [4, 4] of a frame with axes of length 1, and the length of the axes in the file.

    Blender writes the scale of a camera into its pose. The length is 1 for a pose that needs no change.
    """
    key = "transform_matrix"
    values = _matrix_of(matrix, where, key)
    gram = values[:3, :3].T @ values[:3, :3]
    length = float(np.trace(gram) / 3) ** 0.5
    if np.abs(gram - np.eye(3)).max() <= ORTHONORMAL or not 1 / LARGEST <= length <= LARGEST:
        return _checked_pose(values, where, key), 1.0
    scaled = values.copy()
    scaled[:3, :3] /= length
    if np.abs(gram / length**2 - np.eye(3)).max() > ORTHONORMAL:
        return _checked_pose(values, where, key), 1.0
    return _checked_pose(scaled, where, key), length


def _matrix_of(matrix: object, where: str, key: str) -> NDArray[np.float64]:
    """Returns a float64 matrix, after checking that it has numbers of a sensible size and the shape of a pose."""
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
    return values


def _checked_pose(values: NDArray[np.float64], where: str, key: str) -> Tensor:
    """Returns a pose float64 [4, 4], after checking that ``values`` is a rigid motion, 4 x 4 or 3 x 4."""
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
    entries, frames, notes = read_transforms(path, reading.allow_outside)
    frames = sorted(frames, key=lambda frame: frame.path.as_posix())
    if len(frames) < 2:
        raise SceneError(f"{path}: needs at least two images, since one is held out for testing")
    declared = _declared_split(path, entries, frames)
    frames, held_out = (frames, None) if declared is None else declared
    return capture_scene(folder, entries, frames, held_out, reading, notes)


def _declared_split(
    path: Path, entries: dict[str, Any], frames: list[ListedImage]
) -> tuple[list[ListedImage], Tensor] | None:
    """Returns the frames in nerfstudio's lists of file names, and bool held_out; None if the file has no lists.

    See `split_by_lists`.
    """
    lists: dict[str, set[str]] = {}
    for key in SPLITS:
        names = entries.get(key)
        if names is not None and not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
            raise SceneError(f"{path}: {key} must be a list of file names, got {names!r:.60}")
        lists[key] = {plain(name) for name in names or ()}
    all_names = {plain(frame["file_path"]) for frame in entries["frames"]}
    for key, names in lists.items():
        if unknown := sorted(names - all_names):
            raise SceneError(f"{path}: {key} lists {unknown[0]}, but no frame has this file_path")
    present = [plain(frame.values["file_path"]) for frame in frames]
    split = split_by_lists(path, SPLITS, list(lists.values()), present, all_names)
    if split is None:
        return None
    chosen, held_out, unused = split
    if unused:
        log.warning("%s: %d images are in none of %s and are left out", path, unused, ", ".join(SPLITS))
    return [frames[place] for place in chosen], held_out


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
    notes += time_notes(frames)
    transform = _applied(entries, path)
    headers = [read_header(frame.path) for frame in frames]
    views = [_view(frame, header) for frame, header in zip(frames, headers)]
    scaled = [
        (*header.size, path.name, *view.size)
        for view, header in zip(views, headers)
        if view.size not in (header.size, header.size[::-1])
    ]
    if scaled:
        sizes = "{} x {} pixels, where {} says {:g} x {:g}".format(*scaled[0])
        notes.append(f"images have {sizes}: their lenses are scaled")
    factor = reading.downscale or least_factor(max(max(header.size) for header in headers))
    return photograph_scene(path, folder, views, held_out, reading, factor=factor, notes=notes, transform=transform)


def _applied(entries: dict[str, Any], path: Path) -> Tensor:
    """Returns the transform float64 [4, 4] from nerfstudio's original coordinates to the coordinates of the poses."""
    matrix = entries.get("applied_transform")
    transform = pose_of(np.eye(4).tolist() if matrix is None else matrix, str(path), "applied_transform")
    transform[:3] *= number(entries, "applied_scale", path, positive=True) or 1.0
    return transform


def time_notes(frames: Sequence[ListedImage]) -> list[str]:
    """Returns a line on times that differ between frames, as of D-NeRF's moving scenes; [] without such times."""
    times = {time for frame in frames if is_number(time := frame.values.get("time"))}
    return ["its times are not used: the scene is taken as still"] if len(times) > 1 else []


def _view(frame: ListedImage, header: Header) -> View:
    """Returns the view of a frame, with its lens; raises SceneError for an unsupported lens or distortion."""
    values, path = frame.values, frame.source
    model = values.get("camera_model") or "OPENCV"
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
    width, height = size = _lens_size(frame, header)
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


def _lens_size(frame: ListedImage, header: Header) -> tuple[float, float]:
    """Returns the (width, height) to which a frame's lens refers.

    This is the size of the image file or, if the image was scaled after its lens was calibrated, ``w`` and ``h`` of the
    frame, which must have the same aspect ratio. If only the image that its orientation tag turns upright fits ``w``
    and ``h``, the lens refers to that image.
    """
    stated = [number(frame.values, key, frame.source, positive=True) for key in ("w", "h")]
    w, h = stated
    for size in (header.size, header.size[::-1])[: 1 + header.turns % 2]:
        # Exporters that scale images may write fractional sizes.
        if not any(want is not None and abs(want - got) >= 1 for want, got in zip(stated, size)):
            return size
        cropped = w is not None and abs(size[0] - w) <= ROUNDED
        if not (cropped or w is None or h is None or abs(size[0] / w - size[1] / h) * max(w, h) > ROUNDED):
            return w, h
    says = " and ".join(f"{key} = {want:g}" for key, want in zip("wh", stated) if want is not None)
    width, height = header.size
    raise SceneError(f"{frame.path}: is {width} x {height} pixels, but {frame.source} says {says}: {CROPPED}")


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


def views_without_images(path: Path, size: tuple[int, int]) -> tuple[list[View], Tensor]:
    """Reads the cameras of a transforms file, in the file's order; their images need not exist.

    A camera without ``w`` and ``h`` has the size of its image, if its lens is in pixels and the image exists, or else
    twice its principal point, or else ``size``. Cameras see the images as stored; a view of an image that exists has
    its header, with the turns of the orientation tag. Frames without a pose are left out.

    Args:
        path: the file.
        size: (width, height) of upright images of unknown size.

    Returns:
        (the views, the transform float64 [4, 4] from the original coordinates to the coordinates of the poses).
    """
    entries = read_json(path, dict)
    shared, views = _named_distortion(entries, path), list[View]()
    for position, frame in enumerate(entries["frames"]):
        if not isinstance(frame, dict):
            raise SceneError(f"{path}: frame {position} must be an object, got {frame!r:.60}")
        is_last = position == len(entries["frames"]) - 1
        if _is_unknown(frame.get("transform_matrix")) and (views or not is_last):
            continue
        pose, _ = _scaled_pose(frame.get("transform_matrix"), f"{path}: frame {position}")
        values = {**shared, **_named_distortion(frame, path)}
        stated = [number(values, side, path, positive=True) for side in "wh"]
        image = _image_header(path, values)
        default = _image_size(path, values, image) if None in stated else None
        default = default or (size[::-1] if image is not None and image.turns % 2 else size)
        width, height = (max(round(side or other), 1) for side, other in zip(stated, default))
        view = _view(ListedImage(path, pose, path, values), Header((width, height)))
        views.append(view if image is None else view._replace(header=image))
    return stored_views(views), _applied(entries, path)


def _image_header(path: Path, values: dict[str, Any]) -> Header | None:
    """Returns the header of a frame's image; None if it does not exist in the file's folder."""
    name = values.get("file_path")
    with contextlib.suppress(SceneError):
        image = _exact_file(path.parent, name) if isinstance(name, str) and is_text(name) else None
        if image is not None and not leads_outside(image, path.parent):
            return read_header(image)
    return None


def _image_size(path: Path, values: dict[str, Any], image: Header | None) -> tuple[int, int] | None:
    """Returns the size of a frame's image: its file's, or twice the principal point; None for a lens not in pixels."""
    if not any(values.get(key) for key in ("fl_x", "fl_y", "cx", "cy")):
        return None
    if image is not None:
        return image.size
    cx, cy = (number(values, key, path, positive=True) for key in ("cx", "cy"))
    if cx is None or cy is None:
        raise SceneError(f"{path}: must state w and h, or cx and cy, since its lens is in pixels")
    return round(2 * cx), round(2 * cy)
