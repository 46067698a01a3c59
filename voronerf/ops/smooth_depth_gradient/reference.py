"""A loss on the curvature of unseen rays' disparities, and its gradient. r rays, m samples."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from voronerf.ops.composite.reference import check_ray_offsets, composite, optical_depth, packed_light, saveable
from voronerf.ops.render_loss.reference import robust_error

#: The scale of the robust error. For larger log ratios of disparities, which occur at edges of surfaces, the loss is
#: linear.
EDGE = 0.05


def smooth_depth_loss(disparity: Tensor, opacity: Tensor, far: Tensor, triples: int) -> Tensor:
    """Returns the loss [] of the last rays, from the disparities and opacities [r] of all rays.

    See ``voronerf.ops.smooth_depth_gradient`` for the formula and the arguments.
    """
    middle, one, other = (disparity + (1 - opacity) / far)[len(far) - 3 * triples :].view(3, triples)
    bent = ((one + other) / (2 * middle)).log()
    return robust_error(bent.square(), EDGE).mean() if triples else bent.sum()


@torch.inference_mode(False)
@torch.enable_grad()
def smooth_depth_gradient(loss: Tensor, gradient: Tensor, *arguments: Any) -> None:
    """Adds the loss and its gradient; see ``voronerf.ops.smooth_depth_gradient``."""
    *tensors, triples, factor, hidden, density_scale, activated = arguments
    density, depths, deltas, _, ray_offsets, far = (saveable(tensor.detach()) for tensor in tensors)
    check_ray_offsets("smooth_depth_gradient", ray_offsets, len(density))
    density.requires_grad_()
    disparities = 1 / depths[:, None]
    light, _ = packed_light(optical_depth(density.detach(), deltas), ray_offsets)
    lit = torch.where(light <= hidden, density.detach(), density)
    seen = composite(lit, disparities, depths, deltas, ray_offsets)
    added = factor * smooth_depth_loss(seen.colour[:, 0], seen.opacity, far, triples)
    slope = torch.autograd.grad(added, density)[0]
    if not activated:
        slope = slope * -density_scale * torch.expm1(-density / density_scale)  # derivative of the softplus
    with torch.no_grad():
        loss += added
        gradient[:, 3] += slope
