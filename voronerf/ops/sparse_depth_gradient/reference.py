"""How little of a ray's light comes from near a known point, with its gradient. s of r rays, m samples (packed)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from voronerf.ops.composite.reference import check_ray_offsets

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
def sparse_depth_gradient(*given: Any) -> None:
    """Adds the sum of the `sparse_depth_loss`, and its gradient; see ``voronerf.ops.sparse_depth_gradient``."""
    loss, gradient, density, depths, deltas, weights, ray_offsets, distances, factor, density_scale, activated = given
    s = len(distances)
    check_ray_offsets("sparse_depth_gradient", ray_offsets, len(density))
    # Samples of other rays, or of none, are those of one more, which has no point: no host reads where they begin.
    offsets, sample = ray_offsets[: s + 1].long(), torch.arange(len(density), device=density.device)
    ray = torch.searchsorted(offsets, sample, right=True) - 1
    own = (ray >= 0) & (ray < s)
    ray = torch.where(own, ray, s)
    near = near_point(depths, deltas, torch.nn.functional.pad(distances, (0, 1), value=torch.nan)[ray])
    there = torch.where(near, weights, 0)
    # Sums along each ray are differences of sums along all of them, which float32 would round too much.
    optical, light = (_sums_along(values, ray, offsets) for values in (density * deltas, there))
    total = distances.new_zeros(s + 1).index_add(0, ray, there)
    slope = -deltas / total[ray] * (torch.where(near, torch.exp(-optical), 0) - (total[ray] - light))
    if not activated:
        slope = slope * -density_scale * torch.expm1(-density / density_scale)  # of a softplus
    loss += factor * sparse_depth_loss(total[:s]).sum()
    gradient[:, 3] += torch.where(own & (total[ray] > 1e-3), factor * slope, 0)


def _sums_along(values: Tensor, ray: Tensor, offsets: Tensor) -> Tensor:
    """Running sums [m] of values [m] along each ray; what is not finite stays in its own."""

    def along(each: Tensor) -> Tensor:
        before = torch.nn.functional.pad(each.double().cumsum(0), (1, 0))
        return before[1:] - before[offsets][ray]

    sums = along(values.where(values.isfinite(), 0))
    for value, there in ((torch.inf, values == torch.inf), (torch.nan, values.isnan() | (values == -torch.inf))):
        sums = torch.where(along(there) > 0, value, sums)
    return sums.to(values.dtype)
