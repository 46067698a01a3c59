"""Leaves of a tree of diagrams drawn by their distances. n points, m centres of all diagrams together, g diagrams."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops.formulas import in_pieces

_PIECE = {"cpu": 1 << 17}
"""Distances held at a time on a device: what a core's second-level cache holds."""
_LARGE_PIECE = 1 << 22
"""The same on other devices, where few launches count."""


@torch.no_grad()
def draw_cell(
    points: Tensor, centres: Tensor, child_offsets: Tensor, child: Tensor, uniforms: Tensor, temperature: float
) -> Tensor:
    """A leaf for every point, drawn at random by its distances to the centres, level by level.

    On each level the first centre is drawn up to which the probabilities sum to at least 1 - u, u being the uniform
    number of the point for that level: uniforms [n, levels], in 0 to 1 (NaN counts as 0). A point that is not finite,
    or whose squared distances overflow, goes to the first centre on every level. Points are float32 or float64 [n, 3],
    the tree is as in `ops.locate_cell`, the temperature is positive and finite, in scene units. Leaves are int32 [n].
    """
    # Neither 0 nor infinite in float32: the nearest centre's mass is 1 at any temperature.
    temperature = min(max(temperature, 1e-37), 3e38)
    table = torch.arange(centres.shape[0], dtype=torch.int32, device=centres.device)
    owner = torch.searchsorted(child_offsets, table, right=True) - 1

    def run(points: Tensor, uniforms: Tensor) -> Tensor:
        distance = (points[:, None] - centres).square().sum(2).sqrt()
        # How much of the distribution the drawn centre and those before it must hold: more than nothing, at most all.
        wanted = (1 - uniforms.nan_to_num(0.0)).clamp(torch.finfo(torch.float32).eps / 2, 1)
        # `state` is the diagram a point is in, or (negative) the leaf it has reached.
        state = torch.zeros(points.shape[0], dtype=torch.int32, device=points.device)
        for level in range(uniforms.shape[1]):
            elsewhere = owner[None, :] != state[:, None]
            nearest = distance.masked_fill(elsewhere, torch.inf).amin(1, keepdim=True)
            # Infinity and NaN have no mass.
            mass = ((nearest - distance) / temperature).exp().masked_fill(elsewhere, 0).nan_to_num(0.0)
            # A device sums as a tree, each place with roundings of its own: a sum may be below the one before it, and
            # the last above that at the last centre with mass. Of those with mass the first counts that has enough.
            sums = mass.cumsum(1).masked_fill(mass == 0, 0)
            total = sums.amax(1, keepdim=True)
            drawn = (sums >= wanted[:, level, None] * total).to(torch.uint8).argmax(1)
            drawn = torch.where(total[:, 0] > 0, drawn, child_offsets[state.clamp(min=0)])
            state = torch.where(state < 0, state, child[drawn])
        return -state - 1

    return in_pieces(run, _PIECE.get(points.device.type, _LARGE_PIECE) // centres.shape[0], points, uniforms)
