"""Geometry of parts in a scene: similarities and convex solids."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

#: Tolerance for the orthonormality of a rotation, since files store rounded numbers.
_ORTHONORMAL = 1e-4


def _eye() -> Tensor:
    return torch.eye(3, dtype=torch.float64, device="cpu")


def _zeros() -> Tensor:
    return torch.zeros(3, dtype=torch.float64, device="cpu")


@dataclass(frozen=True, eq=False)
class Similarity:
    """A similarity ``x -> scale * rotation @ x + translation``, from the frame of a part to the scene.

    Args:
        scale: 1e-9 to 1e9.
        rotation: [3, 3], orthonormal with determinant 1.
        translation: [3].

    Raises:
        ValueError: An argument is invalid.

    Examples:
        >>> import torch
        >>> from voronerf.editing.geometry import Similarity
        >>> move = Similarity.of((1.0, 0, 0), degrees=(0, 0, 90), scale=2)
        >>> move.points(torch.tensor([[1.0, 0, 0]])).round(decimals=3)
        tensor([[1., 2., 0.]])
        >>> (move @ move.inverse).is_identity
        True
    """

    scale: float = 1.0
    rotation: Tensor = field(default_factory=_eye)
    translation: Tensor = field(default_factory=_zeros)

    def __post_init__(self) -> None:
        for name, shape in (("rotation", (3, 3)), ("translation", (3,))):
            value = torch.as_tensor(getattr(self, name), dtype=torch.float64, device="cpu")
            object.__setattr__(self, name, value)
            if value.shape != shape or not bool(value.isfinite().all()):
                raise ValueError(f"Similarity: {name} must be {list(shape)} finite numbers, got {value.tolist()}")
        if not 1e-9 <= self.scale <= 1e9:
            raise ValueError(f"Similarity: scale must lie in 1e-9..1e9, got {self.scale}")
        if float((self.rotation @ self.rotation.T - _eye()).abs().max()) > _ORTHONORMAL:
            raise ValueError(f"Similarity: rotation must be orthonormal, got {self.rotation.tolist()}")
        if float(torch.linalg.det(self.rotation)) < 0:
            raise ValueError("Similarity: rotation must not mirror, its determinant is -1")

    @classmethod
    def of(
        cls,
        translation: Sequence[float] = (0, 0, 0),
        degrees: Sequence[float] = (0, 0, 0),
        scale: float = 1.0,
    ) -> Similarity:
        """Makes a similarity from rotations about the axes x, y and z of the scene, in this order."""
        rotation = _eye()
        for axis, angle in enumerate(degrees):
            c, s, turn = math.cos(math.radians(angle)), math.sin(math.radians(angle)), _eye()
            i, j = (axis + 1) % 3, (axis + 2) % 3
            turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
            rotation = turn @ rotation
        return cls(float(scale), rotation, torch.tensor(translation, dtype=torch.float64, device="cpu"))

    @functools.cached_property
    def is_identity(self) -> bool:
        """True if the similarity is the identity, up to rounding."""
        still = (self.rotation - _eye()).abs().max() < 1e-12 and self.translation.abs().max() < 1e-12
        return bool(still) and abs(self.scale - 1) < 1e-12

    @functools.cached_property
    def inverse(self) -> Similarity:
        """The inverse similarity, from the scene to the part."""
        return Similarity(1 / self.scale, self.rotation.T, -(self.translation @ self.rotation) / self.scale)

    @functools.cached_property
    def matrix(self) -> Tensor:
        """The similarity as a matrix, [4, 4]."""
        top = torch.cat((self.scale * self.rotation, self.translation[:, None]), 1)
        return torch.cat((top, torch.tensor([[0.0, 0, 0, 1]], dtype=torch.float64, device="cpu")))

    def __matmul__(self, first: Similarity) -> Similarity:
        """Composes two similarities: applies ``first``, then this one."""
        return Similarity(self.scale * first.scale, self.rotation @ first.rotation, self.points(first.translation))

    def points(self, points: Tensor) -> Tensor:
        """Maps points [..., 3] from the part to the scene."""
        if self.is_identity:
            return points
        return points @ (self.scale * self.rotation.T).to(points) + self.translation.to(points)

    def directions(self, directions: Tensor) -> Tensor:
        """Rotates unit vectors [..., 3] from the part to the scene."""
        return directions if self.is_identity else directions @ self.rotation.T.to(directions)

    def to_values(self) -> dict[str, Any]:
        """Returns the arguments as JSON values."""
        return {"scale": self.scale, "rotation": self.rotation.tolist(), "translation": self.translation.tolist()}


@dataclass(frozen=True)
class Solid:
    """A convex solid, an intersection of half-spaces or a ball; with ``outside``, its complement.

    Args:
        planes: Half-spaces (a, b, c, d), for ``a x + b y + c z <= d``.
        ball: Centre and radius (x, y, z, r), instead of planes.
        outside: Whether the solid is the space outside of the planes or the ball.

    Raises:
        ValueError: There are neither planes nor a ball, or both, or their numbers are invalid.

    Examples:
        >>> import torch
        >>> from voronerf.editing.geometry import Solid
        >>> box = Solid.box((0, 0, 0), (1, 2, 3))
        >>> box.holds(torch.tensor([[0.5, 1.5, 2.5], [0.5, 2.5, 0]]))
        tensor([ True, False])
    """

    planes: tuple[tuple[float, ...], ...] = ()
    ball: tuple[float, ...] | None = None
    outside: bool = False

    def __post_init__(self) -> None:
        rows = [*self.planes, *([] if self.ball is None else [self.ball])]
        if not rows or (self.ball is not None and self.planes) or any(len(row) != 4 for row in rows):
            raise ValueError("Solid: must have planes of four numbers, or a ball of four")
        if not all(math.isfinite(x) for row in rows for x in row):
            raise ValueError("Solid: planes and ball must be finite")
        if self.ball is not None and self.ball[3] <= 0:
            raise ValueError(f"Solid: the radius of a ball must be positive, got {self.ball[3]}")

    @classmethod
    def box(cls, low: Sequence[float], high: Sequence[float]) -> Solid:
        """Returns the box between two corners.

        Raises:
            ValueError: The second corner is not above the first.
        """
        if not all(a < b for a, b in zip(low, high, strict=True)):
            raise ValueError(f"Solid: a box must have its second corner above the first, got {[*low]} and {[*high]}")
        unit = _eye().tolist()
        above = [(*unit[i], float(high[i])) for i in range(3)]
        below = [(*(-x for x in unit[i]), -float(low[i])) for i in range(3)]
        return cls(tuple(above + below))

    def holds(self, points: Tensor) -> Tensor:
        """Returns a mask, bool [n], of the points [n, 3] in the solid."""
        if self.ball is not None:
            ball = points.new_tensor(self.ball)
            inside = (points - ball[:3]).square().sum(-1) <= ball[3] ** 2
        else:
            planes = points.new_tensor(self.planes)
            inside = (points @ planes[:, :3].T <= planes[:, 3]).all(-1)
        return ~inside if self.outside else inside

    def bounds(self) -> Tensor:
        """Returns float32 [2, 3], the box around the ball or the half-spaces' intersection; ignores ``outside``.

        Raises:
            ValueError: The intersection of the half-spaces has no corner.
        """
        if self.ball is not None:
            centre, radius = torch.tensor(self.ball[:3], dtype=torch.float32, device="cpu"), self.ball[3]
            return torch.stack((centre - radius, centre + radius))
        planes = torch.tensor(self.planes, dtype=torch.float64, device="cpu")
        normals, ends = planes[:, :3], planes[:, 3]
        corners = []
        for rows in itertools.combinations(range(len(planes)), 3):
            if abs(float(torch.linalg.det(normals[list(rows)]))) > 1e-9:
                corner = torch.linalg.solve(normals[list(rows)], ends[list(rows)])
                if bool((normals @ corner <= ends + 1e-6 * (1 + ends.abs())).all()):
                    corners.append(corner)
        if not corners:
            raise ValueError("Solid: must have bounds")
        points = torch.stack(corners).float()
        return torch.stack((points.amin(0), points.amax(0)))

    def moved(self, move: Similarity) -> Solid:
        """Returns the solid after a similarity."""
        if self.ball is not None:
            centre = move.points(torch.tensor(self.ball[:3], dtype=torch.float64, device="cpu")).tolist()
            return Solid(ball=(*centre, self.ball[3] * move.scale), outside=self.outside)
        planes = torch.tensor(self.planes, dtype=torch.float64, device="cpu")
        normals = move.directions(planes[:, :3])
        ends = planes[:, 3] * move.scale + normals @ move.translation
        rows = torch.cat((normals, ends[:, None]), 1).tolist()
        return Solid(tuple(map(tuple, rows)), outside=self.outside)

    def to_values(self) -> dict[str, Any]:
        """Returns the arguments as JSON values."""
        return {"planes": [*map(list, self.planes)], "ball": self.ball and list(self.ball), "outside": self.outside}

    @classmethod
    def from_values(cls, values: dict[str, Any]) -> Solid:
        """Makes a solid from the values of :meth:`to_values`."""
        ball = None if values["ball"] is None else tuple(map(float, values["ball"]))
        return cls(tuple(tuple(map(float, row)) for row in values["planes"]), ball, bool(values["outside"]))
