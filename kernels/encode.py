"""The encodings as Warp kernels: ``frequency_encode`` and, with variances, ``integrated_encode``.

n points, d features, L octaves. A thread takes one feature of one point. Columns are ``[x,] sin x, cos x, sin 2x, ...``
with d of each. Backward, sines and cosines are computed again: they are each other's derivatives. The arithmetic
is float32; second derivatives come from the reference formulas.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import warp as wp
from torch import Tensor

from voronerf.kernels._launch import array, launch
from voronerf.ops._core.custom_op import custom_op, in_float32
from voronerf.ops._core.derivatives import OfOne
from voronerf.ops.frequency_encode.autograd import Encoding, register

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


def frequency_encode(x: Tensor, octaves: int, include_input: bool = True) -> Tensor:
    """``[x, sin x, cos x, sin 2x, cos 2x, sin 4x, ...]``; see ``voronerf.ops.frequency_encode``."""
    encoded: Tensor = in_float32(_encode, Encoding(x, None, octaves, include_input))
    return encoded


def integrated_encode(means: Tensor, variances: Tensor, octaves: int) -> Tensor:
    """Expected encoding of a Gaussian; see ``voronerf.ops.integrated_encode``."""
    encoded: Tensor = in_float32(_encode, Encoding(means, variances, octaves, False))
    return encoded


@custom_op("encode_warp")
def _encode(given: Encoding) -> Iterator[Tensor]:
    out = given.result()
    yield out
    launch(_encode_kernel, given.x.shape, [*_inputs(given), array(out, out)], out)


@custom_op("encode_warp_backward")
def _backward(arriving: OfOne, given: Encoding, wanted: Sequence[bool]) -> Iterator[list[Tensor]]:
    of_x, of_variances = results = given.gradients()
    yield results
    to_spread = of_x[:0] if given.variances is None else of_variances
    inputs = [array(arriving.result, of_x), *_inputs(given), array(of_x, of_x), array(to_spread, of_x)]
    launch(_encode_backward_kernel, given.x.shape, inputs, of_x)


def _inputs(given: Encoding) -> list[object]:
    x, variances = given.x, given.variances
    spread = array(x[:0] if variances is None else variances, x)
    return [array(x, x), spread, variances is not None, given.octaves, given.include_input]


register(_encode, _backward)
