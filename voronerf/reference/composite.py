"""Volume rendering of samples along rays. r rays, s samples of a ray, m samples of all rays (packed), c channels."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Composite(NamedTuple):
    """What a batch of rays sees.

    Attributes:
        colour: [r, c], background included.
        opacity: [r], the sum of the weights.
        depth: [r], the sum of weight times depth: not divided by the opacity.
        weights: like sigma, each sample's contribution.
    """

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    weights: Tensor


def composite(
    sigma: Tensor,
    rgb: Tensor,
    depths: Tensor,
    deltas: Tensor,
    *,
    ray_offsets: Tensor | None = None,
    background: Tensor | None = None,
) -> Composite:
    """Absorption and emission along rays; see ``voronerf.ops.composite``."""
    storage = rgb.dtype
    wide = torch.promote_types(storage, torch.float32)
    sigma, rgb, depths, deltas = (tensor.to(wide) for tensor in (sigma, rgb, depths, deltas))
    # An opaque sample is infinite density; a finite one that lets nothing through gives the same, and 0 x inf nowhere.
    optical = sigma.clamp(max=torch.finfo(torch.float32).max) * deltas
    if ray_offsets is None:
        weights = _transmittance(optical) * -torch.expm1(-optical)
        colour = (weights[:, None, :] @ rgb)[:, 0]
        opacity = weights.sum(dim=1)
        depth = (weights * depths).sum(dim=1)
    else:
        ray = _ray_of_sample(ray_offsets, sigma.shape[0])
        weights = _packed_transmittance(optical, ray_offsets, ray) * -torch.expm1(-optical)
        # Colour, opacity and depth are one sum, over columns side by side. The last row takes samples of no ray.
        columns = torch.cat([rgb, torch.ones_like(depths)[:, None], depths[:, None]], dim=1) * weights[:, None]
        total = columns.new_zeros(ray_offsets.shape[0] + 1, columns.shape[1]).index_add(0, ray, columns)[1:-1]
        colour, opacity, depth = total[:, :-2], total[:, -2], total[:, -1]
    if background is not None:
        colour = colour + (1 - opacity)[:, None] * background.to(wide)
    return Composite(colour.to(storage), opacity.to(storage), depth.to(storage), weights.to(storage))


def _transmittance(optical: Tensor) -> Tensor:
    """exp of minus the optical depth in front of each sample [r, s]; the shift keeps inf - inf out of it."""
    before = torch.nn.functional.pad(optical[:, :-1], (1, 0))
    return torch.exp(-before.cumsum(dim=1))


def _ray_of_sample(ray_offsets: Tensor, samples: int) -> Tensor:
    """One more than the ray of each packed sample; 0 and r + 1 for samples outside all rays."""
    index = torch.arange(samples, dtype=torch.int32, device=ray_offsets.device)
    return torch.searchsorted(ray_offsets, index, right=True)


def _packed_transmittance(optical: Tensor, ray_offsets: Tensor, ray: Tensor) -> Tensor:
    """The same for packed samples: one running sum over all rays, less its value where the ray starts.

    Float64 carries the running sum of millions of samples. One sample counts for at most ``limit``, where nothing
    visible passes, so that an opaque ray costs the rays behind it no digits; what is not a number counts for nothing
    outside its own ray.
    """
    limit = 128.0 if optical.dtype == torch.float32 else 768.0
    bad = optical.detach().isnan()
    depth = optical.double().masked_fill(bad, 0).clamp(max=limit)
    start = ray_offsets.long()[(ray - 1).clamp(0, ray_offsets.shape[0] - 1)]
    running = torch.nn.functional.pad(depth.cumsum(dim=0), (1, 0))
    before = running[:-1] - running[start]
    spoiled = torch.nn.functional.pad(bad.cumsum(dim=0), (1, 0))
    transmittance = torch.exp(-before).to(optical.dtype)
    return transmittance.masked_fill(spoiled[:-1] > spoiled[start], torch.nan)
