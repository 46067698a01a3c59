"""Ray marching as Warp kernels. r rays, s strata per ray, m samples of all rays (packed).

One thread walks along one ray, twice: first to count its samples and then, with the offsets, to write them. So no mask
of strata needs to be stored. Operations and their order equal the reference's, each rounded separately (``fuse_fp``
off), so that a sample falls in the same voxel.
"""

from __future__ import annotations

from typing import Any

import torch
import warp as wp

from voronerf.kernels._launch import array, filled, launch
from voronerf.ops._core.checks import MAX_COUNT
from voronerf.ops._core.declare import declared
from voronerf.ops.formulas import SPACINGS
from voronerf.ops.march_rays.reference import March, fake, memory

wp.set_module_options({"enable_backward": False, "fuse_fp": False})
_OP = declared("march_rays")
_FIRST, _SECOND, _GOLDEN = (wp.constant(wp.uint32(number)) for number in (0x7FEB352D, 0x846CA68B, 0x9E3779B9))


@wp.func
def _depth(near: wp.float32, far: wp.float32, fraction: wp.float32, spacing: wp.int32) -> wp.float32:
    depth = near + (far - near) * fraction
    if spacing == 1:  # disparity
        inverse = far * (1.0 - fraction) + near * fraction
        depth = near * far / wp.max(inverse, 1.17549435e-38)
    return depth


@wp.func
def _edge(near: wp.float32, far: wp.float32, stratum: wp.int32, samples: wp.int32, spacing: wp.int32) -> wp.float32:
    edge = far
    if stratum < samples:
        edge = _depth(near, far, wp.float32(stratum) / wp.float32(samples), spacing)
    return edge


@wp.func
def _point(origin: wp.vec3, direction: wp.vec3, at: wp.float32, space: wp.array2d(dtype=wp.float32)) -> wp.vec3:
    # Returns a point in the grid's space. `space` has one row (centre and radius of the sphere of a `Contraction`),
    # five rows (normalised device coordinates, as in `Perspective.numbers`) or none (world space).
    x = origin[0] + at * direction[0]
    y = origin[1] + at * direction[1]
    z = origin[2] + at * direction[2]
    if space.shape[0] == 1:
        radius = space[0, 3]
        scale = 1.0 / radius
        x = (x - space[0, 0]) * scale
        y = (y - space[0, 1]) * scale
        z = (z - space[0, 2]) * scale
        length = wp.sqrt(x * x + y * y + z * z)
        if length < 1.0:
            length = wp.float32(1.0)
        inverse = 1.0 / length
        factor = (2.0 - inverse) * inverse
        x = space[0, 0] + radius * x * factor
        y = space[0, 1] + radius * y * factor
        z = space[0, 2] + radius * z * factor
    if space.shape[0] == 5:
        x -= space[0, 0]
        y -= space[0, 1]
        z -= space[0, 2]
        right = x * space[1, 0] + y * space[1, 1] + z * space[1, 2]
        up = x * space[2, 0] + y * space[2, 1] + z * space[2, 2]
        depth = x * space[3, 0] + y * space[3, 1] + z * space[3, 2]
        if depth < space[4, 0] / 2.0:
            depth = space[4, 0] / 2.0
        x = right / (depth * space[4, 1])
        y = up / (depth * space[4, 2])
        z = 1.0 - 2.0 * space[4, 0] / depth
    return wp.vec3(x, y, z)


@wp.func
def _mixed(bits: wp.uint32) -> wp.uint32:
    x = (bits ^ (bits >> wp.uint32(16))) * _FIRST
    x = (x ^ (x >> wp.uint32(15))) * _SECOND
    return x ^ (x >> wp.uint32(16))


@wp.func
def _hashed(key: wp.uint32, stratum: wp.int32) -> wp.float32:
    # Returns a number in [0, 1) for each stratum of a ray.
    h = _mixed(key ^ (wp.uint32(stratum) * _GOLDEN))
    return wp.float32(h >> wp.uint32(8)) / 16777216.0


@wp.func
def _cell(point: wp.float32, low: wp.float32, high: wp.float32, size: wp.int32) -> wp.int32:
    scale = wp.float32(size) / (high - low)
    place = (point - low) * scale
    cell = wp.int32(-1)
    if place >= 0.0 and place <= wp.float32(size):
        cell = wp.min(wp.int32(place), size - 1)
    return cell


@wp.struct
class Inputs:
    """The rays and the grid.

    ``space`` is empty, [0, 0], for world space. It has shape [1, 4] for the sphere of a ``voronerf.nerf.Contraction``,
    and [5, 3] for the normalised device coordinates of a ``Perspective``.
    """

    origins: wp.array2d(dtype=wp.float32)
    directions: wp.array2d(dtype=wp.float32)
    near: wp.array(dtype=wp.float32)
    far: wp.array(dtype=wp.float32)
    occupied: wp.array3d(dtype=wp.uint8)
    box: wp.array2d(dtype=wp.float32)
    uniforms: wp.array2d(dtype=wp.float32)
    jittered: wp.bool
    seed: wp.array(dtype=wp.int32)
    hashed: wp.bool
    start: wp.array(dtype=wp.int32)
    started: wp.bool
    space: wp.array2d(dtype=wp.float32)
    samples: wp.int32
    spacing: wp.int32
    max_samples: wp.int32


@wp.struct
class Samples:
    """The outputs. The first walk writes ``counts``, each ray's number of samples; the second writes the samples."""

    counts: wp.array(dtype=wp.int32)
    ray_index: wp.array(dtype=wp.int32)
    depths: wp.array(dtype=wp.float32)
    deltas: wp.array(dtype=wp.float32)
    positions: wp.array2d(dtype=wp.float32)
    stop: wp.array(dtype=wp.int32)


@wp.kernel
def _march_kernel(inputs: Inputs, counting: wp.bool, offsets: wp.array(dtype=wp.int32), out: Samples) -> None:
    ray = wp.tid()
    origin = wp.vec3(inputs.origins[ray, 0], inputs.origins[ray, 1], inputs.origins[ray, 2])
    direction = wp.vec3(inputs.directions[ray, 0], inputs.directions[ray, 1], inputs.directions[ray, 2])
    begin = inputs.near[ray]
    end = inputs.far[ray]
    stratum = wp.int32(0)
    if inputs.started:
        stratum = wp.max(inputs.start[ray], 0)
    row = wp.int32(0)
    room = wp.int32(0)
    if not counting:
        row = offsets[ray]
        room = offsets[ray + 1] - row
    key = wp.uint32(0)
    if inputs.hashed:
        key = _mixed(wp.uint32(inputs.seed[0]) * _GOLDEN + wp.uint32(ray))
    samples = wp.int32(0)
    going = end > begin and stratum < inputs.samples
    while going:
        first = _edge(begin, end, stratum, inputs.samples, inputs.spacing)
        last = _edge(begin, end, stratum + 1, inputs.samples, inputs.spacing)
        inside = wp.float32(0.5)
        if inputs.jittered:
            inside = inputs.uniforms[ray, stratum]
        if inputs.hashed:
            inside = _hashed(key, stratum)
        at = _depth(begin, end, (wp.float32(stratum) + inside) / wp.float32(inputs.samples), inputs.spacing)
        # min and max would turn NaN into a number.
        if at < first:
            at = first
        if at > last:
            at = last
        point = _point(origin, direction, at, inputs.space)
        x = _cell(point[0], inputs.box[0, 0], inputs.box[1, 0], inputs.occupied.shape[0])
        y = _cell(point[1], inputs.box[0, 1], inputs.box[1, 1], inputs.occupied.shape[1])
        z = _cell(point[2], inputs.box[0, 2], inputs.box[1, 2], inputs.occupied.shape[2])
        taken = wp.bool(False)
        if x >= 0 and y >= 0 and z >= 0:
            taken = inputs.occupied[x, y, z] != wp.uint8(0)
        if taken and not counting:
            if samples == room:
                # The ray is truncated; the next call starts here.
                going = wp.bool(False)
            else:
                out.ray_index[row + samples] = ray
                out.depths[row + samples] = at
                out.deltas[row + samples] = last - first
                for axis in range(3):
                    out.positions[row + samples, axis] = point[axis]
        if going:
            stratum += 1
            if taken:
                samples += 1
            going = stratum < inputs.samples and samples < inputs.max_samples
    if counting:
        out.counts[ray] = samples
    elif end > begin:
        out.stop[ray] = wp.min(stratum, inputs.samples)
    else:
        out.stop[ray] = inputs.samples


@_OP.custom_op("march_rays_warp", fake=fake)
def march_rays(arguments: Any) -> March:
    """Returns samples in occupied voxels; see ``voronerf.ops.march_rays``."""
    near, r, capacity, inputs = arguments.near, arguments.r, arguments.capacity, _inputs(arguments)
    counts = near.new_zeros(r + 1, dtype=torch.int32)
    out = filled(Samples(), counts=counts[1:], positions=arguments.origins[:0])
    filled(out, ray_index=counts[:0], depths=near[:0], deltas=near[:0], stop=counts[:0])
    launch(_march_kernel, r, [inputs, True, array(counts[:0], near), out], near)
    # The number of samples may exceed int32, so it is summed in int64 and clamped before the cast.
    offsets = counts.cumsum(dim=0).clamp(max=MAX_COUNT if capacity is None else capacity).int()
    samples = memory(near, offsets, int(offsets[-1]) if capacity is None else capacity)
    for part in samples[1:5]:  # zeros in rows that belong to no ray
        part.zero_()
    launch(_march_kernel, r, [inputs, False, array(offsets, near), _samples(samples)], near)
    return samples


def _samples(march: March) -> Any:
    out = filled(Samples(), counts=march.ray_offsets[:0], ray_index=march.ray_index, depths=march.depths)
    return filled(out, deltas=march.deltas, positions=march.positions, stop=march.stop)


def _inputs(rays: Any) -> Any:
    near, contraction = rays.near, rays.contraction
    none = near.new_empty(0, dtype=torch.int32)
    inputs = filled(
        Inputs(),
        uniforms=near.new_empty(0, 0) if rays.uniforms is None else rays.uniforms,
        jittered=rays.uniforms is not None,
        seed=none if rays.seed is None else rays.seed,
        hashed=rays.seed is not None,
        start=none if rays.start is None else rays.start,
        started=rays.start is not None,
        space=near.new_empty(0, 0) if contraction is None else contraction.view(-1, contraction.shape[-1]),
    )
    rest = ("origins", "directions", "near", "far", "occupied", "box", "samples")
    max_samples = rays.samples if rays.max_samples is None else rays.max_samples
    filled(inputs, spacing=SPACINGS.index(rays.spacing), max_samples=max_samples)
    return filled(inputs, **{name: getattr(rays, name) for name in rest})
