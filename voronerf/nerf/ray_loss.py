"""The loss of a batch of rays, with gradients: one contract, and the ways to it in one process.

r rays, m samples of all rays. A way takes a :class:`Batch`, samples its rays, asks the field and gives a
:class:`RenderOutput`; ``why_not`` says what keeps a renderer from it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, cast

import torch
from torch import Tensor

from voronerf.nerf.cameras import Rays
from voronerf.nerf.fields.radiance import activate_radiance
from voronerf.nerf.occupancy import HIDDEN
from voronerf.nerf.renderer import Renderer
from voronerf.nerf.samplers import Occupancy
from voronerf.nerf.sampling import colour_loss
from voronerf.nerf.volume import Samples, gradient_shares
from voronerf.ops.forward_with_tape import forward_with_tape
from voronerf.ops.render_loss import RenderLoss, render_loss_gradient
from voronerf.ops.sighting_gradient import sighting_gradient
from voronerf.ops.sighting_gradient.reference import seen_there, sighting_loss
from voronerf.router import VoronoiRouter


@dataclass(frozen=True)
class Batch:
    """Rays [r], where they enter and leave the scene, and the colours to learn.

    Attributes:
        rays: Origins and unit directions; radii for cones.
        near: [r], the depth at which each ray enters the scene.
        far: [r], the depth at which it leaves the scene.
        target: [r, 3], the colour of each ray's pixel over the background.
        background: [3], or [r, 3] where it was drawn; None for black.
        seen: [s], the distances of the points that the last s rays end at, or None.
        view: int64 [r], number of the training picture of each ray, or None if not needed.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import Rays
        >>> from voronerf.nerf import Batch
        >>> rays = Rays(torch.zeros(5, 3), torch.tensor([[0.0, 0, 1]]).expand(5, 3))
        >>> batch = Batch(rays, torch.ones(5), torch.full((5,), 3.0), torch.rand(5, 3), background=torch.ones(3))
    """

    rays: Rays
    near: Tensor
    far: Tensor
    target: Tensor
    background: Tensor | None = None
    seen: Tensor | None = None
    view: Tensor | None = None


class RenderOutput(NamedTuple):
    """What a step finds. Only the loss has gradients.

    Where cells of the field are frozen, a faster way may leave out rays that meet none of the others; the entries of
    ``error`` are then those of the rays of ``samples``.

    Attributes:
        loss: [].
        error: [r], the squared error of the colour of each ray, summed over the channels.
        weights: [m], contributions of the samples to their rays.
        density: [m].
        samples: Those of the last pass.
        colour: [r, 3], as the field shows the rays; None where no process sees whole rays.

    Examples:
        >>> import torch
        >>> from voronerf import NeRF
        >>> from voronerf.nerf import Rays, Renderer, Stratified
        >>> from voronerf.nerf import Batch, Step
        >>> step = Step(Renderer({"field": NeRF(width=16, depth=2)}, Stratified(8)))
        >>> rays = Rays(torch.zeros(5, 3), torch.tensor([[0.0, 0, 1]]).expand(5, 3))
        >>> found = step.run(Batch(rays, torch.ones(5), torch.full((5,), 3.0), torch.rand(5, 3)))
        >>> found.loss.requires_grad, found.error.shape, found.importance().shape
        (True, torch.Size([5]), torch.Size([40]))
    """

    loss: Tensor
    error: Tensor
    weights: Tensor
    density: Tensor
    samples: Samples
    colour: Tensor | None = None

    def importance(self) -> Tensor:
        """[m]: the weight of each sample times the error of its ray (Elsner et al. 2023, section 3.1)."""
        return self.weights * self.error.index_select(0, self.samples.ray_index)


class RayLoss(Protocol):
    """A way to the loss of a batch.

    Examples:
        >>> from voronerf import NeRF
        >>> from voronerf.nerf import Renderer, Stratified
        >>> from voronerf.nerf import Step
        >>> Step(Renderer({"field": NeRF(width=16, depth=2)}, Stratified(8))).way.explain()
        'networks, colours and loss are separate operations'
    """

    def __call__(self, batch: Batch, generator: torch.Generator | None, *, backward: bool = False) -> RenderOutput:
        """The loss of rays at random samples; ``loss.backward()`` gives the gradients of all parameters.

        Args:
            batch: The rays.
            generator: Of the samples.
            backward: Whether that is done at once, which can be faster.
        """
        ...

    def explain(self) -> str:
        """This way in a line."""
        ...


def why_not_fused(renderer: Renderer) -> str | None:
    """What keeps networks, colours, loss and gradients from being one operation; None if nothing does."""
    field = renderer.field
    if not isinstance(renderer.sampler, Occupancy):
        return "empty space is not skipped"
    if not isinstance(field, VoronoiRouter):
        return f"the field is a {type(field).__name__}, no router"
    if getattr(type(field.module), "activate", None) is not activate_radiance:
        return f"{type(field.module).__name__} does not say what its outputs mean (activate = activate_radiance)"
    if field.coords not in (None, "first3"):
        return "other positions than those of the samples decide the cells"
    return None if field.by_table else f"{type(field.module).__name__} does more than its layer table says"


class Fused:
    """Networks, colours, loss and gradients in one operation, from what the networks put out.

    Args:
        renderer: For which :func:`why_not_fused` is None.
        sightings: Factor of the `sighting_loss`; 0 is off.
    """

    def __init__(self, renderer: Renderer, sightings: float = 0.0) -> None:
        self.renderer, self.sightings = renderer, sightings

    def __call__(self, batch: Batch, generator: torch.Generator | None, *, backward: bool = False) -> RenderOutput:
        """See :class:`RayLoss`."""
        renderer, directions, target, background = self.renderer, batch.rays.directions, batch.target, batch.background
        field = cast(VoronoiRouter, renderer.field)
        samples = renderer.sampler.sample(batch.rays, batch.near, batch.far, jitter=True, generator=generator)
        all_rays = len(samples.ray_offsets) - 1
        seen = None
        if self.sightings and batch.seen is not None:
            seen = torch.nn.functional.pad(batch.seen, (len(batch.rays) - len(batch.seen), 0), value=math.nan)
        frozen = field.frozen_cells is not None
        if seen is not None or frozen:
            samples = samples.counted()
        if frozen:
            rays = _rays_to_learn(field, samples)
            samples, directions, target = samples.of_rays(rays), directions[rays], target[rays]
            if background is not None and background.dim() == 2:
                background = background[rays]
            seen = None if seen is None else seen[rays]
        inputs, asked = samples.inputs, batch.rays.origins.requires_grad
        if asked:
            inputs, directions = inputs.detach().requires_grad_(), directions.detach().requires_grad_()
        table = field.table_arguments(inputs, directions, samples.ray_index)
        outputs = forward_with_tape(cast(Any, {**cast(Any, table), "rows": samples.rows}), backend=renderer.backend)
        shares = gradient_shares(renderer.sampler.space.full_gradient, samples.depths)
        found, gradient = render_loss_gradient(
            outputs.raw,
            samples.deltas,
            samples.ray_offsets,
            target,
            background=background,
            density_scale=density_scale(field),
            hidden=HIDDEN,  # what next to no light reaches learns nothing, and takes no part in the backward pass
            backend=renderer.backend,
        )
        loss = found.loss
        if seen is not None and batch.seen is not None:
            # As the mean over rays, a part of them has its share of this taken afterwards.
            factor = self.sightings / len(batch.seen) * len(batch.rays) / max(len(target), 1)
            loss = loss + self._learn_sightings(gradient, found, samples, seen, factor)
        if shares is not None:
            gradient = gradient * shares[:, None]
        if len(target) < all_rays:  # the others count, but learn nothing
            loss, gradient = (values * (len(target) / all_rays) for values in (loss, gradient))
        loss = outputs.learn(loss, gradient, backward=backward)
        if asked:
            assert inputs.grad is not None and directions.grad is not None
            self._learn_rays(batch.rays, samples, inputs.grad, directions.grad)
        return RenderOutput(loss, found.error, found.weights, found.density, samples, found.colour)

    def _learn_rays(self, rays: Rays, samples: Samples, of_inputs: Tensor, of_directions: Tensor) -> None:
        """Gives rays the gradients to their origins and directions: samples move with them.

        Args:
            rays: r rays.
            samples: Of the rays.
            of_inputs: [m, 3], gradient to the positions as the field sees them.
            of_directions: [r, 3], what the view direction adds.
        """
        ray, contraction = samples.ray_index.long(), self.renderer.contraction
        if contraction is not None:
            origins, directions = (tensor.detach().index_select(0, ray) for tensor in (rays.origins, rays.directions))
            points = torch.addcmul(origins, samples.depths[:, None], directions).requires_grad_()
            with torch.enable_grad():
                (of_inputs,) = torch.autograd.grad(contraction.points(points), points, of_inputs)
        every = torch.cat((of_inputs, of_inputs * samples.depths[:, None]), 1)
        place = (ray * 6)[:, None] + torch.arange(6, device=ray.device)
        sums = every.new_zeros(len(rays), 6)
        sums.view(-1).index_add_(0, place.view(-1), every.view(-1))
        rays.origins.grad, rays.directions.grad = sums[:, :3], sums[:, 3:] + of_directions

    def _learn_sightings(
        self, gradient: Tensor, found: RenderLoss, samples: Samples, seen: Tensor, factor: float
    ) -> Tensor:
        """The loss of the rays whose point is known, times a factor; its gradient is added to that of the outputs.

        Args:
            gradient: [m, 4].
            found: Of the rays.
            samples: Of the rays.
            seen: [r], the distances of the points, NaN before the last rays.
            factor: Of the sum over rays.
        """
        first = int(seen.isnan().sum())
        begin, scale = int(samples.ray_offsets[first]), density_scale(cast(VoronoiRouter, self.renderer.field))
        density = found.density[begin:]
        loss, slope = sighting_gradient(
            density,
            samples.depths[begin:],
            samples.deltas[begin:],
            found.weights[begin:],
            samples.ray_offsets[first:],
            seen[first:],
            backend=self.renderer.backend,
        )
        # The density is a softplus of the output, whose derivative is 1 - exp(-density / scale) times the scale.
        gradient[begin:, 3] -= factor * scale * slope * torch.expm1(-density / scale)
        return factor * loss

    def explain(self) -> str:
        """See :class:`RayLoss`."""
        return "networks, colours, loss and gradients in one operation"


def _rays_to_learn(field: VoronoiRouter, samples: Samples) -> Tensor:
    """The rays with a sample in a cell that is not frozen, one at least; the others have no gradient."""
    frozen = field.frozen_cells
    assert frozen is not None
    learns = ~frozen.index_select(0, field.diagram.locate(samples.positions, backend=field.backend))
    rays = torch.zeros(len(samples.ray_offsets) - 1, dtype=torch.bool, device=learns.device)
    rays[samples.ray_index[learns]] = True
    rays[:1] |= ~rays.any()
    return rays.nonzero()[:, 0]


class Composed:
    """Each pass along the rays by itself, differentiated by torch.

    Args:
        renderer: Of any kind.
        sightings: Factor of the `sighting_loss`; 0 is off.
    """

    def __init__(self, renderer: Renderer, sightings: float) -> None:
        self.renderer, self.sightings = renderer, sightings

    def __call__(self, batch: Batch, generator: torch.Generator | None, *, backward: bool = False) -> RenderOutput:
        """See :class:`RayLoss`."""
        given: dict[str, Any] = {"background": batch.background, "jitter": True, "generator": generator}
        *before, last = self.renderer.render(batch.rays, batch.near, batch.far, **given)
        loss, samples = colour_loss(last.colour, batch.target), last.samples
        if self.sightings and batch.seen is not None:
            others = len(batch.rays) - len(batch.seen)
            begin, end = (int(samples.ray_offsets[ray]) for ray in (others, -1))
            depths, deltas, weights = (values[begin:end] for values in (samples.depths, samples.deltas, last.weights))
            ray = samples.ray_index[begin:end].long() - others
            there = weights * seen_there(depths, deltas, batch.seen[ray])
            light = torch.zeros_like(batch.seen).index_add(0, ray, there)
            loss = loss + self.sightings * sighting_loss(light).mean()
        for first in before:
            loss = loss + self.renderer.sampler.loss_before(first, last, batch.target)
        error = (last.colour.detach() - batch.target).square().sum(-1)
        if backward:
            loss.backward()
            loss = loss.detach()
        return RenderOutput(loss, error, last.weights.detach(), last.density.detach(), samples, last.colour.detach())

    def explain(self) -> str:
        """See :class:`RayLoss`."""
        return "networks, colours and loss are separate operations"


def density_scale(field: VoronoiRouter) -> float:
    """The factor on the density of a radiance field."""
    return float(cast(Any, field.module).density_scale)
