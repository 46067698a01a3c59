"""Inverse of the cumulative distribution as a Warp kernel. r rays, s bins of a ray.

A thread takes a ray and walks sorted targets and bins side by side, as csrc/rays/resample.cpp does; the running mass is
float64. Targets are sorted by torch.
"""

from __future__ import annotations

from typing import Any

import warp as wp
from torch import Tensor

from voronerf.kernels._launch import array, launch
from voronerf.ops._core.custom_op import in_float32
from voronerf.ops._core.declare import declared

wp.set_module_options({"enable_backward": False})


@wp.func
def _mass(weight: wp.float32) -> wp.float64:
    mass = wp.float64(0.0)
    if wp.isfinite(weight) and weight > 0.0:
        mass = wp.float64(weight)
    return mass


@wp.kernel
def _resample_kernel(
    weights: wp.array2d(dtype=wp.float32),
    edges: wp.array2d(dtype=wp.float32),
    uniforms: wp.array2d(dtype=wp.float32),
    given: wp.bool,
    depths: wp.array2d(dtype=wp.float32),
) -> None:
    ray = wp.tid()
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    bins = weights.shape[1]
    count = depths.shape[1]
    total = wp.float64(0.0)
    last = bins - 1
    for i in range(bins):
        mass = _mass(weights[ray, i])
        total += mass
        if mass > zero:
            last = i
    even = total == zero
    if even:
        total = wp.float64(bins)
        last = bins - 1
    bin = wp.int32(0)
    lower = wp.float64(0.0)
    here = wp.where(even, one, _mass(weights[ray, 0]))
    for j in range(count):
        u = (wp.float64(j) + wp.float64(0.5)) / wp.float64(count)
        if given:
            # Comparisons rather than min and max, here and below: NaN stays NaN.
            u = wp.float64(uniforms[ray, j])
            if u < zero:
                u = zero
            if u > one:
                u = one
        target = u * total
        # A target on the edge of two bins belongs to the later one, so a bin of no mass is never drawn; the last bin
        # that has mass takes what rounds to the very end.
        while bin < last and target >= lower + here:
            lower += here
            bin += 1
            here = wp.where(even, one, _mass(weights[ray, bin]))
        inside = (target - lower) / here
        if inside < zero:
            inside = zero
        if inside > one:
            inside = one
        near = wp.float64(edges[ray, bin])
        far = wp.float64(edges[ray, bin + 1])
        depth = near + inside * (far - near)
        if depth > far:
            depth = far
        depths[ray, j] = wp.float32(depth)


@declared("resample").custom_op("resample_warp")
def _resample(given: Any, depths: Tensor) -> None:
    targets = depths[:0] if given.uniforms is None else given.uniforms.sort(dim=1).values
    inputs = [array(tensor, depths) for tensor in (given.weights, given.edges, targets)]
    launch(_resample_kernel, given.r, [*inputs, given.uniforms is not None, array(depths, depths)], depths)


resample = in_float32(_resample)
