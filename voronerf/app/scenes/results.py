"""Checks of the results in the folder of a stopped `voronerf process`, which may be damaged or another person's.

COLMAP reads most of these files in threads of C++, where an error, or an index that is out of range, ends the process.
Therefore all files are read once in Python's thread before COLMAP continues with them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from voronerf.app.files import leads_outside, read_json
from voronerf.app.scenes.colmap import ColmapModel
from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.folds import Pair

#: The number of columns of SIFT's descriptors.
DESCRIPTOR = 128


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


def check_database(colmap: Any, path: Path, names: Collection[str]) -> None:
    """Raises SceneError unless a database has whole features and matches, and only of images with these names."""

    def check(holds: bool, rule: str) -> None:
        if not holds:
            raise SceneError(f"{path}: {rule}; without this file, the same command computes it again")

    counts: dict[int, int] = {}
    with named_errors(str(path)), colmap.Database.open(path) as opened:
        cameras = {camera.camera_id for camera in opened.read_all_cameras()}
        rigs = {rig.rig_id for rig in opened.read_all_rigs()}
        frames = {frame.frame_id for frame in opened.read_all_frames() if frame.rig_id in rigs}
        for image in opened.read_all_images():
            name = f"image {image.name!r:.60}"
            check(image.name in names, f"{name} must be in the folder of images")
            check(image.camera_id in cameras and image.frame_id in frames, f"{name} must have a camera in a rig")
            places = opened.read_keypoints(image.image_id)
            descriptors = opened.read_descriptors(image.image_id).data
            whole = len(descriptors) == len(places) and descriptors.size == DESCRIPTOR * len(places)
            whole = whole and bool(np.isfinite(places).all())
            check(whole, f"{name} must have finite features, each with a descriptor of {DESCRIPTOR} numbers")
            counts[image.image_id] = len(places)
        geometries = zip(*opened.read_two_view_geometries())
        matches = [*zip(*opened.read_all_matches()), *((pair, each.inlier_matches) for pair, each in geometries)]
    for pair, rows in matches:
        most = [counts.get(number, 0) for number in colmap.pair_id_to_image_pair(pair)]
        check(bool((rows < np.array(most)).all()), "matches must be of features of two images")


def check_model(model: ColmapModel, names: Collection[str]) -> None:
    """Raises SceneError unless the images of a model are different images with these names."""
    listed = [image.name for image in model.images]
    if len({*names} & {*listed}) != len(listed):
        raise SceneError(f"{model.path}: must have different images of the folder of images, got {listed!r:.60}")
