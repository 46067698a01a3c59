"""``render_loss`` of the compiled module. r rays, m samples of all rays (packed).

The forward pass computes the loss and its gradient, so the backward pass only scales the gradient.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared
from voronerf.ops.render_loss.autograd import register

_OP = declared("render_loss_gradient")
_inputs = _OP.inputs(native.compiled.RenderLossInputs, offsets="ray_offsets")
_outputs = _OP.outputs(native.compiled.RenderLossOutputs)
render_loss_gradient = _OP.compiled_op("render_loss_native", "render_loss", _inputs, _outputs)
register(render_loss_gradient)


def render_loss(raw: Tensor, *others: Any) -> list[Tensor]:
    """Applies activations, compositing and the error; see ``voronerf.ops.render_loss``."""
    *parts, _ = render_loss_gradient(raw.float(), *others)
    return parts
