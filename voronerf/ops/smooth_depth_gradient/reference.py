"""How far the depths of neighbours are from a plane where no picture says, with its gradient. r rays, m samples."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from voronerf.ops.composite.reference import check_ray_offsets, composite, kept, optical_depth, packed_light
from voronerf.ops.render_loss.reference import robust_error

#: Scale of the logarithms beyond which the loss is not squared: at the edge of a surface.
EDGE = 0.05


def smooth_depth_loss(disparity: Tensor, opacity: Tensor, far: Tensor, triples: int) -> Tensor:
    """The loss [] of the last of r rays, from their sums [r] of weights over depths and of weights.

    Formula and arguments are those of ``voronerf.ops.smooth_depth_gradient``.
    """
    middle, one, other = (disparity + (1 - opacity) / far)[len(far) - 3 * triples :].view(3, triples)
    bent = ((one + other) / (2 * middle)).log()
    return robust_error(bent.square(), EDGE).mean() if triples else bent.sum()


@torch.inference_mode(False)
@torch.enable_grad()
def smooth_depth_gradient(loss: Tensor, gradient: Tensor, *given: Any) -> None:
    """Adds the loss of bent depths; see ``voronerf.ops.smooth_depth_gradient``."""
    *tensors, triples, factor, hidden, density_scale, activated = given
    density, depths, deltas, _, ray_offsets, far = (kept(tensor.detach()) for tensor in tensors)
    check_ray_offsets("smooth_depth_gradient", ray_offsets, len(density))
    density.requires_grad_()
    disparities = 1 / depths[:, None]
    light, _ = packed_light(optical_depth(density.detach(), deltas), ray_offsets)
    lit = torch.where(light <= hidden, density.detach(), density)
    seen = composite(lit, disparities, depths, deltas, ray_offsets)
    own = factor * smooth_depth_loss(seen.colour[:, 0], seen.opacity, far, triples)
    slope = torch.autograd.grad(own, density)[0]
    if not activated:
        slope = slope * -density_scale * torch.expm1(-density / density_scale)  # of a softplus
    with torch.no_grad():
        loss += own
        gradient[:, 3] += slope
