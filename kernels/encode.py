"""The encodings as Warp kernels: ``frequency_encode`` and, with variances, ``integrated_encode``.

n points, d features, L octaves. A thread takes one feature of one point. Columns are ``[x,] sin x, cos x, sin 2x, ...``
with d of each. Backward, sines and cosines are computed again: they are each other's derivatives. The arithmetic
is float32; second derivatives come from the reference formulas.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from voronerf.kernels._launch import array, launch
from voronerf.ops.frequency_encode.autograd import (
    encode_backward_backward,
    encode_backward_setup,
    encode_gradients,
    encode_setup,
)

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _encode_kernel(
    x: wp.array2d(dtype=wp.float32),
    variances: wp.array2d(dtype=wp.float32),
    blurred: wp.bool,
    octaves: wp.int32,
    include_input: wp.bool,
    out: wp.array2d(dtype=wp.float32),
) -> None:
    i, j = wp.tid()
    d = x.shape[1]
    column = j
    if include_input:
        out[i, column] = x[i, j]
        column += d
    scale = wp.float32(1.0)
    for _ in range(octaves):
        angle = x[i, j] * scale
        blur = wp.float32(1.0)
        if blurred:
            blur = wp.exp(-0.5 * scale * scale * variances[i, j])
        out[i, column] = wp.sin(angle) * blur
        out[i, column + d] = wp.cos(angle) * blur
        column += 2 * d
        scale *= 2.0


@wp.kernel
def _encode_backward_kernel(
    gradient: wp.array2d(dtype=wp.float32),
    x: wp.array2d(dtype=wp.float32),
    variances: wp.array2d(dtype=wp.float32),
    blurred: wp.bool,
    octaves: wp.int32,
    include_input: wp.bool,
    grad_x: wp.array2d(dtype=wp.float32),
    grad_variances: wp.array2d(dtype=wp.float32),
) -> None:
    i, j = wp.tid()
    d = x.shape[1]
    column = j
    to_x = wp.float32(0.0)
    to_variance = wp.float32(0.0)
    if include_input:
        to_x = gradient[i, column]
        column += d
    scale = wp.float32(1.0)
    for _ in range(octaves):
        angle = x[i, j] * scale
        blur = wp.float32(1.0)
        if blurred:
            blur = wp.exp(-0.5 * scale * scale * variances[i, j])
        sine = wp.sin(angle) * blur
        cosine = wp.cos(angle) * blur
        to_x += scale * (gradient[i, column] * cosine - gradient[i, column + d] * sine)
        to_variance += -0.5 * scale * scale * (gradient[i, column] * sine + gradient[i, column + d] * cosine)
        column += 2 * d
        scale *= 2.0
    grad_x[i, j] = to_x
    if blurred:
        grad_variances[i, j] = to_variance


def frequency_encode(x: Tensor, octaves: int, *, include_input: bool = True) -> Tensor:
    """``[x, sin x, cos x, sin 2x, cos 2x, sin 4x, ...]``; see ``voronerf.ops.frequency_encode``."""
    encoded: Tensor = _encode(x.float(), None, octaves, include_input)
    return encoded.to(x.dtype)


def integrated_encode(means: Tensor, variances: Tensor, octaves: int) -> Tensor:
    """Expected encoding of a Gaussian; see ``voronerf.ops.integrated_encode``."""
    encoded: Tensor = _encode(means.float(), variances.float(), octaves, False)
    return encoded.to(means.dtype)


@torch.library.custom_op("voronerf::encode_warp", mutates_args=())
def _encode(x: Tensor, variances: Tensor | None, octaves: int, include_input: bool) -> Tensor:
    """The frequency encoding or, with variances, the integrated one."""
    out = _allocate(x, octaves, include_input)
    spread = x[:0] if variances is None else variances
    inputs = [array(x, x), array(spread, x), variances is not None, octaves, include_input, array(out, x)]
    launch(_encode_kernel, x.shape, inputs, x)
    return out


@torch.library.custom_op("voronerf::encode_warp_backward", mutates_args=())
def _encode_backward(
    gradient: Tensor, x: Tensor, variances: Tensor | None, octaves: int, include_input: bool
) -> list[Tensor]:
    """Gradients to x and to the variances, the second empty without them."""
    grad_x, grad_variances = results = _allocate_gradients(x, variances)
    spread = x[:0] if variances is None else variances
    to_spread = grad_x[:0] if variances is None else grad_variances
    given = [array(gradient, x), array(x, x), array(spread, x), variances is not None, octaves, include_input]
    launch(_encode_backward_kernel, x.shape, [*given, array(grad_x, x), array(to_spread, x)], x)
    return results


def _allocate(x: Tensor, octaves: int, include_input: bool) -> Tensor:
    return x.new_empty(x.shape[0], x.shape[1] * (include_input + 2 * octaves))


def _allocate_gradients(x: Tensor, variances: Tensor | None) -> list[Tensor]:
    return [x.new_empty(x.shape), x.new_empty(0 if variances is None else variances.shape)]


@_encode.register_fake
def _(x: Tensor, variances: Tensor | None, octaves: int, include_input: bool) -> Tensor:
    return _allocate(x, octaves, include_input)


@_encode_backward.register_fake
def _(gradient: Tensor, x: Tensor, variances: Tensor | None, octaves: int, include_input: bool) -> list[Tensor]:
    return _allocate_gradients(x, variances)


_encode.register_autograd(encode_gradients(_encode_backward), setup_context=encode_setup)
_encode_backward.register_autograd(encode_backward_backward, setup_context=encode_backward_setup)
