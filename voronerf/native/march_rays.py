"""Ray marching of the compiled module as PyTorch ops: ``march_rays``, ``update_occupancy``.

r rays, s strata of a ray, m samples of all rays (packed). Marching is two custom ops, since the number of samples is
known between them: the first leaves a bit for every stratum that is kept and the offsets of the rays, the second the
samples. Shapes and dtypes have been validated by ``voronerf.ops``.
"""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf import native as _native
from voronerf.checks import MAX_COUNT
from voronerf.reference.march_rays import March


def march_rays(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    occupied: Tensor,
    box: Tensor,
    samples: int,
    *,
    uniforms: Tensor | None = None,
    disparity: bool = False,
    start: Tensor | None = None,
    most: int | None = None,
    capacity: int | None = None,
) -> March:
    """One sample for each stratum that falls in an occupied cell; see ``voronerf.ops.march_rays``."""
    most = samples if most is None else most
    rest = (samples, disparity, most)
    tensors = (origins, directions, near, far, occupied, box, uniforms, start)
    mask, offsets = _count(*tensors, *rest, MAX_COUNT if capacity is None else capacity)
    rows = int(offsets[-1]) if capacity is None else capacity
    return March(offsets, *_fill(*tensors, mask, offsets, *rest, rows))


def update_occupancy(
    density: Tensor, cells: Tensor, values: Tensor, *, decay: float, threshold: float
) -> tuple[Tensor, Tensor]:
    """The larger of what was found and what is remembered; see ``voronerf.ops.update_occupancy``."""
    remembered, occupied = _update(density, cells, values, decay, threshold)
    return remembered, occupied


@torch.library.custom_op("voronerf::march_rays_native_count", mutates_args=(), device_types="cpu")
def _count(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    occupied: Tensor,
    box: Tensor,
    uniforms: Tensor | None,
    start: Tensor | None,
    samples: int,
    disparity: bool,
    most: int,
    capacity: int,
) -> tuple[Tensor, Tensor]:
    kept = _contiguous(origins, directions, near, far, occupied, box, uniforms, start)
    mask, offsets = _allocate_count(near, samples)
    sizes = [near.shape[0], samples, *occupied.shape, int(disparity), most]
    _native._C.march_rays_count(
        _addresses(kept), sizes, mask.data_ptr(), offsets.data_ptr(), capacity, _native._ISA, torch.get_num_threads()
    )
    return mask, offsets


@torch.library.custom_op("voronerf::march_rays_native_fill", mutates_args=(), device_types="cpu")
def _fill(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    occupied: Tensor,
    box: Tensor,
    uniforms: Tensor | None,
    start: Tensor | None,
    mask: Tensor,
    offsets: Tensor,
    samples: int,
    disparity: bool,
    most: int,
    rows: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    kept = _contiguous(origins, directions, near, far, occupied, box, uniforms, start)
    results = _allocate_fill(near, rows)
    sizes = [near.shape[0], samples, *occupied.shape, int(disparity), most]
    tables = mask.data_ptr(), offsets.data_ptr()
    addresses = (result.data_ptr() for result in results)
    _native._C.march_rays_fill(
        _addresses(kept), sizes, *tables, rows, *addresses, _native._ISA, torch.get_num_threads()
    )
    return results


@torch.library.custom_op("voronerf::update_occupancy_native", mutates_args=(), device_types="cpu")
def _update(density: Tensor, cells: Tensor, values: Tensor, decay: float, threshold: float) -> tuple[Tensor, Tensor]:
    kept = [tensor.contiguous() for tensor in (density, cells, values)]
    results = _allocate_update(density)
    addresses = (tensor.data_ptr() for tensor in (*kept, *results))
    counts = density.numel(), cells.shape[0]
    if not _native._C.update_occupancy(*addresses, *counts, decay, threshold, torch.get_num_threads()):
        low, high = (int(bound) for bound in cells.aminmax())
        raise ValueError(
            f"update_occupancy: cells must lie in 0 to {density.numel() - 1}, got values from {low} to {high}"
        )
    return results


def _contiguous(*tensors: Tensor | None) -> list[Tensor | None]:
    return [None if tensor is None else tensor.contiguous() for tensor in tensors]


def _addresses(tensors: list[Tensor | None]) -> list[int]:
    return [0 if tensor is None else tensor.data_ptr() for tensor in tensors]


def _allocate_count(near: Tensor, samples: int) -> tuple[Tensor, Tensor]:
    mask = near.new_empty(near.shape[0], -(-samples // 32), dtype=torch.int32)
    return mask, near.new_empty(near.shape[0] + 1, dtype=torch.int32)


def _allocate_fill(near: Tensor, rows: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """ray_index, depths, deltas, positions, stop."""
    index, stop = (near.new_empty(count, dtype=torch.int32) for count in (rows, near.shape[0]))
    return index, near.new_empty(rows), near.new_empty(rows), near.new_empty(rows, 3), stop


def _allocate_update(density: Tensor) -> tuple[Tensor, Tensor]:
    return density.new_empty(density.shape), density.new_empty(density.shape, dtype=torch.bool)


@_count.register_fake
def _(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    occupied: Tensor,
    box: Tensor,
    uniforms: Tensor | None,
    start: Tensor | None,
    samples: int,
    disparity: bool,
    most: int,
    capacity: int,
) -> tuple[Tensor, Tensor]:
    return _allocate_count(near, samples)


@_fill.register_fake
def _(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    occupied: Tensor,
    box: Tensor,
    uniforms: Tensor | None,
    start: Tensor | None,
    mask: Tensor,
    offsets: Tensor,
    samples: int,
    disparity: bool,
    most: int,
    rows: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    return _allocate_fill(near, rows)


@_update.register_fake
def _(density: Tensor, cells: Tensor, values: Tensor, decay: float, threshold: float) -> tuple[Tensor, Tensor]:
    return _allocate_update(density)
