"""The loss of a batch of rays, with gradients. r rays, m samples of all rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.nerf.cameras import Rays
from voronerf.nerf.occupancy import HIDDEN
from voronerf.nerf.radiance import Radiance, radiance_of, router_of
from voronerf.nerf.renderer import Renderer
from voronerf.nerf.sampling import colour_loss
from voronerf.nerf.volume import Samples
from voronerf.ops._core import backends
from voronerf.ops.forward_with_tape import forward_with_tape
from voronerf.ops.render_loss import render_loss_gradient
from voronerf.ops.scale_gradient import scale_gradient
from voronerf.ops.smooth_depth_gradient import smooth_depth_gradient
from voronerf.ops.smooth_depth_gradient.reference import smooth_depth_loss
from voronerf.ops.sparse_depth_gradient import sparse_depth_gradient
from voronerf.ops.sparse_depth_gradient.reference import near_point, sparse_depth_loss


@dataclass(frozen=True)
class Batch:
    """Rays [r], where they enter and leave the scene, and the colours to learn.

    Attributes:
        rays: Origins and unit directions; radii for cones.
        near: [r], the depth at which each ray enters the scene.
        far: [r], the depth at which it leaves the scene.
        target: [r, 3], the colour of each ray's pixel over the background.
        background: [3], or [r, 3] where it was drawn; None for black.
        sparse_depths: [s], the distances of the points of a sparse model that the first s rays end at, or None.
        unseen: Pairs at the end that are `voronerf.ops.unseen_rays`, whose colours are not known.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import Batch, Rays
        >>> rays = Rays(torch.zeros(5, 3), torch.tensor([[0.0, 0, 1]]).expand(5, 3))
        >>> batch = Batch(rays, torch.ones(5), torch.full((5,), 3.0), torch.rand(5, 3), background=torch.ones(3))
    """

    rays: Rays
    near: Tensor
    far: Tensor
    target: Tensor
    background: Tensor | None = None
    sparse_depths: Tensor | None = None
    unseen: int = 0


class RenderOutput(NamedTuple):
    """What :class:`RayLoss` gives. Only the loss has gradients.

    Attributes:
        loss: [].
        error: [r], the squared error of the colour of each ray, summed over the channels.
        weights: [m], contributions of the samples to their rays.
        density: [m], per scene unit.
        samples: Those of the last pass.
        colour: [r, 3], as the field shows the rays.

    Examples:
        >>> import torch
        >>> from voronerf import NeRF
        >>> from voronerf.nerf import Batch, RayLoss, Rays, Renderer, Stratified
        >>> rays = Rays(torch.zeros(5, 3), torch.tensor([[0.0, 0, 1]]).expand(5, 3))
        >>> batch = Batch(rays, torch.ones(5), torch.full((5,), 3.0), torch.rand(5, 3))
        >>> output = RayLoss(Renderer({"field": NeRF(width=16, depth=2)}, Stratified(8)))(batch)
        >>> output.loss.requires_grad, output.error.shape, output.importance().shape
        (True, torch.Size([5]), torch.Size([40]))
    """

    loss: Tensor
    error: Tensor
    weights: Tensor
    density: Tensor
    samples: Samples
    colour: Tensor

    def importance(self) -> Tensor:
        """[m]: the weight of each sample times the error of its ray (Elsner et al. 2023, section 3.1)."""
        return self.weights * self.error.index_select(0, self.samples.ray_index)


class RayLoss:
    """The mean squared or robust error of rays at random samples.

    Where nothing keeps it from that (:meth:`why_not_fused`), networks, colours, loss and gradients are one operation
    each way; else torch differentiates each pass along the rays.

    Args:
        renderer: Networks and sampler.
        sparse_depth: Factor of the loss on light that does not come from where the points of a sparse model are
            (Deng et al. 2022, "Depth-supervised NeRF"); 0 is off.
        robust: Scale of the errors beyond which the loss of a ray is not squared: see `voronerf.ops.render_loss`. What
            differs from picture to picture, such as exposure, is no reason for fog then. 0 is off.
        smooth_depth: Factor of the loss on depths that differ between two neighbours of the unseen rays of a batch: see
            `voronerf.ops.smooth_depth_gradient`.

    Examples:
        >>> import torch
        >>> from voronerf import NeRF, VoronoiRouter
        >>> from voronerf.nerf import Batch, RayLoss, Rays, Renderer, Stratified
        >>> router = VoronoiRouter(NeRF(width=16, depth=2), torch.zeros(1, 3))
        >>> loss = RayLoss(Renderer({"field": router}, Stratified(8)))
        >>> rays = Rays(torch.zeros(5, 3), torch.tensor([[0.0, 0, 1]]).expand(5, 3))
        >>> output = loss(Batch(rays, torch.ones(5), torch.full((5,), 3.0), torch.rand(5, 3)), backward=True)
        >>> router.module.colour.weight.grad is not None
        True
        >>> print(loss.explain())
        samples: Stratified, 8 a ray
        loss: networks, colours and loss are separate operations
        not faster: empty space is not skipped
        field: forward: fused
    """

    def __init__(
        self, renderer: Renderer, *, sparse_depth: float = 0.0, robust: float = 0.0, smooth_depth: float = 0.0
    ) -> None:
        self.renderer, self.sparse_depth, self.robust = renderer, sparse_depth, robust
        self.smooth_depth = smooth_depth

    def __call__(
        self, batch: Batch, generator: torch.Generator | None = None, *, backward: bool = False
    ) -> RenderOutput:
        """The loss of a batch, and what its samples have found.

        Args:
            batch: The rays.
            generator: Of random samples.
            backward: Whether gradients are added to those of the parameters at once, as ``loss.backward()`` does it,
                in less time; the loss has none then.
        """
        field = self.radiance()
        if isinstance(field, str) and self.renderer.sampler.grid is not None:  # perhaps not traced yet
            middle = (batch.near + batch.far)[:, None] / 2
            samples = self.renderer.sampler.space.samples(batch.rays, middle, middle.expand(-1, 2))
            field = self.radiance((samples.inputs, batch.rays.directions))
        if isinstance(field, str):
            return self._separate(batch, generator, backward)
        return self._fused(field, batch, generator, backward)

    def why_not_fused(self) -> str | None:
        """What keeps networks, colours, loss and gradients from being one operation; None if nothing does.

        What a module with ``fuse=True`` computes is known from its first step on, which traces it.
        """
        found = self.radiance()
        return found if isinstance(found, str) else None

    def radiance(self, samples: tuple[Tensor, Tensor] | None = None) -> Radiance | str:
        """What the field computes; or why the operations are separate. Samples are those of `radiance_of`."""
        renderer = self.renderer
        if renderer.sampler.grid is None:
            return "empty space is not skipped"
        return radiance_of(renderer.field, samples, inputs=6 if renderer.cones else 3, backend=renderer.backend)

    def _fused(self, field: Radiance, batch: Batch, generator: torch.Generator | None, backward: bool) -> RenderOutput:
        renderer, depths = self.renderer, batch.sparse_depths if self.sparse_depth else None
        samples = renderer.sampler.sample(batch.rays, batch.near, batch.far, jitter=True, generator=generator)
        network = field.arguments(samples.inputs, batch.rays.directions, samples.ray_index, renderer.backend)
        tape = forward_with_tape({**network, "rows": samples.rows}, backend=renderer.backend)
        found, gradient = render_loss_gradient(
            tape.raw,
            samples.deltas,
            samples.ray_offsets,
            batch.target,
            background=batch.background,
            **field.rule,
            robust=self.robust,
            hidden=HIDDEN,  # what next to no light reaches learns nothing, and takes no part in the backward pass
            backend=renderer.backend,
        )
        if depths is not None:
            sparse_depth_gradient(
                found.loss,
                gradient,
                found.density,
                samples.depths,
                samples.deltas,
                found.weights,
                samples.ray_offsets,
                depths,
                factor=self.sparse_depth / len(depths),
                **field.rule,
                backend=renderer.backend,
            )
        if batch.unseen:
            smooth_depth_gradient(
                found.loss,
                found.error,
                gradient,
                found.density,
                samples.depths,
                samples.deltas,
                found.weights,
                samples.ray_offsets,
                batch.far,
                pairs=batch.unseen,
                factor=self.smooth_depth,
                robust=self.robust,
                hidden=HIDDEN,
                **field.rule,
                backend=renderer.backend,
            )
        if (full := renderer.sampler.space.full_gradient) is not None:
            scale_gradient(gradient, samples.depths, full, backend=renderer.backend)
        loss = tape.backward(found.loss, gradient, defer=not backward)
        return RenderOutput(loss, found.error, found.weights, found.density, samples, found.colour)

    def _separate(self, batch: Batch, generator: torch.Generator | None, backward: bool) -> RenderOutput:
        given: dict[str, Any] = {"background": batch.background, "jitter": True, "generator": generator}
        *before, last = self.renderer.render(batch.rays, batch.near, batch.far, **given)
        rays, samples = len(batch.rays), last.samples
        seen = rays - 2 * batch.unseen
        loss = colour_loss(last.colour[:seen], batch.target[:seen], self.robust) * (seen / rays)
        if self.sparse_depth and batch.sparse_depths is not None:
            several = len(batch.sparse_depths)
            known = torch.nn.functional.pad(batch.sparse_depths, (0, len(batch.rays) - several), value=torch.nan)
            ray = samples.ray_index.long()
            there = last.weights * near_point(samples.depths, samples.deltas, known[ray])
            light = torch.zeros_like(known).index_add(0, ray, there)
            loss = loss + self.sparse_depth * sparse_depth_loss(light[:several]).mean()
        if batch.unseen:
            nearness = last.weights / samples.depths
            disparity = torch.zeros_like(batch.far).index_add(0, samples.ray_index.long(), nearness)
            loss = loss + self.smooth_depth * smooth_depth_loss(disparity, last.opacity, batch.far, batch.unseen)
        for first in before:
            target = torch.cat((batch.target[:seen], first.colour[seen:].detach()))
            loss = loss + self.renderer.sampler.loss_before(first, last, target)
        error = (last.colour.detach() - batch.target).square().sum(-1)
        error[seen:] = 0
        if backward:
            loss.backward()
            loss = loss.detach()
        return RenderOutput(loss, error, last.weights.detach(), last.density.detach(), samples, last.colour.detach())

    def explain(self) -> str:
        """How a step is computed, and what keeps it from a faster way: some lines."""
        renderer = self.renderer
        lines = [f"samples: {renderer.sampler.explain()}"]
        obstacle = self.why_not_fused()
        separate = obstacle is not None
        if not separate:
            device, dtype = renderer.device, torch.float32
            chosen = backends.chosen("forward_with_tape", device, dtype, backend=renderer.backend)
            lines.append(f"loss: networks, colours, loss and gradients in one operation, on the {chosen} backend")
            if chosen != "native":
                reason = backends.why_not("forward_with_tape", "native", device, dtype)
                obstacle = reason or f"--backend {renderer.backend}"
        else:
            lines.append("loss: networks, colours and loss are separate operations")
        if obstacle is not None:
            lines.append(f"not faster: {obstacle}")
        for name, field in renderer.fields.items():
            if separate and (router := router_of(field)) is not None:
                lines.append(f"{name}: {router.explain()}")
        return "\n".join(lines)
