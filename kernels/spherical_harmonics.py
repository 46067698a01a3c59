"""``spherical_harmonics`` as Warp kernels. n directions, one thread each.

The arithmetic is float32; second derivatives come from the reference formula.
"""

from __future__ import annotations

from typing import Any

import warp as wp
from torch import Tensor

from voronerf.kernels._launch import array, launch
from voronerf.ops._core.custom_op import in_float32
from voronerf.ops._core.declare import declared
from voronerf.ops.spherical_harmonics import reference

wp.set_module_options({"enable_backward": False})
_OP = declared("spherical_harmonics")


@wp.kernel
def _harmonics_kernel(
    directions: wp.array2d(dtype=wp.float32), degree: wp.int32, out: wp.array2d(dtype=wp.float32)
) -> None:
    i = wp.tid()
    x = directions[i, 0]
    y = directions[i, 1]
    z = directions[i, 2]
    out[i, 0] = 0.28209479177387814
    if degree > 1:
        out[i, 1] = -0.48860251190291987 * y
        out[i, 2] = 0.48860251190291987 * z
        out[i, 3] = -0.48860251190291987 * x
    if degree > 2:
        out[i, 4] = 1.0925484305920792 * x * y
        out[i, 5] = -1.0925484305920792 * y * z
        out[i, 6] = 0.94617469575755997 * z * z - 0.31539156525251999
        out[i, 7] = -1.0925484305920792 * x * z
        out[i, 8] = 0.54627421529603959 * (x * x - y * y)
    if degree > 3:
        out[i, 9] = 0.59004358992664352 * y * (y * y - 3.0 * x * x)
        out[i, 10] = 2.8906114426405538 * x * y * z
        out[i, 11] = 0.45704579946446572 * y * (1.0 - 5.0 * z * z)
        out[i, 12] = 0.3731763325901154 * z * (5.0 * z * z - 3.0)
        out[i, 13] = 0.45704579946446572 * x * (1.0 - 5.0 * z * z)
        out[i, 14] = 1.4453057213202769 * z * (x * x - y * y)
        out[i, 15] = 0.59004358992664352 * x * (3.0 * y * y - x * x)


@wp.kernel
def _harmonics_backward_kernel(
    gradient: wp.array2d(dtype=wp.float32),
    directions: wp.array2d(dtype=wp.float32),
    degree: wp.int32,
    of_x: wp.array2d(dtype=wp.float32),
) -> None:
    i = wp.tid()
    x = directions[i, 0]
    y = directions[i, 1]
    z = directions[i, 2]
    to_x = wp.float32(0.0)
    to_y = wp.float32(0.0)
    to_z = wp.float32(0.0)
    if degree > 1:
        to_x = -0.48860251190291987 * gradient[i, 3]
        to_y = -0.48860251190291987 * gradient[i, 1]
        to_z = 0.48860251190291987 * gradient[i, 2]
    if degree > 2:
        c = 1.0925484305920792
        to_x += c * (y * gradient[i, 4] - z * gradient[i, 7] + x * gradient[i, 8])
        to_y += c * (x * gradient[i, 4] - z * gradient[i, 5] - y * gradient[i, 8])
        to_z += 1.8923493915151199 * z * gradient[i, 6] - c * (y * gradient[i, 5] + x * gradient[i, 7])
    if degree > 3:
        a = 1.7701307697799306
        b = 2.8906114426405538
        d = x * x - y * y
        e = 0.45704579946446572 * (1.0 - 5.0 * z * z)
        to_x += -2.0 * a * x * y * gradient[i, 9] + b * y * z * gradient[i, 10] + e * gradient[i, 13]
        to_x += b * x * z * gradient[i, 14] - a * d * gradient[i, 15]
        to_y += -a * d * gradient[i, 9] + b * x * z * gradient[i, 10] + e * gradient[i, 11]
        to_y += -b * y * z * gradient[i, 14] + 2.0 * a * x * y * gradient[i, 15]
        to_z += b * x * y * gradient[i, 10] - 4.5704579946446572 * z * (y * gradient[i, 11] + x * gradient[i, 13])
        to_z += 1.1195289977703462 * (5.0 * z * z - 1.0) * gradient[i, 12] + 0.5 * b * d * gradient[i, 14]
    of_x[i, 0] = to_x
    of_x[i, 1] = to_y
    of_x[i, 2] = to_z


@_OP.custom_op("spherical_harmonics_warp")
def _forward(arguments: Any, out: Tensor) -> None:
    launch(_harmonics_kernel, arguments.n, [array(arguments.directions, out), arguments.degree, array(out, out)], out)


@_OP.backward_op("spherical_harmonics_warp_backward", _forward, reference.spherical_harmonics)
def _backward(arguments: Any, arriving: Any, gradients: Any) -> None:
    of_x, directions = gradients.directions, arguments.directions
    inputs = [array(arriving.result, of_x), array(directions, of_x), arguments.degree, array(of_x, of_x)]
    launch(_harmonics_backward_kernel, arguments.n, inputs, of_x)


spherical_harmonics = in_float32(_forward)
