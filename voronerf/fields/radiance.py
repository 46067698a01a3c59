"""The activations that radiance fields have in common."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor


def activate_radiance(self: Any, raw: Tensor) -> tuple[Tensor, Tensor]:
    """Turns the network's outputs into what a renderer needs.

    A class with ``activate = activate_radiance`` and a ``density_scale`` declares by it what its outputs mean. Training
    through an occupancy grid then goes from outputs to the loss in one operation (``voronerf.ops.render_loss``).

    Args:
        self: The field, which has a ``density_scale``.
        raw: [n, 4]: colour before its sigmoid, density before its softplus.

    Returns:
        (colour [n, 3] in 0..1, density [n] >= 0 per scene unit), float32 or wider.
    """
    raw = raw.float() if raw.dtype in (torch.float16, torch.bfloat16) else raw
    # `split`, because its gradient is one concatenation, and that of two slices two padded arrays and their sum.
    # `contiguous`, because torch vectorises activations for contiguous values only. Together a third of the time.
    colour, density = (part.contiguous() for part in raw.split([3, 1], dim=-1))
    return torch.sigmoid(colour), F.softplus(density.squeeze(-1)) * self.density_scale
