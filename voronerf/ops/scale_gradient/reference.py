"""Gradients of samples near the camera, made smaller. m samples, c outputs of the networks."""

from __future__ import annotations

import torch
from torch import Tensor


@torch.no_grad()
def scale_gradient(gradient: Tensor, depths: Tensor, full: float) -> None:
    """Multiplies the gradients of samples by their shares; see ``voronerf.ops.scale_gradient``."""
    gradient *= shares_of(depths, full)[:, None]


def shares_of(depths: Tensor, full: float) -> Tensor:
    """Factors [m] on the gradients of samples at depths [m]; whole from a distance on."""
    return (depths / full).square().clamp(max=1)
