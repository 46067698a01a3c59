"""Solids that rays are cast against: spheres, boxes, cylinders and tori, each in its own frame.

r rays, n points. Distances are along unit directions, infinite where a ray misses. Rays start outside of every
solid; one that starts inside of the box around a torus does not see it. NumPy, so that views can be cast in parallel
threads.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

TRACE_STEPS = 40
SURFACE = 5e-4  # a traced ray closer than this to a torus has hit it

Array = NDArray[np.float32]
Rows = NDArray[np.int64]


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
    def distance(self, origins: Array, directions: Array) -> Array:
        """Distance to the first hit in the solid's own frame, [r]."""

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

    def hit(self, origins: Array, directions: Array) -> Array:
        """Distance to the first hit of rays in the world, [r]; either argument may be [1, 3] for all rays."""
        start = turned(origins - np.array(self.centre, dtype=np.float32), self.turn)
        along = turned(directions, self.turn)
        shape = np.broadcast_shapes(start.shape, along.shape)
        return self.distance(np.broadcast_to(start, shape), np.broadcast_to(along, shape))

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

    def distance(self, origins: Array, directions: Array) -> Array:  # noqa: D102
        (ox, oy, oz), (dx, dy, dz) = origins.T, directions.T
        b = ox * dx + oy * dy + oz * dz
        root = b * b - (ox * ox + oy * oy + oz * oz) + np.float32(self.radius**2)
        t = -b - np.sqrt(np.maximum(root, 0))
        return np.where((root >= 0) & (t > 0), t, np.float32(np.inf))

    def normal(self, points: Array) -> Array:  # noqa: D102
        return normalised(points)


@dataclass(frozen=True, eq=False)
class Box(Solid):
    """A box with the given half sides."""

    half: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def extent(self) -> tuple[float, float, float]:  # noqa: D102 (described by Solid)
        return self.half

    def distance(self, origins: Array, directions: Array) -> Array:  # noqa: D102
        enter, _, hit = slab(origins, directions, self.half)
        return np.where(hit, enter, np.float32(np.inf))

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

    def distance(self, origins: Array, directions: Array) -> Array:  # noqa: D102
        # the ray is inside between the later of the two entries (tube, slab) and the earlier of the two exits
        (ox, oy, oz), (dx, dy, dz) = origins.T, directions.T
        a = np.maximum(dx * dx + dy * dy, np.float32(1e-12))
        b, c = ox * dx + oy * dy, ox * ox + oy * oy - np.float32(self.radius**2)
        root = b * b - a * c
        spread = np.sqrt(np.maximum(root, 0))
        dz = np.where(np.abs(dz) < 1e-9, np.float32(1e-9), dz)
        low, high = (-self.half_height - oz) / dz, (self.half_height - oz) / dz
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
    """A ring around the z axis of its frame, found by sphere tracing its exact distance (Hart 1996)."""

    ring: float = 1.0
    tube: float = 0.25

    def extent(self) -> tuple[float, float, float]:  # noqa: D102 (described by Solid)
        return self.ring + self.tube, self.ring + self.tube, self.tube

    def distance(self, origins: Array, directions: Array) -> Array:  # noqa: D102
        t, leave, inside = slab(origins, directions, self.extent())
        result = np.full_like(t, np.inf)
        rows = inside.nonzero()[0]
        t, leave, origins, directions = t[rows], leave[rows], origins[rows], directions[rows]
        for _ in range(TRACE_STEPS):
            x, y, z = (origins + t[:, None] * directions).T
            gap = np.hypot(np.hypot(x, y) - np.float32(self.ring), z) - np.float32(self.tube)
            arrived = gap < SURFACE
            result[rows[arrived]] = t[arrived]
            t = t + gap
            on = ~arrived & (t < leave)
            rows, t, leave, origins, directions = rows[on], t[on], leave[on], origins[on], directions[on]
        return result

    def normal(self, points: Array) -> Array:  # noqa: D102
        x, y, z = points.T
        inward = 1 - self.ring / np.hypot(x, y)
        return normalised(np.stack((x * inward, y * inward, z), axis=-1))


def slab(origins: Array, directions: Array, half: tuple[float, float, float]) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Where rays are inside of a box around the origin: (enter [r], leave [r], hit [r]). One behind them is missed."""
    enter, leave = np.full(len(origins), -np.inf, np.float32), np.full(len(origins), np.inf, np.float32)
    for o, d, side in zip(origins.T, directions.T, half):
        d = np.where(np.abs(d) < 1e-9, np.float32(1e-9), d)
        low, high = (-side - o) / d, (side - o) / d
        enter, leave = np.maximum(enter, np.minimum(low, high)), np.minimum(leave, np.maximum(low, high))
    return enter, leave, (leave > enter) & (enter > 0)


def candidates(solids: Sequence[Solid], origins: Array, directions: Array) -> list[Rows]:
    """For each solid the rows of the rays that meet its bounding ball.

    Most rays pass most solids by; they are dropped here before the solids' own costlier arithmetic.

    Args:
        solids: of the scene.
        origins: [r, 3], or [1, 3] where all rays start from the same point.
        directions: [r, 3] unit, or [1, 3] where all rays are parallel.
    """
    (ox, oy, oz), (dx, dy, dz) = origins.T, directions.T
    own, square = ox * dx + oy * dy + oz * dz, ox * ox + oy * oy + oz * oz
    rows = []
    for solid in solids:
        cx, cy, cz = (np.float32(value) for value in solid.centre)
        reach = np.float32(sum(side * side for side in solid.extent()) + 1e-3)
        along = dx * cx + dy * cy + dz * cz - own
        apart = square - 2 * (ox * cx + oy * cy + oz * cz) + (cx * cx + cy * cy + cz * cz)
        rows.append(((apart - along * along <= reach) & (along >= -np.sqrt(reach))).nonzero()[0])
    return rows


def first_hits(solids: Sequence[Solid], origins: Array, directions: Array) -> tuple[Array, Rows]:
    """The first solid on each ray: (distance [r], infinite for a miss; its number [r], 0 for a miss).

    Arguments as of `candidates`.
    """
    (count,) = np.broadcast_shapes(origins.shape[:1], directions.shape[:1])
    depth, which = np.full(count, np.inf, dtype=np.float32), np.zeros(count, dtype=np.int64)
    for index, (solid, rows) in enumerate(zip(solids, candidates(solids, origins, directions))):
        found = solid.hit(_rows_of(origins, rows), _rows_of(directions, rows))
        closer = found < depth[rows]
        depth[rows[closer]], which[rows[closer]] = found[closer], index
    return depth, which


def _rows_of(vectors: Array, rows: Rows) -> Array:
    """Rows of vectors [r, 3]; vectors [1, 3] stand for every row and are returned whole."""
    return vectors if len(vectors) == 1 else vectors[rows]
