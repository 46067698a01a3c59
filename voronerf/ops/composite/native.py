"""``composite`` of the compiled module, and its gradients.

r rays, s samples of a ray, m samples of all rays (packed), c channels. The arithmetic is float32; half-precision types
are cast to and from float32. Second derivatives come from the reference formula.
"""

from __future__ import annotations

from typing import Any

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import in_float32
from voronerf.ops._core.declare import declared
from voronerf.ops._core.rows import new_empty, rows_of
from voronerf.ops.composite import reference

_OP = declared("composite")


def _samples(arguments: Any) -> int:
    return arguments.sigma.numel() if arguments.ray_offsets is None else rows_of(arguments.sigma)


_inputs = _OP.inputs(native.compiled.CompositeInputs, offsets="ray_offsets", m=_samples)
_outputs = _OP.outputs(native.compiled.CompositeOutputs)
_forward = _OP.compiled_op("composite_native", "composite", _inputs, _outputs)


@_OP.backward_op("composite_native_backward", _forward, reference.composite)
def _backward(arguments: Any, arriving: Any, gradients: Any) -> None:
    sigma = arguments.sigma
    if gradients.sigma is None:  # the kernels always write this gradient
        gradients = gradients._replace(sigma=new_empty(sigma, rows_of(sigma), *sigma.shape[1:]))
    left = None if arguments.background is None else new_empty(sigma, arguments.r)
    outputs = native.compiled.CompositeGradients(**arriving._asdict(), **gradients._asdict(), left=left)
    native.compiled.composite_backward(_inputs(arguments), outputs, native.machine(sigma))


composite = in_float32(_forward)
