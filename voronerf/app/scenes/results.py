"""Checks of the results in the folder of a stopped `voronerf process`, which may be damaged or another person's.

COLMAP reads most of these files in threads of C++, where an error, or an index that is out of range, ends the process.
Therefore all files are read once in Python's thread before COLMAP continues with them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from voronerf.app.files import leads_outside, read_json
from voronerf.app.scenes.colmap import ColmapModel
from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.folds import Pair

#: The number of columns of SIFT's descriptors.
DESCRIPTOR = 128
#: The tables of a database whose rows are matrices: the bytes of a number, and the possible numbers of columns.
MATRICES = {
    "keypoints": (4, (2, 4, 6)),
    "descriptors": (1, (DESCRIPTOR,)),
    "matches": (4, (2,)),
    "two_view_geometries": (4, (2,)),
}


@contextlib.contextmanager
def named_errors(stage: str) -> Iterator[None]:
    """A context in which the errors of COLMAP and of reading become a SceneError that names the stage."""
    try:
        yield
    except SceneError:
        raise
    except (RuntimeError, ValueError, LookupError, ArithmeticError, MemoryError) as error:
        raise SceneError(f"{stage}: {' '.join(str(error).split())[:300]}") from None


def check_files(out: Path) -> None:
    """Raises SceneError unless a folder has only files and folders: COLMAP would write through a link."""
    for path in out.rglob("*"):
        if leads_outside(path, out) or not (path.is_file() or path.is_dir()):
            raise SceneError(f"{path}: must be a file or a folder in {out}, got a link to another place or a device")


def read_result(path: Path, kind: type) -> Any:
    """Returns the contents of a JSON file, a dict or a list."""
    try:
        return read_json(path, kind)
    except ValueError as error:
        raise SceneError(str(error)) from None


def read_pairs(path: Path, names: Collection[str]) -> list[Pair]:
    """Returns the stored pairs of images that are to be matched."""
    pairs = read_result(path, list)
    for pair in pairs:
        if not (isinstance(pair, list) and len(pair) == 2 and all(isinstance(x, str) and x in names for x in pair)):
            raise SceneError(f"{path}: must have pairs of names of images, got {pair!r:.60}")
    return [(a, b) for a, b in pairs]


def check_database(colmap: Any, path: Path, sizes: Mapping[str, tuple[int, int]]) -> None:
    """Raises SceneError unless the features and matches in a database are valid, and all belong to images in ``sizes``.

    ``sizes`` maps the images' names to their sizes. Some of COLMAP's solvers crash for positions far from an image.
    """

    def check(holds: bool, rule: str) -> None:
        if not holds:
            raise SceneError(f"{path}: {rule}; without this file, the same command computes it again")

    for table, wrong in _wrong_matrices(path).items():
        check(wrong is None, f"{table} must have whole matrices, got {wrong} rows and columns")
    counts: dict[int, int] = {}
    with named_errors(str(path)), colmap.Database.open(path) as opened:
        cameras = {camera.camera_id for camera in opened.read_all_cameras()}
        rigs = {rig.rig_id for rig in opened.read_all_rigs()}
        frames = {frame.frame_id for frame in opened.read_all_frames() if frame.rig_id in rigs}
        for image in opened.read_all_images():
            name = f"image {image.name!r:.60}"
            check(image.name in sizes, f"{name} must be in the folder of images")
            check(image.camera_id in cameras and image.frame_id in frames, f"{name} must have a camera in a rig")
            places = opened.read_keypoints(image.image_id)
            descriptors = opened.read_descriptors(image.image_id).data
            inside = (places[:, :2] >= 0) & (places[:, :2] <= max(sizes[image.name]))
            check(bool(inside.all() and np.isfinite(places).all()), f"{name} must have finite features in the image")
            check(len(descriptors) == len(places), f"{name} must have a descriptor of each feature")
            counts[image.image_id] = len(places)
        geometries = zip(*opened.read_two_view_geometries())
        matches = [*zip(*opened.read_all_matches()), *((pair, each.inlier_matches) for pair, each in geometries)]
    for pair, rows in matches:
        most = [counts.get(number, 0) for number in colmap.pair_id_to_image_pair(pair)]
        check(bool((rows < np.array(most)).all()), "matches must be of features of two images")


def _wrong_matrices(path: Path) -> dict[str, tuple[Any, Any] | None]:
    """Returns (rows, columns) of an invalid matrix in each table of a database; None for a table without one.

    COLMAP allocates and copies a matrix before it compares the size with the stored bytes, if it compares them at all.
    """
    import sqlite3  # some Pythons lack it

    try:
        with contextlib.closing(sqlite3.connect(path)) as opened:
            tables = {name for (name,) in opened.execute("SELECT name FROM sqlite_master")} & MATRICES.keys()
            wrong = {}
            for table in sorted(tables):
                size, columns = MATRICES[table]
                shape = f"rows BETWEEN 0 AND {2**31} AND (rows = 0 OR cols IN ({', '.join(map(str, columns))}))"
                whole = f"{shape} AND coalesce(length(CAST(data AS BLOB)), 0) = rows * cols * {size}"
                wrong[table] = opened.execute(f"SELECT rows, cols FROM {table} WHERE ({whole}) IS NOT 1").fetchone()
            return wrong
    except sqlite3.Error as error:
        raise SceneError(f"{path}: {error}") from None


def check_model(model: ColmapModel, names: Collection[str]) -> None:
    """Raises SceneError unless the images of a model are different images with these names."""
    listed = [image.name for image in model.images]
    if len({*names} & {*listed}) != len(listed):
        raise SceneError(f"{model.path}: must have different images of the folder of images, got {listed!r:.60}")
