"""Native ops that compute an encoding without parameters.

The arithmetic is float32; inputs and outputs of half types are cast. Second derivatives come from the reference.
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
    """Makes the native implementation, with gradients, of an op that computes an encoding.

    Args:
        op: the name of the op; its smooth arguments are x and optionally the variances.
        encoding: the encoding's name in ``ENCODINGS``.
        formula: the reference of the op.
        inputs: a function from the op's arguments to x and the members after it in ``Encoding``
            (csrc/encoding/encode.h).
    """
    declaration = declared(op)

    @declaration.custom_op(f"{op}_native")
    def forward(arguments: Any, out: Tensor) -> None:
        on_huge_pages(out)
        spec = native.compiled.Encoding(encoding, *out.shape, *inputs(arguments))
        native.compiled.encode(spec, out, native.machine(out))

    @declaration.backward_op(f"{op}_native_backward", forward, formula)
    def backward(arguments: Any, arriving: Any, gradients: Any) -> None:
        gradient = arriving.result
        spec = native.compiled.Encoding(encoding, *gradient.shape, *inputs(arguments))
        of_x, of_variances = (*gradients, None)[:2]
        native.compiled.encode_backward(spec, gradient, of_x, of_variances, native.machine(gradient))

    return in_float32(forward)
