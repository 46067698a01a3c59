"""Gradients of the networks' outputs, from gradients of rendered values. r rays, m samples of all rays (packed)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from voronerf.ops.composite.reference import check_ray_offsets, composite, optical_depth, packed_light, saveable


@torch.inference_mode(False)
@torch.enable_grad()
def rendered_gradient(gradient: Tensor, *arguments: Any) -> None:
    """Adds the gradient of a loss with respect to ``raw``; see ``voronerf.ops.rendered_gradient``."""
    *tensors, hidden, density_scale, activated = (saveable(value) for value in arguments)
    raw, density, depths, deltas, _, ray_offsets, background, *slopes = tensors
    check_ray_offsets("rendered_gradient", ray_offsets, len(density))
    colours = raw[:, :3] if activated else torch.sigmoid(raw[:, :3])
    density, rgb = leaves = [part.detach().requires_grad_() for part in (density, colours)]
    seen = composite(density, rgb, depths, deltas, ray_offsets, background)
    parts = seen.colour, seen.opacity, seen.depth, seen.weights, rgb, density
    pairs = [(part, slope) for part, slope in zip(parts, slopes, strict=True) if slope is not None]
    if not pairs:
        return
    outputs, arriving = zip(*pairs)
    of_density, of_rgb = torch.autograd.grad(outputs, leaves, arriving, materialize_grads=True)
    with torch.no_grad():
        if not activated:
            of_density = of_density * -density_scale * torch.expm1(-density / density_scale)  # softplus derivative
            of_rgb = of_rgb * rgb * (1 - rgb)
        light, ray = packed_light(optical_depth(density, deltas), ray_offsets)
        learning = (ray > 0) & (ray < len(ray_offsets))
        if hidden:
            learning &= ~(light <= hidden)
        gradient += torch.cat([of_rgb, of_density[:, None]], dim=1).masked_fill(~learning[:, None], 0)
