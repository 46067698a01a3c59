"""``spherical_harmonics`` of the compiled module. n directions.

The arithmetic is float32; half types are cast on the way in and out. Second derivatives come from the reference
formula.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import custom_op, in_float32
from voronerf.ops._core.derivatives import OfOne
from voronerf.ops.spherical_harmonics.autograd import Harmonics, register


def spherical_harmonics(directions: Tensor, degree: int) -> Tensor:
    """Bands 0 to degree - 1; see ``voronerf.ops.spherical_harmonics``."""
    encoded: Tensor = in_float32(_forward, Harmonics(directions, degree))
    return encoded


@custom_op("spherical_harmonics_native")
def _forward(given: Harmonics) -> Iterator[Tensor]:
    directions, degree = given
    out = directions.new_empty(directions.shape[0], degree**2)
    yield out
    native.on_huge_pages(out)
    native.compiled.spherical_harmonics(directions, out, directions.shape[0], degree, native.machine(out))


@custom_op("spherical_harmonics_native_backward")
def _backward(arriving: OfOne, given: Harmonics, wanted: Sequence[bool]) -> Iterator[list[Tensor]]:
    directions, degree = given
    found = directions.new_empty(directions.shape)
    yield [found]
    assert arriving.result is not None
    inputs = directions, arriving.result, found, directions.shape[0], degree
    native.compiled.spherical_harmonics_backward(*inputs, native.machine(found))


register(_forward, _backward)
