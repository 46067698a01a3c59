"""The elementwise activations and their derivatives, in the forms the grouped operations share."""

from __future__ import annotations

import torch
from torch import Tensor

FROM_OUTPUT = ("none", "relu", "softplus", "sigmoid")
"""Activations whose derivative follows from their output, so that the input need not be kept."""


def activate(name: str, x: Tensor) -> Tensor:
    """``name`` of ``x``; softplus is log(1 + e^x) with no threshold."""
    if name == "relu":
        return x.relu()
    if name == "softplus":
        return torch.logaddexp(x, torch.zeros_like(x))
    if name == "sigmoid":
        return x.sigmoid()
    if name == "sine":
        return x.sin()
    return x


def activate_(name: str, x: Tensor) -> Tensor:
    """``activate`` in place, for code that autograd does not see."""
    if name == "relu":
        return x.relu_()
    if name == "softplus":
        return torch.logaddexp(x, x.new_zeros(()), out=x)
    if name == "sigmoid":
        return x.sigmoid_()
    if name == "sine":
        return x.sin_()
    return x


def times_derivative(name: str, gradient: Tensor, output: Tensor) -> Tensor:
    """``gradient`` times the derivative of an activation in ``FROM_OUTPUT``, as a function of its ``output``."""
    if name == "relu":
        return gradient.masked_fill(output <= 0, 0)
    if name == "softplus":
        return gradient * -torch.expm1(-output)
    if name == "sigmoid":
        return gradient * (output * (1 - output))
    assert name == "none"
    return gradient


def times_derivative_(name: str, gradient: Tensor, output: Tensor) -> Tensor:
    """The same in place, for code that autograd does not see; for a sine, ``output`` is the slope itself."""
    if name == "relu":
        return torch.ops.aten.threshold_backward.grad_input(gradient, output, 0, grad_input=gradient)
    if name == "sigmoid":
        return torch.ops.aten.sigmoid_backward.grad_input(gradient, output, grad_input=gradient)
    if name == "softplus":
        return gradient.mul_(torch.expm1(-output).neg_())
    return gradient.mul_(output) if name == "sine" else gradient
