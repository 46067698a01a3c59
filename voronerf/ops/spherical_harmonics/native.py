"""``spherical_harmonics`` of the compiled module. n directions.

The arithmetic is float32; half types are cast on the way in and out. Second derivatives come from the reference
formula.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import in_float32
from voronerf.ops._core.declare import declared
from voronerf.ops._core.memory import on_huge_pages
from voronerf.ops.spherical_harmonics import reference

_OP = declared("spherical_harmonics")


@_OP.custom_op("spherical_harmonics_native")
def _forward(given: Any, out: Tensor) -> None:
    on_huge_pages(out)
    native.compiled.spherical_harmonics(given.directions, out, given.n, given.degree, native.machine(out))


@_OP.backward_op("spherical_harmonics_native_backward", _forward, reference.spherical_harmonics)
def _backward(given: Any, arriving: Any, gradients: Any) -> None:
    inputs = given.directions, arriving.result, gradients.directions, given.n, given.degree
    native.compiled.spherical_harmonics_backward(*inputs, native.machine(gradients.directions))


spherical_harmonics = in_float32(_forward)
