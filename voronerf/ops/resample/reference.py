"""Hierarchical sampling. r rays, s bins of a ray."""

from __future__ import annotations

import torch
from torch import Tensor


@torch.no_grad()
def resample(weights: Tensor, edges: Tensor, count: int, uniforms: Tensor | None = None) -> Tensor:
    """Draws depths in proportion to the weights of the bins; see ``voronerf.ops.resample``."""
    wide = torch.float64
    mass = torch.where(weights.isfinite(), weights, 0).to(wide).clamp(min=0)
    # Overflow guard: the masses are scaled to at most 1.
    most = mass.amax(dim=1, keepdim=True)
    mass = torch.where(most > 0, mass / most, 1)
    upper = mass.cumsum(dim=1)
    lower = upper - mass
    if uniforms is None:
        strata = torch.arange(count, dtype=wide, device=edges.device)
        uniforms = ((strata + 0.5) / count).expand(weights.shape[0], count)
    target = uniforms.to(wide).sort(dim=1).values.clamp(0, 1) * upper[:, -1:]
    # A target on the edge of two bins belongs to the later bin, so a bin without mass is never drawn. A target that is
    # rounded to the end belongs to the last bin with mass.
    last = (upper < upper[:, -1:]).sum(dim=1, keepdim=True)
    bins = torch.minimum(torch.searchsorted(upper, target.contiguous(), right=True), last)
    inside = ((target - lower.gather(1, bins)) / mass.gather(1, bins)).clamp(0, 1)
    near, far = edges.to(wide).gather(1, bins), edges.to(wide).gather(1, bins + 1)
    return torch.minimum(near + inside * (far - near), far).to(edges.dtype)
