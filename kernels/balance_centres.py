"""Balancing a diagram's cells as Warp kernels. m samples, k centres.

All steps run on the device, two launches each: a thread for each sample finds its cell and adds its mass there; a
thread for each centre finds its neighbours and moves. Masses are added as integers, in units of some 2^-52 of their
sum, so that the order in which threads come does not matter: the result is the same at every call.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
import warp as wp
from torch import Tensor

from voronerf.custom_op import custom_op
from voronerf.kernels._launch import array, launch

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

_BITS = 52


@wp.func
def _squared_distance(
    points: wp.array2d(dtype=wp.float32),
    i: wp.int32,
    centres: wp.array2d(dtype=wp.float32),
    j: wp.int32,
) -> wp.float64:
    dx = wp.float64(points[i, 0]) - wp.float64(centres[j, 0])
    dy = wp.float64(points[i, 1]) - wp.float64(centres[j, 1])
    dz = wp.float64(points[i, 2]) - wp.float64(centres[j, 2])
    return dx * dx + dy * dy + dz * dz


@wp.kernel
def _weigh_kernel(
    samples: wp.array2d(dtype=wp.float32),
    units: wp.array(dtype=wp.int64),
    centres: wp.array2d(dtype=wp.float32),
    weights: wp.array(dtype=wp.int64),
) -> None:
    i = wp.tid()
    best = wp.float64(1.7976931348623157e308)
    cell = wp.int32(0)
    for j in range(centres.shape[0]):
        value = _squared_distance(samples, i, centres, j)
        if value < best:
            best = value
            cell = j
    wp.atomic_add(weights, cell, units[i])


@wp.kernel
def _move_kernel(
    centres: wp.array2d(dtype=wp.float32),
    weights: wp.array(dtype=wp.int64),
    alpha: wp.float64,
    neighbours: wp.int32,
    global_norm: wp.bool,
    moved: wp.array2d(dtype=wp.float32),
    cleared: wp.array(dtype=wp.int64),
) -> None:
    i = wp.tid()
    k = centres.shape[0]
    own = weights[i]
    heaviest = own
    if global_norm:
        for j in range(k):
            heaviest = wp.max(heaviest, weights[j])
    x = wp.float64(0.0)
    y = wp.float64(0.0)
    z = wp.float64(0.0)
    # The next neighbour is the closest centre behind the last, ties in the order of the centres.
    distance = wp.float64(-1.0)
    last = wp.int32(-1)
    for _ in range(neighbours):
        best = wp.float64(1.7976931348623157e308)
        nearest = wp.int32(-1)
        for j in range(k):
            value = _squared_distance(centres, i, centres, j)
            behind = value > distance or (value == distance and j > last)
            if j != i and behind and value < best:
                best = value
                nearest = j
        if nearest >= 0:
            distance = best
            last = nearest
            if not global_norm:
                heaviest = wp.max(heaviest, weights[nearest])
            difference = wp.float64(weights[nearest] - own)
            x += (wp.float64(centres[nearest, 0]) - wp.float64(centres[i, 0])) * difference
            y += (wp.float64(centres[nearest, 1]) - wp.float64(centres[i, 1])) * difference
            z += (wp.float64(centres[nearest, 2]) - wp.float64(centres[i, 2])) * difference
    scale = wp.float64(0.0)
    # A neighbourhood without any weight has only zero differences.
    if heaviest > wp.int64(0):
        scale = alpha / (wp.float64(heaviest) * wp.float64(neighbours))
    moved[i, 0] = wp.float32(wp.float64(centres[i, 0]) + scale * x)
    moved[i, 1] = wp.float32(wp.float64(centres[i, 1]) + scale * y)
    moved[i, 2] = wp.float32(wp.float64(centres[i, 2]) + scale * z)
    cleared[i] = wp.int64(0)


@custom_op("balance_centres_warp")
def balance_centres(
    samples: Tensor, masses: Tensor, centres: Tensor, steps: int, alpha: float, neighbours: int, global_norm: bool
) -> Iterator[tuple[Tensor, Tensor]]:
    """The published update, repeated; see ``voronerf.ops.balance_centres``."""
    m, k = samples.shape[0], centres.shape[0]
    moved, weights = centres.new_empty(centres.shape), masses.new_empty(k)
    yield moved, weights
    # A power of two, in which masses that are short numbers are whole.
    unit = torch.ldexp(masses.new_ones(()), torch.frexp(masses.sum()).exponent - _BITS)
    units = (masses / unit).round().to(torch.int64)
    now, then = centres.clone(memory_format=torch.contiguous_format), torch.empty_like(centres)
    found, cleared = units.new_zeros(2, k)
    given = [array(samples, samples), array(units, samples)]
    places = [array(now, samples), array(then, samples)]
    sums = [array(found, samples), array(cleared, samples)]
    steps = steps if k > 1 else 0
    for step in range(steps):
        here, there = step % 2, 1 - step % 2
        launch(_weigh_kernel, m, [*given, places[here], sums[here]], samples)
        rest = [alpha, min(neighbours, k - 1), global_norm, places[there], sums[there]]
        launch(_move_kernel, k, [places[here], sums[here], *rest], samples)
    last = steps % 2
    launch(_weigh_kernel, m, [*given, places[last], sums[last]], samples)
    moved.copy_((now, then)[last])
    weights.copy_((found, cleared)[last] * unit)
