"""The encodings as Warp kernels: ``frequency_encode`` and, with variances, ``integrated_encode``.

n points, d features, L octaves. A thread takes one feature of one point. Columns are ``[x,] sin x, cos x, sin 2x, ...``
with d of each. Backward, sines and cosines are computed again: they are each other's derivatives. The arithmetic
is float32; second derivatives come from the reference formulas.
"""

from __future__ import annotations

from typing import Any

import warp as wp
from torch import Tensor

from voronerf.kernels._launch import array, launch
from voronerf.ops._core.custom_op import in_float32
from voronerf.ops._core.declare import declared
from voronerf.ops.frequency_encode import reference
from voronerf.ops.integrated_encode import reference as integrated

wp.set_module_options({"enable_backward": False})
_FREQUENCY, _INTEGRATED = declared("frequency_encode"), declared("integrated_encode")


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


@_FREQUENCY.custom_op("frequency_encode_warp")
def _frequency(given: Any, out: Tensor) -> None:
    inputs = _inputs(given.x, None, given.octaves, given.include_input)
    launch(_encode_kernel, given.x.shape, [*inputs, array(out, out)], out)


@_FREQUENCY.backward_op("frequency_encode_warp_backward", _frequency, reference.frequency_encode)
def _frequency_backward(given: Any, arriving: Any, gradients: Any) -> None:
    _fill_gradients(arriving.result, gradients.x, None, _inputs(given.x, None, given.octaves, given.include_input))


@_INTEGRATED.custom_op("integrated_encode_warp")
def _integrated(given: Any, out: Tensor) -> None:
    inputs = _inputs(given.means, given.variances, given.octaves, False)
    launch(_encode_kernel, given.means.shape, [*inputs, array(out, out)], out)


@_INTEGRATED.backward_op("integrated_encode_warp_backward", _integrated, integrated.integrated_encode)
def _integrated_backward(given: Any, arriving: Any, gradients: Any) -> None:
    of_means, of_variances = (given.means.new_empty(given.means.shape) if part is None else part for part in gradients)
    inputs = _inputs(given.means, given.variances, given.octaves, False)
    _fill_gradients(arriving.result, of_means, of_variances, inputs)


def _fill_gradients(gradient: Tensor, of_x: Tensor, of_variances: Tensor | None, inputs: list[object]) -> None:
    to_spread = of_x[:0] if of_variances is None else of_variances
    launched = [array(gradient, of_x), *inputs, array(of_x, of_x), array(to_spread, of_x)]
    launch(_encode_backward_kernel, of_x.shape, launched, of_x)


def _inputs(x: Tensor, variances: Tensor | None, octaves: int, include_input: bool) -> list[object]:
    spread = array(x[:0] if variances is None else variances, x)
    return [array(x, x), spread, variances is not None, octaves, include_input]


frequency_encode, integrated_encode = in_float32(_frequency), in_float32(_integrated)
