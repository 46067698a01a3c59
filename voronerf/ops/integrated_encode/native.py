"""``integrated_encode`` of the compiled module."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import in_float32
from voronerf.ops._core.declare import declared
from voronerf.ops.frequency_encode.native import encode, encode_backward
from voronerf.ops.integrated_encode import reference

_OP = declared("integrated_encode")
_inputs = _OP.inputs(native.compiled.Encoding, x="means", d=3, include_input=False, width="w")


@_OP.custom_op("integrated_encode_native")
def _forward(given: Any, out: Tensor) -> None:
    encode(_inputs(given), out)


@_OP.backward_op("integrated_encode_native_backward", _forward, reference.integrated_encode)
def _backward(given: Any, arriving: Any, gradients: Any) -> None:
    encode_backward(_inputs(given), arriving.result, gradients.means, gradients.variances)


integrated_encode = in_float32(_forward)
