"""Image files of COLMAP and LLFF folders: in `images`, or reduced by a factor N in `images_N`."""

from __future__ import annotations

import logging
import os
import posixpath
import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from voronerf.app.files import leads_outside
from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.images import DYNAMIC_MASK, FORMATS, Header, read_header
from voronerf.app.scenes.names import (
    OTHER_PICTURES,
    Accepts,
    compare,
    compare_tails,
    has_images,
    plain,
    stay_inside,
)
from voronerf.app.scenes.photographs import least_factor

log = logging.getLogger(__name__)

SUFFIXES = (".png", ".jpg", ".jpeg", ".jfif")
#: Suffixes of phones' images, and of all images that `voronerf process` converts to JPEG or PNG.
HEIF = (".heic", ".heif")
CONVERTED = (".tif", ".tiff", ".bmp", ".webp", *HEIF)
#: Suffixes of images that are not read.
UNREAD = (*CONVERTED, ".avif", ".exr")


class ImageFolder(NamedTuple):
    """A folder of images.

    Attributes:
        path: the folder.
        full: the folder of the same images in full size; None if ``path`` holds images in full size, or if there is no
            such folder.
        masks: the folder of the images' masks, or None.
        factor: the factor by which the images in ``path`` must still be downscaled; None to choose the factor by size.
        notes: lines for the user.
        root: the folder that must hold all files.
    """

    path: Path
    full: Path | None
    masks: Path | None
    factor: int | None
    notes: tuple[str, ...]
    root: Path

    def reduction(self, headers: Sequence[Header]) -> int:
        """Returns the factor by which the images with these headers must still be downscaled."""
        return self.factor or least_factor(max(max(header.size) for header in headers))


def image_folders(folder: Path, images: str = "images") -> dict[int, Path]:
    """Returns {N: folder} for `images` (N = 1) and `images_N`, ignoring case; `images` is a path in ``folder``."""
    if images == ".":
        return {1: folder}
    parent, name = (folder / images).parent, Path(images).name
    matches = [
        (re.fullmatch(rf"{re.escape(name)}(?:_([1-9]\d{{0,3}}))?", path.name, re.IGNORECASE), path)
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
        raise SceneError(
            f"{folder}: has neither a folder {images} nor {name}_2, {name}_4, ...; rename the folder of the images to "
            f"{images}"
        )
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
    root = folder if images == "." else sizes[chosen].parent
    return ImageFolder(sizes[chosen], full, masks.get(chosen, masks.get(1)), factor, notes, root)


def other_folder(
    source: Path, folder: Path, images: str, names: Sequence[str], allow_outside: bool
) -> tuple[str, tuple[str, ...]]:
    """Finds the folder of a model's images if the path ``images`` does not exist in the scene's folder.

    The search covers the scene's folder and its subfolders, except for folders of masks and depths.

    Returns:
        (the path of the folder with most files that the model names, or ``images`` if ``images`` exists or if
        there is no such folder; lines for the user).
    """
    if image_folders(folder, images):
        return images, ()
    inside = [
        path
        for path in sorted(folder.iterdir())
        if path.is_dir() and not path.name.startswith(".") and not OTHER_PICTURES.fullmatch(path.name)
    ]
    inside = [path for path in inside if allow_outside or not leads_outside(path, folder)]
    counts = {path: sum(os.path.isfile(path / plain(name)) for name in names) for path in (folder, *inside)}
    if not any(counts.values()):
        files = {path: named_files(source, path, names, allow_outside) for path in inside}
        counts = {path: len(found) - found.count(None) for path, found in files.items()}
    most = max(counts.values(), default=0)
    found = [path.relative_to(folder).as_posix() for path, count in counts.items() if count == most > 0]
    if len(found) > 1:
        raise SceneError(
            f"{folder}: has no folder {images}, and {found[0]} as well as {found[1]} has images of the model; rename "
            f"the folder of the images to {images}"
        )
    if not found:
        return images, ()
    where = folder.name if found == ["."] else found[0]
    return found[0], (f"images are read from {where}, since there is no folder {images}",)


def named_images(
    source: Path, images: ImageFolder, names: Sequence[str], allow_outside: bool
) -> tuple[list[Path | None], tuple[str, ...]]:
    """Finds the image file of each name by `named_files` or, if that finds no file, by the order of files and names.

    Warns of missing files.

    Returns:
        (the file of each name, None if it is missing; lines for the user).
    """
    files = named_files(source, images.path, names, allow_outside, images.root)
    notes: tuple[str, ...] = ()
    if not any(files):
        files = _files_in_order(source, images, names, allow_outside)
        notes = (f"no file in {images.path.name} has a name of the model: files are matched by order",)
    missing = files.count(None)
    if missing == len(files):
        raise none_exists(source, images.path, names)
    if missing:
        log.warning("%s: %d of %d listed images are missing and are skipped", source, missing, len(files))
    return files, notes


def none_exists(source: Path, folder: Path, names: Sequence[str]) -> SceneError:
    """Returns the error for a list of images, none of which exists; images in other formats are named."""
    stems = {posixpath.splitext(posixpath.basename(plain(name)))[0].casefold() for name in names}
    unread = (path for path in folder.rglob("*") if path.suffix.lower() in UNREAD and path.stem.casefold() in stems)
    other = next(unread, None)
    return SceneError(
        f"{source}: none of its {len(names)} images exists, the first is {folder / names[0]}"
        + (f"; {_conversion(other)}" if other else "")
    )


def _conversion(path: Path) -> str:
    """Returns the remedy for images in a format that is not read."""
    return f"mogrify -format png {shlex.quote(str(path.parent))}/*{path.suffix} writes PNG files, which are found"


def named_files(
    source: Path, folder: Path, names: Sequence[str], allow_outside: bool, root: Path | None = None
) -> list[Path | None]:
    """Finds the file of each name in a folder and its subfolders; None for a missing file, see `find_files`.

    Args:
        source: the file that lists the names, for error messages.
        folder: the folder of the files.
        names: the file names, with or without folders.
        allow_outside: whether the files may lie outside of the scene's folder.
        root: the scene's folder; None for the folder that holds ``folder``.
    """
    names, root = [plain(name) for name in names], folder.parent if root is None else root
    exact = {
        name: folder / name
        for name in names
        if os.path.isfile(folder / name) and (allow_outside or not leads_outside(folder / name, root))
    }
    found = find_files(source, folder, names, exact, of_one_folder=False)
    for name in names:
        if name in found or not posixpath.isabs(name):  # an absolute path may come from another machine
            stay_inside(found.get(name, folder / name), root, allow_outside)
    return [found.get(name) for name in names]


def find_files(
    source: Path,
    folder: Path,
    names: Sequence[str],
    exact: dict[str, Path],
    *,
    of_one_folder: bool,
    accepts: Accepts = has_images,
    but: Sequence[Path] = (),
) -> dict[str, Path]:
    """Finds the image file of each name: its file in ``exact``, or a file in a folder and its subfolders.

    A name is compared with a file's path: exactly, then with the suffix of the path removed, then with the suffixes of
    the name and the path removed, each in normalised Unicode. Names without a file are compared by the same three rules
    again, ignoring case. If none of the names has a file, they are compared by `compare_tails`.

    Args:
        source: the file that lists the names, for error messages.
        folder: the folder of the files.
        names: normalised names, see `plain`.
        exact: the file of each name whose file exists as it is named.
        of_one_folder: whether the innermost folders of a name and of its file must be equal.
        accepts: see `compare_tails`.
        but: files that are not taken.

    Returns:
        The file of each name; missing files are absent. If images exist as they are named, but in a format that is not
        read, and also as PNG or JPEG, the latter are taken.
    """

    def inside(path: Path) -> str:
        return Path(os.path.relpath(path, folder)).as_posix()

    found = {name: inside(path) for name, path in exact.items() if path.suffix.lower() not in UNREAD}
    result = dict(exact)
    if not set(names) <= found.keys():
        remedy = f" in {folder}: keep only one of these files"
        taken = {inside(path) for path in but}
        files = [file for file in map(inside, image_files(folder)) if file not in taken]
        compare(source, names, files, found, remedy)
        if not found and not exact:
            found = compare_tails(source, names, files, remedy, of_one_folder=of_one_folder, accepts=accepts)
        result |= {
            name: folder / file
            for name, file in found.items()
            if name not in exact or exact[name].suffix.lower() in UNREAD
        }
    for path in set(result.values()):
        if path.suffix.lower() in UNREAD:
            _check_format(path)
    return result


def _check_format(path: Path) -> None:
    """Raises SceneError for an image file in a format that is not read, whatever its suffix."""
    try:
        read_header(path)
    except SceneError:
        formats = " or ".join(FORMATS)
        raise SceneError(f"{path}: is not an image in {formats} format; {_conversion(path)}") from None


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
    return [path and places.get(path) for path in named_files(source, images.full, names, allow_outside, images.root)]


def _in_numeric_order(paths: Sequence[Path | str]) -> bool:
    """Returns whether sorted paths are in numeric order, too, such as 9 before 10."""
    parts = [re.split(r"0*(\d+)", str(path)) for path in paths]  # at odd places numbers, which may be too long for int
    keys = [[(len(part) * (place % 2), part) for place, part in enumerate(pieces)] for pieces in parts]
    return keys == sorted(keys)


def image_files(folder: Path) -> list[Path]:
    """Returns the image files of a folder and its subfolders, except for the pictures of runs, sorted by path."""
    files: list[Path] = []
    for place, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not (Path(place, name) / "checkpoints").is_dir()]
        files += (path for name in names if _is_image(path := Path(place, name)))
    return sorted(files, key=lambda path: path.relative_to(folder).as_posix())


def listed_images(folder: Path) -> list[Path]:
    """Returns the image files of a folder, sorted by name."""
    return sorted(path for path in folder.iterdir() if _is_image(path))


def _is_image(path: Path) -> bool:
    """Returns whether a path is an image file and no mask; other files of macOS, such as ._a.jpg, do not count."""
    return path.suffix.lower() in SUFFIXES and not path.name.startswith((".", DYNAMIC_MASK)) and path.is_file()
