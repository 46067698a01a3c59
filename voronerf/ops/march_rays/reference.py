"""Ray marching through an occupancy grid. r rays, s strata of a ray, m samples of all rays (packed).

All backends do the same operations in the same order and round each one, so a sample falls in the same voxel on all
of them.
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core.rows import new_empty, rows_of
from voronerf.ops.formulas import depth_of


class March(NamedTuple):
    """The samples of rays in occupied voxels, packed.

    Attributes:
        ray_offsets: int32 [r + 1]: ray i owns samples ``ray_offsets[i]`` to ``ray_offsets[i + 1]``.
        ray_index: int32 [m], the ray of each sample.
        depths: [m], the distance of each sample along its ray, ascending.
        deltas: [m], the length of the stratum of each sample.
        positions: [m, 3], the positions of the samples in the space of the grid.
        stop: int32 [r], the stratum from which the next call continues each ray; s for a finished ray.

    Examples:
        >>> import torch
        >>> from voronerf import march_rays
        >>> ray = torch.tensor([[-1.0, 0.5, 0.5]]), torch.tensor([[1.0, 0.0, 0.0]])
        >>> ends = torch.zeros(1), torch.tensor([4.0])
        >>> box = torch.tensor([[0.0, 0, 0], [2.0, 1, 1]])
        >>> march = march_rays(*ray, *ends, torch.ones(2, 1, 1, dtype=torch.bool), box, 8)
        >>> march.positions[:, 0], march.ray_index
        (tensor([0.2500, 0.7500, 1.2500, 1.7500]), tensor([0, 0, 0, 0], dtype=torch.int32))
    """

    ray_offsets: Annotated[Tensor, "int32 [r + 1]"]
    ray_index: Annotated[Tensor, "int32 [m]"]
    depths: Annotated[Tensor, "same [m]"]
    deltas: Annotated[Tensor, "same [m]"]
    positions: Annotated[Tensor, "same [m, 3]"]
    stop: Annotated[Tensor, "int32 [r]"]


def memory(near: Tensor, offsets: Tensor, rows: Any) -> March:
    """Allocates a result of ``rows`` samples, with ``offsets`` as its ray offsets."""
    index, stop = (new_empty(near, count, dtype=torch.int32) for count in (rows, rows_of(near)))
    return March(offsets, index, new_empty(near, rows), new_empty(near, rows), new_empty(near, rows, 3), stop)


def fake(arguments: Any) -> March:
    """Allocates fake results; without a capacity the number of samples is a dynamic size."""
    rows = torch.library.get_ctx().new_dynamic_size() if arguments.capacity is None else arguments.capacity
    offsets = arguments.near.new_empty(arguments.near.shape[0] + 1, dtype=torch.int32)
    return memory(arguments.near, offsets, rows)


@torch.no_grad()
def march_rays(*arguments: Any) -> March:
    """Samples each stratum and keeps the samples in occupied voxels; see ``voronerf.ops.march_rays``."""
    origins, directions, near, far, occupied, box, samples, *options = arguments
    uniforms, seed, spacing, start, max_samples, capacity, contraction = options
    max_samples = samples if max_samples is None else max_samples
    r, device = len(near), near.device
    stratum = torch.arange(samples + 1, device=device)
    # The divisor is a tensor: if it were a Python number, PyTorch might multiply by its reciprocal, which rounds
    # differently.
    count = near.new_full((), samples)
    edges = depth_of(near[:, None], far[:, None], stratum.to(near.dtype) / count, spacing)
    edges = torch.where(stratum < samples, edges, far[:, None])
    if seed is not None:
        uniforms = hashed_uniforms(seed, r, samples).to(near.dtype)
    inside = near.new_full((), 0.5) if uniforms is None else uniforms
    distances = depth_of(near[:, None], far[:, None], (stratum[:-1].to(near.dtype) + inside) / count, spacing)
    distances = torch.minimum(torch.maximum(distances, edges[:, :-1]), edges[:, 1:])

    mask = far[:, None] > near[:, None]
    cell = torch.zeros_like(distances, dtype=torch.int64)
    points = [origins[:, axis, None] + distances * directions[:, axis, None] for axis in range(3)]
    for axis, (size, place) in enumerate(zip(occupied.shape, contracted(points, contraction))):
        scale = box.new_full((), size) / (box[1, axis] - box[0, axis])
        place = (place - box[0, axis]) * scale
        mask = mask & (place >= 0) & (place <= size)
        # NaN guard: samples at NaN are masked, but their index must be valid, and NaN may convert to any integer.
        cell = cell * size + place.nan_to_num(0).clamp(0, size).long().clamp(max=size - 1)
    mask = mask & (occupied.reshape(-1)[cell] != 0)
    if start is not None:
        mask = mask & (stratum[:-1] >= start[:, None])
    rank = mask.cumsum(dim=1)
    # A ray wants at most `max_samples` samples, and gets fewer if the capacity is exhausted.
    wanted = rank[:, -1].clamp(max=max_samples)
    offsets = torch.nn.functional.pad(wanted.cumsum(dim=0), (1, 0))
    if capacity is not None:
        offsets = offsets.clamp(max=capacity)
    counts = offsets.diff()
    rows = int(offsets[-1]) if capacity is None else capacity
    written = mask & (rank <= counts[:, None])
    # Strata without a sample are scattered to one additional row.
    row = torch.where(written, offsets[:-1, None] + rank - 1, rows).reshape(-1)
    ray = torch.arange(r, dtype=torch.int32, device=device)[:, None].expand(r, samples)
    ray_index, depths, deltas = (
        torch.zeros(rows + 1, dtype=values.dtype, device=device).scatter(0, row, values.reshape(-1))[:rows]
        for values in (ray, distances, edges.diff(dim=1))
    )
    positions = depths.new_zeros(rows, 3)
    if r > 0:
        used = torch.arange(rows, device=device) < offsets[-1]
        points = [origins[ray_index, axis] + depths * directions[ray_index, axis] for axis in range(3)]
        positions = torch.where(used[:, None], torch.stack(contracted(points, contraction), dim=-1), 0)
    last = torch.where(written, stratum[:-1], -1).amax(dim=1)
    waiting = torch.where(mask & ~written, stratum[:-1], samples).amin(dim=1)
    # A ray with `max_samples` samples continues after its last sample, a cut ray at the first sample that did not fit.
    full = (counts == wanted) & (wanted == max_samples)
    stop = torch.where(counts < wanted, waiting, torch.where(full, last + 1, samples))
    return March(offsets.to(torch.int32), ray_index, depths, deltas, positions, stop.to(torch.int32))


def hashed_uniforms(seed: Tensor, r: int, samples: int) -> Tensor:
    """Returns hashes of ray, stratum and seed (int32 [1]): [r, samples] in [0, 1), exact in float32."""
    ray, stratum = (torch.arange(count, device=seed.device) for count in (r, samples))
    key = _mixed(ray + seed.long() * 0x9E3779B9)
    return (_mixed(key[:, None] ^ stratum * 0x9E3779B9) >> 8) / 2**24


def _mixed(x: Tensor) -> Tensor:
    """Hashes the low 32 bits of int64 (lowbias32 by Chris Wellons)."""
    x = x & 0xFFFFFFFF
    x = ((x ^ (x >> 16)) * 0x7FEB352D) & 0xFFFFFFFF
    x = ((x ^ (x >> 15)) * 0x846CA68B) & 0xFFFFFFFF
    return x ^ (x >> 16)


def contracted(points: list[Tensor], contraction: Tensor | None) -> list[Tensor]:
    """Returns the three coordinates of points, mapped like ``voronerf.nerf.Contraction`` or ``Perspective``."""
    if contraction is None:
        return points
    if contraction.dim() == 1:
        centre, radius = contraction[:3], contraction[3]
        scale = radius.reciprocal()
        x, y, z = ((points[axis] - centre[axis]) * scale for axis in range(3))
        # The float64 root, cast to float32, is correctly rounded; torch's float32 root is not.
        length = (x * x + y * y + z * z).double().sqrt().to(x.dtype).clamp_min(1)
        inverse = length.reciprocal()
        factor = (2 - inverse) * inverse
        return [centre[axis] + radius * offset * factor for axis, offset in enumerate((x, y, z))]
    centre, (near, across, down) = contraction[0], contraction[4].unbind()
    x, y, z = (points[axis] - centre[axis] for axis in range(3))
    right, up, ahead = (x * axis[0] + y * axis[1] + z * axis[2] for axis in contraction[1:4])
    depth = torch.maximum(ahead, near / 2)
    return [right / (depth * across), up / (depth * down), 1 - 2 * near / depth]
