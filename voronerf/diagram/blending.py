"""Blending of neighbouring cells: which leaves contribute to a point near their borders, and with what weights.

Letters: n points, m entries (a point and one of its leaves), k siblings, the centres of one diagram of a tree.

The border between siblings i and j is a plane, and the signed distance of a point x to it is

    d_ij(x) = (|x - v_j|^2 - |x - v_i|^2) / (2 |v_i - v_j|),

positive on the side of i. With the margin M, the weight of a sibling falls linearly: 1 at a distance M inside its cell,
1/2 on its border, 0 at a distance M outside its nearest plane:

    u_i(x) = clamp(1/2 + min_j d_ij(x) / (2 M), 0, 1),    divided by the sum over the siblings.

Each u_i is continuous in x. A point farther than M from every border has the weight 1 in its own cell and 0 in the
others. The weights of the levels of a tree multiply, so the weights of the leaves of a point sum to 1.

At most `most` leaves contribute to a point: the weight of the next leaf is subtracted from all of theirs before they
are divided by their sum. So a leaf appears and disappears with weight 0, and nothing jumps. If `most` + 1 leaves have
exactly the same weight, only the nearest is kept; for 4 that needs more borders in one place than cells in general
position have.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.diagram.voronoi import VoronoiDiagram

_CHUNK_ELEMENTS = 1 << 20  # distances held at once: 4 MiB in float32, a few times that in all


class Blend(NamedTuple):
    """The points within a margin, and their leaves."""

    rows: Tensor  # int64 [m], the point of each entry, ascending; a point outside all margins has no entry
    cells: Tensor  # int32 [m], a leaf of that point, from the heaviest to the lightest
    weights: Tensor  # floating [m], > 0; the weights of a point sum to 1


@torch.no_grad()
def blend_cells(diagram: VoronoiDiagram, points: Tensor, margin: float, *, most: int = 4) -> Blend:
    """The leaves that contribute to points near borders, and their weights. Not differentiable.

    Args:
        diagram: of any depth.
        points: floating [n, 3]; half types are compared in float32. A point that is not finite is in no margin.
        margin: M, in scene units, the same on every level; 0 blends nothing.
        most: largest number of leaves of a point, at least 1.

    Raises:
        ValueError: shapes, a margin that is negative or not finite, `most` below 1.
    """
    if points.dim() != 2 or points.shape[1] != 3 or not points.is_floating_point():
        raise ValueError(f"blend_cells: points must be floating [n, 3], got {points.dtype} {list(points.shape)}")
    if not 0.0 <= margin < float("inf"):
        raise ValueError(f"blend_cells: margin must be finite and at least 0, got {margin}")
    if most < 1:
        raise ValueError(f"blend_cells: most must be at least 1, got {most}")
    dtype = torch.promote_types(points.dtype, torch.float32)
    found = [
        (
            torch.empty(0, dtype=torch.int64, device=points.device),
            torch.empty(0, dtype=torch.int32, device=points.device),
            torch.empty(0, dtype=dtype, device=points.device),
        )
    ]
    if margin > 0 and diagram.num_cells > 1:
        apart = _apart(diagram, dtype)
        size = max(1, _CHUNK_ELEMENTS // (3 * apart.shape[1]))
        for start in range(0, points.shape[0], size):
            rows, cells, weights = _soft_leaves(diagram, points[start : start + size].to(dtype), margin, apart)
            rows, cells, weights = _heaviest(rows, cells, weights, most)
            found.append((rows + start, cells, weights))
    rows, cells, weights = (torch.cat(parts) for parts in zip(*found, strict=True))
    return Blend(rows, cells, weights)


def _soft_leaves(
    diagram: VoronoiDiagram, points: Tensor, margin: float, apart: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """(rows, leaves, weights) of all leaves with a weight, level by level; `apart` is what `_apart` gives."""
    centres = diagram.centres.to(points.dtype)
    offsets, child = diagram.child_offsets.long(), diagram.child
    rows = torch.arange(points.shape[0], device=points.device)
    node, weights = torch.zeros_like(rows), torch.ones_like(points[:, 0])
    leaves = []
    for level in range(diagram.depth):
        if level == 0:  # the same siblings for all points
            siblings = torch.arange(int(offsets[1]), device=points.device)[None]
            squared = torch.cdist(points, centres[siblings[0]], compute_mode="donot_use_mm_for_euclid_dist").square_()
            siblings = siblings.expand(len(rows), -1)
        else:
            siblings = offsets[node][:, None] + torch.arange(apart.shape[1], device=points.device)
            absent = siblings >= offsets[node + 1][:, None]
            siblings = siblings.clamp(max=centres.shape[0] - 1)
            squared = (points[rows][:, None] - centres[siblings]).square().sum(2)
            squared = squared.masked_fill(absent, float("inf"))
        entry, member, share = _soft_siblings(squared, siblings, apart, margin)
        weights = weights[entry] * share
        rows, link = rows[entry], child[siblings[entry, member]]
        final = link < 0
        leaves.append((rows[final], -1 - link[final], weights[final]))
        rows, node, weights = rows[~final], link[~final].long(), weights[~final]
        if rows.numel() == 0:
            break
    found = [torch.cat(parts) for parts in zip(*leaves, strict=True)]
    return found[0], found[1], found[2]


def _apart(diagram: VoronoiDiagram, dtype: torch.dtype) -> Tensor:
    """[centres of all diagrams, most siblings]: how far each centre's siblings are, in the order of their rows."""
    offsets, centres = diagram.child_offsets.tolist(), diagram.centres.to(dtype)
    widest = max(last - first for first, last in itertools.pairwise(offsets))
    table = centres.new_zeros(centres.shape[0], widest)
    for first, last in itertools.pairwise(offsets):
        own = centres[first:last]
        table[first:last, : last - first] = (own[:, None] - own).norm(dim=2)
    return table


def _soft_siblings(squared: Tensor, siblings: Tensor, apart: Tensor, margin: float) -> tuple[Tensor, Tensor, Tensor]:
    """The weights of siblings.

    Args:
        squared: [e, k], squared distances; infinite for entries that are not siblings.
        siblings: int64 [e, k], rows of the centres.
        apart: [m, >= k], what `_apart` gives.
        margin: M.

    Returns:
        (entry [q], sibling [q], weight [q] > 0), the weights of an entry summing to 1.
    """
    every, k = torch.arange(squared.shape[0], device=squared.device), squared.shape[1]
    least, nearest = squared.min(1)
    # nearer to the plane between a sibling and the nearest than M; never so for the nearest itself, or in its place
    beyond = squared - least[:, None] < 2 * margin * apart[siblings[every, nearest], :k]
    near = beyond.any(1)
    entry, member = beyond.nonzero(as_tuple=True)
    own, alone = every[near], every[~near]
    entry, member = torch.cat([entry, own]), torch.cat([member, nearest[own]])
    lead = squared[entry] - squared[entry, member][:, None]
    side = apart[siblings[entry, member], :k]
    column = torch.arange(k, device=squared.device)
    # to itself, and by whose cell it is between centres in one place
    ahead = (lead > 0) | ((lead == 0) & (column >= member[:, None]))
    inside = torch.where(side > 0, lead / (2 * side), torch.where(ahead, float("inf"), -float("inf")))
    share = (0.5 + inside.amin(1) / (2 * margin)).clamp(0, 1)
    total = torch.zeros_like(least).index_add_(0, entry, share)
    share = share / total[entry]
    kept = share > 0
    entry, member = torch.cat([entry[kept], alone]), torch.cat([member[kept], nearest[alone]])
    return entry, member, torch.cat([share[kept], torch.ones_like(least[alone])])


def _heaviest(rows: Tensor, cells: Tensor, weights: Tensor, most: int) -> tuple[Tensor, Tensor, Tensor]:
    """The `most` heaviest leaves of each row that has several, in order, with weights that sum to 1."""
    if rows.numel() == 0:
        return rows, cells, weights
    several = rows.bincount()[rows] > 1
    rows, cells, weights = rows[several], cells[several], weights[several]
    # equal weights: the lowest leaf first, so that the result does not depend on the order of the search
    order = cells.argsort(stable=True)
    order = order[weights[order].argsort(descending=True, stable=True)]
    order = order[rows[order].argsort(stable=True)]
    rows, cells, weights = rows[order], cells[order], weights[order]
    present, number, count = rows.unique_consecutive(return_inverse=True, return_counts=True)
    rank = torch.arange(rows.shape[0], device=rows.device) - (count.cumsum(0) - count)[number]
    beyond = torch.zeros_like(present, dtype=weights.dtype)
    next_one = rank == most
    beyond[number[next_one]] = weights[next_one]
    left = torch.where(rank < most, weights - beyond[number], 0)
    total = torch.zeros_like(beyond).index_add_(0, number, left)
    left = torch.where(total[number] > 0, left / total[number], (rank == 0).to(left.dtype))
    kept = left > 0
    return rows[kept], cells[kept], left[kept]


class Mixture:
    """What is to be evaluated beside each sample in its own cell, and how much of it goes into the result.

    Attributes:
        rows: int64 [m], the sample of each entry; m is never 1.
        cells: int32 [m], the cell to evaluate it in.
        weights: floating [m].
        kept: floating [n], the share of a sample's own cell; 1 outside of all margins.
    """

    def __init__(self, rows: Tensor, cells: Tensor, weights: Tensor, kept: Tensor) -> None:
        self.rows, self.cells, self.weights, self.kept = rows, cells, weights, kept

    @classmethod
    def of(cls, diagram: VoronoiDiagram, positions: Tensor, margin: float, backend: str) -> Mixture | None:
        """The mixture at positions [..., 3]; None if no sample lies in a margin."""
        positions = positions.detach().reshape(-1, 3)
        blend = blend_cells(diagram, positions, margin)
        if blend.rows.numel() == 0:
            return None
        own = blend.cells == diagram.locate(positions[blend.rows], backend=backend)
        kept = torch.ones(positions.shape[0], dtype=blend.weights.dtype, device=positions.device)
        kept[blend.rows] = 0
        kept[blend.rows[own]] = blend.weights[own]
        rows, cells, weights = (part[~own] for part in blend)
        if rows.numel() == 0:
            return None
        if rows.shape[0] == 1:  # a single row is ambiguous: add one of weight 0
            rows, cells, weights = rows.repeat(2), cells.repeat(2), torch.cat([weights, torch.zeros_like(weights)])
        return cls(rows, cells, weights, kept)

    def mix(self, own: Tensor, others: Tensor) -> Tensor:
        """Weighted means; results that are not floating-point are those of a sample's own cell.

        Args:
            own: [n, ...], the results in the samples' own cells.
            others: [m, ...], those of the entries.
        """
        if not own.is_floating_point():
            return own
        dtype = torch.promote_types(torch.promote_types(own.dtype, torch.float32), self.kept.dtype)
        n, m = self.kept.shape[0], self.rows.shape[0]
        total = own.reshape(n, -1).to(dtype) * self.kept[:, None]
        total = total.index_add(0, self.rows, others.reshape(m, -1).to(dtype) * self.weights[:, None].to(dtype))
        return total.to(own.dtype).reshape(own.shape)
