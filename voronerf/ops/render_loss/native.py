"""``render_loss`` of the compiled module."""

from __future__ import annotations

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared

_OP = declared("render_loss")
_inputs = _OP.inputs(native.compiled.RenderLossInputs, offsets="ray_offsets")
_outputs = _OP.outputs(native.compiled.RenderLossOutputs)
render_loss = _OP.compiled_op("render_loss_native", "render_loss", _inputs, _outputs)
