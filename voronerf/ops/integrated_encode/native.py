"""``integrated_encode`` of the compiled module."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from voronerf.ops._core.custom_op import in_float32
from voronerf.ops._core.declare import declared
from voronerf.ops.frequency_encode.native import encode, encode_backward
from voronerf.ops.integrated_encode import reference

_OP = declared("integrated_encode")


@_OP.custom_op("integrated_encode_native")
def _forward(given: Any, out: Tensor) -> None:
    encode(out, given.means, given.variances, given.octaves, False)


@_OP.backward_op("integrated_encode_native_backward", _forward, reference.integrated_encode)
def _backward(given: Any, arriving: Any, gradients: Any) -> None:
    x, variances, octaves = given
    encode_backward(arriving.result, gradients.means, gradients.variances, x, variances, octaves, False)


integrated_encode = in_float32(_forward)
