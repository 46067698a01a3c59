"""Rays rendered and compared with the colours they should have: what a training step needs of its networks.

r rays, m samples of all rays.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, cast

import torch
from torch import Tensor

from voronerf import backends
from voronerf.fields.radiance import activate_radiance
from voronerf.ops.march_rays import March
from voronerf.ops.render_loss import check_targets, render_loss
from voronerf.rendering.cameras import Rays
from voronerf.rendering.field import Field
from voronerf.rendering.marching import Marched, march_grid
from voronerf.rendering.occupancy import HIDDEN, OccupancyGrid
from voronerf.rendering.volume import Rendered, weaken_near
from voronerf.router import VoronoiRouter


class Comparison(NamedTuple):
    """The result of `Renderer.compare`. Only the loss has gradients.

    Attributes:
        loss: [].
        error: [r], the squared error of the colour of each ray, summed over the channels.
        positions: [m, 3] of the samples of the last pass.
        weights: [m], their contributions to their rays.
        ray_index: int32 [m], the ray of each sample; None where all rays have as many, one ray after the other.
        density: [m], or None without an occupancy grid.
        deltas: [m], the lengths of their strata, or None likewise.

    Examples:
        >>> import torch
        >>> from voronerf import NeRF
        >>> from voronerf.rendering import Rays, Renderer
        >>> renderer = Renderer({"field": NeRF(width=16, depth=2)}, samples=8)
        >>> rays = Rays(torch.zeros(5, 3), torch.tensor([[0.0, 0, 1]]).expand(5, 3))
        >>> found = renderer.compare(rays, 1.0, 3.0, torch.rand(5, 3))
        >>> found.loss.requires_grad, found.error.shape, found.importance().shape
        (True, torch.Size([5]), torch.Size([40]))
    """

    loss: Tensor
    error: Tensor
    positions: Tensor
    weights: Tensor
    ray_index: Tensor | None = None
    density: Tensor | None = None
    deltas: Tensor | None = None

    def importance(self) -> Tensor:
        """[m]: the weight of each sample times the error of its ray (Elsner et al. 2023, section 3.1)."""
        if self.ray_index is None:
            return (self.weights.reshape(len(self.error), -1) * self.error[:, None]).reshape(-1)
        return self.weights * self.error.index_select(0, self.ray_index)


def compared(loss: Tensor, last: Rendered | Marched, target: Tensor) -> Comparison:
    """The comparison of a last pass with the colours [r, 3] that it should have."""
    error = (last.colour.detach() - target).square().sum(-1)
    positions, weights = last.positions.detach().reshape(-1, 3), last.weights.detach().reshape(-1)
    if isinstance(last, Rendered):
        return Comparison(loss, error, positions, weights)
    return Comparison(loss, error, positions, weights, last.ray_index, last.density.detach(), last.deltas)


class Marching(Protocol):
    """What `compare_marched` reads of a renderer."""

    samples: int
    spacing: str
    backend: str
    occupancy: OccupancyGrid | None
    full_gradient: float | None

    @property
    def field(self) -> Field:
        """The field of its last pass."""
        ...


def compare_marched(
    renderer: Marching,
    rays: Rays,
    near: Tensor,
    far: Tensor,
    target: Tensor,
    *,
    background: Tensor | None,
    generator: torch.Generator | None,
) -> Comparison | None:
    """`render_marched` and its loss in one pass from the outputs of the networks.

    None where that is not to be had: without a grid, for fields that do not declare what their outputs mean
    (`activate_radiance`), and for a backend that has no `render_loss`.
    """
    grid = renderer.occupancy
    if grid is None or not compares_outputs(renderer):
        return None
    march = march_grid(rays, near, far, grid, renderer.samples, True, generator, renderer.spacing, renderer.backend)
    return compare_samples(renderer, rays, march, target, background)


def compares_outputs(renderer: Marching) -> bool:
    """Whether colours are to be had from the outputs of the networks: their field says what these mean."""
    field = renderer.field
    if renderer.backend not in ("auto", "native") or not isinstance(field, VoronoiRouter):
        return False
    return getattr(type(field.module), "activate", None) is activate_radiance and field.by_table


def compare_samples(
    renderer: Marching, rays: Rays, march: March, target: Tensor, background: Tensor | None
) -> Comparison:
    """`compare_marched` of samples, for a renderer that `compares_outputs`."""
    field = cast(VoronoiRouter, renderer.field)
    module: Any = field.module
    rest: dict[str, Any] = {
        "background": background,
        "density_scale": float(module.density_scale),
        "hidden": HIDDEN,  # what next to no light reaches learns nothing, and takes no part in the backward pass
    }
    given = march.positions, rays.directions, march.ray_index
    routed = field.table_arguments(*given) if _learns_natively(renderer, march.positions) else None
    if routed is not None and _in_float32(routed):
        from voronerf.ops.learn_rays.native import learn_rays  # which is there where the compiled module is

        check_targets("compare", target, background, (torch.float32,), {"r": len(rays)})
        found = learn_rays(march, routed, target, **rest)
    else:
        raw = field.raw(*given)
        weaken_near(renderer.full_gradient, march.depths, raw)
        found = render_loss(raw, march.deltas, march.ray_offsets, target, **rest, backend=renderer.backend)
    return Comparison(
        found.loss, found.error, march.positions, found.weights, march.ray_index, found.density, march.deltas
    )


def _learns_natively(renderer: Marching, positions: Tensor) -> bool:
    """Whether networks, loss and gradients are to be had in one, if all of them are in float32: on the CPU."""
    device = positions.device
    if device.type != "cpu" or torch.is_autocast_enabled("cpu") or renderer.full_gradient is not None:
        return False
    return torch.is_grad_enabled() and backends.missing("native", device) is None


def _in_float32(routed: dict[str, Any]) -> bool:
    tensors = (routed["positions"], *routed["weights"], *routed["biases"], routed["features"])
    return all(tensor is None or tensor.dtype == torch.float32 for tensor in tensors)
