"""Parts: routers that stand in one scene, each in a frame of its own, asked as one field.

n samples, r rays, k cells of all parts, l leaves of the diagram of one part. Positions, lengths and densities are in
units of the scene where nothing else is said; a part has its own frame, from which a similarity leads to the scene.

Where several parts of a layer speak for a point, the part of the nearest centre decides, and its own diagram the cell.
A part speaks for a point in its region whose leaf has a network. Layers lie on top of each other: their densities add
up, and their colours are mixed by density, as of two clouds in one place.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from voronerf import ops
from voronerf.app.train.build import as_field
from voronerf.diagram import VoronoiDiagram
from voronerf.nerf.contraction import Contraction
from voronerf.town.geometry import Similarity, Solid
from voronerf.town.network import StoredRouter


class Part(nn.Module):
    """Networks that stand somewhere in a scene: a diagram in a frame of its own, whose leaves have networks.

    Mostly one router has the networks of all leaves. There are several where territories have tables of their own, and
    leaves without a network where cells were cut away: nothing is seen there.

    Args:
        networks: Router i has the leaves with ``owner == i``, in ascending order.
        diagram: l leaves; None for that of the only router.
        owner: int [l], the network of each leaf, -1 for none; None for the only one.
        frame: From the part to the scene.
        contraction: Of the space that the diagram and the networks are in; None for none.
        region: Solids in the part's frame; it speaks for what lies in all of them.
        layer: 0 for the scene, more for what is on top.
    """

    owner: Tensor
    number: Tensor

    def __init__(
        self,
        networks: Sequence[StoredRouter],
        diagram: VoronoiDiagram | None = None,
        owner: Tensor | None = None,
        *,
        frame: Similarity | None = None,
        contraction: Contraction | None = None,
        region: Sequence[Solid] = (),
        layer: int = 0,
    ) -> None:
        super().__init__()
        self.networks = tuple(networks)
        self.diagram = networks[0].diagram if diagram is None else diagram
        leaves, device = self.diagram.num_cells, self.diagram.centres.device
        owner = torch.zeros(leaves, dtype=torch.int32) if owner is None else owner.int()
        if owner.shape != (leaves,):
            raise ValueError(f"Part: owner must have shape [{leaves}], got {list(owner.shape)}")
        counts = [int((owner == i).sum()) for i in range(len(networks))]
        wanted = [network.diagram.num_cells for network in networks]
        if counts != wanted or int(owner.max()) >= len(counts):
            raise ValueError(
                f"Part: owner must name as many leaves of each router as it has cells, {wanted}, got {counts}"
            )
        kept = owner >= 0
        self.register_buffer("owner", owner.to(device))
        self.register_buffer("number", torch.where(kept, kept.cumsum(0) - 1, -1).int().to(device))
        self.num_cells = int(kept.sum())
        self.frame, self.contraction, self.region = frame or Similarity(), contraction, tuple(region)
        self.layer = layer

    @functools.cached_property
    def centres(self) -> Tensor:
        """[cells, 3], the centres of the cells in the scene."""
        centres = self.diagram.leaf_centres
        centres = self.frame.points(centres if self.contraction is None else self.contraction.inverse(centres))
        return centres[self.owner >= 0]

    def changed(self, **changes: Any) -> Part:
        """A part with the same networks, and other values of the constructor's arguments."""
        names = ("networks", "diagram", "owner", "frame", "contraction", "region", "layer")
        return Part(**{**{name: getattr(self, name) for name in names}, **changes})

    def keep(self, cells: Tensor) -> Part | None:
        """The part without the networks of other cells; None without any. Cells are numbers, int64 [c]."""
        if len(cells) == self.num_cells:
            return self
        kept = torch.zeros(self.num_cells, dtype=torch.bool, device=self.owner.device)
        kept[cells] = True
        owner, networks = torch.full_like(self.owner, -1), list[StoredRouter]()
        for index, network in enumerate(self.networks):
            mine = (self.owner == index).nonzero()[:, 0]
            inside = kept[self.number[mine].long()]
            if bool(inside.any()):
                owner[mine[inside]] = len(networks)
                networks.append(network if bool(inside.all()) else network.part(inside.nonzero()[:, 0]))
        return self.changed(networks=networks, owner=owner) if networks else None

    def open(self) -> None:
        """Makes the routers of all networks."""
        self.routers = nn.ModuleList(network.router for network in self.networks)

    def find(self, own: Tensor, backend: str = "auto") -> tuple[Tensor, Tensor]:
        """Which leaf points [n, 3] of the part's frame lie in, int64 [n], and for which the part speaks, bool [n]."""
        points = own if self.contraction is None else self.contraction.points(own)
        leaf = self.diagram.locate(points, backend=backend).long()
        speaks = self.owner[leaf] >= 0
        for solid in self.region:
            speaks &= solid.holds(own)
        return leaf, speaks

    def evaluate(self, own: Tensor, leaf: Tensor, directions: Tensor, ray_index: Tensor) -> tuple[Tensor, Tensor]:
        """Colours [m, 3] and densities [m] per scene unit of points that the part speaks for.

        Args:
            own: [m, 3], in the part's frame.
            leaf: int64 [m].
            directions: [r, 3], in the scene.
            ray_index: int32 [m].
        """
        points = own if self.contraction is None else self.contraction.points(own)
        directions = self.frame.inverse.directions(directions)
        if len(self.networks) == 1:
            colour, density = as_field(self.networks[0].router)(points, directions, ray_index)
        else:
            colour, density, owner = own.new_zeros(len(own), 3), own.new_zeros(len(own)), self.owner[leaf]
            for number, network in enumerate(self.networks):
                rows = (owner == number).nonzero()[:, 0]
                if len(rows):
                    found = as_field(network.router)(points[rows], directions, ray_index[rows])
                    colour, density = (x.to(y).index_copy(0, rows, y) for x, y in zip((colour, density), found))
        return colour, density if self.frame.is_identity else density / self.frame.scale


class Claim(NamedTuple):
    """Positions that a part speaks for."""

    part: int
    rows: Tensor  # int64 [m], numbers of the positions
    own: Tensor  # [m, 3], the positions in the part's frame
    leaf: Tensor  # int64 [m], the leaves that they lie in


class Parts(nn.Module):
    """Several parts of one scene, a :class:`voronerf.nerf.Field`.

    Attributes:
        parts: In the order of their cells: part after part, the cells of each in the order of its leaves.
        diagram: Flat, of the centres of all cells in the scene; for drawings.
        num_cells: k.

    Args:
        parts: At least one.
        backend: Of the look-ups.
    """

    def __init__(self, parts: Sequence[Part], *, backend: str = "auto") -> None:
        super().__init__()
        if not parts or all(part.layer for part in parts):
            raise ValueError("Parts: parts must hold at least one in layer 0")
        self.parts, self.backend = nn.ModuleList(parts), backend
        self.diagram = VoronoiDiagram(torch.cat([part.centres for part in parts]))
        self.num_cells = self.diagram.num_cells
        #: The parts of each layer.
        self.layers = [[i for i, p in enumerate(parts) if p.layer == n] for n in sorted({p.layer for p in parts})]

    def __iter__(self) -> Iterator[Part]:
        return iter(self.parts)  # type: ignore[arg-type]

    def __getitem__(self, index: int) -> Part:
        return self.parts[index]  # type: ignore[return-value]

    def claims(self, layer: int, positions: Tensor) -> list[Claim]:
        """Which parts of a layer speak for which positions [n, 3] of the scene, in the order of the parts."""
        of, every = self.layers[layer], torch.arange(len(positions), device=positions.device)
        who = torch.zeros_like(every)
        if len(of) > 1:
            counts = torch.tensor([self[i].num_cells for i in of], device=who.device)
            centres = torch.cat([self[i].centres for i in of])
            nearest = ops.nearest_centre(positions, centres, backend=self.backend).long()
            who = torch.repeat_interleave(counts)[nearest]
        found: dict[int, list[Claim]] = {index: [] for index in of}
        left = torch.ones_like(who, dtype=torch.bool)
        for number, index in enumerate(of):
            claim = self._claim(index, positions, (who == number).nonzero()[:, 0])
            found[index].append(claim)
            left[claim.rows] = False
        rows = left.nonzero()[:, 0]
        if len(of) > 1 and len(rows):  # for these the nearest of the other parts that speak
            least = positions.new_full((len(positions),), math.inf)
            others = []
            for index in of:
                claim = self._claim(index, positions, rows)
                places, centres = positions[claim.rows], self[index].centres.to(positions)
                nearest = ops.nearest_centre(places, centres, backend=self.backend).long()
                away = (places - centres[nearest]).norm(dim=-1)
                least[claim.rows] = torch.minimum(least[claim.rows], away)
                others.append((claim, away))
            for claim, away in others:
                first = away == least[claim.rows]
                least[claim.rows[first]] = -1.0  # a tie goes to the first
                found[claim.part].append(Claim(claim.part, *(column[first] for column in claim[1:])))
        joined = [Claim(i, *map(torch.cat, zip(*(claim[1:] for claim in each)))) for i, each in found.items()]
        return [claim for claim in joined if len(claim.rows)]

    def _claim(self, index: int, positions: Tensor, rows: Tensor) -> Claim:
        """The rows that a part speaks for, of those it is asked about."""
        own = self[index].frame.inverse.points(positions[rows])
        leaf, speaks = self[index].find(own, self.backend)
        return Claim(index, rows[speaks], own[speaks], leaf[speaks])

    def assign(self, positions: Tensor) -> Tensor:
        """The cell that shows each position: [n, 3] -> int32 [n], of the uppermost layer that has one; -1 for none."""
        found = torch.full((len(positions),), -1, dtype=torch.int32, device=positions.device)
        for layer in range(len(self.layers)):
            for claim in self.claims(layer, positions):
                found[claim.rows] = self.cells_of(claim)
        return found

    def cells_of(self, claim: Claim) -> Tensor:
        """The cell of each position of a claim, int32 [m]."""
        return self[claim.part].number[claim.leaf] + sum(part.num_cells for part in [*self][: claim.part])

    def forward(self, positions: Tensor, directions: Tensor, ray_index: Tensor) -> tuple[Tensor, Tensor]:
        """Colours [n, 3] and densities [n] of positions [n, 3]; see :class:`voronerf.nerf.Field`."""
        under, below = positions.new_zeros(len(positions), 3), positions.new_zeros(len(positions))
        for layer in range(len(self.layers)):
            colour, density = torch.zeros_like(under), torch.zeros_like(below)
            for claim in self.claims(layer, positions):
                found = self[claim.part].evaluate(claim.own, claim.leaf, directions, ray_index[claim.rows])
                colour, density = (
                    whole.to(part).index_copy(0, claim.rows, part) for whole, part in zip((colour, density), found)
                )
            total = below + density
            share = torch.where(density > 0, density / total.clamp_min(torch.finfo(total.dtype).tiny), 0)[:, None]
            under, below = torch.where(share > 0, under + share * (colour - under), under), total
        return under, below
