"""``spherical_harmonics`` of the compiled module. n directions.

The arithmetic is float32; half types are cast on the way in and out. Second derivatives come from the reference
formula.
"""

from __future__ import annotations

from collections.abc import Iterator

from torch import Tensor

from voronerf import native
from voronerf.native.custom_op import custom_op, on_huge_pages
from voronerf.ops.spherical_harmonics.autograd import (
    harmonics_backward_backward,
    harmonics_backward_setup,
    harmonics_gradient,
    harmonics_setup,
)


def spherical_harmonics(directions: Tensor, degree: int) -> Tensor:
    """Bands 0 to degree - 1; see ``voronerf.ops.spherical_harmonics``."""
    encoded: Tensor = _forward(directions.float(), degree)
    return encoded.to(directions.dtype)


@custom_op("spherical_harmonics_native")
def _forward(directions: Tensor, degree: int) -> Iterator[Tensor]:
    n = directions.shape[0]
    out = directions.new_empty(n, degree**2)
    yield out
    on_huge_pages(out)
    native.compiled.spherical_harmonics(directions, out, n, degree, native.machine(directions))


@custom_op("spherical_harmonics_native_backward")
def _backward(gradient: Tensor, directions: Tensor, degree: int) -> Iterator[Tensor]:
    n = directions.shape[0]
    found = directions.new_empty(n, 3)
    yield found
    native.compiled.spherical_harmonics_backward(directions, gradient, found, n, degree, native.machine(directions))


_forward.register_autograd(harmonics_gradient(_backward), setup_context=harmonics_setup)
_backward.register_autograd(harmonics_backward_backward, setup_context=harmonics_backward_setup)
