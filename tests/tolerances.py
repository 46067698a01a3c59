"""How far a result may be from the same computed in float64; the table itself is in `voronerf/ops/_core/tolerances.py`.

The error of a result is its largest absolute difference from the float64 result, divided by the largest magnitude
there. It may be twice that of plain PyTorch in the same dtype, plus a floor: the rounding of the result itself, and for
float32 and float64 some 30 roundings more: plain PyTorch may be lucky, and sums may be taken in any order.
"""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops._core.tolerances import FLOOR


def error(result: Tensor, exact: Tensor) -> float:
    """Largest difference from the float64 result, relative to its largest magnitude."""
    assert exact.dtype == torch.float64
    if exact.numel() == 0:
        return 0.0
    difference = (result.detach().double().cpu() - exact.detach().cpu()).abs().max().item()
    scale = exact.abs().max().item()
    return difference / scale if scale > 0 else difference


def assert_as_exact(result: Tensor, plain: Tensor, exact: Tensor) -> None:
    """Fails unless ``result`` is within twice the error of ``plain``, which has the same dtype, plus the floor."""
    assert result.shape == plain.shape == exact.shape
    assert result.dtype == plain.dtype
    allowed = 2 * error(plain, exact) + FLOOR[result.dtype]
    found = error(result, exact)
    assert found <= allowed, f"error {found:.3g} is above {allowed:.3g} (plain PyTorch has {error(plain, exact):.3g})"
