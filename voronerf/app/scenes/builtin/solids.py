"""Solids that rays are cast against: spheres, boxes, cylinders and tori, each in its own frame.

n points. Which of them a ray meets first, and where, is said by :func:`voronerf.ops.first_solid`. NumPy, so that views
can be shaded in parallel threads.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Rows = NDArray[np.int64]
Axes = tuple[Array, Array, Array]
"""x, y and z of vectors, of shapes that broadcast."""


# points [n, 3] and normals [n, 3] in the solid's frame -> colour [n, 3] in 0..1
Texture = Callable[[Array, Array], Array]


def rotation(axis: str, degrees: float) -> Array:
    """Rotation about a coordinate axis, [3, 3]."""
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    result = np.eye(3, dtype=np.float32)
    result[i, i] = result[j, j] = cosine
    result[i, j], result[j, i] = -sine, sine
    return result


def normalised(vectors: Array) -> Array:
    """Vectors [n, 3] at unit length."""
    x, y, z = vectors.T
    return vectors / np.sqrt(x * x + y * y + z * z)[:, None]


def turned(vectors: Array, matrix: Array | None) -> Array:
    """vectors [n, 3] @ matrix [3, 3], without the threads that a matrix product would start."""
    if matrix is None:
        return vectors
    x, y, z = vectors.T
    return np.stack([x * matrix[0, i] + y * matrix[1, i] + z * matrix[2, i] for i in range(3)], axis=-1)


@dataclass(frozen=True, eq=False)
class Solid(ABC):
    """A solid in a pose, with its surface.

    Attributes:
        centre: position of the solid's frame.
        texture: colour of the surface.
        gloss: strength of the highlight, 0..1.
        sharpness: Phong exponent of the highlight.
        turn: rotation of the solid's frame to the world, [3, 3], or None for none.
    """

    centre: tuple[float, float, float]
    texture: Texture
    gloss: float = 0.2
    sharpness: float = 20.0
    turn: Array | None = None

    @abstractmethod
    def extent(self) -> tuple[float, float, float]:
        """Half sides of the bounding box in the solid's own frame."""

    @abstractmethod
    def measures(self) -> tuple[float, ...]:
        """Those of its kind, see :class:`voronerf.ops.Solids`."""

    @abstractmethod
    def normal(self, points: Array) -> Array:
        """Outward unit normals of points on the surface, in the solid's own frame."""

    def bounds(self) -> Array:
        """A box in the world that holds the solid, [2, 3]; tight where the solid stands upright."""
        half = np.array(self.extent(), dtype=np.float32)
        if self.turn is not None:
            half = np.abs(self.turn) @ half
        centre = np.array(self.centre, dtype=np.float32)
        return np.stack((centre - half, centre + half))

    def surface(self, points: Array) -> tuple[Array, Array]:
        """(normals [n, 3] in the world, colours [n, 3]) of points on the surface."""
        local = turned(points - np.array(self.centre, dtype=np.float32), self.turn)
        normals = self.normal(local)
        back = None if self.turn is None else self.turn.T
        return turned(normals, back), self.texture(local, normals)


@dataclass(frozen=True, eq=False)
class Sphere(Solid):
    """A ball."""

    radius: float = 1.0

    def extent(self) -> tuple[float, float, float]:  # noqa: D102 (described by Solid)
        return self.radius, self.radius, self.radius

    def measures(self) -> tuple[float, ...]:  # noqa: D102
        return (self.radius**2,)

    def normal(self, points: Array) -> Array:  # noqa: D102
        return normalised(points)


@dataclass(frozen=True, eq=False)
class Box(Solid):
    """A box with the given half sides."""

    half: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def extent(self) -> tuple[float, float, float]:  # noqa: D102 (described by Solid)
        return self.half

    def measures(self) -> tuple[float, ...]:  # noqa: D102
        return self.half

    def normal(self, points: Array) -> Array:  # noqa: D102
        face = np.argmax(np.abs(points) / np.array(self.half, dtype=np.float32), axis=-1)[:, None]
        result = np.zeros_like(points)
        np.put_along_axis(result, face, np.sign(np.take_along_axis(points, face, -1)), -1)
        return result


@dataclass(frozen=True, eq=False)
class Cylinder(Solid):
    """A cylinder around the z axis of its frame, with flat ends."""

    radius: float = 1.0
    half_height: float = 1.0

    def extent(self) -> tuple[float, float, float]:  # noqa: D102 (described by Solid)
        return self.radius, self.radius, self.half_height

    def measures(self) -> tuple[float, ...]:  # noqa: D102
        return self.radius**2, self.half_height

    def normal(self, points: Array) -> Array:  # noqa: D102
        x, y, z = points.T
        around = np.hypot(x, y)
        end = np.abs(z) / self.half_height > around / self.radius
        safe = np.maximum(around, np.float32(1e-9))
        columns = np.where(end, 0, x / safe), np.where(end, 0, y / safe), np.where(end, np.sign(z), 0)
        return np.stack(columns, axis=-1)


@dataclass(frozen=True, eq=False)
class Torus(Solid):
    """A ring around the z axis of its frame."""

    ring: float = 1.0
    tube: float = 0.25

    def extent(self) -> tuple[float, float, float]:  # noqa: D102 (described by Solid)
        return self.ring + self.tube, self.ring + self.tube, self.tube

    def measures(self) -> tuple[float, ...]:  # noqa: D102
        return self.ring, self.tube, self.ring + self.tube

    def normal(self, points: Array) -> Array:  # noqa: D102
        x, y, z = points.T
        inward = 1 - self.ring / np.hypot(x, y)
        return normalised(np.stack((x * inward, y * inward, z), axis=-1))


def slab(origins: Axes, directions: Axes, half: Sequence[float | Array]) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Where rays are inside of a box around the origin: (enter, leave, hit). One behind them is missed."""
    lows, highs = [], []
    for o, d, side in zip(origins, directions, half):
        d = np.where(np.abs(d) < 1e-9, np.float32(1e-9), d)
        low, high = (-side - o) / d, (side - o) / d
        lows.append(np.minimum(low, high))
        highs.append(np.maximum(low, high))
    enter, leave = np.maximum(np.maximum(*lows[:2]), lows[2]), np.minimum(np.minimum(*highs[:2]), highs[2])
    return enter, leave, (leave > enter) & (enter > 0)
