"""Volume rendering of the compiled module as PyTorch ops.

r rays, s samples of a ray, m samples of all rays (packed), c channels. A custom op each way, functional both: they make
inputs contiguous, allocate outputs, and pass addresses. The arithmetic is float32; half types are cast on the way in
and out. Second derivatives come from the reference formula. Shapes and dtypes have been validated by ``voronerf.ops``.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from voronerf import native as _native
from voronerf.derivatives import (
    composite_backward_backward,
    composite_backward_setup,
    composite_forward_backward,
    composite_forward_setup,
)
from voronerf.reference.composite import Composite


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
    """r, s, m, c and whether the background is per ray, as csrc/bindings/bindings_composite.cpp reads them."""
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


_forward.register_autograd(composite_forward_backward(_backward), setup_context=composite_forward_setup)
_backward.register_autograd(composite_backward_backward, setup_context=composite_backward_setup)
