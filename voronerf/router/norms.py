"""A layer norm whose derivatives of any order are correct.

PyTorch's third derivative treats the mean and the deviation as constants.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from voronerf.router.transforms import transformed


def native_layer_norm(
    input: Tensor, normalized_shape: Sequence[int], weight: Tensor | None, bias: Tensor | None, eps: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Computes ``torch.native_layer_norm``; for half precision, it calls PyTorch's function."""
    dtypes = {tensor.dtype for tensor in (input, weight, bias) if tensor is not None}
    plain = torch.is_autocast_enabled(input.device.type) or dtypes not in ({torch.float32}, {torch.float64})
    if plain or not torch.is_grad_enabled():
        return torch.native_layer_norm(input, normalized_shape, weight, bias, eps)
    apply = _LayerNorm.apply if transformed() else _apply_directly
    results: tuple[Tensor, Tensor, Tensor] = apply(input, list(normalized_shape), weight, bias, eps)
    return results


def layer_norm(
    input: Tensor,
    normalized_shape: Sequence[int],
    weight: Tensor | None = None,
    bias: Tensor | None = None,
    eps: float = 1e-5,
    cudnn_enable: bool = True,
) -> Tensor:
    """Computes ``torch.layer_norm``; see :func:`native_layer_norm`."""
    return native_layer_norm(input, normalized_shape, weight, bias, eps)[0]


EXACT: dict[Any, Any] = {
    F.layer_norm: layer_norm,
    torch.layer_norm: layer_norm,
    torch.native_layer_norm: native_layer_norm,
}
"""The replacements of PyTorch's functions, by function."""


class _LayerNorm(torch.autograd.Function):
    """A layer norm whose gradient is PyTorch's own, unless the gradient is differentiated again."""

    generate_vmap_rule = True

    @staticmethod
    def forward(
        x: Tensor, shape: list[int], weight: Tensor | None, bias: Tensor | None, eps: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        return torch.native_layer_norm(x, shape, weight, bias, eps)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        x, ctx.shape, weight, bias, ctx.eps = inputs
        ctx.save_for_backward(x, weight, bias, *output[1:])
        ctx.mark_non_differentiable(*output[1:])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
        x, weight, bias, mean, scale = ctx.saved_tensors
        shape, (to_x, _, to_weight, to_bias, _) = ctx.shape, ctx.needs_input_grad
        if not torch.is_grad_enabled():
            native = torch.ops.aten.native_layer_norm_backward
            gradients = native(
                gradient.contiguous(), x.contiguous(), shape, mean, scale, weight, bias, [to_x, to_weight, to_bias]
            )
            return gradients[0], None, gradients[1], gradients[2], None
        dims = list(range(-len(shape), 0))
        centred = x - x.mean(dims, keepdim=True)
        scale = (centred.square().mean(dims, keepdim=True) + ctx.eps).rsqrt()
        y = centred * scale
        inner = gradient if weight is None else gradient * weight
        inner = inner - inner.mean(dims, keepdim=True) - y * (inner * y).mean(dims, keepdim=True)
        by_weight = (gradient * y).sum_to_size(shape) if to_weight else None
        return scale * inner, None, by_weight, gradient.sum_to_size(shape) if to_bias else None, None


#: ``_LayerNorm.apply`` without its check of signatures, which takes 50 us.
_apply_directly: Any = super(torch.autograd.Function, _LayerNorm).apply
