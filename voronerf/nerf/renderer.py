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
from voronerf.nerf.samplers import Sampler, Stratified
from voronerf.nerf.segment import replayed
from voronerf.nerf.volume import RayColours, Rendered, Samples, per_ray, render_samples


class RenderedImage(NamedTuple):
    """A rendered picture, of `Renderer.image`.

    Attributes:
        colour: [h, w, 3], the background included.
        opacity: [h, w].
        depth: [h, w], as in `Rendered`.
        heaviest: [h, w, 3], position of the heaviest sample of each ray; its cell is the one that the pixel shows. A
            ray without samples (opacity 0) has its far end.

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
    """Renders the rays of a scene: fields, asked where a sampler says.

    Attributes:
        fields: By name.
        sampler: Can be set at any time.

    Args:
        fields: By the names of the sampler's networks; "field" has the colours.
        sampler: Where along a ray they are asked.
        backend: Of the ops.

    Raises:
        ValueError: Fields of other names.

    Examples:
        >>> import torch
        >>> from voronerf import NeRF
        >>> from voronerf.nerf import Hierarchical, Rays, Renderer
        >>> networks = {"coarse": NeRF(width=16, depth=2), "field": NeRF(width=16, depth=2)}
        >>> renderer = Renderer(networks, Hierarchical(8, 8))
        >>> rays = Rays(torch.zeros(5, 3), torch.tensor([[0.0, 0, 1]]).expand(5, 3))
        >>> first, second = renderer.render(rays, 1.0, 3.0)
        >>> first.weights.shape, second.weights.shape  # the second pass asks at the points of both
        (torch.Size([40]), torch.Size([80]))
    """

    def __init__(self, fields: Mapping[str, Field], sampler: Sampler, *, backend: str = "auto") -> None:
        wanted = sampler.networks(sampler.space.cones)
        if set(fields) != set(wanted):
            raise ValueError(f"Renderer: fields must be {' and '.join(wanted)}, got {sorted(fields)}")
        self.fields, self.sampler, self.backend = dict(fields), sampler, backend

    @property
    def field(self) -> Field:
        """The field whose colours count."""
        return self.fields["field"]

    @property
    def occupancy(self) -> OccupancyGrid | None:
        """Which space the sampler skips."""
        return self.sampler.grid

    @property
    def cones(self) -> bool:
        """Whether fields are asked about Gaussians."""
        return self.sampler.space.cones

    @property
    def contraction(self) -> Contraction | Perspective | None:
        """The contraction of the space that the fields work in."""
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
        """Renders rays, with one result for each pass; the last has the colours. Differentiable.

        Args:
            rays: r rays, with radii for cones.
            near: [r] or one for all, where the rays begin.
            far: [r] or one for all, where the rays end.
            background: [3] or [r, 3]; None is black.
            jitter: random samples, for training.
            generator: of the jitter.
        """
        near, far = per_ray(near, rays), per_ray(far, rays)

        def look(name: str, samples: Samples) -> Rendered:
            arguments = self.fields[name], rays, far, samples, self.sampler.space
            return render_samples(*arguments, background=background, backend=self.backend)

        samples, before = self.sampler.draw(look, rays, near, far, jitter=jitter, generator=generator)
        return (*before, look("field", samples))

    def see(
        self, rays: Rays, near: Tensor, far: Tensor, background: Tensor | None = None, heaviest: bool = True
    ) -> RayColours:
        """Renders rays of a picture, without randomness.

        Args:
            rays: r rays.
            near: [r].
            far: [r].
            background: [3] or [r, 3]; None is black.
            heaviest: whether to find the heaviest samples; without it that part of the result means nothing.
        """
        arguments = self.field, rays, near, far
        if (seen := self.sampler.see(*arguments, background=background, heaviest=heaviest)) is not None:
            return seen
        last = self.render(rays, near, far, background=background)[-1]
        places = rays.origins
        if heaviest:
            positions, weights = (last.samples.by_ray(values) for values in (last.samples.positions, last.weights))
            places = positions[torch.arange(len(rays), device=places.device), weights.argmax(-1)]
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
        """The whole image of one camera, without gradients and without randomness.

        Args:
            cameras: on the fields' device.
            index: the camera.
            near: nearest distance of interest.
            far: farthest.
            box: [2, 3] outside of which nothing is; rays that miss it show the background without asking the field.
            background: [3], None is black.
            heaviest: whether to look for each ray's heaviest sample; without it that part of the result means nothing.
            chunk: rays rendered at a time; bounds the memory. Default 4,096, and with a grid, which leaves few samples
                of a ray, 131,072.
        """
        if chunk is None:
            chunk = 4096 if self.occupancy is None else 131_072
        if chunk < 1:
            raise ValueError(f"Renderer.image: chunk must be >= 1, got {chunk}")
        bounds: dict[str, Any] = {"near": near, "far": far, "box": box}
        rays, first, last = cameras.image_rays_between(index, cones=self.cones, backend=self.backend, **bounds)
        missed = last <= first
        first, last = first.masked_fill(missed, far), last.masked_fill(missed, far)
        # Through a grid a ray that misses the box costs nothing; without one the field would be asked about it.
        count, asked = len(first), None if self.occupancy is not None else (~missed).nonzero()[:, 0]
        parts = []
        for start in range(0, max(1, count if asked is None else len(asked)), chunk):
            rows = slice(start, start + chunk) if asked is None else asked[start : start + chunk]
            parts.append(self.see(rays[rows], first[rows], last[rows], background, heaviest))
        seen = RayColours(*map(torch.cat, zip(*parts, strict=True)))
        if asked is not None and len(asked) < count:
            none = torch.zeros_like(rays.origins) if background is None else background.expand(count, 3)
            places = rays.origins + far * rays.directions
            places = places if self.contraction is None else self.contraction.points(places)
            whole = none.to(rays.origins), torch.zeros_like(first), torch.full_like(first, far), places
            seen = RayColours(*(to.clone().index_copy_(0, asked, part.to(to.dtype)) for to, part in zip(whole, seen)))
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
    """Colours of rays by quadrature of the volume rendering integral (Mildenhall et al. 2020, NeRF, eq. 3).

    Args:
        field: called once, on all samples; the samples of a ray are consecutive.
        rays: r rays.
        near: start of the integral, [r] or one for all.
        far: end, [r] or one for all. A ray with far == near gets the background.
        samples: s, one in each of s strata; or another sampler, such as `Occupancy`.
        background: [3] or [r, 3], the colour behind the scene; None is black.
        jitter: random samples in the strata, else their middles.
        generator: of the jitter.

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
