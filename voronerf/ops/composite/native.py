"""``composite`` of the compiled module, and its gradients.

r rays, s samples of a ray, m samples of all rays (packed), c channels. The arithmetic is float32; half types are cast
on the way in and out. Second derivatives come from the reference formula.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from torch import Tensor

from voronerf import native
from voronerf.native.custom_op import custom_op
from voronerf.ops.composite.autograd import (
    composite_backward_backward,
    composite_backward_setup,
    composite_forward_backward,
    composite_forward_setup,
)
from voronerf.ops.composite.reference import Composite


def composite(
    sigma: Tensor,
    rgb: Tensor,
    depths: Tensor,
    deltas: Tensor,
    *,
    ray_offsets: Tensor | None = None,
    background: Tensor | None = None,
) -> Composite:
    """Absorption and emission along rays; see ``voronerf.ops.composite``."""
    if background is not None:
        background = background.float()
    parts = _forward(sigma.float(), rgb.float(), depths.float(), deltas.float(), ray_offsets, background)
    return Composite(*(part.to(rgb.dtype) for part in parts))


@custom_op("composite_native")
def _forward(
    sigma: Tensor, rgb: Tensor, depths: Tensor, deltas: Tensor, ray_offsets: Tensor | None, background: Tensor | None
) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    r = _rays(sigma, ray_offsets)
    colour, opacity, depth = rgb.new_empty(r, rgb.shape[-1]), sigma.new_empty(r), sigma.new_empty(r)
    weights = sigma.new_empty(sigma.shape)
    yield colour, opacity, depth, weights
    compiled = native.compiled
    given = _inputs(sigma, rgb, depths, deltas, ray_offsets, background)
    results = compiled.CompositeOutputs(colour=colour, opacity=opacity, depth=depth, weights=weights)
    compiled.composite(given, results, native.machine(sigma))


@custom_op("composite_native_backward")
def _backward(
    colour: Tensor | None,
    opacity: Tensor | None,
    depth: Tensor | None,
    weights: Tensor | None,
    sigma: Tensor,
    rgb: Tensor,
    depths: Tensor,
    deltas: Tensor,
    ray_offsets: Tensor | None,
    background: Tensor | None,
    wanted: Sequence[bool],
) -> Iterator[list[Tensor]]:
    """Gradients to sigma, rgb, depths, deltas and background, empty where not wanted; that to sigma is always there.

    The first four arguments are the gradients of the outputs, None for zero.
    """
    chosen = [
        tensor if want else None for tensor, want in zip((sigma, rgb, depths, deltas, background), [True, *wanted[1:]])
    ]
    results = [sigma.new_empty(0 if tensor is None else tensor.shape) for tensor in chosen]
    yield results
    compiled = native.compiled
    given = _inputs(sigma, rgb, depths, deltas, ray_offsets, background)
    of_sigma, of_rgb, of_depths, of_deltas, of_background = (
        None if tensor is None else result for tensor, result in zip(chosen, results)
    )
    gradients = compiled.CompositeGradients(
        colour=colour,
        opacity=opacity,
        depth=depth,
        weights=weights,
        sigma=of_sigma,
        rgb=of_rgb,
        depths=of_depths,
        deltas=of_deltas,
        background=of_background,
        left=None if background is None else sigma.new_empty(given.r),
    )
    compiled.composite_backward(given, gradients, native.machine(sigma))


def _inputs(
    sigma: Tensor, rgb: Tensor, depths: Tensor, deltas: Tensor, ray_offsets: Tensor | None, background: Tensor | None
) -> native.compiled.CompositeInputs:
    return native.compiled.CompositeInputs(
        sigma=sigma,
        rgb=rgb,
        depths=depths,
        deltas=deltas,
        offsets=ray_offsets,
        background=background,
        background_per_ray=background is not None and background.dim() == 2,
        r=_rays(sigma, ray_offsets),
        s=sigma.shape[1] if ray_offsets is None else 0,
        m=sigma.numel(),
        c=rgb.shape[-1],
    )


def _rays(sigma: Tensor, ray_offsets: Tensor | None) -> int:
    return sigma.shape[0] if ray_offsets is None else ray_offsets.shape[0] - 1


_forward.register_autograd(composite_forward_backward(_backward), setup_context=composite_forward_setup)
_backward.register_autograd(composite_backward_backward, setup_context=composite_backward_setup)
