"""Balancing with the compiled module, as a PyTorch op. m samples, k centres."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf import native as _native


def balance_centres(
    samples: Tensor, masses: Tensor, centres: Tensor, *, steps: int, alpha: float, neighbours: int, global_norm: bool
) -> tuple[Tensor, Tensor]:
    """The published update, repeated; see ``voronerf.ops.balance_centres``."""
    moved, weights = _balance(samples, masses, centres, steps, alpha, neighbours, global_norm)
    return moved, weights


@torch.library.custom_op("voronerf::balance_centres_native", mutates_args=(), device_types="cpu")
def _balance(
    samples: Tensor, masses: Tensor, centres: Tensor, steps: int, alpha: float, neighbours: int, global_norm: bool
) -> tuple[Tensor, Tensor]:
    m, k = samples.shape[0], centres.shape[0]
    samples, masses = samples.contiguous(), masses.contiguous()
    moved, weights = centres.clone(memory_format=torch.contiguous_format), masses.new_empty(k)
    cells = samples.new_empty(m, dtype=torch.int32)
    workspace = masses.new_empty(_native._C.balance_centres_workspace(k))
    addresses = (tensor.data_ptr() for tensor in (samples, masses, moved, weights, cells, workspace))
    rest = (steps, alpha, min(neighbours, k - 1), global_norm, _native._ISA, torch.get_num_threads())
    _native._C.balance_centres(*addresses, m, k, *rest)
    return moved, weights


@_balance.register_fake
def _(
    samples: Tensor, masses: Tensor, centres: Tensor, steps: int, alpha: float, neighbours: int, global_norm: bool
) -> tuple[Tensor, Tensor]:
    return centres.new_empty(centres.shape), masses.new_empty(centres.shape[0])
