"""The heaviest samples of a batch with Warp's radix sort. n samples, q of them kept.

Importance that counts is positive and finite, and the bits of positive floats rise as they do: complemented, they are
the keys of a stable sort that brings the heaviest first and, of equally heavy ones, the first.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from voronerf.kernels._launch import array, launch, on_stream

wp.set_module_options({"enable_backward": False})


@wp.func
def _counts(value: wp.float32) -> wp.bool:
    return value > 0.0 and wp.isfinite(value)


@wp.kernel
def _keys_kernel(
    points: wp.array2d(dtype=wp.float32),
    importance: wp.array(dtype=wp.float32),
    keys: wp.array(dtype=wp.int32),
    order: wp.array(dtype=wp.int32),
) -> None:
    i = wp.tid()
    value = importance[i]
    finite = wp.isfinite(points[i, 0]) and wp.isfinite(points[i, 1]) and wp.isfinite(points[i, 2])
    key = wp.int32(2147483647)
    if _counts(value) and finite:
        key = wp.int32(2147483647) - wp.cast(value, wp.int32)
    keys[i] = key
    order[i] = i


@wp.kernel
def _gather_kernel(
    points: wp.array2d(dtype=wp.float32),
    importance: wp.array(dtype=wp.float32),
    keys: wp.array(dtype=wp.int32),
    order: wp.array(dtype=wp.int32),
    kept_points: wp.array2d(dtype=wp.float32),
    kept: wp.array(dtype=wp.float32),
) -> None:
    row = wp.tid()
    i = order[row]
    valid = keys[row] < wp.int32(2147483647)
    kept[row] = wp.where(valid, importance[i], 0.0)
    for axis in range(3):
        kept_points[row, axis] = wp.where(valid, points[i, axis], 0.0)


def select_heaviest(points: Tensor, importance: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The samples of largest importance; see ``voronerf.ops.select_heaviest``."""
    kept_points, kept = _select(points, importance, count)
    return kept_points, kept


@torch.library.custom_op("voronerf::select_heaviest_warp", mutates_args=())
def _select(points: Tensor, importance: Tensor, count: int) -> tuple[Tensor, Tensor]:
    n = points.shape[0]
    # The sort needs room for twice the pairs, and leaves them in the first half.
    keys, order = (points.new_empty(2 * n, dtype=torch.int32) for _ in range(2))
    results = _allocate(points, count)
    given = [array(points, points), array(importance, points)]
    table = [array(keys, points), array(order, points)]
    launch(_keys_kernel, n, [*given, *table], points)
    with on_stream(points):
        wp.utils.radix_sort_pairs(*table, n)
    launch(_gather_kernel, min(count, n), [*given, *table, *(array(tensor, points) for tensor in results)], points)
    return results


@_select.register_fake
def _(points: Tensor, importance: Tensor, count: int) -> tuple[Tensor, Tensor]:
    return _allocate(points, count)


def _allocate(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    rows = min(count, points.shape[0])
    return points.new_empty(rows, 3), points.new_empty(rows)
