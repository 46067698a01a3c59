"""A grid of candidate lists. n points, k centres.

What the tables mean and the map from space to cells are said in csrc/geometry/centre_grid.h. A list
may hold any superset of the centres that are nearest somewhere in its cell; this grid has no bricks and drops only
what one other centre beats in all of a cell.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

CELL_BITS = 12
"""Of the number of a finest cell along an axis."""
BRICK_BITS = 2
REACH, EDGE = 1024.0, 1100.0
_WIDEN = 2e-6
_MARGIN = 4e-15
"""More than the rounding of two float64 values, in units of their squared distances."""
_PIECE = 1 << 20


class GridTables(NamedTuple):
    """What a grid consists of."""

    frame: Tensor  # float32 [2, 3], the middle of the box of the cells and the inverse of half its width
    entries: Tensor  # int32, the root grid, then the bricks
    lists: Tensor  # int32, candidates behind their number
    table: Tensor  # float32 [k, 4], centres and a column of zeros
    bits: int  # the root grid has ``2**bits`` cells along an axis


def centre_grid(centres: Tensor) -> GridTables:
    """A grid over all of space; see ``voronerf.ops.centre_grid``."""
    table = centre_table(centres)
    centres = centres.detach().double()
    k, bits = centres.shape[0], root_bits(centres.shape[0])
    frame = _frame(centres)
    side = 2**bits
    steps = torch.arange(side, dtype=torch.float64, device=centres.device) / side
    low = _coordinate((steps - _WIDEN).clamp(min=0)[:, None], frame)
    high = _coordinate((steps + 1 / side + _WIDEN).clamp(max=1)[:, None], frame)
    entries, pieces, place = [], [], 0
    for cells in torch.arange(side**3, device=centres.device).split(max(1, _PIECE // (8 * k))):
        kept = _candidates(_corners(cells, side, low, high), centres)
        counts = kept.sum(dim=1)
        starts = place + torch.arange(len(cells), device=cells.device) + counts.cumsum(0) - counts
        lists = torch.empty(int(counts.sum()) + len(cells), dtype=torch.int32, device=cells.device)
        # Row by row, indices rising, each row behind its count.
        row, candidate = kept.nonzero(as_tuple=True)
        lists[starts - place] = counts.int()
        lists[torch.arange(len(row), device=cells.device) + row + 1] = candidate.int()
        entries.append(starts.int())
        pieces.append(lists)
        place += len(lists)
    return GridTables(frame, torch.cat(entries), torch.cat(pieces), table, bits)


def root_bits(k: int) -> int:
    """Bits of the root grid along an axis: eight cells a centre, within limits."""
    return next(bits for bits in (3, 4, 5, 6) if bits == 6 or 8**bits >= 8 * k)


def centre_table(centres: Tensor) -> Tensor:
    """float32 [k, 4]: centres and a column of zeros, so that a row is 16 bytes."""
    return torch.nn.functional.pad(centres.float(), (0, 1))


def _frame(centres: Tensor) -> Tensor:
    low, high = centres.amin(dim=0), centres.amax(dim=0)
    half = 1.125 * (high / 2 - low / 2)
    far = torch.maximum(low.abs(), high.abs()).amax()
    half = half.clamp(min=0.125 * half.amax()).clamp(min=1e-6 * far).clamp(1e-30, 1e30)
    return torch.stack([(low / 2 + high / 2).clamp(-1e30, 1e30), 1 / half]).float()


def _coordinate(t: Tensor, frame: Tensor) -> Tensor:
    """Coordinates [..., 3] at the part t [..., 1] of the cells of each axis."""
    middle, inverse = frame.double()
    p = t / 0.375 - 4 / 3
    outside = (1 / (1 - 3 * (p.abs() - 1)).clamp(min=1 / EDGE)).clamp(max=EDGE)
    return middle + torch.where(p.abs() <= 1, p, p.sign() * outside) / inverse


def _corners(cells: Tensor, side: int, low: Tensor, high: Tensor) -> Tensor:
    """The eight corners [n, 8, 3] of cells of the root grid."""
    along = torch.stack([cells // side**2, cells // side % side, cells % side], dim=1)
    axes = torch.arange(3, device=cells.device)
    ends = torch.stack([low[along, axes], high[along, axes]])
    choice = torch.cartesian_prod(*[torch.arange(2, device=cells.device)] * 3)
    return ends[choice[:, None], torch.arange(len(cells), device=cells.device)[None, :, None], axes].transpose(0, 1)


def _candidates(corners: Tensor, centres: Tensor) -> Tensor:
    """Which centres stay, bool [n, k]: those that the centre nearest to the middle does not beat at all corners.

    The difference of two squared distances is linear in the point, so what holds at the corners holds in the cell.
    """
    squared = (corners[:, :, None] - centres).square().sum(dim=3)
    margin = _MARGIN * squared + 1e-300
    inside = (corners.mean(dim=1)[:, None] - centres).square().sum(dim=2)
    best = inside.argmin(dim=1)[:, None, None].expand(-1, 8, 1)
    return ~(squared - margin > (squared + margin).gather(2, best)).all(dim=1)
