"""``composite`` of the compiled module, and its gradients.

r rays, s samples of a ray, m samples of all rays (packed), c channels. The arithmetic is float32; half types are cast
on the way in and out. Second derivatives come from the reference formula.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import custom_op, in_float32
from voronerf.ops.composite.autograd import Arriving, RaySamples, register


def composite(*given: Tensor | None) -> Any:
    """Absorption and emission along rays; see ``voronerf.ops.composite``."""
    return in_float32(_forward, RaySamples._make(given))


@custom_op("composite_native")
def _forward(given: RaySamples) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    colour, opacity, depth, weights = results = given.results()
    yield results
    outputs = native.compiled.CompositeOutputs(colour=colour, opacity=opacity, depth=depth, weights=weights)
    native.compiled.composite(_inputs(given), outputs, native.machine(given.sigma))


@custom_op("composite_native_backward")
def _backward(arriving: Arriving, given: RaySamples, wanted: Sequence[bool]) -> Iterator[list[Tensor]]:
    results = given.gradients(list(wanted))
    yield results
    sigma, background = given.sigma, given.background
    to_rgb, to_depths, to_deltas, to_background = (
        result if want else None for result, want in zip(results[1:], wanted[1:])
    )
    gradients = native.compiled.CompositeGradients(
        **arriving._asdict(),
        sigma=results[0],
        rgb=to_rgb,
        depths=to_depths,
        deltas=to_deltas,
        background=to_background,
        left=None if background is None else sigma.new_empty(given.rays),
    )
    native.compiled.composite_backward(_inputs(given), gradients, native.machine(sigma))


def _inputs(given: RaySamples) -> native.compiled.CompositeInputs:
    sigma, background = given.sigma, given.background
    return native.compiled.CompositeInputs(
        sigma=sigma,
        rgb=given.rgb,
        depths=given.depths,
        deltas=given.deltas,
        offsets=given.ray_offsets,
        background=background,
        background_per_ray=background is not None and background.dim() == 2,
        r=given.rays,
        s=sigma.shape[1] if given.ray_offsets is None else 0,
        m=sigma.numel(),
        c=given.rgb.shape[-1],
    )


register(_forward, _backward)
