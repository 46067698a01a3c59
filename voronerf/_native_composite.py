"""Volume rendering of the compiled module as PyTorch ops. r rays, s samples of a ray, m samples in all, c channels.

Two custom ops, forward and backward, functional both. Everything is float32 inside; half types are cast on the way in
and out. Second derivatives come from the reference formula. Arguments have been validated by ``voronerf.ops``.
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
    results = _forward(
        sigma.float(),
        rgb.float(),
        depths.float(),
        deltas.float(),
        ray_offsets,
        None if background is None else background.float(),
    )
    return Composite(*(result.to(rgb.dtype) for result in results))


@torch.library.custom_op("voronerf::composite_native", mutates_args=(), device_types="cpu")
def _forward(
    sigma: Tensor,
    rgb: Tensor,
    depths: Tensor,
    deltas: Tensor,
    ray_offsets: Tensor | None,
    background: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    results = _allocate(sigma, rgb, ray_offsets)
    _call([sigma, rgb, depths, deltas, ray_offsets, background, *results])
    return results


@torch.library.custom_op("voronerf::composite_native_backward", mutates_args=(), device_types="cpu")
def _backward(
    gradients: Sequence[Tensor],
    results: Sequence[Tensor],
    sigma: Tensor,
    rgb: Tensor,
    depths: Tensor,
    deltas: Tensor,
    ray_offsets: Tensor | None,
    background: Tensor | None,
) -> list[Tensor]:
    found = _allocate_gradients(gradients, sigma, rgb, depths, deltas, background)
    of_background = None if background is None else torch.empty_like(results[0])
    inputs = [sigma, rgb, depths, deltas, ray_offsets, background]
    _call([*inputs, *results, *gradients, *found[:4], of_background])
    if background is not None and of_background is not None:
        found[4] = of_background if background.dim() == 2 else of_background.sum(dim=0)
    return found


def _call(tensors: list[Tensor | None]) -> None:
    """Passes inputs, results and gradients in the order of csrc/bindings_composite.cpp."""
    kept = [None if tensor is None else tensor.contiguous() for tensor in tensors]
    sigma, rgb, ray_offsets, background, colour = kept[0], kept[1], kept[4], kept[5], kept[6]
    assert sigma is not None and rgb is not None and colour is not None
    s = 0 if ray_offsets is not None else sigma.shape[1]
    per_ray = background is not None and background.dim() == 2
    sizes = [colour.shape[0], s, sigma.numel(), rgb.shape[-1], int(per_ray)]
    addresses = [0 if tensor is None else tensor.data_ptr() for tensor in kept]
    _native._C.composite(addresses, sizes, _native._ISA, torch.get_num_threads())


def _allocate(sigma: Tensor, rgb: Tensor, ray_offsets: Tensor | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    rays = sigma.shape[0] if ray_offsets is None else ray_offsets.shape[0] - 1
    new = sigma.new_empty
    return new(rays, rgb.shape[-1]), new(rays), new(rays), new(sigma.shape)


def _allocate_gradients(
    gradients: Sequence[Tensor], sigma: Tensor, rgb: Tensor, depths: Tensor, deltas: Tensor, background: Tensor | None
) -> list[Tensor]:
    """Gradients of sigma, rgb, depths, deltas and background, the last empty if there is none."""
    shapes = [tensor.shape for tensor in (sigma, rgb, depths, deltas)]
    return [
        *(sigma.new_empty(shape) for shape in shapes),
        sigma.new_empty(0 if background is None else background.shape),
    ]


@_forward.register_fake
def _(
    sigma: Tensor,
    rgb: Tensor,
    depths: Tensor,
    deltas: Tensor,
    ray_offsets: Tensor | None,
    background: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return _allocate(sigma, rgb, ray_offsets)


@_backward.register_fake
def _(
    gradients: Sequence[Tensor],
    results: Sequence[Tensor],
    sigma: Tensor,
    rgb: Tensor,
    depths: Tensor,
    deltas: Tensor,
    ray_offsets: Tensor | None,
    background: Tensor | None,
) -> list[Tensor]:
    return _allocate_gradients(gradients, sigma, rgb, depths, deltas, background)


def _forward_setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    ctx.save_for_backward(*inputs, *output)


def _forward_backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
    inputs, results = ctx.saved_tensors[:6], ctx.saved_tensors[6:]
    *of_samples, of_background = _backward(list(gradients), list(results), *inputs)
    return (*of_samples, None, None if inputs[5] is None else of_background)


def _backward_setup(ctx: Any, inputs: tuple[Any, ...], output: list[Tensor]) -> None:
    gradients, _, *rest = inputs
    ctx.save_for_backward(*gradients, *rest)


def _backward_backward(ctx: Any, cotangents: list[Tensor]) -> tuple[Any, ...]:
    """Derivative of the gradients, through the reference formula."""
    saved = ctx.saved_tensors
    ray_offsets = saved[8]
    with torch.enable_grad():
        leaves = [
            None if tensor is None or tensor is ray_offsets else tensor.detach().requires_grad_() for tensor in saved
        ]
        gradients, inputs = leaves[:4], [*leaves[4:8], leaves[9]]
        results = _reference(*inputs[:4], ray_offsets=ray_offsets, background=inputs[4])  # type: ignore[arg-type]
        pairs = [(leaf, cotangent) for leaf, cotangent in zip(inputs, cotangents) if leaf is not None]
        firsts = torch.autograd.grad(
            results,
            [leaf for leaf, _ in pairs],
            gradients,
            create_graph=True,
            allow_unused=True,
            materialize_grads=True,
        )
        total = results[0].new_zeros(())
        for first, (_, cotangent) in zip(firsts, pairs):
            total = total + (first * cotangent).sum()
        present = [leaf for leaf in leaves if leaf is not None]
        found = iter(torch.autograd.grad(total, present, allow_unused=True))
    seconds = [None if leaf is None else next(found) for leaf in leaves]
    # The results are functions of the inputs, which the reference has followed; they get no gradient of their own.
    return (seconds[:4], [None] * 4, *seconds[4:8], None, seconds[9])


_forward.register_autograd(_forward_backward, setup_context=_forward_setup)
_backward.register_autograd(_backward_backward, setup_context=_backward_setup)
