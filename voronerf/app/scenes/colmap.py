"""Reads COLMAP's sparse models: `cameras`, `images` and `points3D`, binary or text.

c images, n points, s observations of points in images. COLMAP's poses are world to camera, with axes x right, y down, z
forward; voronerf's are camera to world with OpenGL's axes. Every count in a file is compared with the remaining bytes,
so that a corrupt count allocates no memory.

Source: COLMAP, "Output Format". Models of rigs also store the pose of each image in `images`; only these poses are
read.
"""

from __future__ import annotations

import contextlib
import os
import re
import struct
from collections.abc import Iterator
from itertools import starmap
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from voronerf.app.files import is_utf16, leads_outside
from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.folders import (
    ImageFolder,
    choose_images,
    image_folders,
    named_files,
    named_images,
    other_folder,
)
from voronerf.app.scenes.images import read_header
from voronerf.app.scenes.lenses import EQUIRECTANGULAR, MODELS, OTHER_MODELS, Lens, colmap_lens
from voronerf.app.scenes.names import plain, stay_inside
from voronerf.app.scenes.photographs import Reading, View, photograph_scene
from voronerf.app.scenes.scene import Scene
from voronerf.app.scenes.transforms import LARGEST, LONGEST

Array = NDArray[Any]

FILES = ("cameras", "images", "points3D")
#: Model folders in a scene's folder, and their image folders, in the order of the search. A model folder holds one
#: model, or models 0, 1, ... These are the layouts of COLMAP, nerfstudio, gaussian-splatting (before undistortion),
#: image_undistorter, automatic_reconstructor and GLOMAP.
PLACES = {
    "sparse": "images",
    "colmap/sparse": "images",
    "distorted/sparse": "input",
    "dense/sparse": "dense/images",
    ".": "images",
    "dense/0/sparse": "dense/0/images",
    "output": "images",
}
#: The largest size of a file in bytes.
MOST_BYTES = 2**31
#: The minimum number of images that see a point; if fewer images see it, its position is too uncertain.
LEAST_SEEN = 3
#: The first invalid point number: COLMAP writes 2^64 - 1 for an observation without a point.
NO_POINT = 2**63
#: The fraction of a view's points that is dropped at each end of the depths, and the minimum number of points for depth
#: bounds.
OUTLIERS, LEAST_POINTS = 0.01, 20


class ColmapCamera(NamedTuple):
    """A camera: its COLMAP model's name, its lens, and the size of its images in pixels."""

    model: str
    lens: Lens
    width: int
    height: int


class ColmapImage(NamedTuple):
    """An image of a sparse model.

    Attributes:
        name: the file name.
        camera: the camera.
        pose: float64 [4, 4], camera to world, with OpenGL's axes.
        points: int64 [s], the numbers of the points that the image shows.
    """

    name: str
    camera: ColmapCamera
    pose: Array
    points: Array


class ColmapModel(NamedTuple):
    """A sparse model of COLMAP: images with cameras, and points."""

    path: Path  # the file `images`
    images: list[ColmapImage]  # sorted by name
    numbers: Array  # int64 [n], ascending numbers of the points that at least three images see
    points: Array  # float64 [n, 3], positions of these points


class Models(NamedTuple):
    """The sparse models of a scene.

    Attributes:
        folder: the scene's folder.
        images: the path of the image folder in ``folder``.
        paths: the folders of the models, in the order of the models' numbers.
    """

    folder: Path
    images: str
    paths: list[Path]


def find_models(folder: Path) -> Models | None:
    """Returns the COLMAP models in a folder, or None; the folder is a scene or a model, or holds models 0, 1, ...

    Of several places with models, the first one with images is taken.
    """
    found: list[Models] = []
    for place, images in PLACES.items():
        base = Path(os.path.abspath(folder)) if place == "." else folder
        inside = base / place
        numbered = sorted(
            (path for path in inside.glob("[0-9]*") if path.name.isdecimal()), key=lambda path: int(path.name)
        )
        if paths := [path for path in (*numbered, inside) if _suffix(path)]:
            found.append(Models(*(_scene_around(base) if place == "." else (base, images)), paths))
    with_images = (models for models in found if image_folders(models.folder, models.images))
    return next(with_images, found[0] if found else None)


def _scene_around(folder: Path) -> tuple[Path, str]:
    """Returns (scene folder, path of the images in it); ``folder`` is the scene folder or a model folder inside it."""
    models = folder.parent if folder.name.isdecimal() else folder
    scenes = [
        (around, images)
        for place, images in PLACES.items()
        if (around := Path(*models.parts[: len(models.parts) - len(Path(place).parts)])) / place == models
    ]
    if image_folders(folder) or (
        any(path.is_dir() and not path.name.isdecimal() for path in folder.iterdir())
        and not any(starmap(image_folders, scenes))
    ):
        return folder, PLACES["."]  # without `images`, one of the folders inside may have the images
    return next((scene for scene in scenes if image_folders(*scene)), scenes[0])


def _suffix(folder: Path) -> str | None:
    """Returns the suffix of a model's files, .bin if both kinds exist; None for a folder without a model."""
    for suffix in (".bin", ".txt"):
        if all((folder / f"{name}{suffix}").is_file() for name in FILES[:2]):
            return suffix
    return None


def _count_images(folder: Path) -> int:
    """Returns the number of images of a model; 0 for a broken model. Binary files are not read in full."""
    path = folder / f"images{_suffix(folder)}"
    try:
        if path.suffix == ".txt":
            return sum(1 for _ in _text_images(path))
        with open(path, "rb") as file:
            count = int.from_bytes(file.read(8), "little")
        return count if count * LEAST_IMAGE <= path.stat().st_size else 0
    except (OSError, SceneError):
        return 0


def read_model(folder: Path) -> ColmapModel:
    """Reads a model, from the binary files if both kinds exist. Without `points3D`, the model has no points."""
    suffix = _suffix(folder) or ".bin"
    cameras_path, images_path, points_path = (folder / f"{name}{suffix}" for name in FILES)
    binary = suffix == ".bin"
    try:
        cameras = dict((_cameras if binary else _text_cameras)(cameras_path))
        images = []
        for name, camera, values, points in (_images if binary else _text_images)(images_path):
            if "\0" in name:
                raise SceneError(f"{images_path}: the name of an image must have no zero byte, got {name!r:.60}")
            if camera not in cameras:
                raise SceneError(
                    f"{images_path}: image {name} has camera {camera}, which is missing in {cameras_path.name}"
                )
            images.append(ColmapImage(name, cameras[camera], _pose(values, f"{images_path}: image {name}"), points))
        numbers, points = np.zeros(0, dtype=np.int64), np.zeros((0, 3))
        if points_path.is_file():
            rows = list((_points if binary else _text_points)(points_path))
            kept = sorted(
                (number, x, y, z) for number, x, y, z, seen in rows if seen >= LEAST_SEEN and number < NO_POINT
            )
            numbers = np.array([row[0] for row in kept], dtype=np.int64)
            points = np.array([row[1:] for row in kept], dtype=np.float64).reshape(-1, 3)
            if not (np.abs(points) <= LARGEST).all():
                raise SceneError(f"{points_path}: has points that are not finite, or beyond {LARGEST:.0e}")
    except OSError as error:
        raise SceneError(f"{error.filename}: cannot be read: {error.strerror}") from None
    if not images:
        raise SceneError(f"{images_path}: has no images")
    return ColmapModel(images_path, sorted(images, key=lambda image: image.name), numbers, points)


def _check_size(path: Path) -> None:
    if path.stat().st_size > MOST_BYTES:
        raise SceneError(f"{path}: must be at most {MOST_BYTES / 2**30:g} GiB")


class _Reader:
    """A reader of the values in a binary file, one after another."""

    def __init__(self, path: Path) -> None:
        _check_size(path)
        self.path, self.data, self.offset = path, path.read_bytes(), 0

    def count(self, least: int, what: str) -> int:
        """Reads the count of records, and checks that records of at least ``least`` bytes fit into the file."""
        (count,) = self.values("<Q")
        remaining = len(self.data) - self.offset
        if count * least > remaining:
            raise SceneError(f"{self.path}: is cut short or broken: {count} {what} do not fit into {remaining} bytes")
        return int(count)

    def values(self, layout: str) -> tuple[Any, ...]:
        end = self.offset + struct.calcsize(layout)
        if end > len(self.data):
            raise SceneError(f"{self.path}: is cut short: it ends at byte {len(self.data)}, within a record")
        numbers = struct.unpack_from(layout, self.data, self.offset)
        self.offset = end
        return numbers

    def name(self) -> str:
        end = self.data.find(b"\0", self.offset)
        if end < 0:
            raise SceneError(f"{self.path}: is cut short: it ends within the name of an image")
        text = self.data[self.offset : end].decode(errors="replace")
        self.offset = end + 1
        return text

    def records(self, count: int, kind: np.dtype[Any]) -> Array:
        rows = np.frombuffer(self.data, kind, count, self.offset)
        self.offset += count * kind.itemsize
        return rows


def _cameras(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    reader = _Reader(path)
    for _ in range(reader.count(24 + 2 * 8, "cameras")):
        number, model, width, height = reader.values("<IiQQ")
        unknown = OTHER_MODELS.get(model, f"number {model}, newer than COLMAP 4.2,")
        name, parameters = MODELS.get(model, (unknown, ""))
        yield number, _camera(path, number, name, width, height, reader.values(f"<{len(parameters.split())}d"))


#: The size in bytes of the smallest image record, with no observations and an empty name.
LEAST_IMAGE = 64 + 1 + 8
OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
RawImage = tuple[str, int, tuple[float, ...], Array]


def _images(path: Path) -> Iterator[RawImage]:
    reader = _Reader(path)
    for _ in range(reader.count(LEAST_IMAGE, "images")):
        _, *values, camera = reader.values("<I7dI")
        name = reader.name()
        seen = reader.records(reader.count(OBSERVATION.itemsize, "observations"), OBSERVATION)["point"]
        yield name, camera, tuple(values), seen[seen >= 0]


def _points(path: Path) -> Iterator[tuple[int, float, float, float, int]]:
    reader = _Reader(path)
    for _ in range(reader.count(43 + 8, "points")):
        number, x, y, z = reader.values("<Q3d")
        reader.offset += 3 + 8  # colour and error
        seen = reader.count(8, "observations")
        reader.offset += 8 * seen
        yield number, x, y, z, seen


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yields the number and the words of each line except comments; empty lines have no words."""
    _check_size(path)
    with open(path, "rb") as start:
        utf16 = is_utf16(start.read(2))
    if utf16:
        raise SceneError(f"{path}: is UTF-16 text; save it as UTF-8")
    with open(path, encoding="utf-8-sig", errors="replace") as file:  # Windows programs may write a byte order mark
        for number, line in enumerate(file, 1):
            if not line.startswith("#"):
                yield number, line.split()


@contextlib.contextmanager
def _line_of(what: str, path: Path, line: int, words: list[str]) -> Iterator[None]:
    try:
        yield
    except (ValueError, IndexError, OverflowError):
        comma = next((word for word in words if re.fullmatch(r"[-+]?\d+,\d+(e[-+]?\d+)?", word, re.IGNORECASE)), None)
        cause = f", since it has decimal commas: write {comma.replace(',', '.')} instead of {comma}" if comma else ""
        raise SceneError(f"{path}: line {line} does not describe {what}{cause}") from None


def _text_cameras(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    for line, words in _lines(path):
        if not words:
            continue
        with _line_of("a camera", path, line, words):
            number, (width, height), parameters = int(words[0]), map(int, words[2:4]), [float(x) for x in words[4:]]
        yield number, _camera(path, number, words[1], width, height, parameters)


def _text_images(path: Path) -> Iterator[RawImage]:
    lines = _lines(path)
    for line, words in lines:
        if not words:
            continue
        with _line_of("an image", path, line, words):
            values, camera, name = tuple(map(float, words[1:8])), int(words[8]), " ".join(words[9:])
        line, seen = next(lines, (line + 1, []))  # the line of the image's observations, which may be empty
        with _line_of("the points of an image", path, line, seen):
            numbers = [int(number) for number in seen[2::3]]
        yield name, camera, values, np.array([number for number in numbers if 0 <= number < NO_POINT], dtype=np.int64)


def _text_points(path: Path) -> Iterator[tuple[int, float, float, float, int]]:
    for line, words in _lines(path):
        if not words:
            continue
        with _line_of("a point", path, line, words):
            number, (x, y, z), seen = int(words[0]), map(float, words[1:4]), (len(words) - 8) // 2
        yield number, x, y, z, seen


def _camera(path: Path, number: int, model: str, width: int, height: int, parameters: Any) -> ColmapCamera:
    try:
        lens = colmap_lens(model, parameters)
    except ValueError as error:
        raise SceneError(f"{path}: camera {number}: {error}") from None
    finite = np.isfinite((*lens.intrinsics, *lens.coefficients)).all() and all(
        0 < side <= LARGEST for side in (width, height)
    )
    if not finite or not all(1 / LONGEST <= f / side <= LONGEST for f, side in zip(lens.intrinsics, (width, height))):
        raise SceneError(
            f"{path}: camera {number} must have a size, finite parameters, and a focal length of {1 / LONGEST:g} to "
            f"{LONGEST} times its images"
        )
    return ColmapCamera(model, lens, width, height)


def _pose(values: tuple[float, ...], where: str) -> Array:
    """Returns the camera-to-world pose [4, 4] of a world-to-camera unit quaternion (w, x, y, z) and translation."""
    numbers = np.array(values, dtype=np.float64)
    length = np.linalg.norm(numbers[:4]) if len(numbers) == 7 else 0.0
    if not ((np.abs(numbers) <= LARGEST).all() and abs(length - 1) < 0.01):
        raise SceneError(f"{where}: its pose must be a unit quaternion and a translation of up to {LARGEST:.0e}")
    w, x, y, z = numbers[:4] / length
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    pose = np.eye(4)
    pose[:3, :3] = turn.T * (1, -1, -1)
    pose[:3, 3] = -turn.T @ numbers[4:]
    return pose


def load_colmap(folder: Path, reading: Reading) -> Scene:
    """Loads a capture with a COLMAP model; every 8th image in the order of names is held out for testing.

    Lists of test images override this rule, see `listed_split`. If there are several models, the one with the most
    images is read. Masks lie in `masks` beside the images; their black pixels are neither trained nor scored. The
    bounds of a view are the depths between which 98 % of its points lie.
    """
    models = find_models(folder)
    if models is None:
        raise SceneError(f"{folder}: has no COLMAP model, cameras and images as .bin or .txt, in sparse/0 or sparse")
    folder = models.folder
    inside = [path for path in models.paths if reading.allow_outside or not leads_outside(path / "images.bin", folder)]
    counts = {path: _count_images(path) for path in inside} if len(inside) > 1 else {}
    place = max(counts, key=lambda path: counts[path], default=(inside or models.paths)[0])
    for part in place.iterdir():
        stay_inside(part, folder, reading.allow_outside)
    model = read_model(place)
    names = [image.name for image in model.images]
    place_of_images, folder_notes = other_folder(model.path, folder, models.images, names, reading.allow_outside)
    chosen = choose_images(folder, reading.downscale, place_of_images)
    files, notes = named_images(model.path, chosen, names, reading.allow_outside)
    images = [(file, image) for file, image in zip(files, model.images) if file is not None]
    masks, mask_notes = _find_masks(model.path, chosen, images, reading.allow_outside)
    headers, views = [read_header(file) for file, _ in images], []
    for (file, image), mask, header in zip(images, masks, headers):
        size = (float(image.camera.width), float(image.camera.height))
        points = points_seen(image, model)
        pose, bounds, seen = torch.from_numpy(image.pose), depth_bounds(image, points), torch.from_numpy(points)
        views.append(View(file, pose, image.camera.lens, size, mask, bounds, seen, header, name=plain(image.name)))
    kinds = sorted({image.camera.model for image in model.images})
    about = [f"COLMAP model {place.relative_to(folder)} of {len(views)} images, {' and '.join(kinds)}"]
    if counts:
        sizes = ", ".join(f"{path.relative_to(folder)} of {count}" for path, count in counts.items())
        other = next(path for path in counts if path != place)
        about.append(f"the largest of the models is read: {sizes} images (--data {other} reads another one)")
    if place == folder / "dense/0/sparse" and (other := folder / "dense/1").is_dir():
        about.append(f"the first of the folders in dense is read (--data {other} reads another one)")
    about += [*folder_notes, *chosen.notes, *notes, *mask_notes]
    factor = chosen.reduction(headers)
    return photograph_scene(model.path, folder, views, None, reading, factor=factor, notes=about)


def _find_masks(
    source: Path, folder: ImageFolder, images: list[tuple[Path, ColmapImage]], allow_outside: bool
) -> tuple[list[Path | None], list[str]]:
    """Returns the mask file of each image, or None, and lines for the user about the masks.

    The mask of 0.jpg is 0.jpg.png (COLMAP's name) or 0.png.
    """
    masks = folder.masks
    if masks is None:
        return [None] * len(images), []
    names = [_name_inside(folder.path / image.name.replace("\\", "/"), folder.path) for _, image in images]
    files = [_name_inside(file, folder.path) for file, _ in images]
    by_name, by_file = (named_files(source, masks, keys, allow_outside) for keys in (names, files))
    result = [first or second for first, second in zip(by_name, by_file)]
    count = len(result) - result.count(None)
    return result, [f"{count} of {len(result)} images have a mask in {masks.name}, whose black pixels do not count"]


def _name_inside(path: Path, folder: Path) -> str:
    """Returns a path relative to a folder, or its file name if it lies outside the folder."""
    name = os.path.relpath(path, folder)
    return path.name if name.startswith("..") else name


def points_seen(image: ColmapImage, model: ColmapModel) -> Array:
    """Returns the points of the model that an image sees, float64 [s, 3]."""
    places = np.searchsorted(model.numbers, image.points)
    in_range = places < len(model.numbers)
    return np.asarray(model.points[places[in_range][model.numbers[places[in_range]] == image.points[in_range]]])


def depth_bounds(image: ColmapImage, points: Array) -> tuple[float, float] | None:
    """Returns the least and the largest depth of an image's points [s, 3] without outliers; None for too few points."""
    offsets = points - image.pose[:3, 3]
    panorama = image.camera.lens.model == EQUIRECTANGULAR  # without an optical axis, distances replace depths
    depth = np.linalg.norm(offsets, axis=1) if panorama else -offsets @ image.pose[:3, 2]
    depth = depth[depth > 0]
    if len(depth) < LEAST_POINTS:
        return None
    low, high = np.quantile(depth, (OUTLIERS, 1 - OUTLIERS))
    return float(low), float(high)
