"""Names of images in the files of other programs: the image files that they mean, and lists of test images."""

from __future__ import annotations

import itertools
import posixpath
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from voronerf.app.files import is_utf16, leads_outside
from voronerf.app.scenes.errors import SceneError

#: Folders that programs keep beside photographs: masks, depths and the like, and smaller copies.
OTHER_PICTURES = re.compile(r"(?i)(.+[_-])?(masks?|depths?|confidences?|normals?|semantics?|segmentations?)([_-].+)?")
MASKS = re.compile(r"(?i)(.+[_-])?masks?([_-].+)?")
COPIES = re.compile(r"(?i)images_\d+")
#: The suffix of an image in a name.
SUFFIX = re.compile(r"(?i)\.(png|jpe?g|jfif|tiff?|bmp|webp|hei[cf]|avif|exr)$")
#: The files in a scene's folder that list the names of images for training and for testing (nerfbaselines), and the
#: file in a COLMAP model's folder that lists the names of test images (gaussian-splatting, hierarchical-3d-gaussians).
TRAIN_LIST, TEST_LIST, MODEL_LIST = "train_list.txt", "test_list.txt", "test.txt"
#: The largest size of such a list in bytes.
MOST_BYTES = 2**25


def stay_inside(path: Path, folder: Path, allow_outside: bool, name: str = "") -> None:
    """Raises SceneError for a path that leads out of the scene's folder by `..` or a link, unless this is allowed.

    The error message begins with ``name`` or, if it is empty, with the path.
    """
    if not allow_outside and leads_outside(path, folder):
        raise SceneError(f"{name or path}: must lie in the folder of the scene; --allow-outside also reads other files")


def plain(name: str) -> str:
    """Returns a normalised file name, so that ./images/a.png equals images/a.png, and images\\a.png on Windows."""
    return posixpath.normpath(name.replace("\\", "/"))


def _composed(name: str) -> str:
    """Returns a name in composed Unicode (NFC), since macOS writes an umlaut as a letter and a combining mark."""
    return unicodedata.normalize("NFC", name)


def _caseless(name: str) -> str:
    return unicodedata.normalize("NFC", unicodedata.normalize("NFD", name).casefold())


def _whole(name: str) -> str:
    return name


def _without_suffix(name: str) -> str:
    return posixpath.splitext(name)[0]


Change = Callable[[str], str]
#: The comparisons of a name and a file, the strictest first: functions that normalise (both, the name, the file).
LEVELS: tuple[tuple[Change, Change, Change], ...] = tuple(
    (fold, *cut)
    for fold in (_composed, _caseless)
    for cut in ((_whole, _whole), (_whole, _without_suffix), (_without_suffix, _without_suffix))
)


def compare(source: Path, names: Iterable[str], files: Sequence[str], found: dict[str, str], remedy: str) -> None:
    """Adds to ``found`` a file for each name without one, by the first of `LEVELS` that makes name and file equal.

    A file belongs to one name: it is not taken if two names are equal to it, or if it is in ``found`` already.

    Args:
        source: the file that lists the names, for error messages.
        names: normalised names, see `plain`.
        files: paths in a folder, separated by `/`.
        found: the files found so far, by name; changed in place.
        remedy: the end of the error message if several files match a name.
    """
    names = set(names)
    for fold, cut, cut_file in LEVELS:
        by_key = defaultdict(list)
        for file in files:
            by_key[fold(cut_file(file))].append(file)
        keys = {name: fold(cut(name)) for name in names}
        counts, taken = Counter(keys.values()), set(found.values())
        for name in sorted(names - found.keys()):
            if taken and cut is _whole and cut_file is _without_suffix and SUFFIX.search(name):
                continue  # 0.jpg.png is the mask of a 0.jpg that is missing
            same = by_key.get(keys[name], [])
            if len(same) > 1:
                raise SceneError(f"{source}: {name} may be {' or '.join(same[:2])}{remedy}")
            if len(same) == counts[keys[name]] == 1 and same[0] not in taken:
                found[name] = same[0]


Accepts = Callable[[int, list[str]], bool]


def has_images(tail: int, rest: list[str]) -> bool:
    """Returns whether a folder may have images: ``rest`` (see `compare_tails`) names no masks, depths or the like."""
    return not any(map(OTHER_PICTURES.fullmatch, rest))


def has_masks(tail: int, rest: list[str]) -> bool:
    """Returns whether a folder may have masks: ``rest`` names masks, or ``tail`` > 0 (a listed folder's name)."""
    return tail > 0 or any(map(MASKS.fullmatch, rest))


def compare_tails(
    source: Path,
    names: Iterable[str],
    files: Sequence[str],
    remedy: str,
    *,
    of_one_folder: bool,
    accepts: Accepts = lambda tail, rest: True,
) -> dict[str, str]:
    """Matches names with files whose paths begin differently, as on another machine; returns the file of each match.

    All names in one listed folder get files of one folder, chosen by these criteria in order: the same innermost
    name, files for most names, the longest common end of its path. `compare` compares the base names.

    Args:
        source: the file that lists the names, for error messages.
        names: normalised names, see `plain`.
        files: paths in a folder, separated by `/`.
        remedy: the end of the error message if several files match a name.
        of_one_folder: whether the innermost folders must be equal, as they always must if base names repeat.
        accepts: function that returns whether to take files of a folder: the last ``tail`` names of its path equal the
            listed folder's, and ``rest`` are its other names.
    """
    listed, inside = _by_folder(names), _by_folder(files)
    bases = Counter(base for group in listed.values() for base in group)
    of_one_folder = of_one_folder or max(bases.values(), default=1) > 1
    keys = {folder: set().union(*map(_keys, group)) for folder, group in inside.items()}
    parts, alike = {folder: _parts(folder) for folder in inside}, defaultdict(list)
    for folder, names_inside in parts.items():
        alike[tuple(names_inside[:1])].append(folder)
    choices = []
    for folder, group in listed.items():
        names_of, scores = _parts(folder), dict[str, tuple[int, int, bool, int]]()
        for others in (alike[tuple(names_of[:1])], () if of_one_folder else inside):
            for other in others if not scores else ():
                tail = sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], zip(names_of, parts[other])))
                rest = parts[other][tail:]
                count = sum(not keys[other].isdisjoint(_keys(base)) for base in group)
                if count and accepts(tail, rest):
                    scores[other] = (count, tail, not any(map(COPIES.fullmatch, rest)), -len(rest))
        if scores:
            top = max(scores.values())
            choices.append((top, folder, [other for other, score in scores.items() if score == top]))
    found: dict[str, str] = {}
    for _, folder, best in sorted(choices, reverse=True):
        if len(best) > 1:
            base = listed[folder][0]
            candidates = " or ".join(posixpath.join(other, base) for other in sorted(best)[:2])
            raise SceneError(f"{source}: {posixpath.join(folder, base)} may be {candidates}{remedy}")
        taken, matches = set(found.values()), dict[str, str]()
        rest = [base for base in inside[best[0]] if posixpath.join(best[0], base) not in taken]
        compare(source, listed[folder], rest, matches, remedy)
        found |= {posixpath.join(folder, base): posixpath.join(best[0], file) for base, file in matches.items()}
    return found


def _by_folder(paths: Iterable[str]) -> dict[str, list[str]]:
    """Returns the base names of paths by their folders."""
    folders = defaultdict(list)
    for path in sorted(set(paths)):
        folders[posixpath.dirname(path)].append(posixpath.basename(path))
    return folders


def _keys(base: str) -> set[str]:
    """Returns a base name with and without its suffix, in normalised Unicode and lower case."""
    return {_caseless(base), _caseless(_without_suffix(base))}


def _parts(folder: str) -> list[str]:
    """Returns the names of a path of folders, the innermost first, in normalised Unicode and lower case."""
    return _caseless(folder).split("/")[::-1] if folder else []


def split_by_lists(
    path: Path, kinds: Sequence[str], lists: Sequence[set[str]], names: Sequence[str], every: set[str]
) -> tuple[list[int], Tensor, int] | None:
    """Splits images by lists of names for training, testing and validation; returns None if all lists are empty.

    An empty list for training or testing is filled with the images that are in no other list. Images for validation
    are used for testing if there is no list for testing; otherwise they are left out.

    Args:
        path: the file or folder to name in errors.
        kinds: the names of the lists, for error messages.
        lists: the three sets of names.
        names: the names of the images, as in the lists.
        every: ``names``, and the names of missing images.

    Returns:
        (the places of the chosen images in ``names``; bool held_out, True for test images; the number of images in
        ``every`` that are in no list).
    """
    train, test, validation = lists
    if not (train or test or validation):
        return None
    test = test or validation
    train, test = train or every - test - validation, test or every - train
    if shared := sorted(train & test):
        raise SceneError(f"{path}: {kinds[0]} and the images for testing must differ, both have {shared[0]}")
    chosen = [(place, name in test) for place, name in enumerate(names) if name in train | test]
    held_out = torch.tensor([held for _, held in chosen], dtype=torch.bool, device="cpu")
    for part, present in (("training", bool((~held_out).any())), ("testing", bool(held_out.any()))):
        if not present:
            raise SceneError(f"{path}: {', '.join(kinds)} leave no image for {part}")
    return [place for place, _ in chosen], held_out, len(every - train - test - validation)


def listed_split(
    source: Path, folder: Path, names: Sequence[str], allow_outside: bool
) -> tuple[tuple[list[int], Tensor, int] | None, list[str]]:
    """Splits images by the lists of names in the scene's folder or beside a COLMAP model, see `TRAIN_LIST`.

    Comments and empty lines of a list are ignored.

    Args:
        source: the file with the cameras; `MODEL_LIST` lies beside it.
        folder: the scene's folder.
        names: the names of the images.
        allow_outside: whether the lists may lie outside of the scene's folder.

    Returns:
        (the result of `split_by_lists`, lines for the user).
    """
    paths = {"train": folder / TRAIN_LIST, "test": folder / TEST_LIST}
    if not any(path.is_file() for path in paths.values()) and source.parent != folder:
        paths = {"test": source.parent / MODEL_LIST}
    paths = {kind: path for kind, path in paths.items() if path.is_file()}
    lists: dict[str, set[str]] = {"train": set(), "test": set()}
    notes = []
    for kind, path in paths.items():
        stay_inside(path, folder, allow_outside)
        listed = _read_list(path)
        found: dict[str, str] = {}
        remedy = ": the list must give its folder and its suffix"
        images = sorted(set(names))
        compare(path, listed, images, found, remedy)
        found = found or compare_tails(path, listed, images, remedy, of_one_folder=False)
        lists[kind] = set(found.values())
        if missing := len(listed) - len(found):
            notes.append(f"{missing} of {len(listed)} names in {path.relative_to(folder)} have no image")
    split = split_by_lists(folder, [path.name for path in paths.values()], (*lists.values(), set()), names, set(names))
    if split is not None:
        where = " and ".join(str(path.relative_to(folder)) for path in paths.values())
        notes.append(f"test images are those of {where}: {int(split[1].sum())} of {len(names)}")
    elif notes:
        notes.append("every 8th image is held out")
    return split, notes


def _read_list(path: Path) -> list[str]:
    """Returns the distinct names in a text file."""
    if path.stat().st_size > MOST_BYTES:
        raise SceneError(f"{path}: must be at most {MOST_BYTES / 2**20:g} MiB")
    if is_utf16(path.read_bytes()):
        raise SceneError(f"{path}: is UTF-16 text; save it as UTF-8")
    lines = (line.strip() for line in path.read_text(encoding="utf-8-sig", errors="replace").splitlines())
    return list(dict.fromkeys(plain(line) for line in lines if line and not line.startswith("#")))
