"""``draw_cell`` of the compiled module. n points, m centres of g diagrams."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from voronerf import native
from voronerf.native.custom_op import custom_op
from voronerf.ops.locate_cell.native import check_tree, too_shallow


def draw_cell(
    points: Tensor,
    centres: Tensor,
    child_offsets: Tensor,
    child: Tensor,
    uniforms: Tensor,
    *,
    temperature: float,
    depth: int,
    weights: Tensor | None = None,
) -> Tensor:
    """A leaf for every point, drawn from its distances; see ``voronerf.ops.draw_cell``."""
    leaves: Tensor = _draw_cell(points, centres, child_offsets, child, uniforms, temperature, depth, weights)
    return leaves


@custom_op("draw_cell")
def _draw_cell(
    points: Tensor,
    centres: Tensor,
    child_offsets: Tensor,
    child: Tensor,
    uniforms: Tensor,
    temperature: float,
    depth: int,
    weights: Tensor | None,
) -> Iterator[Tensor]:
    leaves = points.new_empty(points.shape[0], dtype=torch.int32)
    yield leaves
    compiled, machine = native.compiled, native.machine(points)
    n, m, g = points.shape[0], centres.shape[0], child_offsets.shape[0] - 1
    given = points, centres, weights, child_offsets, child, uniforms, leaves
    if isinstance(machine, compiled.Cuda):
        compiled.draw_cell(*given, n, m, g, depth, temperature, machine)
        return
    check_tree(child_offsets, child, m, "draw_cell")
    places = child.new_empty(compiled.draw_cell_places(m, machine))
    sums = points.new_empty(compiled.draw_cell_sums(m, machine))
    if not compiled.draw_cell(*given, places, sums, n, m, depth, temperature, machine):
        raise too_shallow(depth, "draw_cell")
