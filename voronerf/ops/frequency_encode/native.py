"""The encodings of the compiled module: the frequency encoding and, with variances, the integrated one.

n points, d features, L octaves. The arithmetic is float32; half types are cast on the way in and out. Second
derivatives come from the reference formulas.
"""

from __future__ import annotations

from collections.abc import Iterator

from torch import Tensor

from voronerf import native
from voronerf.native.custom_op import custom_op, on_huge_pages
from voronerf.ops.frequency_encode.autograd import (
    encode_backward_backward,
    encode_backward_setup,
    encode_gradients,
    encode_setup,
)


def frequency_encode(x: Tensor, octaves: int, *, include_input: bool = True) -> Tensor:
    """``[x, sin x, cos x, sin 2x, cos 2x, sin 4x, ...]``; see ``voronerf.ops.frequency_encode``."""
    encoded: Tensor = encode(x.float(), None, octaves, include_input)
    return encoded.to(x.dtype)


@custom_op("encode_native")
def encode(x: Tensor, variances: Tensor | None, octaves: int, include_input: bool) -> Iterator[Tensor]:
    """The frequency encoding or, with variances, the integrated one."""
    out = x.new_empty(x.shape[0], x.shape[1] * (include_input + 2 * octaves))
    yield out
    on_huge_pages(out)
    compiled, machine = native.compiled, native.machine(x)
    given = _encoding(x, variances, octaves, include_input)
    if isinstance(machine, compiled.Cuda):
        compiled.encode(given, out, machine)
    else:
        compiled.encode(given, out, _workspace(x, octaves, machine), machine)


@custom_op("encode_native_backward")
def _backward(
    gradient: Tensor, x: Tensor, variances: Tensor | None, octaves: int, include_input: bool
) -> Iterator[list[Tensor]]:
    """Gradients to x and to the variances, the second empty without them."""
    of_x, of_variances = x.new_empty(x.shape), x.new_empty(0 if variances is None else variances.shape)
    yield [of_x, of_variances]
    compiled, machine = native.compiled, native.machine(x)
    given = _encoding(x, variances, octaves, include_input)
    results = of_x, None if variances is None else of_variances
    if isinstance(machine, compiled.Cuda):
        compiled.encode_backward(given, gradient, *results, machine)
    else:
        compiled.encode_backward(given, gradient, *results, _workspace(x, octaves, machine), machine)


def _encoding(x: Tensor, variances: Tensor | None, octaves: int, include_input: bool) -> native.compiled.Encoding:
    n, d = x.shape
    return native.compiled.Encoding(
        x=x,
        variances=variances,
        n=n,
        d=d,
        octaves=octaves,
        include_input=include_input,
        width=d * (include_input + 2 * octaves),
    )


def _workspace(x: Tensor, octaves: int, machine: native.compiled.Cpu) -> Tensor:
    return x.new_empty(native.compiled.encode_workspace(x.shape[1], octaves, machine))


encode.register_autograd(encode_gradients(_backward), setup_context=encode_setup)
_backward.register_autograd(encode_backward_backward, setup_context=encode_backward_setup)
