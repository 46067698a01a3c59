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


@_OP.custom_op("frequency_encode_native")
def _forward(given: Any, out: Tensor) -> None:
    encode(out, given.x, None, given.octaves, given.include_input)


@_OP.backward_op("frequency_encode_native_backward", _forward, reference.frequency_encode)
def _backward(given: Any, arriving: Any, gradients: Any) -> None:
    encode_backward(arriving.result, gradients.x, None, given.x, None, given.octaves, given.include_input)


frequency_encode = in_float32(_forward)


def encode(out: Tensor, x: Tensor, variances: Tensor | None, octaves: int, include_input: bool) -> None:
    """Fills ``out`` with the frequency encoding or, with variances, the integrated one."""
    on_huge_pages(out)
    native.compiled.encode(_taken(out.shape[1], x, variances, octaves, include_input), out, *_where(x, octaves))


def encode_backward(
    gradient: Tensor,
    of_x: Tensor | None,
    of_variances: Tensor | None,
    x: Tensor,
    variances: Tensor | None,
    octaves: int,
    include_input: bool,
) -> None:
    """Fills the gradients to x and to the variances."""
    of_x, of_variances = (
        like.new_empty(like.shape) if part is None and like is not None else part
        for part, like in ((of_x, x), (of_variances, variances))
    )
    inputs = _taken(gradient.shape[1], x, variances, octaves, include_input)
    native.compiled.encode_backward(inputs, gradient, of_x, of_variances, *_where(x, octaves))


def _taken(width: int, x: Tensor, variances: Tensor | None, octaves: int, include_input: bool) -> Any:
    n, d = x.shape
    return native.compiled.Encoding(
        x=x, variances=variances, n=n, d=d, octaves=octaves, include_input=include_input, width=width
    )


def _where(x: Tensor, octaves: int) -> tuple[Any, ...]:
    """On the CPU a workspace comes before the machine."""
    compiled, machine = native.compiled, native.machine(x)
    if isinstance(machine, compiled.Cuda):
        return (machine,)
    return x.new_empty(compiled.encode_workspace(x.shape[1], octaves, machine)), machine
