"""A loss on rays that end at known points, and its gradient. r rays, s of them with points, m samples."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from voronerf.ops.composite.reference import check_ray_offsets, composite, saveable

#: The largest distance of a sparse model's point from the surface, relative to the point's distance from the camera.
NEARBY = 0.03


def sparse_depth_loss(
    weights: Tensor, depths: Tensor, deltas: Tensor, ray_offsets: Tensor, distances: Tensor
) -> Tensor:
    """Returns the loss [s] of rays that end at known points, differentiable in the weights.

    See ``voronerf.ops.sparse_depth_gradient`` for the formula and the arguments.
    """
    # Samples outside the s rays go to two additional rays, so the host does not read the offsets.
    sample = torch.arange(len(weights), device=weights.device)
    ray = torch.searchsorted(ray_offsets[: len(distances) + 1].long(), sample, right=True)
    points = torch.nn.functional.pad(distances, (1, 1), value=torch.nan)
    near = (depths - points[ray]).abs() <= NEARBY * points[ray] + deltas
    light = torch.zeros_like(points).index_add(0, ray, torch.where(near, weights, 0))[1:-1]
    return -torch.log(light.clamp_min(1e-3))


@torch.inference_mode(False)
@torch.enable_grad()
def sparse_depth_gradient(loss: Tensor, gradient: Tensor, *arguments: Any) -> None:
    """Adds the mean of the `sparse_depth_loss`, and its gradient; see ``voronerf.ops.sparse_depth_gradient``."""
    *tensors, factor, density_scale, activated = arguments
    density, depths, deltas, weights, ray_offsets, distances = (saveable(tensor.detach()) for tensor in tensors)
    check_ray_offsets("sparse_depth_gradient", ray_offsets, len(density))
    density.requires_grad_()
    weights.requires_grad_()
    rgb = density.detach()[:, None]
    composed = composite(density, rgb, depths, deltas, ray_offsets).weights
    of_rays = sparse_depth_loss(weights, depths, deltas, ray_offsets, distances)
    added = factor * of_rays.sum() / max(len(distances), 1)
    slope = torch.autograd.grad(composed, density, torch.autograd.grad(added, weights))[0]
    if not activated:
        slope = slope * -density_scale * torch.expm1(-density / density_scale)  # derivative of the softplus
    with torch.no_grad():
        loss += added
        gradient[:, 3] += slope
