"""Volume rendering: colours of rays from a field evaluated at their samples.

r rays, m samples of all rays (packed), s samples per ray if all rays have the same number. Colours are in 0..1,
distances in world units along unit directions, densities per unit length.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.nerf.cameras import Rays
from voronerf.nerf.cones import frustum_gaussians
from voronerf.nerf.contraction import Contraction, Perspective
from voronerf.nerf.field import Field
from voronerf.ops.composite import composite


class Samples(NamedTuple):
    """The samples of a batch of rays, ordered by ray and distance: the output of a sampler, the input of a field.

    Attributes:
        inputs: [m, 3] points, or [m, 6] Gaussians, in the space of the field.
        ray_index: int32 [m], the ray of each sample.
        ray_offsets: int32 [r + 1]: ray i owns samples ``ray_offsets[i]`` to ``ray_offsets[i + 1]``.
        depths: [m], the distances of the samples.
        deltas: [m], the lengths of the intervals that the samples stand for.
        edges: [r, s + 1], the ends of these intervals if all rays have s samples; else None.
        rows: int32 [1] on the device, the number of leading samples that belong to rays, if the host does not know this
            number; None if all samples belong to rays.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import Rays, Stratified
        >>> rays = Rays(torch.zeros(2, 3), torch.tensor([[0.0, 0, 1]]).expand(2, 3))
        >>> samples = Stratified(4).sample(rays, torch.zeros(2), torch.ones(2))
        >>> samples.depths.shape, samples.by_ray(samples.depths).shape
        (torch.Size([8]), torch.Size([2, 4]))
    """

    inputs: Tensor
    ray_index: Tensor
    ray_offsets: Tensor
    depths: Tensor
    deltas: Tensor
    edges: Tensor | None = None
    rows: Tensor | None = None

    @property
    def positions(self) -> Tensor:
        """The points, or the means of the Gaussians, [m, 3]."""
        return self.inputs if self.inputs.shape[1] == 3 else self.inputs[:, :3]

    def by_ray(self, values: Tensor) -> Tensor:
        """Reshapes values [m, ...] to [r, s, ...] if all rays have s samples; else returns them unchanged."""
        if self.edges is None:
            return values
        r, ends = self.edges.shape
        return values.reshape(r, ends - 1, *values.shape[1:])


@dataclass(frozen=True)
class Space:
    """The coordinates in which a scene is sampled and a field is evaluated.

    Args:
        contraction: The contraction of space for the field; None for world coordinates.
        spacing: Spacing of the strata of a ray, "linear" or "disparity".
        cones: Whether the field is evaluated on Gaussians [m, 6] of cone frustums instead of points [m, 3].
        full_gradient: The distance below which the gradients of samples are scaled by (distance / full_gradient)^2;
            None for no scaling. Rays of a camera lie most densely close in front of it. Without scaling, floaters that
            only one view sees would form close to the cameras.

    Examples:
        >>> from voronerf.nerf import Space, Stratified
        >>> sampler = Stratified(64, space=Space(spacing="disparity"))
    """

    contraction: Contraction | Perspective | None = None
    spacing: str = "linear"
    cones: bool = False
    full_gradient: float | None = None

    def samples(self, rays: Rays, depths: Tensor, edges: Tensor) -> Samples:
        """Returns the samples of rays at depths [r, s], one for each interval between edges [r, s + 1]."""
        r, s = depths.shape
        if self.cones:
            inputs = frustum_gaussians(rays, edges, self.contraction)
        else:
            inputs = torch.addcmul(rays.origins[:, None, :], depths[:, :, None], rays.directions[:, None, :])
            inputs = inputs if self.contraction is None else self.contraction.points(inputs)
        # Copies an expanded view, which is faster than the gather of repeat_interleave.
        index = torch.arange(r, device=depths.device, dtype=torch.int32)[:, None].expand(-1, s).reshape(-1)
        offsets = torch.arange(0, r * s + 1, s, device=depths.device, dtype=torch.int32)
        inputs, deltas = inputs.reshape(r * s, inputs.shape[-1]), edges.diff(dim=-1).reshape(-1)
        return Samples(inputs, index, offsets, depths.reshape(-1), deltas, edges)


class Rendered(NamedTuple):
    """The rendered colours of rays, with the field's outputs at the samples.

    Attributes:
        colour: [r, 3], the background included.
        opacity: [r], 0..1: the sum of the weights.
        depth: [r], expected distance, normalised by the opacity; the far end for a ray with opacity 0.
        weights: [m], the contribution of each sample.
        rgb: [m, 3], the colour of each sample.
        density: [m], the density at each sample.
        samples: The samples at which the field was evaluated.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import Rays, render_rays
        >>> def wall(positions, directions, ray_index):  # opaque where z > 1
        ...     return torch.ones_like(positions), torch.where(positions[:, 2] > 1, 1e9, 0.0)
        >>> rays = Rays(torch.zeros(1, 3), torch.tensor([[0.0, 0, 1]]))
        >>> result = render_rays(wall, rays, 0.0, 2.0, samples=8)
        >>> result.depth, result.weights.shape
        (tensor([1.1250]), torch.Size([8]))
    """

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    weights: Tensor
    rgb: Tensor
    density: Tensor
    samples: Samples


class RayColours(NamedTuple):
    """Colours and depths of the rays of a picture.

    Attributes:
        colour: [r, 3], the background included.
        opacity: [r], 0..1.
        depth: [r], as in `Rendered`.
        heaviest: [r, 3], the position of the heaviest sample of each ray; the far end of a ray without samples.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import Rays, Renderer, Stratified
        >>> def fog(positions, directions, ray_index):
        ...     return torch.ones_like(positions), torch.full_like(positions[:, 0], 0.5)
        >>> rays = Rays(torch.zeros(1, 3), torch.tensor([[0.0, 0, 1]]))
        >>> seen = Renderer({"field": fog}, Stratified(8)).render_colours(rays, torch.zeros(1), torch.ones(1))
        >>> seen.opacity.round(decimals=4)  # 1 - exp(-0.5)
        tensor([0.3935])
    """

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    heaviest: Tensor


@dataclass(frozen=True)
class Batch:
    """A batch of r rays: their bounds in the scene, and their target colours.

    Attributes:
        rays: Origins and unit directions; radii for cones.
        near: [r], the depth at which each ray enters the scene.
        far: [r], the depth at which each ray leaves the scene.
        target: [r, 3], the colour of each ray's pixel over the background.
        background: [3], or [r, 3] if it was drawn for each ray; None for black.
        sparse_depths: [s], the distances at which the first s rays meet points of a sparse model, or None.
        unseen: The number of triples of `voronerf.ops.unseen_rays` at the end of the batch; they have no target colour.

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
        loss: [], the loss.
        error: [r], the squared error of the colour of each ray, summed over the channels.
        weights: [m], contributions of the samples to their rays.
        density: [m], the density at each sample per scene unit.
        samples: The samples of the last pass.
        colour: [r, 3], the rendered colours of the rays.

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
        """Returns [m], the weight of each sample times the error of its ray (Elsner et al. 2023, section 3.1)."""
        return self.weights * self.error.index_select(0, self.samples.ray_index)


def evaluate_field(field: Field, rays: Rays, samples: Samples, space: Space) -> tuple[Tensor, Tensor]:
    """Returns colours [m, 3] and densities [m] of samples, in the dtype of the depths even under autocast.

    The gradients of samples near the camera are scaled, see `Space.full_gradient`.
    """
    outputs = field(samples.inputs, rays.directions, samples.ray_index)
    rgb, density = (values.to(samples.depths.dtype) for values in outputs)
    if space.full_gradient is not None:
        factors = gradient_factors(samples.depths, space.full_gradient)
        for values, scale in ((rgb, factors[:, None]), (density, factors)):
            if values.requires_grad:
                values.register_hook(functools.partial(torch.mul, scale))
    return rgb, density


def gradient_factors(depths: Tensor, full: float) -> Tensor:
    """Returns [m], a factor on the gradient of each sample: (depth / full)^2, at most 1.

    Source: Philip and Deschaintre 2023, "Floaters No More: Radiance Field Gradient Scaling for Improved Near-Camera
    Training".

    Args:
        depths: [m], the distances of the samples.
        full: The distance from which the factor is 1, > 0.
    """
    return (depths / full).square().clamp(max=1)


def render_samples(
    field: Field,
    rays: Rays,
    far: Tensor,
    samples: Samples,
    space: Space,
    *,
    background: Tensor | None = None,
    backend: str = "auto",
) -> Rendered:
    """Renders rays from the samples of a sampler (Mildenhall et al. 2020, NeRF, eq. 3).

    Args:
        field: The field, which is called once on all samples, even if there are none.
        rays: r rays.
        far: [r], the ends of the rays.
        samples: The samples of the rays.
        space: The space of the sampler.
        background: [3] or [r, 3], the colour behind the scene; None is black.
        backend: The backend of the composite op.
    """
    return composite_rays(*evaluate_field(field, rays, samples, space), far, samples, background, backend)


def composite_rays(
    rgb: Tensor, density: Tensor, far: Tensor, samples: Samples, background: Tensor | None, backend: str
) -> Rendered:
    """Composites colours [m, 3] and densities [m] of samples; the other arguments are as in `render_samples`."""
    values_by_ray = (samples.by_ray(values) for values in (density, rgb, samples.depths, samples.deltas))
    offsets = samples.ray_offsets if samples.edges is None else None
    result = composite(*values_by_ray, ray_offsets=offsets, background=background, backend=backend)
    depth = normalised(result.depth, result.opacity, far)
    return Rendered(result.colour, result.opacity, depth, result.weights.reshape(-1), rgb, density, samples)


def normalised(depth: Tensor, opacity: Tensor, far: Tensor) -> Tensor:
    """Returns [r], the depth sums of rays divided by their opacities; the far end for rays with opacity 0."""
    seen = opacity > 0
    return torch.where(seen, depth / torch.where(seen, opacity, 1), far)


def per_ray(distance: Tensor | float, rays: Rays) -> Tensor:
    """Returns [r], a distance for each ray, from one number for all rays or from a tensor."""
    if isinstance(distance, Tensor):
        return distance.expand(len(rays))
    return torch.full_like(rays.origins[:, 0], distance)
