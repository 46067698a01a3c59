"""The encodings of the compiled module: the frequency encoding and, with variances, the integrated one.

n points, d features, L octaves. The arithmetic is float32; half types are cast on the way in and out. Second
derivatives come from the reference formulas.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import custom_op, in_float32
from voronerf.ops._core.derivatives import OfOne
from voronerf.ops.frequency_encode.autograd import Encoding, register


def frequency_encode(x: Tensor, octaves: int, include_input: bool = True) -> Tensor:
    """``[x, sin x, cos x, sin 2x, cos 2x, sin 4x, ...]``; see ``voronerf.ops.frequency_encode``."""
    encoded: Tensor = in_float32(encode, Encoding(x, None, octaves, include_input))
    return encoded


@custom_op("encode_native")
def encode(given: Encoding) -> Iterator[Tensor]:
    """The frequency encoding or, with variances, the integrated one."""
    out = given.result()
    yield out
    native.on_huge_pages(out)
    compiled, machine = native.compiled, native.machine(out)
    inputs = _inputs(given)
    if isinstance(machine, compiled.Cuda):
        compiled.encode(inputs, out, machine)
    else:
        compiled.encode(inputs, out, _workspace(given, machine), machine)


@custom_op("encode_native_backward")
def _backward(arriving: OfOne, given: Encoding, wanted: Sequence[bool]) -> Iterator[list[Tensor]]:
    of_x, of_variances = results = given.gradients()
    yield results
    compiled, machine = native.compiled, native.machine(of_x)
    assert arriving.result is not None
    inputs = _inputs(given), arriving.result, of_x, None if given.variances is None else of_variances
    if isinstance(machine, compiled.Cuda):
        compiled.encode_backward(*inputs, machine)
    else:
        compiled.encode_backward(*inputs, _workspace(given, machine), machine)


def _inputs(given: Encoding) -> native.compiled.Encoding:
    n, d = given.x.shape
    return native.compiled.Encoding(
        x=given.x,
        variances=given.variances,
        n=n,
        d=d,
        octaves=given.octaves,
        include_input=given.include_input,
        width=d * (given.include_input + 2 * given.octaves),
    )


def _workspace(given: Encoding, machine: native.compiled.Cpu) -> Tensor:
    return given.x.new_empty(native.compiled.encode_workspace(given.x.shape[1], given.octaves, machine))


register(encode, _backward)
