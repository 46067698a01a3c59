"""Solids that rays are cast against: spheres, boxes, cylinders and tori, each in its own frame.

r rays, n points. Distances are along unit directions, infinite where a ray misses. Every solid is convex or a torus, and rays
start outside of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from voronerf.rendering.rays import intersect_box

TRACE_STEPS = 40
SURFACE = 5e-4  # a traced ray closer than this to the torus has hit it

# points [n, 3] and normals [n, 3] in the solid's frame -> colour [n, 3] in 0..1
Texture = Callable[[Tensor, Tensor], Tensor]


def rotation(axis: str, degrees: float) -> Tensor:
    """Rotation about a coordinate axis, [3, 3]."""
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    result = torch.eye(3)
    result[i, i] = result[j, j] = cosine
    result[i, j], result[j, i] = -sine, sine
    return result


@dataclass(frozen=True, eq=False)
class Solid:
    """A solid in a pose, with its surface.

    Attributes:
        centre: position of the solid's frame.
        texture: colour of the surface.
        gloss: strength of the highlight, 0..1.
        sharpness: Phong exponent of the highlight.
        turn: rotation of the solid's frame to the world, [3, 3].
    """

    centre: tuple[float, float, float]
    texture: Texture
    gloss: float = 0.2
    sharpness: float = 20.0
    turn: Tensor = field(default_factory=lambda: torch.eye(3))

    def extent(self) -> Tensor:
        """Half sides of the bounding box in the solid's own frame, [3]."""
        raise TypeError("extent: a Solid has no shape of its own")

    def distance(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Distance to the first hit in the solid's own frame, [r]."""
        raise TypeError("distance: a Solid has no shape of its own")

    def normal(self, points: Tensor) -> Tensor:
        """Outward unit normals of points on the surface, in the solid's own frame."""
        raise TypeError("normal: a Solid has no shape of its own")

    def bounds(self) -> Tensor:
        """A box in the world that holds the solid, [2, 3]; exact unless the solid is turned about two axes."""
        half = self.turn.abs() @ self.extent()
        centre = torch.tensor(self.centre)
        return torch.stack((centre - half, centre + half))

    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Distance to the first hit of rays in the world, [r]; either argument may be [1, 3] for all rays."""
        start, along = (origins - torch.tensor(self.centre)) @ self.turn, directions @ self.turn
        return self.distance(*torch.broadcast_tensors(start, along))

    def surface(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """(normals [n, 3] in the world, colours [n, 3]) of points on the surface."""
        local = (points - torch.tensor(self.centre)) @ self.turn
        normals = self.normal(local)
        return normals @ self.turn.T, self.texture(local, normals)


@dataclass(frozen=True, eq=False)
class Sphere(Solid):
    """A ball."""

    radius: float = 1.0

    def extent(self) -> Tensor:
        return torch.full((3,), self.radius)

    def distance(self, origins: Tensor, directions: Tensor) -> Tensor:
        b = (origins * directions).sum(-1)
        root = b * b - (origins * origins).sum(-1) + self.radius**2
        t = -b - root.clamp_min(0).sqrt()
        return torch.where((root >= 0) & (t > 0), t, float("inf"))

    def normal(self, points: Tensor) -> Tensor:
        return points / self.radius


@dataclass(frozen=True, eq=False)
class Box(Solid):
    """A box with the given half sides."""

    half: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def extent(self) -> Tensor:
        return torch.tensor(self.half)

    def distance(self, origins: Tensor, directions: Tensor) -> Tensor:
        half = torch.tensor(self.half)
        enter, _, hit = intersect_box(origins, directions, torch.stack((-half, half)), 0.0, 1e6)
        return torch.where(hit & (enter > 0), enter, float("inf"))

    def normal(self, points: Tensor) -> Tensor:
        face = (points.abs() / torch.tensor(self.half)).argmax(-1, keepdim=True)
        return torch.zeros_like(points).scatter(-1, face, points.gather(-1, face).sign())


@dataclass(frozen=True, eq=False)
class Cylinder(Solid):
    """An upright cylinder with flat ends."""

    radius: float = 1.0
    half_height: float = 1.0

    def extent(self) -> Tensor:
        return torch.tensor((self.radius, self.radius, self.half_height))

    def distance(self, origins: Tensor, directions: Tensor) -> Tensor:
        # the ray is inside between the later of the two entries (tube, slab) and the earlier of the two exits
        (ox, oy, oz), (dx, dy, dz) = origins.unbind(-1), directions.unbind(-1)
        a = (dx * dx + dy * dy).clamp_min(1e-12)
        b, c = ox * dx + oy * dy, ox * ox + oy * oy - self.radius**2
        root = b * b - a * c
        spread = root.clamp_min(0).sqrt()
        dz = torch.where(dz.abs() < 1e-9, 1e-9, dz)
        low, high = (-self.half_height - oz) / dz, (self.half_height - oz) / dz
        enter = torch.maximum((-b - spread) / a, torch.minimum(low, high))
        leave = torch.minimum((-b + spread) / a, torch.maximum(low, high))
        return torch.where((root >= 0) & (enter <= leave) & (enter > 0), enter, float("inf"))

    def normal(self, points: Tensor) -> Tensor:
        x, y, z = points.unbind(-1)
        end = z.abs() / self.half_height > torch.hypot(x, y) / self.radius
        side = torch.stack((x, y, torch.zeros_like(z)), dim=-1) / self.radius
        top = torch.stack((torch.zeros_like(x), torch.zeros_like(y), z.sign()), dim=-1)
        return torch.where(end[:, None], top, torch.nn.functional.normalize(side, dim=-1))


@dataclass(frozen=True, eq=False)
class Torus(Solid):
    """A ring around the z axis of its frame, found by sphere tracing its exact distance."""

    ring: float = 1.0
    tube: float = 0.25

    def extent(self) -> Tensor:
        return torch.tensor((self.ring + self.tube, self.ring + self.tube, self.tube))

    def distance(self, origins: Tensor, directions: Tensor) -> Tensor:
        half = self.extent()
        t, leave, inside = intersect_box(origins, directions, torch.stack((-half, half)), 0.0, 1e6)
        result = torch.full_like(t, float("inf"))
        rows = inside.nonzero()[:, 0]
        t = t[rows]
        for _ in range(TRACE_STEPS):
            gap = self._gap(origins[rows] + t[:, None] * directions[rows])
            arrived = gap < SURFACE
            result[rows[arrived]] = t[arrived]
            t = t + gap
            on = ~arrived & (t < leave[rows])
            rows, t = rows[on], t[on]
        return result

    def normal(self, points: Tensor) -> Tensor:
        around = torch.hypot(points[:, 0], points[:, 1])
        core = points[:, :2] * (self.ring / around)[:, None]
        spoke = torch.cat((points[:, :2] - core, points[:, 2:]), dim=-1)
        return torch.nn.functional.normalize(spoke, dim=-1)

    def _gap(self, points: Tensor) -> Tensor:
        """Distance to the surface, [n]."""
        around = torch.hypot(points[:, 0], points[:, 1])
        return torch.hypot(around - self.ring, points[:, 2]) - self.tube


def candidates(solids: Sequence[Solid], origins: Tensor, directions: Tensor) -> list[Tensor]:
    """For each solid the rows of the rays that meet its bounding ball.

    Most rays pass most solids by; they are dropped here, for all solids at once, before the solids' own costlier arithmetic.

    Args:
        solids: at least one.
        origins: [r, 3], or [1, 3] where all rays start from the same point.
        directions: [r, 3] unit, or [1, 3] where all rays are parallel.
    """
    centres = torch.tensor([solid.centre for solid in solids]).T
    reach = torch.stack([solid.extent().square().sum() for solid in solids])[:, None] + 1e-3
    along = (directions @ centres - (origins * directions).sum(-1, keepdim=True)).T
    apart = ((origins * origins).sum(-1, keepdim=True) - 2 * origins @ centres + (centres * centres).sum(0)).T
    meets = (apart - along * along <= reach) & (along >= -reach.sqrt())
    return [row.nonzero()[:, 0] for row in meets]
