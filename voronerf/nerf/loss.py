"""The loss of a batch of rays, with gradients. r rays, m samples of all rays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.nerf.cameras import Rays
from voronerf.nerf.occupancy import HIDDEN
from voronerf.nerf.radiance import Radiance, radiance_of, router_of
from voronerf.nerf.renderer import Renderer
from voronerf.nerf.volume import Rendered, Samples, composed
from voronerf.ops._core import backends
from voronerf.ops.forward_with_tape import forward_with_tape
from voronerf.ops.render_loss import render_loss_gradient
from voronerf.ops.render_loss.reference import activate, robust_error
from voronerf.ops.scale_gradient import scale_gradient
from voronerf.ops.smooth_depth_gradient import smooth_depth_gradient
from voronerf.ops.smooth_depth_gradient.reference import smooth_depth_loss
from voronerf.ops.sparse_depth_gradient import sparse_depth_gradient
from voronerf.ops.sparse_depth_gradient.reference import sparse_depth_loss


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
        unseen: Triples at the end that are `voronerf.ops.unseen_rays`, whose colours are not known.

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
    """The result of :class:`RayLoss`. Only the loss has gradients.

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
        smooth_depth: Factor of the loss on depths of unseen rays of a batch that lie on no plane with those of their
            neighbours: see `voronerf.ops.smooth_depth_gradient`.
        term: A further term of the loss, a scalar that torch computes from the rendered rays and their batch. The
            networks alone learn from it, and a :class:`TrainingStep` with it is not recorded. It is given all rays: of
            the last ``3 * batch.unseen``, no picture shows the colour.

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
        >>> clear = RayLoss(loss.renderer, term=lambda seen, batch: 0.1 * (seen.opacity * (1 - seen.opacity)).mean())
    """

    def __init__(
        self,
        renderer: Renderer,
        *,
        sparse_depth: float = 0.0,
        robust: float = 0.0,
        smooth_depth: float = 0.0,
        term: Callable[[Rendered, Batch], Tensor] | None = None,
    ) -> None:
        self.renderer, self.sparse_depth, self.robust = renderer, sparse_depth, robust
        self.smooth_depth, self.term = smooth_depth, term

    def __call__(
        self, batch: Batch, generator: torch.Generator | None = None, *, backward: bool = False
    ) -> RenderOutput:
        """Computes the loss of a batch.

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
        """The reason why networks, colours, loss and gradients are not one operation; None if they are.

        What a module with ``fuse=True`` computes is known from its first step on, which traces it.
        """
        radiance = self.radiance()
        return radiance if isinstance(radiance, str) else None

    def radiance(self, samples: tuple[Tensor, Tensor] | None = None) -> Radiance | str:
        """The program of the field, or why the operations are separate; samples as for `radiance_of`."""
        renderer = self.renderer
        if renderer.sampler.grid is None:
            return "empty space is not skipped"
        return radiance_of(renderer.field, samples, inputs=6 if renderer.cones else 3, backend=renderer.backend)

    def _fused(self, field: Radiance, batch: Batch, generator: torch.Generator | None, backward: bool) -> RenderOutput:
        renderer, depths = self.renderer, batch.sparse_depths if self.sparse_depth else None
        samples = renderer.sampler.sample(batch.rays, batch.near, batch.far, jitter=True, generator=generator)
        network = field.arguments(samples.inputs, batch.rays.directions, samples.ray_index, renderer.backend)
        tape = forward_with_tape({**network, "rows": samples.rows}, backend=renderer.backend)
        result, gradient = render_loss_gradient(
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
                result.loss,
                gradient,
                result.density,
                samples.depths,
                samples.deltas,
                result.weights,
                samples.ray_offsets,
                depths,
                factor=self.sparse_depth,
                **field.rule,
                backend=renderer.backend,
            )
        if batch.unseen:
            smooth_depth_gradient(
                result.loss,
                result.error,
                gradient,
                result.density,
                samples.depths,
                samples.deltas,
                result.weights,
                samples.ray_offsets,
                batch.far,
                triples=batch.unseen,
                factor=self.smooth_depth,
                robust=self.robust,
                hidden=HIDDEN,
                **field.rule,
                backend=renderer.backend,
            )
        if self.term is not None:
            with torch.enable_grad():
                raw = tape.raw.detach().requires_grad_()
                values = activate(raw, **field.rule)
                seen = composed(*values, batch.far, samples, batch.background, renderer.backend)
                further = self.term(seen, batch)
            result.loss.add_(further.detach())
            gradient.add_(torch.autograd.grad(further, raw)[0])
        if (full := renderer.sampler.space.full_gradient) is not None:
            scale_gradient(gradient, samples.depths, full, backend=renderer.backend)
        loss = tape.backward(result.loss, gradient, defer=not backward)
        return RenderOutput(loss, result.error, result.weights, result.density, samples, result.colour)

    def _separate(self, batch: Batch, generator: torch.Generator | None, backward: bool) -> RenderOutput:
        *before, last = self.renderer.render(
            batch.rays, batch.near, batch.far, background=batch.background, jitter=True, generator=generator
        )
        samples, rays = last.samples, len(batch.rays)
        seen = rays - 3 * batch.unseen
        error = (last.colour[:seen] - batch.target[:seen]).square().sum(-1)
        loss = robust_error(error, self.robust).sum() / (3 * max(rays, 1))
        if self.sparse_depth and batch.sparse_depths is not None:
            along = last.weights, samples.depths, samples.deltas, samples.ray_offsets
            loss = loss + self.sparse_depth * sparse_depth_loss(*along, batch.sparse_depths).mean()
        if batch.unseen:
            nearness = last.weights / samples.depths
            disparity = torch.zeros_like(batch.far).index_add(0, samples.ray_index.long(), nearness)
            loss = loss + self.smooth_depth * smooth_depth_loss(disparity, last.opacity, batch.far, batch.unseen)
        if self.term is not None:
            loss = loss + self.term(last, batch)
        for first in before:
            target = torch.cat((batch.target[:seen], first.colour[seen:].detach()))
            loss = loss + self.renderer.sampler.loss_before(first, last, target)
        error = torch.nn.functional.pad(error.detach(), (0, rays - seen))
        if backward:
            loss.backward()
            loss = loss.detach()
        error, weights, density, colour = (x.detach() for x in (error, last.weights, last.density, last.colour))
        return RenderOutput(loss, error, weights, density, samples, colour)

    def explain(self) -> str:
        """How a step is computed, and what keeps it from a faster way: some lines."""
        renderer = self.renderer
        lines = [f"samples: {renderer.sampler.explain()}"]
        if (obstacle := self.why_not_fused()) is not None:
            lines += ["loss: networks, colours and loss are separate operations", f"not faster: {obstacle}"]
            routers = ((name, router_of(field)) for name, field in renderer.fields.items())
            return "\n".join([*lines, *(f"{name}: {router.explain()}" for name, router in routers if router)])
        where = renderer.device, torch.float32
        chosen = backends.chosen("forward_with_tape", *where, backend=renderer.backend)
        lines.append(f"loss: networks, colours, loss and gradients in one operation, on the {chosen} backend")
        if chosen != "native":
            reason = backends.why_not("forward_with_tape", "native", *where)
            lines.append(f"not faster: {reason or f'--backend {renderer.backend}'}")
        return "\n".join(lines)
