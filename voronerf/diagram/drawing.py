"""Draws a leaf of a tree of diagrams at random for each point; cells with near centres are more likely.

Letters: n points, m centres of all diagrams, g diagrams.
"""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops.formulas import in_pieces

_PIECE = {"cpu": 1 << 17}
"""The maximum number of distances in memory at a time; on a CPU, they fit in a core's second-level cache."""
_LARGE_PIECE = 1 << 22
"""The maximum number of distances on other devices, where fewer launches matter more than the cache."""


@torch.no_grad()
def draw_cell(
    points: Tensor, centres: Tensor, child_offsets: Tensor, child: Tensor, uniforms: Tensor, temperature: float
) -> Tensor:
    """Draws a leaf for every point at random, by its distances to the centres, level by level.

    On each level, the function draws the first centre at which the cumulative probability reaches 1 - u, where u is the
    point's uniform number for the level. A point that is not finite, or whose squared distances overflow, goes to the
    first centre on every level.

    Args:
        points: float32 or float64 [n, d].
        centres: The centres [m, d] of the tree, as in `ops.locate_cell`.
        child_offsets: int32 [g + 1], as in `ops.locate_cell`.
        child: int32 [m], as in `ops.locate_cell`.
        uniforms: Uniform numbers [n, levels] in 0 to 1; NaN counts as 0.
        temperature: The temperature in scene units, positive and finite.

    Returns:
        int32 [n] leaf numbers.
    """
    # The bounds keep the temperature positive and finite in float32, so the nearest centre's mass is 1 at any
    # temperature.
    temperature = min(max(temperature, 1e-37), 3e38)
    table = torch.arange(centres.shape[0], dtype=torch.int32, device=centres.device)
    owner = torch.searchsorted(child_offsets, table, right=True) - 1

    def run(points: Tensor, uniforms: Tensor) -> Tensor:
        distance = (points[:, None] - centres).square().sum(2).sqrt()
        # The cumulative probability that the drawn centre must reach, in (0, 1].
        wanted = (1 - uniforms.nan_to_num(0.0)).clamp(torch.finfo(torch.float32).eps / 2, 1)
        # `state` is the diagram that a point is in or, if negative, the leaf that the point has reached.
        state = torch.zeros(points.shape[0], dtype=torch.int32, device=points.device)
        for level in range(uniforms.shape[1]):
            elsewhere = owner[None, :] != state[:, None]
            nearest = distance.masked_fill(elsewhere, torch.inf).amin(1, keepdim=True)
            # Centres at a distance of infinity or NaN get mass 0.
            mass = ((nearest - distance) / temperature).exp().masked_fill(elsewhere, 0).nan_to_num(0.0)
            # A GPU rounds each cumulative sum separately, so the sums need not increase, and a centre without mass may
            # have a larger sum than the last centre with mass. Therefore only centres with mass are candidates.
            sums = mass.cumsum(1).masked_fill(mass == 0, 0)
            total = sums.amax(1, keepdim=True)
            drawn = (sums >= wanted[:, level, None] * total).to(torch.uint8).argmax(1)
            drawn = torch.where(total[:, 0] > 0, drawn, child_offsets[state.clamp(min=0)])
            state = torch.where(state < 0, state, child[drawn])
        return -state - 1

    return in_pieces(run, _PIECE.get(points.device.type, _LARGE_PIECE) // centres.shape[0], points, uniforms)
