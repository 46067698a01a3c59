"""``observe_occupancy`` as Warp kernels, in place. x, y, z voxels along each axis, m samples."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp

from voronerf.kernels._launch import array, launch
from voronerf.ops._core.declare import declared

wp.set_module_options({"enable_backward": False})

_INFINITY = wp.constant(float("inf"))


@wp.func
def _place(x: wp.float32, low: wp.float32, high: wp.float32, size: wp.int32) -> wp.int32:
    place = (x - low) / (high - low) * wp.float32(size)
    inside = wp.float32(0.0)
    if place > 0.0:  # false for NaN
        inside = wp.min(place, wp.float32(size - 1))
    return wp.int32(inside)


@wp.func
def _stretch(x: wp.float32, y: wp.float32, z: wp.float32, space: wp.array2d(dtype=wp.float32)) -> wp.float32:
    # Returns the world length of a unit of grid space. `space` has one row (centre and radius of the sphere of a
    # `Contraction`), five rows (normalised device coordinates, as in `Perspective.numbers`) or none (world space).
    if space.shape[0] == 1:
        offset = wp.vec3(x - space[0, 0], y - space[0, 1], z - space[0, 2])
        left = wp.float32(2.0) - wp.length(offset) / space[0, 3]
        inside = wp.float32(1.0e-3)
        if left > 1.0e-3:  # false for NaN
            inside = wp.min(left, wp.float32(1.0))
        return wp.float32(1.0) / (inside * inside)
    if space.shape[0] == 5:
        ahead = wp.float32(1.0e-3)
        if 1.0 - z > 1.0e-3:
            ahead = wp.float32(1.0) - z
        return wp.float32(2.0) * space[4, 0] / (ahead * ahead)
    return wp.float32(1.0)


@wp.kernel
def _find_kernel(
    positions: wp.array2d(dtype=wp.float32),
    deltas: wp.array(dtype=wp.float32),
    fixed: wp.array3d(dtype=wp.uint8),
    box: wp.array2d(dtype=wp.float32),
    density: wp.array3d(dtype=wp.float32),
    cells: wp.array(dtype=wp.int32),
    before: wp.array(dtype=wp.float32),
) -> None:
    i = wp.tid()
    x = _place(positions[i, 0], box[0, 0], box[1, 0], density.shape[0])
    y = _place(positions[i, 1], box[0, 1], box[1, 1], density.shape[1])
    z = _place(positions[i, 2], box[0, 2], box[1, 2], density.shape[2])
    cells[i] = -1
    observes = wp.bool(True)
    if deltas.shape[0] > 0:
        observes = deltas[i] != 0.0
    if fixed.shape[0] > 0:
        observes = observes and fixed[x, y, z] == wp.uint8(0)
    if observes:
        cells[i] = (x * density.shape[1] + y) * density.shape[2] + z
        before[i] = density[x, y, z]


@wp.kernel
def _fade_kernel(
    cells: wp.array(dtype=wp.int32),
    before: wp.array(dtype=wp.float32),
    decay: wp.float32,
    density: wp.array(dtype=wp.float32),
) -> None:
    i = wp.tid()
    if cells[i] < 0:
        return
    # `before` is the old density, so all samples of a voxel write the same value.
    density[cells[i]] = before[i] * decay


@wp.kernel
def _raise_kernel(
    cells: wp.array(dtype=wp.int32),
    sigma: wp.array(dtype=wp.float32),
    deltas: wp.array(dtype=wp.float32),
    weights: wp.array(dtype=wp.float32),
    positions: wp.array2d(dtype=wp.float32),
    space: wp.array2d(dtype=wp.float32),
    hidden: wp.float32,
    density: wp.array(dtype=wp.float32),
) -> None:
    i = wp.tid()
    if cells[i] < 0:
        return
    observed = sigma[i]
    if wp.isnan(observed):
        observed = _INFINITY
    seen = wp.bool(True)
    if weights.shape[0] > 0:
        thickness = observed * deltas[i]
        # 1 - exp(-t), by its series for small t to avoid cancellation.
        absorbed = 1.0 - wp.exp(-thickness)
        if thickness < 0.01:
            absorbed = thickness * (1.0 - 0.5 * thickness * (1.0 - thickness / 3.0))
        seen = weights[i] > hidden * absorbed
    if seen:
        observed *= _stretch(positions[i, 0], positions[i, 1], positions[i, 2], space)
        wp.atomic_max(density, cells[i], observed)


@wp.kernel
def _compare_kernel(
    cells: wp.array(dtype=wp.int32),
    density: wp.array(dtype=wp.float32),
    threshold: wp.float32,
    occupied: wp.array(dtype=wp.uint8),
) -> None:
    i = wp.tid()
    if cells[i] < 0:
        return
    occupied[cells[i]] = wp.where(density[cells[i]] >= threshold, wp.uint8(1), wp.uint8(0))


@declared("observe_occupancy").custom_op("observe_occupancy_warp")
def observe_occupancy(arguments: Any, _: None) -> None:
    """Updates the voxels of the samples: decays and raises densities; see ``voronerf.ops.observe_occupancy``."""
    density, m = arguments.density, arguments.positions.shape[0]
    cells, before = density.new_empty(m, dtype=torch.int32), density.new_empty(m)
    flat, rows, faded = (array(tensor, density) for tensor in (density.view(-1), cells, before))
    samples = [array(tensor, density) for tensor in (arguments.sigma, arguments.deltas, arguments.weights)]
    fixed = density.new_empty(0, 0, 0, dtype=torch.uint8) if arguments.fixed is None else arguments.fixed
    grid = [array(fixed, density), array(arguments.box, density), array(density, density)]
    positions, contraction = array(arguments.positions, density), arguments.contraction
    space = density.new_empty(0, 0) if contraction is None else contraction.view(-1, contraction.shape[-1])
    seen = [*samples, positions, array(space, density)]
    launch(_find_kernel, m, [positions, samples[1], *grid, rows, faded], density)
    launch(_fade_kernel, m, [rows, faded, arguments.decay, flat], density)
    launch(_raise_kernel, m, [rows, *seen, arguments.hidden, flat], density)
    launch(_compare_kernel, m, [rows, flat, arguments.threshold, array(arguments.occupied.view(-1), density)], density)
