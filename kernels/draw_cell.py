"""Drawing a leaf by its distances as a Warp kernel. n points, m centres of all diagrams together, g diagrams.

A thread takes a point down the tree; at each diagram it goes over the centres three times: for the nearest, for the sum
of the masses, and for the first centre up to which they sum to enough, in the same order and with the same roundings.
Nothing outside the tables is read; a walk that leads out of them or ends at no leaf gives a negative number.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from voronerf.kernels._launch import array, launch

wp.set_module_options({"enable_backward": False})


@wp.func
def _squared(
    x: wp.vec3,
    centres: wp.array2d(dtype=wp.float32),
    weights: wp.array(dtype=wp.float32),
    weighted: wp.bool,
    heaviest: wp.float32,
    j: wp.int32,
) -> wp.float32:
    away = x - wp.vec3(centres[j, 0], centres[j, 1], centres[j, 2])
    value = wp.dot(away, away)
    if weighted:
        value = value + (heaviest - weights[j])
    return value


@wp.func
def _mass(nearest: wp.float32, squared: wp.float32, temperature: wp.float32) -> wp.float32:
    mass = wp.exp((nearest - wp.sqrt(squared)) / temperature)
    # Finite, unlike the mass of a point that is not finite; above 1 only by rounding.
    if mass >= 0.0:
        return wp.min(mass, wp.float32(1.0))
    return wp.float32(0.0)


@wp.kernel
def _draw_cell_kernel(
    points: wp.array2d(dtype=wp.float32),
    centres: wp.array2d(dtype=wp.float32),
    weights: wp.array(dtype=wp.float32),
    weighted: wp.bool,
    child_offsets: wp.array(dtype=wp.int32),
    child: wp.array(dtype=wp.int32),
    uniforms: wp.array2d(dtype=wp.float32),
    temperature: wp.float32,
    depth: wp.int32,
    leaves: wp.array(dtype=wp.int32),
) -> None:
    i = wp.tid()
    x = wp.vec3(points[i, 0], points[i, 1], points[i, 2])
    # The diagram the point is in, or (negative) the leaf it has reached.
    state = wp.int32(0)
    for level in range(depth):
        if state >= 0 and state < child_offsets.shape[0] - 1:
            first = wp.max(child_offsets[state], 0)
            last = wp.min(child_offsets[state + 1], centres.shape[0])
            heaviest = wp.float32(-3.4028235e38)
            if weighted:
                for j in range(first, last):
                    heaviest = wp.max(heaviest, weights[j])
            nearest = wp.float32(3.4028235e38)
            for j in range(first, last):
                squared = _squared(x, centres, weights, weighted, heaviest, j)
                if squared < nearest:
                    nearest = squared
            nearest = wp.sqrt(nearest)
            total = wp.float32(0.0)
            for j in range(first, last):
                total += _mass(nearest, _squared(x, centres, weights, weighted, heaviest, j), temperature)
            wanted = wp.float32(1.0) - uniforms[i, level]
            if not (wanted <= 1.0):  # above 1, or NaN
                wanted = wp.float32(1.0)
            wanted = wp.max(wanted, wp.float32(5.9604645e-8)) * total
            drawn = first
            held = wp.float32(0.0)
            if total > 0.0:
                for j in range(first, last):
                    held += _mass(nearest, _squared(x, centres, weights, weighted, heaviest, j), temperature)
                    if held < wanted:
                        drawn = j + 1
            drawn = wp.min(drawn, last - 1)
            if first < last:
                state = child[drawn]
            else:
                state = child_offsets.shape[0]
    leaves[i] = -state - 1


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


@torch.library.custom_op("voronerf::draw_cell_warp", mutates_args=())
def _draw_cell(
    points: Tensor,
    centres: Tensor,
    child_offsets: Tensor,
    child: Tensor,
    uniforms: Tensor,
    temperature: float,
    depth: int,
    weights: Tensor | None,
) -> Tensor:
    leaves = points.new_empty(points.shape[0], dtype=torch.int32)
    placed = [array(tensor, points) for tensor in (points, centres, weights)]
    tables = [array(tensor, points) for tensor in (child_offsets, child, uniforms)]
    # Neither 0 nor infinite in float32: the nearest centre's mass is 1 at any temperature.
    temperature = min(max(temperature, 1e-37), 3e38)
    inputs = [*placed, weights is not None, *tables, temperature, depth, array(leaves, points)]
    launch(_draw_cell_kernel, points.shape[0], inputs, points)
    return leaves


@_draw_cell.register_fake
def _(
    points: Tensor,
    centres: Tensor,
    child_offsets: Tensor,
    child: Tensor,
    uniforms: Tensor,
    temperature: float,
    depth: int,
    weights: Tensor | None,
) -> Tensor:
    return points.new_empty(points.shape[0], dtype=torch.int32)
