"""Renders rays and pictures of a scene.

r rays, h x w pixels. Units as in `voronerf.nerf.volume`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from voronerf.nerf.cameras import Cameras, Rays
from voronerf.nerf.contraction import Contraction, Perspective
from voronerf.nerf.field import Field
from voronerf.nerf.occupancy import OccupancyGrid
from voronerf.nerf.replay import replayed
from voronerf.nerf.samplers import Sampler, Stratified
from voronerf.nerf.volume import RayColours, Rendered, Samples, per_ray, render_samples


class RenderedImage(NamedTuple):
    """A rendered picture, the result of `Renderer.image`.

    Attributes:
        colour: [h, w, 3], the background included.
        opacity: [h, w], 0..1.
        depth: [h, w], as in `Rendered`.
        heaviest: [h, w, 3], the position of the sample with the largest weight; pictures of cells show the cell of this
            sample. For a ray without samples (opacity 0), the far end of the ray.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import Renderer, Stratified, orbit_cameras
        >>> def fog(positions, directions, ray_index):
        ...     return torch.ones_like(positions), torch.full_like(positions[:, 0], 0.5)
        >>> cameras = orbit_cameras(1, radius=2.0, elevation=0.0, width=4, height=3, focal=4.0)
        >>> image = Renderer({"field": fog}, Stratified(8)).image(cameras, 0, near=1.0, far=3.0)
        >>> image.colour.shape, image.depth.shape
        (torch.Size([3, 4, 3]), torch.Size([3, 4]))
    """

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    heaviest: Tensor


@replayed
class Renderer:
    """A renderer of rays, which evaluates fields at the samples of a sampler.

    Attributes:
        fields: The fields by name.
        sampler: The sampler, which can be replaced at any time.

    Args:
        fields: The fields by the names of the sampler's networks; "field" gives the colours.
        sampler: The sampler, which chooses the points along each ray.
        backend: The backend of the ops.

    Raises:
        ValueError: The names of the fields differ from the names of the sampler's networks.

    Examples:
        >>> import torch
        >>> from voronerf import NeRF
        >>> from voronerf.nerf import Hierarchical, Rays, Renderer
        >>> networks = {"coarse": NeRF(width=16, depth=2), "field": NeRF(width=16, depth=2)}
        >>> renderer = Renderer(networks, Hierarchical(8, 8))
        >>> rays = Rays(torch.zeros(5, 3), torch.tensor([[0.0, 0, 1]]).expand(5, 3))
        >>> first, second = renderer.render(rays, 1.0, 3.0)
        >>> first.weights.shape, second.weights.shape  # the second pass includes the points of the first
        (torch.Size([40]), torch.Size([80]))
    """

    def __init__(self, fields: Mapping[str, Field], sampler: Sampler, *, backend: str = "auto") -> None:
        names = sampler.networks(sampler.space.cones)
        if set(fields) != set(names):
            raise ValueError(f"Renderer: fields must be {' and '.join(names)}, got {sorted(fields)}")
        self.fields, self.sampler, self.backend = dict(fields), sampler, backend

    @property
    def field(self) -> Field:
        """The field that gives the colours of the picture."""
        return self.fields["field"]

    @property
    def occupancy(self) -> OccupancyGrid | None:
        """The occupancy grid of the sampler; None if the sampler skips no space."""
        return self.sampler.grid

    @property
    def cones(self) -> bool:
        """True if the fields are evaluated on Gaussians."""
        return self.sampler.space.cones

    @property
    def contraction(self) -> Contraction | Perspective | None:
        """The contraction of space for the fields; None for world coordinates."""
        return self.sampler.space.contraction

    @property
    def device(self) -> torch.device:
        """The device of the field's parameters; the CPU for a field without parameters."""
        parameters = self.field.parameters() if isinstance(self.field, nn.Module) else iter(())
        first = next(parameters, None)
        return torch.device("cpu") if first is None else first.device

    def train(self, mode: bool = True) -> Renderer:
        """Puts the fields into training mode, or into evaluation mode."""
        for field in self.fields.values():
            if isinstance(field, nn.Module):
                field.train(mode)
        return self

    def render(
        self,
        rays: Rays,
        near: Tensor | float,
        far: Tensor | float,
        *,
        background: Tensor | None = None,
        jitter: bool = False,
        generator: torch.Generator | None = None,
    ) -> tuple[Rendered, ...]:
        """Renders rays and returns one result for each pass; the last has the final colours. Differentiable.

        Args:
            rays: r rays, with radii for cones.
            near: [r] or one for all, the distance at which the rays begin.
            far: [r] or one for all, the distance at which the rays end.
            background: [3] or [r, 3], the colour behind the scene; None is black.
            jitter: Whether the samples are random, for training.
            generator: Random generator of the jitter.
        """
        near, far = per_ray(near, rays), per_ray(far, rays)

        def render(name: str, samples: Samples) -> Rendered:
            arguments = self.fields[name], rays, far, samples, self.sampler.space
            return render_samples(*arguments, background=background, backend=self.backend)

        samples, before = self.sampler.draw(render, rays, near, far, jitter=jitter, generator=generator)
        return (*before, render("field", samples))

    def render_colours(
        self, rays: Rays, near: Tensor, far: Tensor, background: Tensor | None = None, heaviest: bool = True
    ) -> RayColours:
        """Renders rays of a picture, without randomness.

        Args:
            rays: r rays.
            near: [r], the distances at which the rays begin.
            far: [r], the distances at which the rays end.
            background: [3] or [r, 3], the colour behind the scene; None is black.
            heaviest: Whether to find the samples with the largest weights; else `heaviest` of the result is undefined.
        """
        arguments = self.field, rays, near, far
        if (seen := self.sampler.render_colours(*arguments, background=background, heaviest=heaviest)) is not None:
            return seen
        last = self.render(rays, near, far, background=background)[-1]
        places = rays.origins
        if heaviest:
            index, numbers = last.samples.ray_index.long(), torch.arange(len(last.weights), device=places.device)
            largest = last.weights.new_zeros(len(rays)).scatter_reduce(0, index, last.weights, "amax")
            numbers = numbers[last.weights == largest[index]]
            places = places.index_copy(0, index[numbers], last.samples.positions[numbers])
        return RayColours(last.colour, last.opacity, last.depth, places)

    @torch.no_grad()
    def image(
        self,
        cameras: Cameras,
        index: int,
        *,
        near: float,
        far: float,
        box: Tensor | None = None,
        background: Tensor | None = None,
        heaviest: bool = True,
        chunk: int | None = None,
    ) -> RenderedImage:
        """Renders the whole image of one camera, without gradients and without randomness.

        Args:
            cameras: The cameras, on the device of the fields.
            index: The index of the camera.
            near: The nearest distance of interest.
            far: The farthest distance of interest.
            box: [2, 3], the box of the scene. Rays that miss it show the background and do not evaluate the field.
            background: [3], the colour behind the scene; None is black.
            heaviest: Whether to find the samples with the largest weights; else `heaviest` of the result is undefined.
            chunk: The number of rays rendered at a time, which bounds the memory. Default 4,096; 131,072 with a grid,
                since rays then have few samples.
        """
        if chunk is None:
            chunk = 4096 if self.occupancy is None else 131_072
        if chunk < 1:
            raise ValueError(f"Renderer.image: chunk must be >= 1, got {chunk}")
        bounds: dict[str, Any] = {"near": near, "far": far, "box": box}
        rays, first, last = cameras.image_rays_between(index, cones=self.cones, backend=self.backend, **bounds)
        missed = last <= first
        first, last = first.masked_fill(missed, far), last.masked_fill(missed, far)
        # A ray that misses the box costs nothing with a grid; without a grid it would evaluate the field.
        count, hits = len(first), None if self.occupancy is not None else (~missed).nonzero()[:, 0]
        parts = []
        for start in range(0, max(1, count if hits is None else len(hits)), chunk):
            rows = slice(start, start + chunk) if hits is None else hits[start : start + chunk]
            parts.append(self.render_colours(rays[rows], first[rows], last[rows], background, heaviest))
        seen = RayColours(*map(torch.cat, zip(*parts, strict=True)))
        if hits is not None and len(hits) < count:
            behind = torch.zeros_like(rays.origins) if background is None else background.expand(count, 3)
            places = rays.origins + far * rays.directions
            places = places if self.contraction is None else self.contraction.points(places)
            blank = behind.to(rays.origins), torch.zeros_like(first), torch.full_like(first, far), places
            seen = RayColours(
                *(values.clone().index_copy_(0, hits, part.to(values.dtype)) for values, part in zip(blank, seen))
            )
        colour, opacity, depth, places = seen
        size = cameras.size(index)[::-1]
        return RenderedImage(
            colour.reshape(*size, 3), opacity.reshape(size), depth.reshape(size), places.reshape(*size, 3)
        )


def render_rays(
    field: Field,
    rays: Rays,
    near: Tensor | float,
    far: Tensor | float,
    *,
    samples: int | Sampler,
    background: Tensor | None = None,
    jitter: bool = False,
    generator: torch.Generator | None = None,
) -> Rendered:
    """Renders rays by quadrature of the volume rendering integral (Mildenhall et al. 2020, NeRF, eq. 3).

    Args:
        field: The field, which is called once on all samples; the samples of a ray are consecutive.
        rays: r rays.
        near: Start of the integral, [r] or one for all.
        far: End of the integral, [r] or one for all. A ray with far == near gets the background.
        samples: s, the number of strata with one sample each; or a sampler, such as `Occupancy`.
        background: [3] or [r, 3], the colour behind the scene; None is black.
        jitter: Whether samples are at random positions in their strata instead of the middles.
        generator: Random generator of the jitter.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import Rays, render_rays
        >>> def fog(positions, directions, ray_index):
        ...     return torch.ones_like(positions), torch.full_like(positions[:, 0], 0.5)
        >>> rays = Rays(torch.zeros(1, 3), torch.tensor([[0.0, 0, 1]]))
        >>> result = render_rays(fog, rays, 0.0, 2.0, samples=64)
        >>> result.opacity.round(decimals=4)  # 1 - exp(-0.5 * 2)
        tensor([0.6321])
    """
    sampler = Stratified(samples) if isinstance(samples, int) else samples
    renderer = Renderer({"field": field}, sampler, backend=sampler.backend)
    return renderer.render(rays, near, far, background=background, jitter=jitter, generator=generator)[-1]
