"""``frequency_encode`` as Warp kernels. n points, d features, L octaves.

One thread handles one feature of one point. Columns are ``[x,] sin x, cos x, sin 2x, ...``, d columns each. The
backward pass recomputes sines and cosines, which are each other's derivatives. The arithmetic is float32; second
derivatives come from the reference formula.
"""

from __future__ import annotations

from typing import Any

import warp as wp
from torch import Tensor

from voronerf.kernels._launch import array, launch
from voronerf.ops._core.custom_op import in_float32
from voronerf.ops._core.declare import declared
from voronerf.ops.frequency_encode import reference

wp.set_module_options({"enable_backward": False})
_OP = declared("frequency_encode")


@wp.kernel
def _encode_kernel(
    x: wp.array2d(dtype=wp.float32),
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
        out[i, column] = wp.sin(x[i, j] * scale)
        out[i, column + d] = wp.cos(x[i, j] * scale)
        column += 2 * d
        scale *= 2.0


@wp.kernel
def _encode_backward_kernel(
    gradient: wp.array2d(dtype=wp.float32),
    x: wp.array2d(dtype=wp.float32),
    octaves: wp.int32,
    include_input: wp.bool,
    of_x: wp.array2d(dtype=wp.float32),
) -> None:
    i, j = wp.tid()
    d = x.shape[1]
    column = j
    total = wp.float32(0.0)
    if include_input:
        total = gradient[i, column]
        column += d
    scale = wp.float32(1.0)
    for _ in range(octaves):
        angle = x[i, j] * scale
        total += scale * (gradient[i, column] * wp.cos(angle) - gradient[i, column + d] * wp.sin(angle))
        column += 2 * d
        scale *= 2.0
    of_x[i, j] = total


@_OP.custom_op("frequency_encode_warp")
def _forward(arguments: Any, out: Tensor) -> None:
    inputs = [array(arguments.x, out), arguments.octaves, arguments.include_input, array(out, out)]
    launch(_encode_kernel, arguments.x.shape, inputs, out)


@_OP.backward_op("frequency_encode_warp_backward", _forward, reference.frequency_encode)
def _backward(arguments: Any, arriving: Any, gradients: Any) -> None:
    of_x = gradients.x
    rest = [array(arguments.x, of_x), arguments.octaves, arguments.include_input, array(of_x, of_x)]
    launch(_encode_backward_kernel, arguments.x.shape, [array(arriving.result, of_x), *rest], of_x)


frequency_encode = in_float32(_forward)
