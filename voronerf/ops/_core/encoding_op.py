"""Ops of the compiled module that are an encoding without parameters.

The arithmetic is float32; half types are cast on the way in and out. Second derivatives come from the reference.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import in_float32
from voronerf.ops._core.declare import declared
from voronerf.ops._core.memory import on_huge_pages


def encoding_op(
    op: str, encoding: str, formula: Callable[..., Tensor], inputs: Callable[[Any], tuple[Any, ...]]
) -> Callable[..., Any]:
    """Makes the implementation of an op that computes an encoding, and its gradients.

    Args:
        op: name of the op, whose smooth arguments are x and, if there are any, the variances.
        encoding: name of the row of ``ENCODINGS``.
        formula: the reference of the op.
        inputs: gives x and the members of ``Encoding`` behind it (csrc/encoding/encode.h), of the op's arguments.
    """
    declaration = declared(op)

    @declaration.custom_op(f"{op}_native")
    def forward(given: Any, out: Tensor) -> None:
        on_huge_pages(out)
        taken = native.compiled.Encoding(encoding, *out.shape, *inputs(given))
        native.compiled.encode(taken, out, native.machine(out))

    @declaration.backward_op(f"{op}_native_backward", forward, formula)
    def backward(given: Any, arriving: Any, gradients: Any) -> None:
        gradient = arriving.result
        taken = native.compiled.Encoding(encoding, *gradient.shape, *inputs(given))
        of_x, of_variances = (*gradients, None)[:2]
        native.compiled.encode_backward(taken, gradient, of_x, of_variances, native.machine(gradient))

    return in_float32(forward)
