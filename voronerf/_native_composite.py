"""Volume rendering of the compiled module as PyTorch ops.

r rays, s samples of a ray, m samples of all rays (packed), c channels. A custom op each way, functional both: they make
inputs contiguous, allocate outputs, and pass addresses. The arithmetic is float32; half types are cast on the way in
and out. Second derivatives come from the reference formula. Shapes and dtypes have been validated by ``voronerf.ops``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf import _native
from voronerf.reference.composite import Composite
from voronerf.reference.composite import composite as _reference


def composite(
    sigma: Tensor,
    rgb: Tensor,
    depths: Tensor,
    deltas: Tensor,
    *,
    ray_offsets: Tensor | None = None,
    background: Tensor | None = None,
) -> Composite:
    """Absorption and emission along rays; see ``voronerf.ops.composite``."""
    if background is not None:
        background = background.float()
    parts = _forward(sigma.float(), rgb.float(), depths.float(), deltas.float(), ray_offsets, background)
    return Composite(*(part.to(rgb.dtype) for part in parts))


@torch.library.custom_op("voronerf::composite_native", mutates_args=(), device_types=("cpu", "cuda"))
def _forward(
    sigma: Tensor, rgb: Tensor, depths: Tensor, deltas: Tensor, ray_offsets: Tensor | None, background: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    inputs = _contiguous(sigma, rgb, depths, deltas, ray_offsets, background)
    results = _allocate(sigma, rgb, ray_offsets)
    arguments = _addresses(inputs), _sizes(sigma, rgb, ray_offsets, background), _addresses(results)
    if _native.on_cuda(sigma):
        _native._C.composite_cuda(*arguments, *_native.stream(sigma))
    else:
        _native._C.composite(*arguments, *_machine())
    return results


@torch.library.custom_op("voronerf::composite_native_backward", mutates_args=(), device_types=("cpu", "cuda"))
def _backward(
    colour: Tensor | None,
    opacity: Tensor | None,
    depth: Tensor | None,
    weights: Tensor | None,
    sigma: Tensor,
    rgb: Tensor,
    depths: Tensor,
    deltas: Tensor,
    ray_offsets: Tensor | None,
    background: Tensor | None,
    wanted: Sequence[bool],
) -> list[Tensor]:
    """Gradients to sigma, rgb, depths, deltas and background, empty where not wanted; that to sigma is always there.

    The first four arguments are the gradients of the outputs, None for zero.
    """
    inputs = _contiguous(sigma, rgb, depths, deltas, ray_offsets, background)
    gradients = _contiguous(colour, opacity, depth, weights)
    workspace = sigma.new_empty(0 if background is None else _rays(sigma, ray_offsets))
    results = _allocate_gradients(sigma, rgb, depths, deltas, background, wanted)
    arguments = (
        _addresses(inputs),
        _sizes(sigma, rgb, ray_offsets, background),
        _addresses(gradients),
        [
            *(address if want else 0 for address, want in zip(_addresses(results), [True, *wanted[1:]])),
            workspace.data_ptr(),
        ],
    )
    if _native.on_cuda(sigma):
        _native._C.composite_backward_cuda(*arguments, *_native.stream(sigma))
    else:
        _native._C.composite_backward(*arguments, *_machine())
    return results


def _machine() -> tuple[int, int]:
    return _native._ISA, torch.get_num_threads()


def _contiguous(*tensors: Tensor | None) -> list[Tensor | None]:
    return [None if tensor is None else tensor.contiguous() for tensor in tensors]


def _addresses(tensors: Sequence[Tensor | None]) -> list[int]:
    return [0 if tensor is None else tensor.data_ptr() for tensor in tensors]


def _sizes(sigma: Tensor, rgb: Tensor, ray_offsets: Tensor | None, background: Tensor | None) -> list[int]:
    """r, s, m, c and whether the background is per ray, as csrc/bindings_composite.cpp reads them."""
    per_ray = background is not None and background.dim() == 2
    s = sigma.shape[1] if ray_offsets is None else 0
    return [_rays(sigma, ray_offsets), s, sigma.numel(), rgb.shape[-1], int(per_ray)]


def _rays(sigma: Tensor, ray_offsets: Tensor | None) -> int:
    return sigma.shape[0] if ray_offsets is None else ray_offsets.shape[0] - 1


def _allocate(sigma: Tensor, rgb: Tensor, ray_offsets: Tensor | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    r = _rays(sigma, ray_offsets)
    return rgb.new_empty(r, rgb.shape[-1]), sigma.new_empty(r), sigma.new_empty(r), sigma.new_empty(sigma.shape)


def _allocate_gradients(
    sigma: Tensor, rgb: Tensor, depths: Tensor, deltas: Tensor, background: Tensor | None, wanted: Sequence[bool]
) -> list[Tensor]:
    return [
        sigma.new_empty(0 if tensor is None or not want else tensor.shape)
        for tensor, want in zip((sigma, rgb, depths, deltas, background), [True, *wanted[1:]])
    ]


@_forward.register_fake
def _(
    sigma: Tensor, rgb: Tensor, depths: Tensor, deltas: Tensor, ray_offsets: Tensor | None, background: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return _allocate(sigma, rgb, ray_offsets)


@_backward.register_fake
def _(
    colour: Tensor | None,
    opacity: Tensor | None,
    depth: Tensor | None,
    weights: Tensor | None,
    sigma: Tensor,
    rgb: Tensor,
    depths: Tensor,
    deltas: Tensor,
    ray_offsets: Tensor | None,
    background: Tensor | None,
    wanted: Sequence[bool],
) -> list[Tensor]:
    return _allocate_gradients(sigma, rgb, depths, deltas, background, wanted)


def _forward_setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*inputs)


def _forward_backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
    inputs = ctx.saved_tensors
    needs = ctx.needs_input_grad
    if all(gradient is None for gradient in gradients):
        return (None,) * len(inputs)
    wanted = [*needs[:4], needs[5]]
    results = _backward(*gradients, *inputs, wanted)
    found = [result if need else None for result, need in zip(results, wanted)]
    return (*found[:4], None, found[4])


def _backward_setup(ctx: Any, inputs: tuple[Any, ...], output: list[Tensor]) -> None:
    *tensors, ctx.wanted = inputs
    ctx.save_for_backward(*tensors)


def _backward_backward(ctx: Any, cotangents: list[Tensor | None]) -> tuple[Tensor | None, ...]:
    """Derivative of the gradients, through the reference formula."""
    saved = ctx.saved_tensors
    ray_offsets = saved[8]
    with torch.enable_grad():
        leaves = [
            None if tensor is None or i == 8 else tensor.detach().requires_grad_() for i, tensor in enumerate(saved)
        ]
        gradients, inputs = leaves[:4], [*leaves[4:8], leaves[9]]
        parts = _reference(*inputs[:4], ray_offsets=ray_offsets, background=inputs[4])  # type: ignore[arg-type]
        outputs = [(part, gradient) for part, gradient in zip(parts, gradients) if gradient is not None]
        pairs = [
            (tensor, cotangent)
            for tensor, cotangent, want in zip(inputs, cotangents, ctx.wanted)
            if want and tensor is not None and cotangent is not None
        ]
        firsts = torch.autograd.grad(
            [part for part, _ in outputs],
            [tensor for tensor, _ in pairs],
            [gradient for _, gradient in outputs],
            create_graph=True,
            allow_unused=True,
            materialize_grads=True,
        )
        total = saved[4].new_zeros(())
        for first, (_, cotangent) in zip(firsts, pairs):
            total = total + (first * cotangent).sum()
        present = [leaf for leaf in leaves if leaf is not None]
        seconds = iter(torch.autograd.grad(total, present, allow_unused=True))
    return (*(None if leaf is None else next(seconds) for leaf in leaves), None)


_forward.register_autograd(_forward_backward, setup_context=_forward_setup)
_backward.register_autograd(_backward_backward, setup_context=_backward_setup)
