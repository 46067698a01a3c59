"""``sighting_gradient`` of the compiled module, on the CPU: no custom op, because a step calls it for its gradient."""

from __future__ import annotations

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops.sighting_gradient.reference import NEARBY


def sighting_gradient(
    density: Tensor, depths: Tensor, deltas: Tensor, weights: Tensor, ray_offsets: Tensor, distances: Tensor
) -> tuple[Tensor, Tensor]:
    """The loss [] and its gradient [m]; see ``voronerf.ops.sighting_gradient``."""
    loss, of_rays, gradient = (density.new_empty(size) for size in ((), distances.shape, density.shape))
    given = native.compiled.Sightings(
        density=density,
        depths=depths,
        deltas=deltas,
        weights=weights,
        offsets=ray_offsets,
        distances=distances,
        nearby=NEARBY,
        s=len(distances),
        m=len(density),
    )
    native.compiled.sighting_gradient(given, loss, of_rays, gradient, native.cpu())
    return loss, gradient
