"""How little of a ray's light comes from near a known point, with its gradient. s rays, m samples (packed)."""

from __future__ import annotations

import torch
from torch import Tensor

#: How far from a surface a point of a sparse model may lie, as a share of its distance from the camera.
NEARBY = 0.03


def near_point(depths: Tensor, deltas: Tensor, distances: Tensor) -> Tensor:
    """Which samples lie near a known point: within `NEARBY` of its distance and their own length.

    Args:
        depths: [...], of samples.
        deltas: [...], their lengths.
        distances: [...], of the point that the ray of each ends at; NaN for none.
    """
    return (depths - distances).abs() <= NEARBY * distances + deltas


def sparse_depth_loss(light: Tensor) -> Tensor:
    """The loss [s] of rays, from the sums [s] of the weights of their samples that are `near_point`."""
    return -torch.log(light.clamp(1e-3, 1))


@torch.no_grad()
def sparse_depth_gradient(
    density: Tensor, depths: Tensor, deltas: Tensor, weights: Tensor, ray_offsets: Tensor, distances: Tensor
) -> tuple[Tensor, Tensor]:
    """The sum of the `sparse_depth_loss`, and its gradient; see ``voronerf.ops.sparse_depth_gradient``."""
    counts = ray_offsets.diff()
    if density.is_cpu and len(counts) and (int(counts.min()) < 0 or int(counts.sum()) != len(density)):
        last, first = int(ray_offsets[-1]), int(ray_offsets[0])
        raise ValueError(
            f"sparse_depth_gradient: ray_offsets must rise, by the number of samples, {len(density)}, got offsets from "
            f"{first} to {last}"
        )
    ray = torch.repeat_interleave(counts)
    near = near_point(depths, deltas, distances[ray])
    there = weights * near
    # Sums along each ray are differences of sums along all of them, which float32 would round too much.
    optical, light = (_sums_along(values, ray, counts) for values in (density * deltas, there))
    total = torch.zeros_like(distances).index_add(0, ray, there)
    known = torch.where(total > 1e-3, -1 / total, 0)
    return sparse_depth_loss(total).sum(), known[ray] * deltas * (torch.exp(-optical) * near - (total[ray] - light))


def _sums_along(values: Tensor, ray: Tensor, counts: Tensor) -> Tensor:
    """Running sums [m] of values [m] along each ray."""
    sums = values.double().cumsum(0)
    before = torch.nn.functional.pad(sums, (1, 0))[counts.cumsum(0) - counts]
    return (sums - before[ray]).to(values.dtype)
