"""Losses on rays whose light does not come from one surface, with their gradient. r rays, m samples (packed)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from voronerf.ops.composite.reference import check_ray_offsets, composite, optical_depth, packed_light, saveable


def surface_losses(
    weights: Tensor,
    opacities: Tensor,
    depths: Tensor,
    deltas: Tensor,
    ray_offsets: Tensor,
    near: Tensor,
    far: Tensor,
    lit: Tensor,
) -> tuple[Tensor, Tensor]:
    """Returns the distortion and the orientation loss [r] of rays, differentiable in weights and opacities [m].

    See ``voronerf.ops.surface_gradient`` for the formulas and the arguments. ``lit`` [m] marks the samples that are not
    hidden; other samples are ignored. Samples outside all rays must be finite.
    """
    r, m = len(near), len(weights)
    # Samples outside all rays go to two additional rays, so the host does not read the offsets.
    ray = torch.searchsorted(ray_offsets.long(), torch.arange(m, device=weights.device), right=True)
    weights = torch.where(lit & (ray > 0) & (ray <= r), weights, 0)
    scale = pad(1 / (1 / near - 1 / far), (1, 1))[ray]
    places, lengths = scale / depths, scale * deltas / depths.square()

    def before(values: Tensor) -> Tensor:
        """Returns the exclusive cumulative sums along each ray."""
        sums = values.double().cumsum(0)
        starts = pad(pad(sums, (1, 0))[ray_offsets.long()], (1, 0))
        return (sums - values - starts[ray]).to(values.dtype)

    spread = 2 * weights * (before(weights * places) - before(weights) * places) + weights.square() * lengths / 3
    beside = lit[1:] & (ray[1:] == ray[:-1]) & (depths.diff() < deltas[1:] + deltas[:-1])
    falls = pad(torch.where(beside, -opacities.diff(), 0).clamp_min(0), (0, 1))[:m]
    losses = torch.stack((spread, weights * falls.square()))
    distortion, orientation = weights.new_zeros(2, r + 2).index_add(1, ray, losses)[:, 1:-1]
    return distortion, orientation


@torch.inference_mode(False)
@torch.enable_grad()
def surface_gradient(loss: Tensor, gradient: Tensor, *arguments: Any) -> None:
    """Adds the means of the `surface_losses`, and their gradient; see ``voronerf.ops.surface_gradient``."""
    *tensors, distortion, orientation, hidden, density_scale, activated = arguments
    density, depths, deltas, _, ray_offsets, near, far = (saveable(tensor.detach()) for tensor in tensors)
    check_ray_offsets("surface_gradient", ray_offsets, len(density))
    light, ray = packed_light(optical_depth(density, deltas), ray_offsets)
    # Samples outside all rays may be uninitialised memory: the unused rows of a batch with a fixed number of rows.
    inside = (ray > 0) & (ray <= len(near))
    density, deltas = (torch.where(inside, tensor, 0) for tensor in (density, deltas))
    depths = torch.where(inside, depths, 1)
    density.requires_grad_()
    optical = optical_depth(density, deltas)
    weights = composite(density, density.detach()[:, None], depths, deltas, ray_offsets).weights
    ends = ray_offsets, near, far, ~(light <= hidden)
    spread, fallen = surface_losses(weights, -torch.expm1(-optical), depths, deltas, *ends)
    added = (distortion * spread + orientation * fallen).sum() / max(len(near), 1)
    slope = torch.autograd.grad(added, density)[0]
    if not activated:
        slope = slope * -density_scale * torch.expm1(-density / density_scale)  # derivative of the softplus
    with torch.no_grad():
        loss += added
        gradient[:, 3] += slope
