"""First hits of rays on solids as a Warp kernel. r rays, s solids.

A thread takes a ray and finds the solids that it may meet in a tree of their boxes (wp.Bvh); distances are by the
reference's formulas. Building the tree of some hundred solids costs less than a thousand rays.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
import warp as wp
from torch import Tensor

from voronerf.custom_op import custom_op
from voronerf.kernels._launch import array, launch, on_stream
from voronerf.ops.cast_solids.reference import BOX, CYLINDER, SPHERE, SURFACE, TINY, TRACE_STEPS, bounds

wp.set_module_options({"enable_backward": False})

_SPHERE, _BOX, _CYLINDER = wp.constant(SPHERE), wp.constant(BOX), wp.constant(CYLINDER)
_STEPS, _SURFACE, _TINY = wp.constant(TRACE_STEPS), wp.constant(SURFACE), wp.constant(TINY)
_INF = wp.constant(float("inf"))
MARGIN = 1e-4  # by which boxes are larger than their solids, above any rounding of where a ray meets them


@wp.func
def _slab(o: Any, d: Any, half: Any) -> Any:
    """Where a ray enters and leaves a box around the origin."""
    enter = -_INF
    leave = _INF
    for axis in range(3):
        along = d[axis]
        if wp.abs(along) < _TINY:
            along = _TINY
        low = (-half[axis] - o[axis]) / along
        high = (half[axis] - o[axis]) / along
        enter = wp.max(enter, wp.min(low, high))
        leave = wp.min(leave, wp.max(low, high))
    return wp.vec2(enter, leave)


@wp.func
def _sphere(o: Any, d: Any, size: Any) -> Any:
    b = wp.dot(o, d)
    root = b * b - wp.dot(o, o) + size[0] * size[0]
    t = -b - wp.sqrt(wp.max(root, 0.0))
    if root >= 0.0 and t > 0.0:
        return t
    return _INF


@wp.func
def _box(o: Any, d: Any, size: Any) -> Any:
    ends = _slab(o, d, size)
    if ends[1] > ends[0] and ends[0] > 0.0:
        return ends[0]
    return _INF


@wp.func
def _cylinder(o: Any, d: Any, size: Any) -> Any:
    a = wp.max(d[0] * d[0] + d[1] * d[1], 1.0e-12)
    b = o[0] * d[0] + o[1] * d[1]
    c = o[0] * o[0] + o[1] * o[1] - size[0] * size[0]
    root = b * b - a * c
    spread = wp.sqrt(wp.max(root, 0.0))
    dz = d[2]
    if wp.abs(dz) < _TINY:
        dz = _TINY
    low = (-size[1] - o[2]) / dz
    high = (size[1] - o[2]) / dz
    enter = wp.max((-b - spread) / a, wp.min(low, high))
    leave = wp.min((-b + spread) / a, wp.max(low, high))
    if root >= 0.0 and enter <= leave and enter > 0.0:
        return enter
    return _INF


@wp.func
def _torus(o: Any, d: Any, size: Any) -> Any:
    ring = size[0]
    tube = size[1]
    ends = _slab(o, d, wp.vec3(ring + tube, ring + tube, tube))
    t = ends[0]
    if ends[1] <= t or t <= 0.0:
        return _INF
    for _ in range(_STEPS):
        p = o + t * d
        around = wp.sqrt(p[0] * p[0] + p[1] * p[1]) - ring
        gap = wp.sqrt(around * around + p[2] * p[2]) - tube
        if gap < _SURFACE:
            return t
        t = t + gap
        if t >= ends[1]:
            return _INF
    return _INF


@wp.kernel
def _cast_solids_kernel(
    tree: wp.uint64,
    kinds: wp.array(dtype=wp.int32),
    frames: wp.array3d(dtype=wp.float32),
    sizes: wp.array2d(dtype=wp.float32),
    origins: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.float32),
    depths: wp.array(dtype=wp.float32),
    solids: wp.array(dtype=wp.int32),
) -> None:
    i = wp.tid()
    origin = wp.vec3(origins[i, 0], origins[i, 1], origins[i, 2])
    direction = wp.vec3(directions[i, 0], directions[i, 1], directions[i, 2])
    best = wp.float32(_INF)
    which = wp.int32(-1)
    number = wp.int32(0)
    query = wp.bvh_query_ray(tree, origin, direction)
    while wp.bvh_query_next(query, number):
        o = wp.vec3(0.0, 0.0, 0.0)
        d = wp.vec3(0.0, 0.0, 0.0)
        for axis in range(3):
            for j in range(3):
                o[axis] = o[axis] + (origin[j] - frames[number, 3, j]) * frames[number, j, axis]
                d[axis] = d[axis] + direction[j] * frames[number, j, axis]
        size = wp.vec3(sizes[number, 0], sizes[number, 1], sizes[number, 2])
        found = wp.float32(_INF)
        if kinds[number] == _SPHERE:
            found = _sphere(o, d, size)
        elif kinds[number] == _BOX:
            found = _box(o, d, size)
        elif kinds[number] == _CYLINDER:
            found = _cylinder(o, d, size)
        else:
            found = _torus(o, d, size)
        # The tree gives the solids in any order: of equally near ones, the one with the lowest index counts.
        if found < best or (found == best and which >= 0 and number < which):
            best = found
            which = number
    depths[i] = best
    solids[i] = which


@custom_op("cast_solids_warp")
def cast_solids(
    kinds: Tensor, frames: Tensor, sizes: Tensor, origins: Tensor, directions: Tensor
) -> Iterator[tuple[Tensor, Tensor]]:
    """Depths and solids; see ``voronerf.ops.cast_solids``."""
    depths, solids = origins.new_empty(origins.shape[0]), origins.new_empty(origins.shape[0], dtype=torch.int32)
    yield depths, solids
    if kinds.shape[0] == 0:
        depths.fill_(float("inf"))
        solids.fill_(-1)
        return
    low, high = (corner.contiguous() for corner in bounds(kinds, frames, sizes))
    low, high = low - MARGIN, high + MARGIN
    with on_stream(origins):
        corners = (wp.from_torch(corner, dtype=wp.vec3) for corner in (low, high))
        tree = wp.Bvh(*corners)
        tables = [array(tensor, origins) for tensor in (kinds, frames, sizes, origins, directions, depths, solids)]
        launch(_cast_solids_kernel, origins.shape[0], [tree.id, *tables], origins)
