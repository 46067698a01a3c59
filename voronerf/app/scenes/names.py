"""Names of images in the files of other programs: the image files that they mean, and lists of test images."""

from __future__ import annotations

import posixpath
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from voronerf.app.files import leads_outside
from voronerf.app.scenes.errors import SceneError

#: Folders that programs keep beside photographs: masks, depths and confidences of depths, and smaller copies.
OTHER_PICTURES, COPIES = re.compile(r"(?i)masks?|depths?|confidences?"), re.compile(r"(?i)images_\d+")
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


def is_utf16(path: Path) -> bool:
    """Returns whether a text file is UTF-16, as editors and shells on Windows may write it."""
    with open(path, "rb") as file:
        start = file.read(2)
    return start in (b"\xff\xfe", b"\xfe\xff") or start.count(0) == 1


def _composed(name: str) -> str:
    """Returns a name in one of its spellings in Unicode: macOS writes an umlaut as a letter and a mark."""
    return unicodedata.normalize("NFC", name)


def _caseless(name: str) -> str:
    return unicodedata.normalize("NFC", unicodedata.normalize("NFD", name).casefold())


def _whole(name: str) -> str:
    return name


def _without_suffix(name: str) -> str:
    return posixpath.splitext(name)[0]


Change = Callable[[str], str]
#: The comparisons of a name and a file, the strictest first, as changes of (both, the name, the file).
LEVELS: tuple[tuple[Change, Change, Change], ...] = tuple(
    (fold, *cut)
    for fold in (_composed, _caseless)
    for cut in ((_whole, _whole), (_whole, _without_suffix), (_without_suffix, _without_suffix))
)


def compare(source: Path, names: Iterable[str], files: Sequence[str], found: dict[str, str], remedy: str) -> None:
    """Adds the file of each name that has none yet to ``found``, by the first of `LEVELS` at which the two are equal.

    A file belongs to one name: it is not taken if two names are equal to it, or if it is in ``found`` already.

    Args:
        source: the file that lists the names, for error messages.
        names: normalised names, see `plain`.
        files: paths in a folder, separated by `/`.
        found: the file of each name, where known.
        remedy: the end of the message of the error for a name that may be several files.
    """
    names = set(names)
    for fold, cut, cut_file in LEVELS:
        by_key = defaultdict(list)
        for file in files:
            by_key[fold(cut_file(file))].append(file)
        keys = {name: fold(cut(name)) for name in names}
        counts, taken = Counter(keys.values()), set(found.values())
        for name in sorted(names - found.keys()):
            same = by_key.get(keys[name], [])
            if len(same) > 1:
                raise SceneError(f"{source}: {name} may be {' or '.join(same[:2])}{remedy}")
            if len(same) == counts[keys[name]] == 1 and same[0] not in taken:
                found[name] = same[0]


def compare_tails(
    source: Path,
    names: Iterable[str],
    files: Sequence[str],
    remedy: str,
    *,
    of_one_folder: bool,
    all_folders: bool = False,
) -> dict[str, str]:
    """Returns files of names whose beginnings differ, as in paths of another machine; names without a file are absent.

    The base names must be equal by one of `LEVELS`. Among several files, the one with the longest common tail of
    folders is taken. A name with a shorter tail than another name of the same folder has no file, and two names never
    take one file.

    Args:
        source: the file that lists the names, for error messages.
        names: normalised names, see `plain`.
        files: paths in a folder, separated by `/`.
        remedy: the end of the message of the error for a name that may be several files.
        of_one_folder: whether the innermost folders must be equal. They must in any case if base names repeat.
        all_folders: whether files in folders of `OTHER_PICTURES` are taken, too.
    """
    names = set(names)
    least = int(of_one_folder or len(set(map(posixpath.basename, names))) < len(names))
    by_level = []
    for fold, _, cut_file in LEVELS:
        by_key = defaultdict(list)
        for file in files:
            by_key[fold(cut_file(posixpath.basename(file)))].append(file)
        by_level.append(by_key)
    best: dict[str, tuple[tuple[int, bool, bool, int], list[str]]] = {}
    for name in names:
        folder, base = _caseless(posixpath.dirname(name)).split("/"), posixpath.basename(name)
        scores: dict[str, tuple[int, bool, bool, int]] = {}
        for level, (fold, cut, _) in enumerate(LEVELS):
            for file in by_level[level].get(fold(cut(base)), ()):
                parts = _caseless(posixpath.dirname(file)).split("/") if "/" in file else []
                tail = next((at for at, (a, b) in enumerate(zip(folder[::-1], parts[::-1])) if a != b), None)
                tail = min(len(folder), len(parts)) if tail is None else tail
                others = parts[: len(parts) - tail]
                if tail < least or (not all_folders and any(map(OTHER_PICTURES.fullmatch, others))):
                    continue
                scores.setdefault(file, (tail, not any(map(COPIES.fullmatch, others)), tail > 0 and not others, -level))
        if scores:
            top = max(scores.values())
            best[name] = top, [file for file, score in scores.items() if score == top]
    deepest: dict[str, int] = defaultdict(int)
    for name, (score, _) in best.items():
        deepest[posixpath.dirname(name)] = max(deepest[posixpath.dirname(name)], score[0])
    claims = defaultdict(list)
    for name, (score, same) in sorted(best.items()):
        if score[0] < deepest[posixpath.dirname(name)]:
            continue
        if len(same) > 1:
            raise SceneError(f"{source}: {name} may be {' or '.join(sorted(same)[:2])}{remedy}")
        claims[same[0]].append((score, name))
    found = {}
    for file, claiming in claims.items():
        score, name = max(claiming)
        if [other for other, _ in claiming].count(score) == 1:
            found[name] = file
    return found


def split_by_lists(
    path: Path, kinds: Sequence[str], lists: Sequence[set[str]], names: Sequence[str], every: set[str]
) -> tuple[list[int], Tensor, int] | None:
    """Returns the images in lists of names for training, for testing and for validation; None if all lists are empty.

    An empty list for training or testing is filled with the images that are in no other list. Images for validation
    are used for testing if there is no list for testing; otherwise they are left out.

    Args:
        path: the file or folder to name in errors.
        kinds: the names of the lists, for error messages.
        lists: the three sets of names.
        names: the names of the images, as in the lists.
        every: these names, and the names of missing images.

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
    """Reads the lists of names beside the images or a COLMAP model, see `TRAIN_LIST`; comments and empty lines may be
    among the names.

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
        found = found or compare_tails(path, listed, images, remedy, of_one_folder=False, all_folders=True)
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
    if is_utf16(path):
        raise SceneError(f"{path}: is UTF-16 text; save it as UTF-8")
    lines = (line.strip() for line in path.read_text(encoding="utf-8-sig", errors="replace").splitlines())
    return list(dict.fromkeys(plain(line) for line in lines if line and not line.startswith("#")))
