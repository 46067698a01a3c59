"""``grouped_linear`` of the compiled module as PyTorch ops of the CPU. n samples, k cells, i inputs, o outputs.

On CUDA it is a network of one layer (``grouped_mlp.py``). Forward and backward, functional both. float32 and
bfloat16 are read and written as they are stored; float16 and float64 are cast to float32 on the way in and back on the
way out. With bfloat16 storage products take bfloat16 operands where the processor multiplies them faster (AVX512-BF16),
and float32 ones elsewhere; sums are float32 always. Second derivatives come from the reference formula. Shapes and
dtypes have been validated by ``voronerf.ops``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf import native as _native
from voronerf.layers import ACTIVATIONS
from voronerf.native import grouped_mlp as _native_mlp
from voronerf.reference.grouped_linear import grouped_linear as _reference
from voronerf.reference.second_derivatives import aliases, second_derivatives

_STORED = (torch.float32, torch.bfloat16)


def grouped_linear(
    x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None = None, *, activation: str = "none"
) -> Tensor:
    """Every sample through the layer of its cell; see ``voronerf.ops.grouped_linear``."""
    if _native.on_cuda(x):
        return _native_mlp.grouped_linear(x, offsets, weight, bias, activation=activation)
    dtype = x.dtype
    if torch.is_autocast_enabled(x.device.type) and dtype != torch.float64:
        dtype = torch.get_autocast_dtype(x.device.type)
    stored = dtype if dtype in _STORED else torch.float32
    given = (x.to(stored), offsets, weight.to(stored), None if bias is None else bias.to(stored))
    out: Tensor = _forward(*given, activation)
    return out.to(dtype)


@torch.library.custom_op("voronerf::grouped_linear_native", mutates_args=(), device_types="cpu")
def _forward(x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None, activation: str) -> Tensor:
    kept = [None if tensor is None else tensor.contiguous() for tensor in (x, offsets, weight, bias)]
    out = _native.fresh(_allocate(x, weight))
    _native._C.grouped_linear(*_call(kept, activation), out.data_ptr(), _native._ISA, torch.get_num_threads())
    return out


@torch.library.custom_op("voronerf::grouped_linear_native_backward", mutates_args=(), device_types="cpu")
def _backward(
    gradient: Tensor,
    x: Tensor,
    offsets: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    activation: str,
    wanted: Sequence[bool],
) -> list[Tensor]:
    """Gradients of x, weight and bias, empty where not wanted: (x, weight and bias)."""
    kept = [None if tensor is None else tensor.contiguous() for tensor in (x, offsets, weight, bias)]
    gradient = gradient.contiguous()
    results = [_native.fresh(result) for result in _allocate_gradients(x, weight, bias, wanted)]
    _native._C.grouped_linear_backward(
        *_call(kept, activation),
        gradient.data_ptr(),
        *[result.data_ptr() if result.numel() else 0 for result in results],
        _native._ISA,
        torch.get_num_threads(),
    )
    return results


def _call(tensors: Sequence[Tensor | None], activation: str) -> list[Any]:
    """Addresses of contiguous x, offsets, weight and bias, then sizes, as csrc/bindings/bindings_mlp.cpp takes them."""
    x, _, weight, _ = tensors
    assert x is not None and weight is not None
    k, o, i = weight.shape
    addresses = [0 if tensor is None else tensor.data_ptr() for tensor in tensors]
    return [*addresses, x.shape[0], k, i, o, ACTIVATIONS.index(activation), x.dtype == torch.bfloat16]


def _allocate(x: Tensor, weight: Tensor) -> Tensor:
    return x.new_empty(x.shape[0], weight.shape[1])


def _allocate_gradients(x: Tensor, weight: Tensor, bias: Tensor | None, wanted: Sequence[bool]) -> list[Tensor]:
    chosen = ((x, wanted[0]), (weight, wanted[1]), (bias, wanted[1]))
    return [x.new_empty(tensor.shape if tensor is not None and want else 0) for tensor, want in chosen]


@_forward.register_fake
def _(x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None, activation: str) -> Tensor:
    return _allocate(x, weight)


@_backward.register_fake
def _(
    gradient: Tensor,
    x: Tensor,
    offsets: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    activation: str,
    wanted: Sequence[bool],
) -> list[Tensor]:
    return _allocate_gradients(x, weight, bias, wanted)


def _forward_setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    x, offsets, weight, bias, ctx.activation = inputs
    ctx.save_for_backward(x, offsets, weight, bias)


def _forward_backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    needs = ctx.needs_input_grad
    results = _backward(gradient, *ctx.saved_tensors, ctx.activation, [needs[0], needs[2] or needs[3]])
    to_x, to_weight, to_bias = (result if need else None for result, need in zip(results, (needs[0], *needs[2:4])))
    return to_x, None, to_weight, to_bias, None


def _backward_setup(ctx: Any, inputs: tuple[Any, ...], output: list[Tensor]) -> None:
    *tensors, ctx.activation, ctx.wanted = inputs
    ctx.save_for_backward(*tensors)


def _backward_backward(ctx: Any, cotangents: list[Tensor]) -> tuple[Tensor | None, ...]:
    """Derivative of the gradients, through the reference formula."""
    gradient, x, offsets, weight, bias = ctx.saved_tensors
    leaves, graph = aliases((x, weight, bias, gradient))
    with torch.enable_grad():
        x, weight, bias, gradient = leaves
        assert x is not None and weight is not None
        with torch.autocast(x.device.type, enabled=False):
            out = _reference(x, offsets, weight, bias, activation=ctx.activation)
        chosen = (ctx.wanted[0], ctx.wanted[1], ctx.wanted[1])
        pairs = [
            (leaf, cotangent)
            for leaf, cotangent, want in zip(leaves, cotangents, chosen)
            if want and leaf is not None and cotangent is not None
        ]
        to_x, to_weight, to_bias, to_gradient = second_derivatives([(out, gradient)], pairs, leaves, graph)
    return to_gradient, to_x, None, to_weight, to_bias, None, None


_forward.register_autograd(_forward_backward, setup_context=_forward_setup)
_backward.register_autograd(_backward_backward, setup_context=_backward_setup)
