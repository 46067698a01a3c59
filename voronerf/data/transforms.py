"""Reads what Blender's `transforms_*.json` and the `transforms.json` of captures share: frames, poses, numbers."""

from __future__ import annotations

import logging
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from voronerf.data.scene import SceneError
from voronerf.files import leads_outside, read_json

log = logging.getLogger(__name__)

SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG")
ORTHONORMAL = 2e-3
#: Of numbers and, where they are positive, its inverse the smallest; far from where float32 ends, even squared.
LARGEST = 1e9
#: Of a focal length, in sides of the image, and its inverse the smallest: fields of view of 0.06 to 179.9 degrees.
LONGEST = 1000


@dataclass(frozen=True)
class Frame:
    """One image of a transforms file: its path, its pose float64 [4, 4], its entries, and the path of its mask."""

    path: Path
    pose: Tensor
    entries: dict[str, Any]
    mask: Path | None = None


def read_transforms(path: Path, allow_outside: bool = False) -> tuple[dict[str, Any], list[Frame]]:
    """Reads a transforms file and finds its images.

    Images that are listed but missing are left out, with one line in the log (logger `voronerf.data.transforms`, level
    WARNING) that says how many.

    Args:
        path: the JSON file.
        allow_outside: also take images that lie outside of its folder.

    Returns:
        (the file's top-level entries, the frames whose image exists, in the file's order).

    Raises:
        SceneError: the file does not parse, has no frames, no image of any frame exists, one lies outside of the
            folder, or a matrix is not a pose.
    """
    try:
        entries = read_json(path)
    except ValueError as error:
        raise SceneError(str(error)) from None
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}") from None
    frames = entries.get("frames") if isinstance(entries, dict) else None
    if not isinstance(frames, list) or not frames:
        raise SceneError(f"{path}: has no frames")

    found = []
    for position, frame in enumerate(frames):
        name = frame.get("file_path") if isinstance(frame, dict) else None
        if not isinstance(name, str) or "\0" in name:
            raise SceneError(f"{path}: frame {position} has no file_path")
        pose = pose_of(frame.get("transform_matrix"), f"{path}: frame {position} ({name})")
        image = _find_image(path.parent, name, allow_outside, f"{path}: frame {position} ({name})")
        if image is not None:
            found.append(Frame(image, pose, frame, _mask(path, frame, allow_outside, f"frame {position} ({name})")))
    if not found:
        raise SceneError(
            f"{path}: none of its {len(frames)} images exists, the first is {path.parent / frames[0]['file_path']}"
        )
    if len(found) < len(frames):
        missing = len(frames) - len(found)
        log.warning("%s: %d of %d listed images are missing and are skipped", path, missing, len(frames))
    return entries, found


def number(entries: dict[str, Any], key: str, path: Path, *, positive: bool = False) -> float | None:
    """A finite number of a transforms file; None if the entry is missing.

    Raises:
        SceneError: the entry is not a number, out of range, or not positive where it must be.
    """
    value = entries.get(key)
    if value is None:
        return None
    # The comparisons take integers of any size; NaN fails them.
    if not is_number(value) or not abs(value) <= LARGEST:
        raise SceneError(f"{path}: {key} must be a finite number up to {LARGEST:.0e}, got {value!r:.60}")
    if positive and not value >= 1 / LARGEST:
        raise SceneError(f"{path}: {key} must be positive, got {value!r}")
    return float(value)


def is_number(value: object) -> bool:
    """Whether a value of JSON is a number, which a boolean is to Python."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def focal_length(entries: dict[str, Any], key: str, side: int, path: Path) -> float | None:
    """A focal length in pixels, from itself or from an angle of view; None if the entry is missing.

    Args:
        entries: of the file or a frame.
        key: "fl_x" or "fl_y", "camera_angle_x" or "camera_angle_y".
        side: pixels of the image along that axis.
        path: the file.

    Raises:
        SceneError: the entry is no such number, or nothing that a camera has.
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
            f"{path}: {key} must give a focal length of {1 / LONGEST:g} to {LONGEST} times the {side} pixels of the "
            f"image, got {value:g}"
        )
    return focal


def distinct_names(paths: list[Path], folder: Path) -> list[str]:
    """A unique name for each image, under which pictures of it are stored.

    The names are the stems of the files if these differ; otherwise the paths inside the folder of the scene, such as
    a_00 for a/00.png; and if a file is listed twice, the paths behind the number of the image.
    """
    names = [path.stem for path in paths]
    if len(set(names)) < len(names):
        inside = [Path(os.path.relpath(path, folder)).with_suffix("") for path in paths]
        names = ["_".join(part for part in path.parts if part != "..") for path in inside]
    if len(set(names)) < len(names):
        names = [f"{position:04d}_{name}" for position, name in enumerate(names)]
    return names


def _find_image(folder: Path, name: str, allow_outside: bool, where: str) -> Path | None:
    """Finds an image file; Blender's files leave out the suffix, and files from Windows may have its separators."""
    for spelt in dict.fromkeys((name, name.replace("\\", "/"))):
        for suffix in SUFFIXES:
            path = Path(f"{folder / spelt}{suffix}")
            _check_inside(path, folder, allow_outside, f"{where}: file_path")
            if os.path.isfile(path):
                return path
    return None


def _mask(path: Path, entries: dict[str, Any], allow_outside: bool, where: str) -> Path | None:
    """The mask of a frame; None without one."""
    name = entries.get("mask_path")
    if name is None:
        return None
    if not isinstance(name, str) or "\0" in name:
        raise SceneError(f"{path}: {where}: mask_path must be a file name, got {name!r:.60}")
    mask = path.parent / name.replace("\\", "/")
    _check_inside(mask, path.parent, allow_outside, f"{path}: {where}: mask_path")
    if not mask.is_file():
        raise SceneError(f"{path}: {where}: its mask {mask} does not exist")
    return mask


def _check_inside(path: Path, folder: Path, allow_outside: bool, what: str) -> None:
    if not allow_outside and leads_outside(path, folder):
        raise SceneError(f"{what} must lead to a file in the folder of the scene; --allow-outside reads others")


def pose_of(matrix: object, where: str, key: str = "transform_matrix") -> Tensor:
    """Checks that rows of numbers are a rigid motion; float64 [4, 4]."""
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
