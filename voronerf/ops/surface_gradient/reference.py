"""How far the light of rays is from that of one surface, with its gradient. r rays, m samples of all rays (packed)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from voronerf.ops.composite.reference import check_ray_offsets, composite, kept, optical_depth, packed_light


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
    """The distortion and the orientation loss [r] of rays, differentiable in the weights and opacities [m] of samples.

    Formulas and arguments are those of ``voronerf.ops.surface_gradient``; only samples that are ``lit`` [m] count.
    Samples that belong to no ray are finite.
    """
    r, m = len(near), len(weights)
    # Samples before and behind those of the rays have a place of their own: no host reads where they begin.
    ray = torch.searchsorted(ray_offsets.long(), torch.arange(m, device=weights.device), right=True)
    weights = torch.where(lit & (ray > 0) & (ray <= r), weights, 0)
    scale = pad(1 / (1 / near - 1 / far), (1, 1))[ray]
    places, lengths = scale / depths, scale * deltas / depths.square()

    def before(values: Tensor) -> Tensor:
        """Sums over the samples of the same ray that lie before each."""
        sums = values.double().cumsum(0)
        starts = pad(pad(sums, (1, 0))[ray_offsets.long()], (1, 0))
        return (sums - values - starts[ray]).to(values.dtype)

    spread = 2 * weights * (before(weights * places) - before(weights) * places) + weights.square() * lengths / 3
    beside = lit[1:] & (ray[1:] == ray[:-1]) & (depths.diff() < deltas[1:] + deltas[:-1])
    falls = pad(torch.where(beside, -opacities.diff(), 0).clamp_min(0), (0, 1))[:m]
    each = torch.stack((spread, weights * falls.square()))
    distortion, orientation = weights.new_zeros(2, r + 2).index_add(1, ray, each)[:, 1:-1]
    return distortion, orientation


@torch.inference_mode(False)
@torch.enable_grad()
def surface_gradient(loss: Tensor, gradient: Tensor, *given: Any) -> None:
    """Adds the means of the `surface_losses`, and their gradient; see ``voronerf.ops.surface_gradient``."""
    *tensors, distortion, orientation, hidden, density_scale, activated = given
    density, depths, deltas, _, ray_offsets, near, far = (kept(tensor.detach()) for tensor in tensors)
    check_ray_offsets("surface_gradient", ray_offsets, len(density))
    light, ray = packed_light(optical_depth(density, deltas), ray_offsets)
    # Samples that belong to no ray hold anything, as those do that a captured step has room for.
    known = (ray > 0) & (ray <= len(near))
    density, deltas = (torch.where(known, tensor, 0) for tensor in (density, deltas))
    depths = torch.where(known, depths, 1)
    density.requires_grad_()
    optical = optical_depth(density, deltas)
    weights = composite(density, density.detach()[:, None], depths, deltas, ray_offsets).weights
    ends = ray_offsets, near, far, ~(light <= hidden)
    spread, fallen = surface_losses(weights, -torch.expm1(-optical), depths, deltas, *ends)
    own = (distortion * spread + orientation * fallen).sum() / max(len(near), 1)
    slope = torch.autograd.grad(own, density)[0]
    if not activated:
        slope = slope * -density_scale * torch.expm1(-density / density_scale)  # of a softplus
    with torch.no_grad():
        loss += own
        gradient[:, 3] += slope
