"""Image files of COLMAP and LLFF folders: in `images`, or reduced by a factor N in `images_N`."""

from __future__ import annotations

import logging
import os
import posixpath
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from voronerf.app.files import leads_outside
from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.images import Header
from voronerf.app.scenes.photographs import least_factor

log = logging.getLogger(__name__)

SUFFIXES = (".png", ".jpg", ".jpeg")
#: Suffixes of phones' images, and of all images that `voronerf process` converts to JPEG or PNG.
HEIF = (".heic", ".heif")
CONVERTED = (".tif", ".tiff", ".bmp", ".webp", *HEIF)


class ImageFolder(NamedTuple):
    """A folder of images.

    Attributes:
        path: the folder.
        full: the folder of the same images in full size; None if ``path`` holds images in full size, or if there is no
            such folder.
        masks: the folder of the images' masks, or None.
        factor: the factor by which the images in ``path`` must still be downscaled; None to choose it by their size.
        notes: lines for the user.
    """

    path: Path
    full: Path | None
    masks: Path | None
    factor: int | None
    notes: tuple[str, ...]

    def reduction(self, headers: Sequence[Header]) -> int:
        """Returns the factor by which the images with these headers must still be downscaled."""
        return self.factor or least_factor(max(max(header.size) for header in headers))


def image_folders(folder: Path, images: str = "images") -> dict[int, Path]:
    """Returns {N: folder} for `images` (N = 1) and `images_N`, ignoring case; `images` is a path in ``folder``."""
    parent, name = (folder / images).parent, Path(images).name
    matches = [
        (re.fullmatch(rf"{name}(?:_([1-9]\d{{0,3}}))?", path.name, re.IGNORECASE), path)
        for path in sorted(parent.iterdir() if parent.is_dir() else ())
    ]
    return {int(match[1] or 1): path for match, path in matches if match and path.is_dir()}


def choose_images(folder: Path, downscale: int | None, images: str = "images") -> ImageFolder:
    """Returns the image folder that needs the least further reduction.

    For `downscale` N, this is `images_N` or, if missing, `images`, whose files are then reduced by N. If `images` is
    missing too, the result is the `images_N` with the smallest N; `downscale` 1 keeps the size of its images. For
    `downscale` None, images are reduced by `least_factor`. The argument `images` is a path in the scene's folder.
    """
    sizes = image_folders(folder, images)
    if not sizes:
        name = Path(images).name
        raise SceneError(f"{folder}: has neither a folder {images} nor {name}_2, {name}_4, ...")
    chosen = downscale if downscale in sizes else min(sizes)
    if downscale is None:
        factor = None
    elif downscale == 1 or downscale % chosen == 0:
        factor = max(downscale // chosen, 1)
    else:
        raise SceneError(f"{sizes[chosen]}: --downscale must be 1 or a multiple of {chosen}, got {downscale}")
    notes = () if chosen == 1 else (f"{sizes[chosen].name} is read instead of {images}",)
    masks = image_folders(folder, posixpath.join(posixpath.dirname(images), "masks"))
    full = sizes.get(1) if chosen > 1 else None
    return ImageFolder(sizes[chosen], full, masks.get(chosen, masks.get(1)), factor, notes)


def stay_inside(path: Path, folder: Path, allow_outside: bool, name: str = "") -> None:
    """Raises SceneError for a path that leads out of the scene's folder by `..` or a link, unless this is allowed.

    The error message begins with ``name`` or, if it is empty, with the path.
    """
    if not allow_outside and leads_outside(path, folder):
        raise SceneError(f"{name or path}: must lie in the folder of the scene; --allow-outside also reads other files")


def named_images(
    source: Path, images: ImageFolder, names: Sequence[str], allow_outside: bool
) -> tuple[list[Path | None], tuple[str, ...]]:
    """Finds the image file of each name by `named_files` or, if that finds no file, by the order of files and names.

    Warns of missing files.

    Returns:
        (the file of each name, None if it is missing; lines for the user).
    """
    files = named_files(source, images.path, names, allow_outside)
    notes: tuple[str, ...] = ()
    if not any(files):
        files = _files_in_order(source, images, names, allow_outside)
        notes = (f"no file in {images.path.name} has a name of the model: files are matched by order",)
    missing = files.count(None)
    if missing == len(files):
        raise SceneError(f"{source}: none of its {len(files)} images exists, the first is {images.path / names[0]}")
    if missing:
        log.warning("%s: %d of %d listed images are missing and are skipped", source, missing, len(files))
    return files, notes


def named_files(source: Path, folder: Path, names: Sequence[str], allow_outside: bool) -> list[Path | None]:
    """Finds the file of each name in a folder and its subfolders; None for a missing file.

    A name is compared with a file's path: exactly, then with the suffix of the path removed, then with the suffixes of
    the name and the path removed. Names without a file are compared in the same three ways again, ignoring case. If
    none of the names has a file, and the base names are unique, base names are compared in all these ways.

    Args:
        source: the file that lists the names, for error messages.
        folder: the folder of the files.
        names: the file names, with or without folders.
        allow_outside: whether the files may lie outside of the scene's folder.
    """
    names = [posixpath.normpath(name.replace("\\", "/")) for name in names]
    found = {
        name: folder / name
        for name in names
        if os.path.isfile(folder / name) and (allow_outside or not leads_outside(folder / name, folder.parent))
    }
    if len(found) < len(set(names)):
        files = image_files(folder)
        _compare(source, folder, set(names), files, found, str)
        if not found and len(set(map(posixpath.basename, names))) == len(set(names)):
            _compare(source, folder, set(names), files, found, posixpath.basename)
    for name in names:
        if name in found or not posixpath.isabs(name):  # an absolute path may come from another machine
            stay_inside(found.get(name, folder / name), folder.parent, allow_outside)
    return [found.get(name) for name in names]


def _compare(
    source: Path, folder: Path, names: set[str], files: list[Path], found: dict[str, Path], part: Callable[[str], str]
) -> None:
    """Compares names with paths after applying the function ``part`` to both, and adds the matches to ``found``.

    If ``part`` is ``str``, which keeps whole paths, several paths that match one name raise SceneError. All other
    ambiguous matches are skipped.
    """
    for fold in (str, str.casefold):
        for cut, cut_file in ((str, str), (str, _without_suffix), (_without_suffix, _without_suffix)):
            by_key = defaultdict(list)
            for path in files:
                by_key[fold(cut_file(part(path.relative_to(folder).as_posix())))].append(path)
            keys = {name: fold(cut(part(name))) for name in names}
            counts, taken = Counter(keys.values()), set(found.values())
            for name in sorted(names - found.keys()):
                paths = by_key.get(keys[name], [])
                if len(paths) > 1 and part is str:
                    candidates = " or ".join(path.relative_to(folder).as_posix() for path in paths[:2])
                    raise SceneError(f"{source}: {name} may be {candidates} in {folder}: keep only one of these files")
                if len(paths) == counts[keys[name]] == 1 and paths[0] not in taken:
                    found[name] = paths[0]


def _without_suffix(name: str) -> str:
    return posixpath.splitext(name)[0]


def _files_in_order(source: Path, images: ImageFolder, names: Sequence[str], allow_outside: bool) -> list[Path | None]:
    """Matches files with names by order; for reduced images, by the order of the images in full size.

    No file is matched if the numbers of files and names differ, or if sorting by characters and by numbers gives
    different orders, as for 10.jpg and 9.jpg: the program that wrote the names, or reduced the images, may have used
    either order.
    """
    files = image_files(images.path)
    ordered: list[Any] = sorted(set(names)) if images.full is None else image_files(images.full)
    if len(ordered) != len(files) or not (_in_numeric_order(ordered) and _in_numeric_order(files)):
        return [None] * len(names)
    places = dict(zip(ordered, files))
    if images.full is None:
        return [places.get(name) for name in names]
    return [path and places.get(path) for path in named_files(source, images.full, names, allow_outside)]


def _in_numeric_order(paths: Sequence[Path | str]) -> bool:
    """Returns whether sorted paths are in numeric order, too, such as 9 before 10."""
    parts = [re.split(r"0*(\d+)", str(path)) for path in paths]  # at odd places numbers, which may be too long for int
    keys = [[(len(part) * (place % 2), part) for place, part in enumerate(pieces)] for pieces in parts]
    return keys == sorted(keys)


def image_files(folder: Path) -> list[Path]:
    """Returns the image files of a folder and its subfolders, sorted by path."""
    files = (path for path in folder.rglob("*") if _is_image(path))
    return sorted(files, key=lambda path: path.relative_to(folder).as_posix())


def listed_images(folder: Path) -> list[Path]:
    """Returns the image files of a folder, sorted by name."""
    return sorted(path for path in folder.iterdir() if _is_image(path))


def _is_image(path: Path) -> bool:
    """Returns whether a path is an image file; macOS adds other files, such as ._a.jpg, which do not count."""
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()
