"""``render_loss`` of the compiled module. r rays, m samples of all rays (packed).

The gradient of the loss is computed with it, so the backward pass only scales it.
"""

from __future__ import annotations

from collections.abc import Iterator

from torch import Tensor

from voronerf import native
from voronerf.native.custom_op import custom_op
from voronerf.ops.render_loss.autograd import render_loss_backward, render_loss_setup
from voronerf.ops.render_loss.reference import RenderLoss


def render_loss(
    raw: Tensor,
    deltas: Tensor,
    ray_offsets: Tensor,
    target: Tensor,
    *,
    background: Tensor | None = None,
    density_scale: float,
    hidden: float = 0.0,
) -> RenderLoss:
    """Activations, compositing and squared error; see ``voronerf.ops.render_loss``."""
    *parts, _ = forward(raw.float(), deltas, ray_offsets, target, background, density_scale, hidden)
    return RenderLoss(*parts)


@custom_op("render_loss_native")
def forward(
    raw: Tensor,
    deltas: Tensor,
    ray_offsets: Tensor,
    target: Tensor,
    background: Tensor | None,
    density_scale: float,
    hidden: float,
) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]]:
    """Loss, colour, weights, density, error, and the gradient of the loss to ``raw``."""
    r, m = target.shape[0], raw.shape[0]
    loss, colour, error = raw.new_empty(()), raw.new_empty(r, 3), raw.new_empty(r)
    weights, density, gradient = raw.new_empty(m), raw.new_empty(m), raw.new_empty(m, 4)
    yield loss, colour, weights, density, error, gradient
    compiled = native.compiled
    given = compiled.RenderLossInputs(
        raw=raw,
        deltas=deltas,
        offsets=ray_offsets,
        target=target,
        background=background,
        background_per_ray=background is not None and background.dim() == 2,
        density_scale=density_scale,
        hidden=hidden,
        r=r,
        m=m,
    )
    results = compiled.RenderLossOutputs(
        loss=loss, colour=colour, weights=weights, density=density, error=error, gradient=gradient
    )
    compiled.render_loss(given, results, native.machine(raw))


forward.register_autograd(render_loss_backward, setup_context=render_loss_setup)


def render_loss_gradient(
    raw: Tensor,
    deltas: Tensor,
    ray_offsets: Tensor,
    target: Tensor,
    background: Tensor | None,
    density_scale: float,
    hidden: float,
) -> tuple[Tensor, ...]:
    """What ``forward`` gives; see ``voronerf.ops.render_loss``."""
    found: tuple[Tensor, ...] = forward.inside(raw, deltas, ray_offsets, target, background, density_scale, hidden)
    return found
