"""``frequency_encode`` of the compiled module, and what the integrated encoding has in common with it.

n points, d features, L octaves. The arithmetic is float32; half types are cast on the way in and out. Second
derivatives come from the reference formulas.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import in_float32
from voronerf.ops._core.declare import declared
from voronerf.ops._core.memory import on_huge_pages
from voronerf.ops.frequency_encode import reference

_OP = declared("frequency_encode")
_inputs = _OP.inputs(native.compiled.Encoding, variances=None, width="w")


@_OP.custom_op("frequency_encode_native")
def _forward(given: Any, out: Tensor) -> None:
    encode(_inputs(given), out)


@_OP.backward_op("frequency_encode_native_backward", _forward, reference.frequency_encode)
def _backward(given: Any, arriving: Any, gradients: Any) -> None:
    encode_backward(_inputs(given), arriving.result, gradients.x, None)


frequency_encode = in_float32(_forward)


def encode(inputs: native.compiled.Encoding, out: Tensor) -> None:
    """Fills ``out`` with the frequency encoding or, with variances, the integrated one."""
    on_huge_pages(out)
    native.compiled.encode(inputs, out, *_where(inputs))


def encode_backward(
    inputs: native.compiled.Encoding, gradient: Tensor, of_x: Tensor | None, of_variances: Tensor | None
) -> None:
    """Fills the gradients to x and to the variances."""
    of_x, of_variances = (
        like.new_empty(like.shape) if part is None and like is not None else part
        for part, like in ((of_x, inputs.x), (of_variances, inputs.variances))
    )
    native.compiled.encode_backward(inputs, gradient, of_x, of_variances, *_where(inputs))


def _where(inputs: native.compiled.Encoding) -> tuple[Any, ...]:
    """On the CPU a workspace comes before the machine."""
    x: Any = inputs.x
    compiled, machine = native.compiled, native.machine(x)
    if isinstance(machine, compiled.Cuda):
        return (machine,)
    return x.new_empty(compiled.encode_workspace(inputs.d, inputs.octaves, machine)), machine
