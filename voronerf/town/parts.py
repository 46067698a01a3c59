"""Parts: several routers that stand in one scene, each in a frame of its own.

n samples, r rays, k cells of all parts, l leaves of the diagram of one part. Positions, lengths and densities are in
units of the scene where nothing else is said; a part has its own frame, from which a similarity leads to the scene.

Where several parts of a layer speak for a point, the part of the nearest centre decides, and its own diagram the cell.
A part speaks for a point in its region whose leaf has a network. Layers lie on top of each other: their densities add
up, and their colours are mixed by density, as of two clouds in one place.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import inspect
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from voronerf import ops
from voronerf.diagram import VoronoiDiagram
from voronerf.router.router import VoronoiRouter
from voronerf.town.coarse import Coarse, is_far

#: How far a rotation may be from orthonormal, which rounding in a file makes it.
_ORTHONORMAL = 1e-4


def _eye() -> Tensor:
    return torch.eye(3, dtype=torch.float64)


def _zeros() -> Tensor:
    return torch.zeros(3, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class Similarity:
    """``x -> scale * rotation @ x + translation``, from the frame of a part to that of the scene.

    Args:
        scale: Positive and finite.
        rotation: [3, 3], orthonormal, no mirror image.
        translation: [3].

    Raises:
        ValueError: For anything else.

    Examples:
        >>> import torch
        >>> from voronerf.town.parts import Similarity
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
            value = torch.as_tensor(getattr(self, name), dtype=torch.float64)
            object.__setattr__(self, name, value)
            if value.shape != shape or not bool(value.isfinite().all()):
                raise ValueError(f"Similarity: {name} must be {list(shape)} finite numbers, got {value.tolist()}")
        if not 0 < self.scale < math.inf:
            raise ValueError(f"Similarity: scale must be positive and finite, got {self.scale}")
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
        """From angles about the axes x, y and z of the scene, turned in this order."""
        rotation = _eye()
        for axis, angle in enumerate(degrees):
            c, s, turn = math.cos(math.radians(angle)), math.sin(math.radians(angle)), _eye()
            i, j = (axis + 1) % 3, (axis + 2) % 3
            turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
            rotation = turn @ rotation
        return cls(float(scale), rotation, torch.tensor(translation, dtype=torch.float64))

    @classmethod
    def of_matrix(cls, matrix: Any) -> Similarity:
        """From a matrix [3, 4] or [4, 4]."""
        matrix = torch.as_tensor(matrix, dtype=torch.float64)
        if matrix.dim() != 2 or matrix.shape[0] not in (3, 4) or matrix.shape[1] != 4:
            raise ValueError(f"Similarity: a matrix must have shape [4, 4] or [3, 4], got {list(matrix.shape)}")
        scale = float(matrix[0, :3].norm())
        return cls(scale, matrix[:3, :3] / (scale or 1), matrix[:3, 3])

    @functools.cached_property
    def is_identity(self) -> bool:
        """Whether it moves nothing, but for rounding."""
        still = (self.rotation - _eye()).abs().max() < 1e-12 and self.translation.abs().max() < 1e-12
        return bool(still) and abs(self.scale - 1) < 1e-12

    @functools.cached_property
    def inverse(self) -> Similarity:
        """From the scene to the part."""
        return Similarity(1 / self.scale, self.rotation.T, -(self.translation @ self.rotation) / self.scale)

    def __matmul__(self, first: Similarity) -> Similarity:
        """This one after another."""
        return Similarity(self.scale * first.scale, self.rotation @ first.rotation, self.points(first.translation))

    def points(self, points: Tensor) -> Tensor:
        """Points [..., 3] of the part in the scene."""
        if self.is_identity:
            return points
        return points @ (self.scale * self.rotation.T).to(points) + self.translation.to(points)

    def directions(self, directions: Tensor) -> Tensor:
        """Unit vectors [..., 3] of the part in the scene."""
        return directions if self.is_identity else directions @ self.rotation.T.to(directions)

    def to_values(self) -> dict[str, Any]:
        """As values of JSON, the arguments."""
        return {"scale": self.scale, "rotation": self.rotation.tolist(), "translation": self.translation.tolist()}


@dataclass(frozen=True)
class Solid:
    """A convex solid: what lies behind all its planes, or in a ball; or with ``outside`` all the rest of space.

    Args:
        planes: (a, b, c, d) each, for ``a x + b y + c z <= d``.
        ball: Centre and radius (x, y, z, r), in place of planes.
        outside: The space around it.

    Raises:
        ValueError: A solid that is empty or has no bounds at all.

    Examples:
        >>> import torch
        >>> from voronerf.town.parts import Solid
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
    def box(cls, low: Sequence[float], high: Sequence[float], *, outside: bool = False) -> Solid:
        """The box between two corners.

        Raises:
            ValueError: The second corner is not above the first.
        """
        if not all(a < b for a, b in zip(low, high, strict=True)):
            raise ValueError(f"Solid: a box must have its second corner above the first, got {[*low]} and {[*high]}")
        unit = _eye().tolist()
        above = [(*unit[i], float(high[i])) for i in range(3)]
        below = [(*(-x for x in unit[i]), -float(low[i])) for i in range(3)]
        return cls(tuple(above + below), outside=outside)

    def holds(self, points: Tensor) -> Tensor:
        """Which of the points [n, 3] it has: bool [n]."""
        if self.ball is not None:
            ball = points.new_tensor(self.ball)
            inside = (points - ball[:3]).square().sum(-1) <= ball[3] ** 2
        else:
            planes = points.new_tensor(self.planes)
            inside = (points @ planes[:, :3].T <= planes[:, 3]).all(-1)
        return ~inside if self.outside else inside

    def bounds(self) -> Tensor:
        """float32 [2, 3], the box around the solid; for ``outside`` around what it leaves out.

        Raises:
            ValueError: For planes that leave a direction open.
        """
        if self.ball is not None:
            centre, radius = torch.tensor(self.ball[:3]), self.ball[3]
            return torch.stack((centre - radius, centre + radius))
        planes = torch.tensor(self.planes, dtype=torch.float64)
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
        """The same solid after a similarity."""
        if self.ball is not None:
            centre = move.points(torch.tensor(self.ball[:3], dtype=torch.float64)).tolist()
            return Solid(ball=(*centre, self.ball[3] * move.scale), outside=self.outside)
        planes = torch.tensor(self.planes, dtype=torch.float64)
        normals = move.directions(planes[:, :3])
        ends = planes[:, 3] * move.scale + normals @ move.translation
        rows = torch.cat((normals, ends[:, None]), 1).tolist()
        return Solid(tuple(map(tuple, rows)), outside=self.outside)

    def to_values(self) -> dict[str, Any]:
        """As values of JSON, the arguments."""
        return {"planes": [*map(list, self.planes)], "ball": self.ball and list(self.ball), "outside": self.outside}

    @classmethod
    def from_values(cls, values: dict[str, Any]) -> Solid:
        """What :meth:`to_values` gave."""
        ball = None if values["ball"] is None else tuple(map(float, values["ball"]))
        return cls(tuple(tuple(map(float, row)) for row in values["planes"]), ball, bool(values["outside"]))


class Asked(NamedTuple):
    """A router that is asked about some points."""

    router: VoronoiRouter  # with the networks
    rows: Tensor | None  # int64 [q], which of all points these are; None for all in their order
    points: Tensor  # [q, 3], in the space of the networks
    directions: Tensor  # [r, 3], as the networks see them
    ray_index: Tensor  # int32 [q]
    scale: float  # of the part's frame, by which densities are divided


class Part(nn.Module):
    """Networks that stand somewhere in a scene: a diagram in a frame of its own, whose leaves have networks.

    Mostly one router has the networks of all leaves. There are several where cells have tables or an optimiser of their
    own, and leaves without a network where cells were cut away: nothing is seen there.

    Args:
        routers: Router i has the leaves with ``owner == i``, in ascending order.
        diagram: l leaves; None for that of the only router.
        owner: int [l], the router of each leaf, -1 for none; None for the only router.
        frame: From the part to the scene.
        contraction: Of the space that the diagram and the networks are in, with a method ``points``; None for none.
        region: Solids in the part's frame; it speaks for what lies in all of them.
        layer: 0 for the scene, more for what is on top.

    Raises:
        ValueError: For owners that are not as many as leaves, or routers of other numbers of cells.

    Examples:
        >>> import torch
        >>> from voronerf import NeRF, VoronoiRouter
        >>> from voronerf.town.parts import Part
        >>> part = Part([VoronoiRouter(NeRF(width=8, depth=1), torch.rand(4, 3))])
        >>> fewer = part.keep(torch.tensor([0, 2]))
        >>> fewer.num_cells, fewer.diagram.num_cells, fewer.owner
        (2, 4, tensor([ 0, -1,  0, -1], dtype=torch.int32))
    """

    owner: Tensor
    number: Tensor

    def __init__(
        self,
        routers: Sequence[nn.Module],
        diagram: VoronoiDiagram | None = None,
        owner: Tensor | None = None,
        *,
        frame: Similarity | None = None,
        contraction: Any = None,
        region: Sequence[Solid] = (),
        layer: int = 0,
    ) -> None:
        super().__init__()
        self.routers = nn.ModuleList(routers)
        self.diagram = self[0].diagram if diagram is None else diagram
        leaves, device = self.diagram.num_cells, self.diagram.centres.device
        owner = torch.zeros(leaves, dtype=torch.int32) if owner is None else owner.int()
        if owner.shape != (leaves,):
            raise ValueError(f"Part: owner must have shape [{leaves}], got {list(owner.shape)}")
        counts = [int((owner == i).sum()) for i in range(len(self.routers))]
        if counts != [router.num_cells for router in self] or int(owner.max()) >= len(counts):
            raise ValueError(
                f"Part: owner must name as many leaves of each router as it has cells, "
                f"{[router.num_cells for router in self]}, got {counts}"
            )
        kept = owner >= 0
        number = torch.where(kept, kept.cumsum(0) - 1, -1).int()
        self.register_buffer("owner", owner.to(device))
        self.register_buffer("number", number.to(device))
        self.num_cells, self.whole = int(kept.sum()), bool(kept.all())
        self.frame, self.contraction, self.region = frame or Similarity(), contraction, tuple(region)
        self.layer = layer
        #: What it shows from far away; None where that is not known, as after every change.
        self.coarse: Coarse | None = None
        boxes = [solid.moved(self.frame).bounds() for solid in self.region if not solid.outside]
        #: A box [2, 3] of the scene outside of which the part does not speak; None for none.
        self.bounds = None
        if boxes:
            low, high = (torch.stack([box[i] for box in boxes]) for i in (0, 1))
            margin = 1e-4 * (high.amin(0) - low.amax(0)).abs()
            self.bounds = torch.stack((low.amax(0) - margin, high.amin(0) + margin))

    def __iter__(self) -> Iterator[VoronoiRouter]:
        return iter(self.routers)  # type: ignore[arg-type]

    def __getitem__(self, index: int) -> VoronoiRouter:
        return self.routers[index]  # type: ignore[return-value]

    @property
    def leaves(self) -> Tensor:
        """int64 [cells], the leaf of each cell."""
        return (self.owner >= 0).nonzero()[:, 0]

    @property
    def centres(self) -> Tensor:
        """[l, 3], the centres of all leaves in the scene."""
        centres = self.diagram.leaf_centres
        return self.frame.points(centres if self.contraction is None else self.contraction.inverse(centres))

    @functools.cached_property
    def kept_centres(self) -> Tensor:
        """[cells, 3], the centres of the cells in the scene."""
        return self.centres[self.leaves]

    def changed(self, **changes: Any) -> Part:
        """A part with the same routers, and other values of the constructor's arguments."""
        names = ("diagram", "owner", "frame", "contraction", "region", "layer")
        return Part(**{"routers": list(self), **{name: getattr(self, name) for name in names}, **changes})

    def split(self, cells: Tensor) -> Part:
        """A part that looks the same, some cells of which are in a router of their own, the last.

        What cells share is copied for them. The other routers are new objects too, unless they have none of the cells.

        Args:
            cells: int64 [c], ascending numbers of cells of this part, at least one.

        Raises:
            ValueError: No cells, cells out of range, or cells that several routers have.
        """
        if not len(cells) or not 0 <= int(cells.min()) <= int(cells.max()) < self.num_cells:
            raise ValueError(f"Part.split: cells must be numbers of 0..{self.num_cells - 1}, got {cells.tolist()}")
        leaves = self.leaves[cells]
        of = self.owner[leaves].unique()
        if len(of) > 1:
            raise ValueError(f"Part.split: cells must be of one router, got those of {of.tolist()}")
        source, owner, routers = int(of[0]), self.owner.clone(), list(self)
        mine = (owner == source).nonzero()[:, 0]
        inside = torch.isin(mine, leaves)
        if bool(inside.all()):
            return self
        owner[leaves] = len(routers)
        routers.append(routers[source].part(inside.nonzero()[:, 0]))
        routers[source] = routers[source].part((~inside).nonzero()[:, 0])
        return self.changed(routers=routers, owner=owner)

    def divide(self, children: Mapping[int, Tensor]) -> tuple[Part, Tensor]:
        """A part that looks the same, some cells of which are divided; what their routers share is copied.

        Args:
            children: The number of a cell, and centres [c, 3] in the space of the networks.

        Returns:
            The part, and int64 [its cells], the cell that each was of.
        """
        leaves = self.leaves
        diagram, parents = self.diagram.refine({int(leaves[cell]): centres for cell, centres in children.items()})
        owner, routers = self.owner[parents], list(self)
        for index, router in enumerate(self):
            before, after = ((owners == index).nonzero()[:, 0] for owners in (self.owner, owner))
            if len(after) > len(before):
                routers[index] = router.with_cells(diagram.part(after), torch.searchsorted(before, parents[after]))
        return self.changed(routers=routers, diagram=diagram, owner=owner), self.number[parents[owner >= 0]].long()

    def keep(self, cells: Tensor) -> Part | None:
        """The part without the networks of other cells; None without any. Cells are numbers, int64 [c]."""
        kept = torch.zeros(self.num_cells, dtype=torch.bool, device=self.owner.device)
        kept[cells] = True
        if bool(kept.all()):
            return self
        owner, leaf = torch.full_like(self.owner, -1), self.leaves
        routers: list[VoronoiRouter] = []
        for index, router in enumerate(self):
            mine = (self.owner == index).nonzero()[:, 0]
            inside = kept[self.number[mine].long()]
            if bool(inside.any()):
                owner[mine[inside]] = len(routers)
                routers.append(router if bool(inside.all()) else router.part(inside.nonzero()[:, 0]))
        return self.changed(routers=routers, owner=owner) if len(leaf[kept]) else None

    def own_points(self, positions: Tensor) -> Tensor:
        """Positions [n, 3] of the scene in the part's frame."""
        return self.frame.inverse.points(positions)

    def find(self, own: Tensor, backend: str = "auto", hidden: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Which leaf points of the part's frame lie in, and for which the part speaks.

        Args:
            own: [n, 3].
            backend: Of the look-up.
            hidden: bool [cells], which of the part's cells count as cut away; None for none.

        Returns:
            (leaf int64 [n], bool [n]).
        """
        leaf = self.diagram.locate(self.contracted(own), backend=backend).long()
        speaks = self.owner[leaf] >= 0
        if hidden is not None:
            speaks = speaks & ~hidden[self.number[leaf].clamp(min=0).long()]
        return leaf, speaks & self.in_region(own)

    def in_region(self, own: Tensor) -> Tensor:
        """Which points [n, 3] of the part's frame lie in its region: bool [n]."""
        inside = torch.ones(len(own), dtype=torch.bool, device=own.device)
        for solid in self.region:
            inside &= solid.holds(own)
        return inside

    def contracted(self, own: Tensor) -> Tensor:
        """Points [n, 3] of the part's frame in the space of the networks."""
        return own if self.contraction is None else self.contraction.points(own)

    def asked(
        self, own: Tensor, leaf: Tensor | None, directions: Tensor, ray_index: Tensor, backend: str = "auto"
    ) -> list[Asked]:
        """Which routers are asked about points that the part speaks for. Arguments are those of :meth:`evaluate`."""
        points, directions = self.contracted(own), self.frame.inverse.directions(directions)
        if len(self.routers) == 1 or leaf is None:
            return [Asked(self[0], None, points, directions, ray_index, self.frame.scale)]
        order, offsets = ops.cell_sort(self.owner[leaf], len(self.routers), backend=backend)
        found, first = list[Asked](), 0
        for router, last in zip(self, offsets[1:].tolist(), strict=True):
            rows = order[first:last].long()
            if len(rows):
                found.append(Asked(router, rows, points[rows], directions, ray_index[rows], self.frame.scale))
            first = last
        return found

    def evaluate(
        self, own: Tensor, leaf: Tensor | None, directions: Tensor, ray_index: Tensor, backend: str = "auto"
    ) -> tuple[Tensor, Tensor]:
        """Colours [m, 3] and densities [m] per scene unit of points that the part speaks for.

        Args:
            own: [m, 3], in the part's frame.
            leaf: int64 [m]; None where one router has all of them.
            directions: [r, 3], in the scene.
            ray_index: int32 [m].
            backend: Of the sorting.
        """
        asked = self.asked(own, leaf, directions, ray_index, backend)
        pieces = [_ask(each.router, each.points, each.directions, each.ray_index) for each in asked]
        colour, density = (
            torch.cat(tensors) if len(pieces) > 1 else tensors[0] for tensors in zip(*pieces, strict=True)
        )
        if asked[0].rows is not None:
            rows = torch.cat([cast(Tensor, each.rows) for each in asked])
            colour, density = (torch.zeros_like(x).index_copy(0, rows, x) for x in (colour, density))
        return colour, density if self.frame.is_identity else density / self.frame.scale


def _ask(router: VoronoiRouter, points: Tensor, directions: Tensor, ray_index: Tensor) -> tuple[Tensor, Tensor]:
    """What a router says of points; with a direction for each where its module takes no other."""
    if "ray_index" in inspect.signature(router.module.forward).parameters:
        colour, density = router(points, directions, ray_index)
    else:
        colour, density = router(points, directions[ray_index.long()])
    return colour, density.reshape(len(points))


class Parts(nn.Module):
    """Several parts of one scene, asked as one field.

    Attributes:
        parts: In the order of their cells: part after part, the cells of each in the order of its leaves.
        diagram: Flat, of the centres of all cells in the scene; for drawings.
        num_cells: k.
        detail: Pixels that a voxel of a coarse level may be wide where `seen_from` shows it; 0 for no such parts.

    Args:
        parts: At least one.
        backend: Of the operations.

    Raises:
        ValueError: No part, or none in layer 0.

    Examples:
        >>> import torch  # networks of two widths, the second moved by 2 along x and half as large
        >>> from voronerf import NeRF, VoronoiRouter
        >>> from voronerf.town.parts import Part, Parts, Similarity
        >>> first = VoronoiRouter(NeRF(width=16, depth=2), torch.zeros(1, 3))
        >>> second = VoronoiRouter(NeRF(width=8, depth=1), torch.tensor([[0.0, 0, -1], [0, 0, 1]]))
        >>> both = Parts([Part([first]), Part([second], frame=Similarity.of((2, 0, 0), scale=0.5))])
        >>> points = torch.tensor([[0.1, 0, 0], [1.9, 0, 0.2]])
        >>> both.assign(points)  # the cells
        tensor([0, 2], dtype=torch.int32)
        >>> colour, density = both(points, torch.tensor([[0.0, 0, 1]]), torch.zeros(2, dtype=torch.int32))
        >>> inner = second(torch.tensor([[-0.2, 0, 0.4]]), torch.tensor([[0.0, 0, 1]]))
        >>> bool((density[1] - 2 * inner[1][0]).abs() < 1e-5)  # the density for half the length is twice as high
        True
    """

    hidden: Tensor | None

    def __init__(self, parts: Sequence[Part], *, backend: str = "auto") -> None:
        super().__init__()
        if not parts or all(part.layer for part in parts):
            raise ValueError("Parts: parts must hold at least one in layer 0")
        self.parts = nn.ModuleList(parts)
        kept = [part.kept_centres for part in parts]
        self.diagram = VoronoiDiagram(torch.cat(kept))
        self.num_cells = self.diagram.num_cells
        layers = sorted({part.layer for part in parts})
        #: The parts of each layer, and the diagram of all their cells where there are several.
        self.layers = [[i for i, part in enumerate(parts) if part.layer == layer] for layer in layers]
        joint = [VoronoiDiagram(torch.cat([kept[i] for i in of])) if len(of) > 1 else None for of in self.layers]
        self.joint = nn.ModuleList(joint)  # type: ignore[arg-type]
        for level, of in enumerate(self.layers):
            counts = torch.tensor([parts[i].num_cells for i in of])
            owners = torch.arange(len(of), dtype=torch.int32).repeat_interleave(counts)
            self.register_buffer(f"_part_of_{level}", owners.to(self.diagram.centres.device), persistent=False)
        self.register_buffer("hidden", None, persistent=False)
        self.backend = backend
        self.detail = 0.0
        self.far: frozenset[int] = frozenset()

    def __iter__(self) -> Iterator[Part]:
        return iter(self.parts)  # type: ignore[arg-type]

    def __len__(self) -> int:
        return len(self.parts)

    def __getitem__(self, index: int) -> Part:
        return self.parts[index]  # type: ignore[return-value]

    @property
    def routers(self) -> list[VoronoiRouter]:
        """The routers of all parts, one that stands in several places once."""
        return list({id(router): router for part in self for router in part}.values())

    @property
    def starts(self) -> list[int]:
        """The number of the first cell of each part, and at the end k."""
        starts = [0]
        for part in self:
            starts.append(starts[-1] + part.num_cells)
        return starts

    @property
    def backend(self) -> str:
        """Of the operations of all parts."""
        return self._backend

    @backend.setter
    def backend(self, backend: str) -> None:
        self._backend = backend
        for router in self.routers:
            router.backend = backend

    def without(self, hidden: Tensor) -> Parts:
        """The same parts without what some cells show, bool [k]; the networks are not copied."""
        twin = copy.copy(self)
        twin._buffers = {**self._buffers, "hidden": hidden.to(self.diagram.centres.device)}
        return twin

    @contextlib.contextmanager
    def seen_from(self, eye: Tensor, pixel: float) -> Iterator[None]:
        """A context in which parts that are far away show their coarse level, if there is a `detail`.

        Args:
            eye: [3], the place that the scene is seen from.
            pixel: Width of a pixel at distance 1.
        """
        eye = eye.to(self.diagram.centres)
        self.far = frozenset(
            index
            for index, part in enumerate(self)
            if part.coarse is not None
            and part.bounds is not None
            and is_far(part.coarse, part.frame.scale, part.bounds.to(eye), eye, pixel * self.detail)
        )
        try:
            yield
        finally:
            self.far = frozenset()

    def _hidden_of(self, index: int) -> Tensor | None:
        if self.hidden is None:
            return None
        starts = self.starts
        return self.hidden[starts[index] : starts[index + 1]]

    def assign(self, positions: Tensor) -> Tensor:
        """The cell that shows each position: [n, 3] -> int32 [n], of the uppermost layer that has one; -1 for none."""
        found = torch.full((len(positions),), -1, dtype=torch.int32, device=positions.device)
        for level in range(len(self.layers)):
            for index, rows, _, leaf in self._claims(level, positions):
                cells = self[index].number[leaf] + self.starts[index]
                found[rows] = cells.int()
        return found

    def shown(self, positions: Tensor) -> Tensor:
        """Which cells show something at positions [n, 3], in any layer: bool [k]."""
        found = torch.zeros(self.num_cells, dtype=torch.bool, device=positions.device)
        for level in range(len(self.layers)):
            for index, _, _, leaf in self._claims(level, positions):
                found[self[index].number[leaf].long() + self.starts[index]] = True
        return found

    def _claims(self, level: int, positions: Tensor) -> list[tuple[int, Tensor, Tensor, Tensor]]:
        """Which parts of a layer speak for which positions: (part, rows, own points, leaves) each."""
        of, n, device = self.layers[level], len(positions), positions.device
        everything = torch.arange(n, device=device)
        if len(of) == 1:
            return [claim for claim in [self._claim(of[0], positions, everything)] if len(claim[1])]
        owners, joint = getattr(self, f"_part_of_{level}"), cast(VoronoiDiagram, self.joint[level])
        who = owners[joint.locate(positions, backend=self.backend).long()]
        order, offsets = ops.cell_sort(who, len(of), backend=self.backend)
        claims, first = [], 0
        for index, last in zip(of, offsets[1:].tolist(), strict=True):
            if last > first:
                claims.append(self._claim(index, positions, order[first:last].long()))
            first = last
        # What the part of the nearest centre says nothing about goes to the nearest of the others that do.
        left = torch.ones(n, dtype=torch.bool, device=device)
        for _, taken, *_ in claims:
            left[taken] = False
        claims += self._claims_of_others(of, positions, left.nonzero()[:, 0])
        merged = []
        for index in sorted({claim[0] for claim in claims}):
            same = [claim[1:4] for claim in claims if claim[0] == index and len(claim[1])]
            if same:
                rows, own, leaf = (torch.cat(column) for column in zip(*same, strict=True))
                if len(same) > 1 and len(rows) == n:  # all of them are taken to be in their order
                    order = rows.argsort()
                    rows, own, leaf = rows[order], own[order], leaf[order]
                merged.append((index, rows, own, leaf))
        return merged

    def _claim(self, index: int, positions: Tensor, rows: Tensor) -> tuple[int, Tensor, Tensor, Tensor]:
        """The rows that a part speaks for, of those it is asked about."""
        part = self[index]
        own = part.own_points(positions if len(rows) == len(positions) else positions[rows])
        leaf, speaks = part.find(own, self.backend, self._hidden_of(index))
        if bool(speaks.all()):
            return index, rows, own, leaf
        return index, rows[speaks], own[speaks], leaf[speaks]

    def _claims_of_others(
        self, of: list[int], positions: Tensor, rows: Tensor
    ) -> list[tuple[int, Tensor, Tensor, Tensor]]:
        """For each of some rows the nearest part that speaks for it."""
        if not len(rows):
            return []
        least = positions.new_full((len(positions),), math.inf)
        everywhere = positions.new_tensor([[-math.inf] * 3, [math.inf] * 3])
        boxes = torch.stack([everywhere if (box := self[i].bounds) is None else box.to(positions) for i in of])
        places = positions[rows][:, None]
        inside = ((places >= boxes[:, 0]) & (places <= boxes[:, 1])).all(-1)
        found = []
        if not bool((inside.sum(1) > 1).any()):  # nothing to compare
            columns = inside.any(0).nonzero()[:, 0].tolist()
            return [self._claim(of[column], positions, rows[inside[:, column]]) for column in columns]
        for column in inside.any(0).nonzero()[:, 0].tolist():
            index, near = of[column], rows[inside[:, column]]
            claim = self._claim(index, positions, near)
            taken, centres = claim[1], self[index].kept_centres
            places = positions[taken]
            nearest = ops.nearest_centre(places, centres.to(places), backend=self.backend).long()
            away = (places - centres[nearest]).norm(dim=-1)
            found.append((claim, away))
            least[taken] = torch.minimum(least[taken], away)
        claims = []
        for (index, taken, own, leaf), away in found:
            first = away == least[taken]
            least[taken[first]] = -1.0  # a tie goes to the first
            claims.append((index, taken[first], own[first], leaf[first]))
        return claims

    def forward(self, positions: Tensor, directions: Tensor, ray_index: Tensor) -> tuple[Tensor, Tensor]:
        """Colours [n, 3] and densities [n] of positions [n, 3]; see :class:`voronerf.nerf.Field`.

        Args:
            positions: [n, 3], in the scene.
            directions: [r, 3], unit vectors.
            ray_index: int32 [n], the row of ``directions`` that belongs to each position.
        """
        result: tuple[Tensor, Tensor] | None = None
        for level in range(len(self.layers)):
            rows, colour, density = self._layer(level, positions, directions, ray_index)
            if rows is not None:
                colour = positions.new_zeros(len(positions), 3).to(colour).index_copy(0, rows, colour)
                density = positions.new_zeros(len(positions)).to(density).index_copy(0, rows, density)
            if result is None:
                result = colour, density
                continue
            under, below = result
            total = below + density
            share = torch.where(density > 0, density / total.clamp_min(torch.finfo(total.dtype).tiny), 0)[:, None]
            result = torch.where(share > 0, under + share * (colour - under), under), total
        assert result is not None
        return result

    def _layer(
        self, level: int, positions: Tensor, directions: Tensor, ray_index: Tensor
    ) -> tuple[Tensor | None, Tensor, Tensor]:
        """What one layer says: the rows that it speaks for, None for all in order, their colours and densities."""
        of, n = self.layers[level], len(positions)
        if len(of) == 1:
            part = self[of[0]]
            whole = part.whole and not part.region and self.hidden is None and len(part.routers) == 1
            if whole:
                return None, *part.evaluate(part.own_points(positions), None, directions, ray_index)
        claims = self._claims(level, positions)
        if not claims:
            return positions.new_empty(0).long(), positions.new_empty(0, 3), positions.new_empty(0)
        pieces = []
        for index, rows, own, leaf in claims:
            rays = ray_index if len(rows) == n else ray_index[rows]
            coarse = self[index].coarse
            if coarse is not None and index in self.far:
                colour, density = coarse(own)
                density = density / self[index].frame.scale
            else:
                colour, density = self[index].evaluate(own, leaf, directions, rays, self.backend)
            pieces.append((rows, colour, density))
        rows, colour, density = (torch.cat(tensors) for tensors in zip(*pieces, strict=True))
        if len(claims) == 1 and len(rows) == n:
            return None, colour, density
        return rows, colour, density

    def asked(self, positions: Tensor, directions: Tensor, ray_index: Tensor) -> list[Asked]:
        """Which routers are asked about positions of a scene of one layer. Arguments are those of :meth:`forward`."""
        found = list[Asked]()
        for index, rows, own, leaf in self._claims(0, positions):
            whole = len(rows) == len(positions)  # claims of several parts are in any order, that of one in theirs
            for each in self[index].asked(own, leaf, directions, ray_index if whole else ray_index[rows], self.backend):
                mine = each.rows if whole else rows if each.rows is None else rows[each.rows]
                found.append(each._replace(rows=mine))
        return found

    def explain(self) -> str:
        """What the parts are, and how their routers are carried out: some lines."""
        lines = []
        for index, part in enumerate(self):
            kinds = ", ".join(type(router.module).__name__ for router in part)
            line = f"part {index}: {part.num_cells} of {part.diagram.num_cells} cells, {kinds}"
            lines.append(line + (f", on top ({part.layer})" if part.layer else ""))
            lines += [f"part {index}: {line}" for router in part for line in router.explain().splitlines()]
        return "\n".join(lines)
