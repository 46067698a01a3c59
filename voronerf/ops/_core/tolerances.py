"""Tolerances between two results of one computation, shared by the router and the tests."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

FLOOR = {torch.float64: 1e-14, torch.float32: 2e-6, torch.float16: 2.0**-11, torch.bfloat16: 2.0**-8}
"""The rounding error allowed on top of twice the error of plain PyTorch, relative to the largest magnitude.

For bfloat16 it allows two rounding errors of half a unit in the last place (2^-9): in the result and in one
intermediate value.
"""

AGREE = {torch.float64: 1e-7, torch.float32: 1e-3, torch.float16: 5e-2, torch.bfloat16: 1e-1}
"""The allowed difference between two ways to run a network of some ten layers, relative to the largest magnitude."""


def agree(actual: Tensor, expected: Tensor, tolerance: float | None = None) -> bool:
    """Returns whether two results of one computation agree in shape, dtype and values.

    Values may differ by ``tolerance``, or else the tolerance of their dtype, times the largest value. Non-finite values
    must be equal and in the same places.
    """
    if actual.shape != expected.shape or actual.dtype != expected.dtype:
        return False
    if expected.is_complex():
        actual, expected = torch.view_as_real(actual), torch.view_as_real(expected)
    if not expected.is_floating_point() or expected.numel() == 0:
        return torch.equal(actual, expected)
    a, b = actual.detach().double(), expected.detach().double()
    finite = b.isfinite()
    if not torch.equal(a.isfinite(), finite) or not torch.equal(a[~finite].nan_to_num(), b[~finite].nan_to_num()):
        return False
    a, b = a[finite], b[finite]
    tolerance = AGREE[expected.dtype] if tolerance is None else tolerance
    return not b.numel() or bool((a - b).abs().max() <= tolerance * b.abs().max() + 1e-12)


def agree_gradients(actual: Sequence[Tensor], expected: Sequence[Tensor]) -> bool:
    """Returns whether two computations of the same gradients agree.

    It compares norms of whole tensors, with ten times the tolerance of values: at the kink of a ReLU, rounding decides
    on which side a sample falls, and single entries of a gradient jump. A gradient that is zero up to rounding is
    compared relative to the largest gradient.
    """
    actual, expected = (
        [torch.view_as_real(tensor) if tensor.is_complex() else tensor for tensor in tensors]
        for tensors in (actual, expected)
    )
    largest = max((float(b.detach().double().norm()) for b in expected), default=0.0)
    for a, b in zip(actual, expected, strict=True):
        if a.shape != b.shape or a.dtype != b.dtype:
            return False
        difference, norm = (a.detach().double() - b.detach().double()).norm(), b.detach().double().norm()
        if norm.isfinite() and not difference <= AGREE[b.dtype] * (10 * norm + 0.1 * largest):
            return False
    return True
