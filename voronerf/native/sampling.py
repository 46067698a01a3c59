"""Drawing and encoding samples with the compiled module, as PyTorch ops: ``frequency_encode``, ``integrated_encode``,
``resample``, ``draw_cell``.

n points, d features, L octaves, r rays, s bins of a ray, m centres of all diagrams of a tree. The ops are functional:
they make inputs contiguous, allocate outputs and workspace, and pass addresses. The arithmetic is float32; half types
are cast on the way in and out. Second derivatives come from the reference formulas. Shapes and dtypes have been
validated by ``voronerf.ops``.
"""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf import native as _native
from voronerf.derivatives import (
    encode_backward_backward,
    encode_backward_setup,
    encode_gradients,
    encode_setup,
)


def frequency_encode(x: Tensor, octaves: int, *, include_input: bool = True) -> Tensor:
    """``[x, sin x, cos x, sin 2x, cos 2x, sin 4x, ...]``; see ``voronerf.ops.frequency_encode``."""
    encoded: Tensor = _encode(x.float(), None, octaves, include_input)
    return encoded.to(x.dtype)


def integrated_encode(means: Tensor, variances: Tensor, octaves: int) -> Tensor:
    """Expected encoding of a Gaussian; see ``voronerf.ops.integrated_encode``."""
    encoded: Tensor = _encode(means.float(), variances.float(), octaves, False)
    return encoded.to(means.dtype)


def resample(weights: Tensor, edges: Tensor, count: int, *, uniforms: Tensor | None = None) -> Tensor:
    """Depths drawn in proportion to the weights of the bins; see ``voronerf.ops.resample``."""
    if uniforms is not None:
        uniforms = uniforms.detach().float()
    depths: Tensor = _resample(weights.detach().float(), edges.detach().float(), count, uniforms)
    return depths.to(edges.dtype)


def draw_cell(
    points: Tensor,
    centres: Tensor,
    child_offsets: Tensor,
    child: Tensor,
    uniforms: Tensor,
    *,
    temperature: float,
    depth: int,
    weights: Tensor | None = None,
) -> Tensor:
    """A leaf for every point, drawn from its distances; see ``voronerf.ops.draw_cell``."""
    leaves: Tensor = _draw_cell(points, centres, child_offsets, child, uniforms, temperature, depth, weights)
    return leaves


@torch.library.custom_op("voronerf::encode_native", mutates_args=(), device_types=("cpu", "cuda"))
def _encode(x: Tensor, variances: Tensor | None, octaves: int, include_input: bool) -> Tensor:
    """The frequency encoding or, with variances, the integrated one."""
    out = _native.fresh(_allocate(x, octaves, include_input))
    kept = [x.contiguous(), None if variances is None else variances.contiguous()]
    addresses = [_address(tensor) for tensor in (*kept, out)]
    if _native.on_cuda(x):
        _native._C.encode_cuda(*addresses, *x.shape, octaves, include_input, *_native.stream(x))
    else:
        workspace = _workspace(x, octaves)
        _native._C.encode(*addresses, workspace.data_ptr(), *_rest(x, octaves, include_input))
    return out


@torch.library.custom_op("voronerf::encode_native_backward", mutates_args=(), device_types=("cpu", "cuda"))
def _encode_backward(
    gradient: Tensor, x: Tensor, variances: Tensor | None, octaves: int, include_input: bool
) -> list[Tensor]:
    """Gradients to x and to the variances, the second empty without them."""
    results = _allocate_gradients(x, variances)
    kept = [gradient.contiguous(), x.contiguous(), None if variances is None else variances.contiguous()]
    addresses = [_address(tensor) for tensor in (*kept, *results)]
    if _native.on_cuda(x):
        _native._C.encode_backward_cuda(*addresses, *x.shape, octaves, include_input, *_native.stream(x))
    else:
        workspace = _workspace(x, octaves)
        _native._C.encode_backward(*addresses, workspace.data_ptr(), *_rest(x, octaves, include_input))
    return results


@torch.library.custom_op("voronerf::resample_native", mutates_args=(), device_types=("cpu", "cuda"))
def _resample(weights: Tensor, edges: Tensor, count: int, uniforms: Tensor | None) -> Tensor:
    depths = _allocate_depths(edges, count)
    kept = [weights.contiguous(), edges.contiguous(), None if uniforms is None else uniforms.contiguous()]
    addresses = [_address(tensor) for tensor in (*kept, depths)]
    if _native.on_cuda(weights):
        workspace = weights.new_empty(weights.shape, dtype=torch.float64)
        _native._C.resample_cuda(*addresses, workspace.data_ptr(), *weights.shape, count, *_native.stream(weights))
    else:
        _native._C.resample(*addresses, *weights.shape, count, torch.get_num_threads())
    return depths


@torch.library.custom_op("voronerf::draw_cell", mutates_args=(), device_types=("cpu", "cuda"))
def _draw_cell(
    points: Tensor,
    centres: Tensor,
    child_offsets: Tensor,
    child: Tensor,
    uniforms: Tensor,
    temperature: float,
    depth: int,
    weights: Tensor | None,
) -> Tensor:
    given = (points, centres, weights, child_offsets, child, uniforms)
    kept = [None if tensor is None else tensor.contiguous() for tensor in given]
    n, m, g = points.shape[0], centres.shape[0], child_offsets.shape[0] - 1
    leaves = points.new_empty(n, dtype=torch.int32)
    if _native.on_cuda(points):
        addresses = [_address(tensor) for tensor in (*kept, leaves)]
        _native._C.draw_cell_cuda(*addresses, n, m, g, depth, temperature, *_native.stream(points))
        return leaves
    fault = _native._C.locate_cell_fault(_address(kept[3]), _address(kept[4]), g, m)
    if fault is not None:
        raise ValueError(f"draw_cell: {fault}")
    threads = torch.get_num_threads()
    places = child.new_empty(_native._C.draw_cell_places(m, threads))
    sums = points.new_empty(_native._C.draw_cell_sums(m, threads))
    addresses = [_address(tensor) for tensor in (*kept, leaves, places, sums)]
    if not _native._C.draw_cell(*addresses, n, m, depth, temperature, _native._ISA, threads):
        raise ValueError(f"draw_cell: depth must be the number of levels of the tree, got {depth}, which is too few")
    return leaves


def _workspace(x: Tensor, octaves: int) -> Tensor:
    return x.new_empty(_native._C.encode_workspace(x.shape[1], octaves, torch.get_num_threads()))


def _rest(x: Tensor, octaves: int, include_input: bool) -> tuple[int, ...]:
    """What follows the addresses in csrc/bindings/bindings_sampling.cpp."""
    return *x.shape, octaves, include_input, _native._ISA, torch.get_num_threads()


def _address(tensor: Tensor | None) -> int:
    return 0 if tensor is None else tensor.data_ptr()


def _allocate(x: Tensor, octaves: int, include_input: bool) -> Tensor:
    return x.new_empty(x.shape[0], x.shape[1] * (include_input + 2 * octaves))


def _allocate_gradients(x: Tensor, variances: Tensor | None) -> list[Tensor]:
    return [x.new_empty(x.shape), x.new_empty(0 if variances is None else variances.shape)]


def _allocate_depths(edges: Tensor, count: int) -> Tensor:
    return edges.new_empty(edges.shape[0], count)


@_encode.register_fake
def _(x: Tensor, variances: Tensor | None, octaves: int, include_input: bool) -> Tensor:
    return _allocate(x, octaves, include_input)


@_encode_backward.register_fake
def _(gradient: Tensor, x: Tensor, variances: Tensor | None, octaves: int, include_input: bool) -> list[Tensor]:
    return _allocate_gradients(x, variances)


@_resample.register_fake
def _(weights: Tensor, edges: Tensor, count: int, uniforms: Tensor | None) -> Tensor:
    return _allocate_depths(edges, count)


@_draw_cell.register_fake
def _(
    points: Tensor,
    centres: Tensor,
    child_offsets: Tensor,
    child: Tensor,
    uniforms: Tensor,
    temperature: float,
    depth: int,
    weights: Tensor | None,
) -> Tensor:
    return points.new_empty(points.shape[0], dtype=torch.int32)


_encode.register_autograd(encode_gradients(_encode_backward), setup_context=encode_setup)
_encode_backward.register_autograd(encode_backward_backward, setup_context=encode_backward_setup)
