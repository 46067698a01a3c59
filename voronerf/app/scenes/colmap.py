"""Reads COLMAP's sparse models: `cameras`, `images` and `points3D`, binary or text.

c images, n points, s observations of points in images. COLMAP's poses are world to camera, with axes x right, y down, z
forward; ours are camera to world with OpenGL's axes. Every count of a file is compared with the bytes that are left, so
that a broken one costs no memory.

Source: COLMAP, "Output Format". Models of rigs keep the pose of each image in `images` too, where it is read.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.folders import choose_images, named_images, stay_inside
from voronerf.app.scenes.lenses import MODELS, Lens, colmap_lens
from voronerf.app.scenes.photographs import Reading, View, photograph_scene
from voronerf.app.scenes.scene import Scene
from voronerf.app.scenes.transforms import LARGEST, LONGEST

Array = NDArray[Any]

FILES = ("cameras", "images", "points3D")
#: Bytes of a file.
MOST_BYTES = 2**31
#: Points that fewer images than this have seen are too uncertain to tell where the scene is.
LEAST_SEEN = 3
#: Numbers of points from here on are none: COLMAP writes the largest, 2^64 - 1, where an observation is of no point.
NO_POINT = 2**63
#: Share of the points of a view that may be wrong, at either end, and how many it needs.
OUTLIERS, LEAST_POINTS = 0.01, 20


class ColmapCamera(NamedTuple):
    """A lens, its model, and the size of its images in pixels."""

    model: str
    lens: Lens
    width: int
    height: int


class ColmapImage(NamedTuple):
    """An image: its file, its camera, its pose float64 [4, 4], camera to world with OpenGL's axes, and the numbers of
    the points that it sees, int64 [s]."""

    name: str
    camera: ColmapCamera
    pose: Array
    points: Array


class ColmapModel(NamedTuple):
    """A sparse model."""

    path: Path  # of the file of images
    images: list[ColmapImage]  # in the order of their names
    numbers: Array  # int64 [n], of the points that at least three images see, rising
    points: Array  # float64 [n, 3]


def find_model(folder: Path) -> Path | None:
    """The folder of a COLMAP model in that of a scene, or None."""
    for inside in ("sparse/0", "sparse", "colmap/sparse/0", "."):
        for suffix in (".bin", ".txt"):
            if all((folder / inside / f"{name}{suffix}").is_file() for name in FILES[:2]):
                return folder / inside
    return None


def read_model(folder: Path) -> ColmapModel:
    """Reads a model; binary files come first where there are both. Without `points3D` it has no points."""
    suffix = ".bin" if (folder / "images.bin").is_file() else ".txt"
    cameras_path, images_path, points_path = (folder / f"{name}{suffix}" for name in FILES)
    binary = suffix == ".bin"
    try:
        cameras = dict((_cameras if binary else _text_cameras)(cameras_path))
        images = []
        for name, camera, values, points in (_images if binary else _text_images)(images_path):
            if camera not in cameras:
                raise SceneError(f"{images_path}: image {name} has camera {camera}, which {cameras_path.name} has not")
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
    """The values of a binary file, one after another."""

    def __init__(self, path: Path) -> None:
        _check_size(path)
        self.path, self.data, self.at = path, path.read_bytes(), 0

    def count(self, least: int, what: str) -> int:
        """A count of records of at least so many bytes each."""
        (count,) = self.values("<Q")
        left = len(self.data) - self.at
        if count * least > left:
            raise SceneError(f"{self.path}: is cut short or broken: {count} {what} do not fit into {left} bytes")
        return int(count)

    def values(self, layout: str) -> tuple[Any, ...]:
        end = self.at + struct.calcsize(layout)
        if end > len(self.data):
            raise SceneError(f"{self.path}: is cut short: it ends at byte {len(self.data)}, within a record")
        numbers = struct.unpack_from(layout, self.data, self.at)
        self.at = end
        return numbers

    def name(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise SceneError(f"{self.path}: is cut short: it ends within the name of an image")
        text = self.data[self.at : end].decode(errors="replace")
        self.at = end + 1
        return text

    def records(self, count: int, kind: np.dtype[Any]) -> Array:
        rows = np.frombuffer(self.data, kind, count, self.at)
        self.at += count * kind.itemsize
        return rows


def _cameras(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    reader = _Reader(path)
    for _ in range(reader.count(24 + 3 * 8, "cameras")):
        number, model, width, height = reader.values("<IiQQ")
        if model not in MODELS:
            raise SceneError(f"{path}: camera {number} has model number {model}, which is not known")
        name, parameters = MODELS[model]
        yield number, _camera(path, number, name, width, height, reader.values(f"<{len(parameters.split())}d"))


OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
RawImage = tuple[str, int, tuple[float, ...], Array]


def _images(path: Path) -> Iterator[RawImage]:
    reader = _Reader(path)
    for _ in range(reader.count(64 + 1 + 8, "images")):
        _, *values, camera = reader.values("<I7dI")
        name = reader.name()
        seen = reader.records(reader.count(OBSERVATION.itemsize, "observations"), OBSERVATION)["point"]
        yield name, camera, tuple(values), seen[seen >= 0]


def _points(path: Path) -> Iterator[tuple[int, float, float, float, int]]:
    reader = _Reader(path)
    for _ in range(reader.count(43 + 8, "points")):
        number, x, y, z = reader.values("<Q3d")
        reader.at += 3 + 8  # colour and error
        seen = reader.count(8, "observations")
        reader.at += 8 * seen
        yield number, x, y, z, seen


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """The words of each line that is no comment, empty ones too, with its number."""
    _check_size(path)
    with open(path, encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            if not line.startswith("#"):
                yield number, line.split()


@contextlib.contextmanager
def _line_of(what: str, path: Path, line: int) -> Iterator[None]:
    try:
        yield
    except (ValueError, IndexError, OverflowError):
        raise SceneError(f"{path}: line {line} is not that of {what}") from None


def _text_cameras(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    for line, words in _lines(path):
        if not words:
            continue
        with _line_of("a camera", path, line):
            number, (width, height), parameters = int(words[0]), map(int, words[2:4]), [float(x) for x in words[4:]]
        yield number, _camera(path, number, words[1], width, height, parameters)


def _text_images(path: Path) -> Iterator[RawImage]:
    lines = _lines(path)
    for line, words in lines:
        if not words:
            continue
        with _line_of("an image", path, line):
            values, camera, name = tuple(map(float, words[1:8])), int(words[8]), " ".join(words[9:])
        line, seen = next(lines, (line + 1, []))  # of its points, and empty without any
        with _line_of("the points of an image", path, line):
            numbers = [int(number) for number in seen[2::3]]
        yield name, camera, values, np.array([number for number in numbers if 0 <= number < NO_POINT], dtype=np.int64)


def _text_points(path: Path) -> Iterator[tuple[int, float, float, float, int]]:
    for line, words in _lines(path):
        if not words:
            continue
        with _line_of("a point", path, line):
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
    """The pose of a unit quaternion (w, x, y, z) and a translation, both world to camera."""
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
    """Loads a capture with a COLMAP model; every 8th image in the order of their names is held out for testing.

    The bounds of a view are the depths between which 98 % of its points lie.
    """
    place = find_model(folder)
    if place is None:
        raise SceneError(f"{folder}: has no COLMAP model, cameras and images as .bin or .txt, in sparse/0 or sparse")
    for part in place.iterdir():
        stay_inside(part, folder, reading.allow_outside)
    model = read_model(place)
    longest = max(max(image.camera.width, image.camera.height) for image in model.images)
    chosen = choose_images(folder, reading.downscale, longest)
    names = [image.name for image in model.images]
    views = []
    for file, image in zip(named_images(model.path, chosen.path, names, reading.allow_outside), model.images):
        if file is not None:
            size = (float(image.camera.width), float(image.camera.height))
            points = points_seen(image, model)
            bounds, pose = depth_bounds(image, points), torch.from_numpy(image.pose)
            views.append(View(file, pose, image.camera.lens, size, None, bounds, torch.from_numpy(points)))
    models = sorted({image.camera.model for image in model.images})
    about = [f"COLMAP model {place.relative_to(folder)} of {len(views)} images, {' and '.join(models)}", *chosen.notes]
    if (folder / "sparse" / "1").is_dir():
        about.append("other models in sparse are not read")
    return photograph_scene(model.path, folder, views, None, reading, factor=chosen.factor, notes=about)


def points_seen(image: ColmapImage, model: ColmapModel) -> Array:
    """The points of the model that an image sees, float64 [s, 3]."""
    at = np.searchsorted(model.numbers, image.points)
    known = at < len(model.numbers)
    return np.asarray(model.points[at[known][model.numbers[at[known]] == image.points[known]]])


def depth_bounds(image: ColmapImage, points: Array) -> tuple[float, float] | None:
    """The depths between which the points [s, 3] of an image lie, but for outliers; None if they are too few."""
    depth = -(points - image.pose[:3, 3]) @ image.pose[:3, 2]
    depth = depth[depth > 0]
    if len(depth) < LEAST_POINTS:
        return None
    low, high = np.quantile(depth, (OUTLIERS, 1 - OUTLIERS))
    return float(low), float(high)
