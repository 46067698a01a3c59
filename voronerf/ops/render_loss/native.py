"""``render_loss`` of the compiled module. r rays, m samples of all rays (packed).

The gradient of the loss is computed with it, so the backward pass only scales it.
"""

from __future__ import annotations

from collections.abc import Iterator

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import custom_op
from voronerf.ops.render_loss.autograd import Results, register, results
from voronerf.ops.render_loss.reference import RenderLossInputs


def render_loss(given: RenderLossInputs) -> list[Tensor]:
    """Activations, compositing and squared error; see ``voronerf.ops.render_loss``."""
    *parts, _ = forward(given._replace(raw=given.raw.float()))
    return parts


def render_loss_gradient(given: RenderLossInputs) -> Results:
    """What ``forward`` gives; see ``voronerf.ops.render_loss_gradient``."""
    found: Results = forward.inside(given)
    return found


@custom_op("render_loss_native")
def forward(given: RenderLossInputs) -> Iterator[Results]:
    """Loss, colour, weights, density, error, and the gradient of the loss to ``raw``."""
    loss, colour, weights, density, error, gradient = found = results(given)
    yield found
    compiled, background = native.compiled, given.background
    inputs = compiled.RenderLossInputs(
        raw=given.raw,
        deltas=given.deltas,
        offsets=given.ray_offsets,
        target=given.target,
        background=background,
        background_per_ray=background is not None and background.dim() == 2,
        density_scale=given.density_scale,
        hidden=given.hidden,
        r=given.target.shape[0],
        m=given.raw.shape[0],
    )
    outputs = compiled.RenderLossOutputs(
        loss=loss, colour=colour, weights=weights, density=density, error=error, gradient=gradient
    )
    compiled.render_loss(inputs, outputs, native.machine(given.raw))


register(forward)
