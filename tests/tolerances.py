"""Compares results with float64 results; the table of tolerances is in `voronerf/ops/_core/tolerances.py`.

The error of a result is its largest absolute difference from the float64 result, divided by the largest magnitude of
the float64 result. It may be at most twice the error of plain PyTorch in the same dtype, plus a floor. The floor is the
rounding of the result itself, plus about 30 roundings for float32 and float64, since sums may be taken in any order.
"""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops._core.tolerances import FLOOR


def error(result: Tensor, exact: Tensor) -> float:
    """Returns the largest difference from the float64 result, relative to the latter's largest magnitude."""
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
    actual = error(result, exact)
    assert actual <= allowed, f"error {actual:.3g} is above {allowed:.3g} (plain PyTorch has {error(plain, exact):.3g})"
