"""``composite`` of the compiled module, and its gradients.

r rays, s samples of a ray, m samples of all rays (packed), c channels. The arithmetic is float32; half types are cast
on the way in and out. Second derivatives come from the reference formula.
"""

from __future__ import annotations

from typing import Any

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import in_float32
from voronerf.ops._core.declare import declared
from voronerf.ops._core.rows import new_empty, rows_of
from voronerf.ops.composite import reference

_OP = declared("composite")


def _samples(given: Any) -> int:
    return given.sigma.numel() if given.ray_offsets is None else rows_of(given.sigma)


_inputs = _OP.inputs(native.compiled.CompositeInputs, offsets="ray_offsets", m=_samples)
_outputs = _OP.outputs(native.compiled.CompositeOutputs)
_forward = _OP.compiled_op("composite_native", "composite", _inputs, _outputs)


@_OP.backward_op("composite_native_backward", _forward, reference.composite)
def _backward(given: Any, arriving: Any, gradients: Any) -> None:
    sigma = given.sigma
    if gradients.sigma is None:  # which kernels write in any case
        gradients = gradients._replace(sigma=new_empty(sigma, rows_of(sigma), *sigma.shape[1:]))
    left = None if given.background is None else new_empty(sigma, given.r)
    found = native.compiled.CompositeGradients(**arriving._asdict(), **gradients._asdict(), left=left)
    native.compiled.composite_backward(_inputs(given), found, native.machine(sigma))


composite = in_float32(_forward)
