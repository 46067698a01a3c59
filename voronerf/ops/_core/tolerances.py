"""How far two results of one computation may lie apart: the one table that the router and the tests share."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

FLOOR = {torch.float64: 1e-14, torch.float32: 2e-6, torch.float16: 2.0**-11, torch.bfloat16: 2.0**-8}
"""Rounding that a result may have on top of twice the error of plain PyTorch, relative to its largest magnitude.

bfloat16 has half of a unit in the last place, 2^-9, for the result and the same for one intermediate.
"""

AGREE = {torch.float64: 1e-7, torch.float32: 1e-3, torch.float16: 5e-2, torch.bfloat16: 1e-1}
"""How far two ways to run a network of some ten layers may differ, relative to the largest magnitude of the result."""


def agree(found: Tensor, expected: Tensor) -> bool:
    """Whether two ways to compute the same tensor gave the same shape, dtype and numbers.

    Values that are not finite must stand in the same places.
    """
    if found.shape != expected.shape or found.dtype != expected.dtype:
        return False
    if expected.is_complex():
        found, expected = torch.view_as_real(found), torch.view_as_real(expected)
    if not expected.is_floating_point() or expected.numel() == 0:
        return torch.equal(found, expected)
    a, b = found.detach().double(), expected.detach().double()
    finite = b.isfinite()
    if not torch.equal(a.isfinite(), finite) or not torch.equal(a[~finite].nan_to_num(), b[~finite].nan_to_num()):
        return False
    a, b = a[finite], b[finite]
    return not b.numel() or bool((a - b).abs().max() <= AGREE[expected.dtype] * b.abs().max() + 1e-12)


def agree_gradients(found: Sequence[Tensor], expected: Sequence[Tensor]) -> bool:
    """Whether two ways gave the same gradients.

    Norms of whole tensors are compared, with ten times the tolerance of values: where a ReLU has its kink, rounding
    decides to which side a sample falls, and single entries of a gradient jump. A gradient that is zero but for
    rounding is compared with the largest of them.
    """
    found, expected = (
        [torch.view_as_real(tensor) if tensor.is_complex() else tensor for tensor in tensors]
        for tensors in (found, expected)
    )
    largest = max((float(b.detach().double().norm()) for b in expected), default=0.0)
    for a, b in zip(found, expected, strict=True):
        if a.shape != b.shape or a.dtype != b.dtype:
            return False
        difference, own = (a.detach().double() - b.detach().double()).norm(), b.detach().double().norm()
        if own.isfinite() and not difference <= AGREE[b.dtype] * (10 * own + 0.1 * largest):
            return False
    return True
