"""The elementwise activations of layers, and the program of one layer. k cells, o outputs and i inputs of a layer."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from voronerf.ops._core.compiler import constant_result
from voronerf.ops._core.layers import NUMBERS
from voronerf.ops._core.program import PARAMETER, Builder, Columns, Program


def activate(name: str, x: Tensor) -> Tensor:
    """Applies the activation called ``name``; softplus is log(1 + e^x) without a threshold."""
    if name == "softplus":
        return torch.logaddexp(x, torch.zeros_like(x))
    return x if name == "none" else {"relu": torch.relu, "sigmoid": torch.sigmoid, "sine": torch.sin}[name](x)


def one_layer(weight: Tensor, bias: Tensor | None, activation: str) -> Program:
    """Returns the program of a layer with weights [k, o, i], and a bias [k, o] or None."""
    _, o, i = weight.shape
    return _one_layer(len(range(o)), len(range(i)), bias is not None, activation)  # plain ints, not symbolic ones


@constant_result  # not on the cached function, which torch.compile would trace
def _one_layer(o: int, i: int, biased: bool, activation: str) -> Program:
    return _one_layer_once(o, i, biased, activation)


@functools.lru_cache(maxsize=256)
def _one_layer_once(o: int, i: int, biased: bool, activation: str) -> Program:
    b = Builder()
    x, weight = b.input(i), b.parameter(o, i)
    y = b.linear(x, weight, o, add=Columns(PARAMETER, b.parameter(o), 0, o) if biased else None)
    return b.program([y if activation == "none" else b.apply(activation, y, *NUMBERS.get(activation, ()))])
