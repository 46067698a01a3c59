"""Solids for ray casting: spheres, boxes, cylinders and tori, each in its own frame.

Sizes: n points, r rays. Distances are along unit directions, infinite for a miss. Rays must start outside all solids. A
ray that starts inside the bounding box of a torus misses the torus.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Axes = tuple[Array, Array, Array]
"""The x, y and z coordinates of vectors, with shapes that broadcast."""
TRACE_STEPS = 40
SURFACE = 5e-4  # distance from a torus below which sphere tracing reports a hit

# points [n, 3] and normals [n, 3] in the solid's frame -> colour [n, 3] in 0..1
Texture = Callable[[Array, Array], Array]


def rotation(axis: str, degrees: float) -> Array:
    """Returns the rotation about a coordinate axis, [3, 3]."""
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    result = np.eye(3, dtype=np.float32)
    result[i, i] = result[j, j] = cosine
    result[i, j], result[j, i] = -sine, sine
    return result


def normalised(vectors: Array) -> Array:
    """Returns vectors [n, 3] scaled to unit length."""
    x, y, z = vectors.T
    return vectors / np.sqrt(x * x + y * y + z * z)[:, None]


def turned(vectors: Axes, matrix: Array) -> Axes:
    """Returns vectors @ matrix [3, 3, ...].

    The matrix's trailing axes broadcast with the vectors. The product starts no BLAS threads.
    """
    x, y, z = vectors
    first, second, third = (x * matrix[0, i] + y * matrix[1, i] + z * matrix[2, i] for i in range(3))
    return first, second, third


@dataclass(frozen=True, eq=False)
class Solid(ABC):
    """A solid with its pose and its surface.

    Attributes:
        centre: origin of the solid's frame, in the world.
        texture: function that returns the colours of surface points.
        gloss: strength of the highlight, 0..1.
        sharpness: Phong exponent of the highlight.
        turn: rotation from the solid's frame to the world, [3, 3]; None for no rotation.
    """

    centre: tuple[float, float, float]
    texture: Texture
    gloss: float = 0.2
    sharpness: float = 20.0
    turn: Array | None = None

    @abstractmethod
    def extent(self) -> tuple[float, float, float]:
        """Returns the half sides of the bounding box in the solid's frame."""

    @abstractmethod
    def measures(self) -> tuple[float, ...]:
        """Returns the solid's dimensions as `distance` takes them: at most three numbers, such as a squared radius."""

    @staticmethod
    @abstractmethod
    def distance(origins: Axes, directions: Axes, measures: Array) -> Array:
        """Returns the distances [r] along rays, in the solids' frames, to solids with `measures` [3, r]."""

    @abstractmethod
    def normal(self, points: Array) -> Array:
        """Returns the outward unit normals at surface points [n, 3], in the solid's frame."""

    def bounds(self) -> Array:
        """Returns a bounding box in world axes, [2, 3]; tight for an unrotated solid."""
        half = np.array(self.extent(), dtype=np.float32)
        if self.turn is not None:
            half = np.abs(self.turn) @ half
        centre = np.array(self.centre, dtype=np.float32)
        return np.stack((centre - half, centre + half))

    def surface(self, points: Array) -> tuple[Array, Array]:
        """Returns (normals [n, 3], colours [n, 3]) at surface points [n, 3], in world coordinates."""
        local = points - np.array(self.centre, dtype=np.float32)
        if self.turn is not None:
            local = np.stack(turned(tuple(local.T), self.turn), axis=-1)
        normals = self.normal(local)
        colours = self.texture(local, normals)
        if self.turn is not None:
            normals = np.stack(turned(tuple(normals.T), self.turn.T), axis=-1)
        return normals, colours


@dataclass(frozen=True, eq=False)
class Sphere(Solid):
    """A ball."""

    radius: float = 1.0

    def extent(self) -> tuple[float, float, float]:  # noqa: D102 (described by Solid)
        return self.radius, self.radius, self.radius

    def measures(self) -> tuple[float, ...]:  # noqa: D102
        return (self.radius**2,)

    @staticmethod
    def distance(origins: Axes, directions: Axes, measures: Array) -> Array:  # noqa: D102
        (ox, oy, oz), (dx, dy, dz) = origins, directions
        b = ox * dx + oy * dy + oz * dz
        root = b * b - (ox * ox + oy * oy + oz * oz) + measures[0]
        t = -b - np.sqrt(np.maximum(root, 0))
        return np.where((root >= 0) & (t > 0), t, np.float32(np.inf))

    def normal(self, points: Array) -> Array:  # noqa: D102
        return normalised(points)


@dataclass(frozen=True, eq=False)
class Box(Solid):
    """A box with half sides `half`."""

    half: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def extent(self) -> tuple[float, float, float]:  # noqa: D102 (described by Solid)
        return self.half

    def measures(self) -> tuple[float, ...]:  # noqa: D102
        return self.half

    @staticmethod
    def distance(origins: Axes, directions: Axes, measures: Array) -> Array:  # noqa: D102
        enter, leave = slab(origins, directions, measures)
        return np.where((leave > enter) & (enter > 0), enter, np.float32(np.inf))

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

    @staticmethod
    def distance(origins: Axes, directions: Axes, measures: Array) -> Array:  # noqa: D102
        # A cylinder is the intersection of an infinite tube and a slab. The ray enters it at the larger of its two
        # entry distances, and leaves it at the smaller of its two exit distances.
        (ox, oy, oz), (dx, dy, dz), (square, half_height, _) = origins, directions, measures
        a = np.maximum(dx * dx + dy * dy, np.float32(1e-12))
        b, c = ox * dx + oy * dy, ox * ox + oy * oy - square
        root = b * b - a * c
        spread = np.sqrt(np.maximum(root, 0))
        dz = np.where(np.abs(dz) < 1e-9, np.float32(1e-9), dz)
        low, high = (-half_height - oz) / dz, (half_height - oz) / dz
        enter = np.maximum((-b - spread) / a, np.minimum(low, high))
        leave = np.minimum((-b + spread) / a, np.maximum(low, high))
        return np.where((root >= 0) & (enter <= leave) & (enter > 0), enter, np.float32(np.inf))

    def normal(self, points: Array) -> Array:  # noqa: D102
        x, y, z = points.T
        around = np.hypot(x, y)
        end = np.abs(z) / self.half_height > around / self.radius
        safe = np.maximum(around, np.float32(1e-9))
        columns = np.where(end, 0, x / safe), np.where(end, 0, y / safe), np.where(end, np.sign(z), 0)
        return np.stack(columns, axis=-1)


@dataclass(frozen=True, eq=False)
class Torus(Solid):
    """A ring around the z axis of its frame; hits are found by sphere tracing with its exact distance (Hart 1996)."""

    ring: float = 1.0
    tube: float = 0.25

    def extent(self) -> tuple[float, float, float]:  # noqa: D102 (described by Solid)
        return self.ring + self.tube, self.ring + self.tube, self.tube

    def measures(self) -> tuple[float, ...]:  # noqa: D102
        return self.ring, self.tube, self.ring + self.tube

    @staticmethod
    def distance(origins: Axes, directions: Axes, measures: Array) -> Array:  # noqa: D102
        ring, tube, outer = measures
        t, leave = slab(origins, directions, np.stack((outer, outer, tube)))
        nearest = np.full_like(t, np.inf)
        rows = ((leave > t) & (t > 0)).nonzero()[0]
        state = np.stack([values[rows] for values in (t, leave, *origins, *directions, ring, tube)])
        for _ in range(TRACE_STEPS):
            t, leave, ox, oy, oz, dx, dy, dz, ring, tube = state
            gap = np.hypot(np.hypot(ox + t * dx, oy + t * dy) - ring, oz + t * dz) - tube
            arrived = gap < SURFACE
            nearest[rows[arrived]] = t[arrived]
            state[0] = t + gap
            active = ~arrived & (state[0] < leave)
            rows, state = rows[active], state[:, active]
        return nearest

    def normal(self, points: Array) -> Array:  # noqa: D102
        x, y, z = points.T
        inward = 1 - self.ring / np.hypot(x, y)
        return normalised(np.stack((x * inward, y * inward, z), axis=-1))


def slab(origins: Axes, directions: Axes, half: Array) -> tuple[Array, Array]:
    """Returns (entry, exit) distances of rays at a box around the origin with half sides `half` [3, ...].

    For a miss, the entry is larger than the exit.
    """
    lows, highs = [], []
    for o, d, side in zip(origins, directions, half):
        d = np.where(np.abs(d) < 1e-9, np.float32(1e-9), d)
        low, high = (-side - o) / d, (side - o) / d
        lows.append(np.minimum(low, high))
        highs.append(np.maximum(low, high))
    return np.maximum(np.maximum(*lows[:2]), lows[2]), np.minimum(np.minimum(*highs[:2]), highs[2])
