"""The image files of COLMAP's and LLFF's folders: `images`, or `images_N`, which are smaller by N."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from voronerf.app.files import leads_outside
from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.photographs import least_factor

log = logging.getLogger(__name__)

SUFFIXES = (".png", ".jpg", ".jpeg")
#: Images of phones, of which `voronerf process` makes JPEG.
HEIF = (".heic", ".heif")


class ImageFolder(NamedTuple):
    """A folder of images, by how much they are still to be reduced, and lines about it."""

    path: Path
    factor: int
    notes: tuple[str, ...]


def choose_images(folder: Path, downscale: int | None, longest: float) -> ImageFolder:
    """The folder of images that needs the least reduction.

    With `downscale` N, `images_N` is read as it is, else `images`. Where there is no `images`, the largest `images_N`
    is read, which a `downscale` of 1 takes as it is. None reduces the images as far as `least_factor` says; `longest`
    is the longest side of those in `images`.
    """
    sizes = {1: folder / "images"} if (folder / "images").is_dir() else {}
    for path in folder.glob("images_*"):
        match = re.fullmatch(r"images_([1-9]\d{0,3})", path.name)
        if match and path.is_dir():
            sizes[int(match[1])] = path
    if not sizes:
        raise SceneError(f"{folder}: has neither a folder images nor images_2, images_4, ...")
    chosen = downscale if downscale in sizes else min(sizes)
    if downscale is None:
        factor = least_factor(longest / chosen)
    elif downscale == 1 or downscale % chosen == 0:
        factor = max(downscale // chosen, 1)
    else:
        raise SceneError(f"{sizes[chosen]}: --downscale must be 1 or a multiple of {chosen}, got {downscale}")
    notes = () if sizes[chosen].name == "images" else (f"{sizes[chosen].name} is read, and not images",)
    return ImageFolder(sizes[chosen], factor, notes)


def stay_inside(path: Path, folder: Path, allow_outside: bool, name: str = "") -> None:
    """Raises SceneError for a path that leads out of the scene's folder by `..` or a link, unless that is allowed.

    The error calls it by a name, or by itself.
    """
    if not allow_outside and leads_outside(path, folder):
        raise SceneError(f"{name or path}: must lie in the folder of the scene; --allow-outside reads others")


def named_images(source: Path, folder: Path, names: Sequence[str], allow_outside: bool) -> list[Path | None]:
    """The files of names in a folder, None for those that are missing; with a warning that says how many."""
    files: list[Path | None] = []
    for name in names:
        path = folder / name.replace("\\", "/")
        stay_inside(path, folder.parent, allow_outside)
        files.append(path if path.is_file() else None)
    missing = files.count(None)
    if missing == len(files):
        raise SceneError(f"{source}: none of its {len(files)} images exists, the first is {folder / names[0]}")
    if missing:
        log.warning("%s: %d of %d listed images are missing and are skipped", source, missing, len(files))
    return files


def listed_images(folder: Path) -> list[Path]:
    """The image files of a folder in the order of their names."""
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file())
