"""Parts: routers that are placed in one scene, each in a frame of its own, and evaluated as one field.

Letters: n samples, r rays, k cells of all parts, l leaves of the diagram of one part. Positions, lengths and densities
are in scene units, or in a part's frame if the text says so; a similarity maps a part's frame to the scene.

A part covers a point if the point lies in the part's region, and in a leaf that has a network. If several parts of a
layer cover a point, the part with the nearest centre is evaluated; its own diagram gives the cell. Layers are
superposed: their densities add up, and their colours are averaged with the densities as weights, as for two clouds in
one place.
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
from voronerf.editing.geometry import Similarity, Solid
from voronerf.editing.network import StoredRouter
from voronerf.nerf.contraction import Contraction
from voronerf.ops.formulas import voxels_of


class Part(nn.Module):
    """A diagram with networks in its leaves, placed in a scene by a frame of its own.

    Leaves whose cells were cut away have no network; space is empty there.

    Args:
        network: The stored router, which has the networks of the kept leaves in ascending order.
        diagram: A diagram with l leaves; None for the diagram of the router.
        kept: bool [l], whether each leaf has a network; None if all leaves have one.
        frame: The similarity from the part's frame to the scene.
        contraction: The contraction of the part's space, or None.
        region: Solids in the part's frame; the part covers their intersection.
        layer: 0 for the scene, 1 or more for objects on top of it.
    """

    kept: Tensor
    number: Tensor

    def __init__(
        self,
        network: StoredRouter,
        diagram: VoronoiDiagram | None = None,
        kept: Tensor | None = None,
        *,
        frame: Similarity | None = None,
        contraction: Contraction | None = None,
        region: Sequence[Solid] = (),
        layer: int = 0,
    ) -> None:
        super().__init__()
        self.network, self.diagram = network, network.diagram if diagram is None else diagram
        leaves, cells, device = self.diagram.num_cells, network.diagram.num_cells, self.diagram.centres.device
        kept = torch.ones(leaves, dtype=torch.bool, device=device) if kept is None else kept.bool()
        if kept.shape != (leaves,):
            raise ValueError(f"Part: kept must have shape [{leaves}], got {list(kept.shape)}")
        self.num_cells = int(kept.sum())
        if self.num_cells != cells:
            raise ValueError(
                f"Part: kept must mark as many leaves as the router has cells, {cells}, got {self.num_cells}"
            )
        self.register_buffer("kept", kept.to(device))
        self.register_buffer("number", torch.where(kept, kept.cumsum(0) - 1, -1).int().to(device))
        self.frame, self.contraction, self.region = frame or Similarity(), contraction, tuple(region)
        self.layer = layer

    @functools.cached_property
    def centres(self) -> Tensor:
        """The centres of the part's cells in scene coordinates, [cells, 3]."""
        centres = self.diagram.leaf_centres
        centres = self.frame.points(centres if self.contraction is None else self.contraction.inverse(centres))
        return centres[self.kept]

    def changed(self, **changes: Any) -> Part:
        """Returns a copy with other values of some of the constructor's arguments."""
        names = ("network", "diagram", "kept", "frame", "contraction", "region", "layer")
        return Part(**{**{name: getattr(self, name) for name in names}, **changes})

    def keep(self, cells: Tensor) -> Part | None:
        """Returns the part with only the networks of ``cells``, int64 [c]; None if no cell is kept."""
        if len(cells) == self.num_cells:
            return self
        if not len(cells):
            return None
        chosen, kept = torch.zeros(self.num_cells, dtype=torch.bool, device=self.kept.device), self.kept.clone()
        chosen[cells] = True
        kept[self.kept] = chosen
        return self.changed(network=self.network.part(chosen.nonzero()[:, 0]), kept=kept)

    def open(self) -> None:
        """Makes the router of the networks, as a submodule."""
        self.router = self.network.router

    def find(self, local: Tensor, backend: str = "auto") -> tuple[Tensor, Tensor]:
        """Returns the leaves, int64 [n], of points [n, 3] in the part's frame, and a mask of covered points, [n]."""
        points = local if self.contraction is None else self.contraction.points(local)
        leaf = self.diagram.locate(points, backend=backend).long()
        covered = self.kept[leaf]
        for solid in self.region:
            covered &= solid.holds(local)
        return leaf, covered

    def evaluate(self, local: Tensor, directions: Tensor, ray_index: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the colours [m, 3] and the densities [m], per scene unit, of points that the part covers.

        Density is 0 in voxels that were empty in the training.

        Args:
            local: [m, 3], the points in the part's frame.
            directions: [r, 3], the rays' directions in the scene.
            ray_index: int32 [m], the ray of each point.
        """
        points = local if self.contraction is None else self.contraction.points(local)
        directions = self.frame.inverse.directions(directions)
        colour, density = as_field(self.network.router)(points, directions, ray_index)
        if self.network.voxels is not None:
            box, occupied = self.network.voxels
            voxel = voxels_of(points, box, occupied.shape).long()
            density = torch.where(occupied.view(-1)[voxel], density, 0)
        return colour, density if self.frame.is_identity else density / self.frame.scale


class Claim(NamedTuple):
    """The positions that a part covers and evaluates."""

    part: int
    rows: Tensor  # int64 [m], numbers of the positions
    local: Tensor  # [m, 3], the positions in the part's frame
    leaf: Tensor  # int64 [m], the leaf of each position


class Parts(nn.Module):
    """Several parts of one scene, as one :class:`voronerf.nerf.Field`.

    Cells are numbered part after part, and within a part in the order of its leaves.

    Attributes:
        parts: The parts.
        diagram: A flat diagram of the centres of all cells, in scene coordinates; for drawings.
        num_cells: The number of cells of all parts, k.

    Args:
        parts: At least one part.
        backend: The backend of the nearest-centre searches.
    """

    def __init__(self, parts: Sequence[Part], *, backend: str = "auto") -> None:
        super().__init__()
        if not parts or all(part.layer for part in parts):
            raise ValueError("Parts: parts must hold at least one in layer 0")
        self.parts, self.backend = nn.ModuleList(parts), backend
        self.diagram = VoronoiDiagram(torch.cat([part.centres for part in parts]))
        self.num_cells = self.diagram.num_cells
        #: The indices in ``parts`` of the parts of each layer.
        self.layers = [[i for i, p in enumerate(parts) if p.layer == n] for n in sorted({p.layer for p in parts})]

    def __iter__(self) -> Iterator[Part]:
        return iter(self.parts)  # type: ignore[arg-type]

    def __getitem__(self, index: int) -> Part:
        return self.parts[index]  # type: ignore[return-value]

    def claims(self, layer: int, positions: Tensor) -> list[Claim]:
        """Assigns positions [n, 3] of the scene to the parts of a layer; returns the claims that are not empty."""
        members, positions_index = self.layers[layer], torch.arange(len(positions), device=positions.device)
        nearest_part = torch.zeros_like(positions_index)
        if len(members) > 1:
            counts = torch.tensor([self[i].num_cells for i in members], device=nearest_part.device)
            centres = torch.cat([self[i].centres for i in members])
            nearest = ops.nearest_centre(positions, centres, backend=self.backend).long()
            nearest_part = torch.repeat_interleave(counts)[nearest]
        claims: dict[int, list[Claim]] = {index: [] for index in members}
        uncovered = torch.ones_like(nearest_part, dtype=torch.bool)
        for number, index in enumerate(members):
            claim = self._claim(index, positions, (nearest_part == number).nonzero()[:, 0])
            claims[index].append(claim)
            uncovered[claim.rows] = False
        rows = uncovered.nonzero()[:, 0]
        if len(members) > 1 and len(rows):  # these positions are not covered by their nearest part
            least = positions.new_full((len(positions),), math.inf)
            others = []  # claims of all parts on these positions; each position goes to the nearest of these parts
            for index in members:
                claim = self._claim(index, positions, rows)
                places, centres = positions[claim.rows], self[index].centres.to(positions)
                nearest = ops.nearest_centre(places, centres, backend=self.backend).long()
                distance = (places - centres[nearest]).norm(dim=-1)
                least[claim.rows] = torch.minimum(least[claim.rows], distance)
                others.append((claim, distance))
            for claim, distance in others:
                first = distance == least[claim.rows]
                least[claim.rows[first]] = -1.0  # a tie goes to the first part
                claims[claim.part].append(Claim(claim.part, *(column[first] for column in claim[1:])))
        joined = [Claim(i, *map(torch.cat, zip(*(claim[1:] for claim in each)))) for i, each in claims.items()]
        return [claim for claim in joined if len(claim.rows)]

    def _claim(self, index: int, positions: Tensor, rows: Tensor) -> Claim:
        """Returns a part's claim: the positions, among those with the numbers ``rows``, that the part covers."""
        local = self[index].frame.inverse.points(positions[rows])
        leaf, covered = self[index].find(local, self.backend)
        return Claim(index, rows[covered], local[covered], leaf[covered])

    def assign(self, positions: Tensor) -> Tensor:
        """Returns the cell of each position [n, 3], int32 [n], in the uppermost layer that covers it, or -1."""
        cells = torch.full((len(positions),), -1, dtype=torch.int32, device=positions.device)
        for layer in range(len(self.layers)):
            for claim in self.claims(layer, positions):
                cells[claim.rows] = self.cells_of(claim)
        return cells

    def cells_of(self, claim: Claim) -> Tensor:
        """Returns the cell of each position of a claim, int32 [m]."""
        return self[claim.part].number[claim.leaf] + sum(part.num_cells for part in [*self][: claim.part])

    def forward(self, positions: Tensor, directions: Tensor, ray_index: Tensor) -> tuple[Tensor, Tensor]:
        """Returns colours [n, 3] and densities [n] of positions [n, 3]; see :class:`voronerf.nerf.Field`."""
        under, below = positions.new_zeros(len(positions), 3), positions.new_zeros(len(positions))
        for layer in range(len(self.layers)):
            colour, density = torch.zeros_like(under), torch.zeros_like(below)
            for claim in self.claims(layer, positions):
                values = self[claim.part].evaluate(claim.local, directions, ray_index[claim.rows])
                colour, density = (
                    full.to(part).index_copy(0, claim.rows, part) for full, part in zip((colour, density), values)
                )
            total = below + density
            share = torch.where(density > 0, density / total.clamp_min(torch.finfo(total.dtype).tiny), 0)[:, None]
            under, below = torch.where(share > 0, under + share * (colour - under), under), total
        return under, below
