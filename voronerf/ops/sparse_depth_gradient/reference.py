"""How little of a ray's light comes from near a known point, with its gradient. s of r rays, m samples (packed)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from voronerf.ops.composite.reference import check_ray_offsets, composite, kept

#: How far from a surface a point of a sparse model may lie, as a share of its distance from the camera.
NEARBY = 0.03


def sparse_depth_loss(
    weights: Tensor, depths: Tensor, deltas: Tensor, ray_offsets: Tensor, distances: Tensor
) -> Tensor:
    """The loss [s] of rays that end at known points, differentiable in the weights.

    Formula and arguments are those of ``voronerf.ops.sparse_depth_gradient``.
    """
    # Samples before and behind those of the s rays have a place of their own: no host reads where they begin.
    sample = torch.arange(len(weights), device=weights.device)
    ray = torch.searchsorted(ray_offsets[: len(distances) + 1].long(), sample, right=True)
    known = torch.nn.functional.pad(distances, (1, 1), value=torch.nan)
    near = (depths - known[ray]).abs() <= NEARBY * known[ray] + deltas
    light = torch.zeros_like(known).index_add(0, ray, torch.where(near, weights, 0))[1:-1]
    return -torch.log(light.clamp_min(1e-3))


@torch.inference_mode(False)
@torch.enable_grad()
def sparse_depth_gradient(loss: Tensor, gradient: Tensor, *given: Any) -> None:
    """Adds the mean of the `sparse_depth_loss`, and its gradient; see ``voronerf.ops.sparse_depth_gradient``."""
    *tensors, factor, density_scale, activated = given
    density, depths, deltas, weights, ray_offsets, distances = (kept(tensor.detach()) for tensor in tensors)
    check_ray_offsets("sparse_depth_gradient", ray_offsets, len(density))
    density.requires_grad_()
    weights.requires_grad_()
    rgb = density.detach()[:, None]
    composed = composite(density, rgb, depths, deltas, ray_offsets).weights
    of_rays = sparse_depth_loss(weights, depths, deltas, ray_offsets, distances)
    own = factor * of_rays.sum() / max(len(distances), 1)
    slope = torch.autograd.grad(composed, density, torch.autograd.grad(own, weights))[0]
    if not activated:
        slope = slope * -density_scale * torch.expm1(-density / density_scale)  # of a softplus
    with torch.no_grad():
        loss += own
        gradient[:, 3] += slope
