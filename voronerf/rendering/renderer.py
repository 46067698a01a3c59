"""Renders rays in one pass, or in several, where later passes sample where earlier ones found something.

r rays, h x w pixels. Units as in `voronerf.rendering.volume`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from voronerf.ops.resample import resample
from voronerf.rendering.cameras import Cameras, Rays
from voronerf.rendering.comparison import Comparison, compare_marched, compared
from voronerf.rendering.contraction import Contraction, Perspective
from voronerf.rendering.field import Field
from voronerf.rendering.marching import Marched, Seen, render_marched, render_until_opaque
from voronerf.rendering.occupancy import OccupancyGrid
from voronerf.rendering.rays import intersect_box
from voronerf.rendering.sampling import (
    blurred_weights,
    distortion_loss,
    interlevel_loss,
    normalised,
    sighting_loss,
    strata_uniforms,
    stratified_depths,
    stratified_edges,
    union_depths,
)
from voronerf.rendering.volume import Rendered, per_ray, render_samples

#: Share of the first pass in the loss if one network is evaluated in two passes (mip-NeRF, section 3.2).
COARSE_SHARE = 0.1


class RenderedImage(NamedTuple):
    """What `Renderer.image` returns.

    Attributes:
        colour: [h, w, 3], the background included.
        opacity: [h, w].
        depth: [h, w], as in `Rendered`.
        heaviest: [h, w, 3], position of the heaviest sample of each ray; its cell is the one that the pixel shows. A
            ray without samples (opacity 0) has its far end.

    Examples:
        >>> import torch
        >>> from voronerf.rendering import Renderer, orbit_cameras
        >>> def fog(positions, directions, ray_index):
        ...     return torch.ones_like(positions), torch.full_like(positions[:, 0], 0.5)
        >>> cameras = orbit_cameras(1, radius=2.0, elevation=0.0, width=4, height=3, focal=4.0)
        >>> image = Renderer({"field": fog}, samples=8).image(cameras, 0, near=1.0, far=3.0, box=None, background=None)
        >>> image.colour.shape, image.depth.shape
        (torch.Size([3, 4, 3]), torch.Size([3, 4]))
    """

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    heaviest: Tensor


class Renderer:
    """Renders the rays of a scene: which fields are evaluated, where along a ray, and in how many passes.

    - "field" alone, no fine samples: one pass over stratified samples.
    - "field" alone with fine samples: the field is evaluated twice (mip-NeRF, section 3.2).
    - "coarse" and "field": the first pass uses the coarse field (NeRF, section 5.2).
    - "proposal" and "field": a density field is evaluated first, in one or more rounds. It learns where the last pass
      finds something; its colours are not used (mip-NeRF 360, section 3).

    The second pass evaluates the samples of both passes; for cones and after a proposal only new intervals.

    Attributes:
        fields: by name.
        occupancy: which space a single pass over points may skip; can be set at any time.
        sharpness: exponent on the weights of a proposal when intervals are drawn from them with jitter, 0..1; 1 at
            first. A smaller one spreads the next pass more evenly (the annealing of mip-NeRF 360, section 3).

    Args:
        fields: by name, as above.
        samples: samples a ray in the first pass.
        fine_samples: samples a ray in the second pass; 0 for a single pass.
        cones: evaluate Gaussians [n, 6] instead of points [n, 3]; rays need radii.
        contraction: of the space that the fields work in.
        spacing: of the strata, "linear" or "disparity".
        occupancy: which space is empty, for a single pass over points.
        rounds: how often a proposal is evaluated, each time on new intervals where it has found something.
        distortion: factor of the `distortion_loss` of the last pass; 0 is off.
        picture_samples: samples a ray of a picture through the occupancy grid; None for `samples`. A picture is walked
            to the first surface alone, so that more of them cost little.
        sightings: factor of the `sighting_loss` of the last pass; 0 is off.
        full_gradient: distance from which the gradients of samples are whole; nearer ones learn less, by the square of
            their distance (Philip and Deschaintre 2023). None for any distance.
        backend: of the ops.

    Raises:
        ValueError: fields of other names, a second field without fine samples, several rounds without a proposal, a
            negative distortion, or occupancy with several passes, cones, distortion or without the contraction.

    Examples:
        >>> import torch
        >>> from voronerf import NeRF
        >>> from voronerf.rendering import Rays, Renderer
        >>> renderer = Renderer({"field": NeRF(width=16, depth=2)}, samples=8, fine_samples=8)
        >>> rays = Rays(torch.zeros(5, 3), torch.tensor([[0.0, 0, 1]]).expand(5, 3))
        >>> first, second = renderer.render(rays, 1.0, 3.0)
        >>> first.weights.shape, second.colour.shape  # the second pass asks at the points of both
        (torch.Size([5, 8]), torch.Size([5, 3]))
    """

    def __init__(
        self,
        fields: Mapping[str, Field],
        *,
        samples: int,
        fine_samples: int = 0,
        cones: bool = False,
        contraction: Contraction | Perspective | None = None,
        spacing: str = "linear",
        occupancy: OccupancyGrid | None = None,
        rounds: int = 1,
        distortion: float = 0.0,
        picture_samples: int | None = None,
        sightings: float = 0.0,
        full_gradient: float | None = None,
        backend: str = "auto",
    ) -> None:
        if set(fields) not in ({"field"}, {"field", "coarse"}, {"field", "proposal"}):
            raise ValueError(f"Renderer: fields must be field, and coarse or proposal, got {sorted(fields)}")
        if min(samples, fine_samples + 1) < 1:
            raise ValueError(f"Renderer: samples must be >= 1 and fine_samples >= 0, got {samples} and {fine_samples}")
        if len(fields) > 1 and fine_samples < 1:
            raise ValueError("Renderer: fine_samples must be >= 1 with two fields, got 0")
        if rounds < 1 or (rounds > 1 and "proposal" not in fields):
            raise ValueError(f"Renderer: rounds must be >= 1, and 1 without a proposal, got {rounds}")
        if not 0 <= distortion < float("inf"):
            raise ValueError(f"Renderer: distortion must be >= 0 and finite, got {distortion}")
        if occupancy is not None and (fine_samples or cones or distortion):
            raise ValueError("Renderer: occupancy must come with a single pass over points, without distortion")
        if occupancy is not None and (occupancy.contraction is None) != (contraction is None):
            raise ValueError("Renderer: occupancy must be a grid in the space of contraction, got one in another")
        self.fields = dict(fields)
        self.samples, self.fine_samples, self.cones = samples, fine_samples, cones
        self.picture_samples = picture_samples or samples
        self.contraction, self.spacing, self.backend = contraction, spacing, backend
        self.rounds, self.distortion, self.sightings = rounds, distortion, sightings
        self.full_gradient = full_gradient
        self.occupancy = occupancy
        self.sharpness = 1.0

    @property
    def field(self) -> Field:
        """The field of the last pass, whose colours count."""
        return self.fields["field"]

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
    ) -> tuple[Rendered | Marched, ...]:
        """Renders rays, with one result for each pass; the last has the colours, the others are for :meth:`loss`.

        Args:
            rays: r rays, with radii for cones.
            near: [r] or one for all, where the rays begin.
            far: [r] or one for all, where the rays end.
            background: [3] or [r, 3]; None is black.
            jitter: random samples, for training.
            generator: of the jitter.
        """
        near, far = per_ray(near, rays), per_ray(far, rays)
        if self.occupancy is not None:
            marched = render_marched(
                self.field,
                rays,
                near,
                far,
                self.occupancy,
                samples=self.samples,
                background=background,
                jitter=jitter,
                generator=generator,
                spacing=self.spacing,
                full_gradient=self.full_gradient,
                backend=self.backend,
            )
            return (marched,)
        if self.cones:
            edges = stratified_edges(near, far, self.samples, jitter=jitter, spacing=self.spacing, generator=generator)
            depths = (edges[:, 1:] + edges[:, :-1]) / 2
        else:
            depths, _, edges = stratified_depths(
                near, far, self.samples, jitter=jitter, spacing=self.spacing, generator=generator
            )
        first_field = self.fields.get("coarse", self.fields.get("proposal", self.field))
        passes = [self._render_samples(first_field, rays, depths, edges, background)]
        if not self.fine_samples:
            return tuple(passes)
        for _ in range(self.rounds - 1):
            depths, edges = self._intervals(passes[-1], self.samples, jitter, generator)
            passes.append(self._render_samples(first_field, rays, depths, edges, background))
        if self.cones or "proposal" in self.fields:
            depths, edges = self._intervals(passes[-1], self.fine_samples, jitter, generator)
        else:
            weights, count = passes[-1].weights.detach(), self.fine_samples
            depths, edges = union_depths(
                depths, edges, weights, count, jitter=jitter, generator=generator, backend=self.backend
            )
        return (*passes, self._render_samples(self.field, rays, depths, edges, background))

    def _render_samples(
        self, field: Field, rays: Rays, depths: Tensor, edges: Tensor, background: Tensor | None
    ) -> Rendered:
        return render_samples(
            field,
            rays,
            depths,
            edges,
            cones=self.cones,
            contraction=self.contraction,
            background=background,
            full_gradient=self.full_gradient,
            backend=self.backend,
        )

    def _intervals(
        self, before: Rendered, count: int, jitter: bool, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """`count` new intervals where the pass before found something, and a sample in each."""
        r, weights = len(before.edges), blurred_weights(before.weights.detach())
        if jitter and "proposal" in self.fields and self.sharpness != 1.0:
            weights = weights**self.sharpness
        uniforms = strata_uniforms(r, count + 1, before.edges, jitter, generator)
        edges = resample(weights, before.edges, count + 1, uniforms=uniforms, backend=self.backend)
        if self.cones or not jitter:
            return (edges[:, 1:] + edges[:, :-1]) / 2, edges
        device = edges.device if generator is None else generator.device
        inside = torch.rand(r, count, device=device, dtype=edges.dtype, generator=generator).to(edges.device)
        return torch.lerp(edges[:, :-1], edges[:, 1:], inside), edges

    def loss(self, passes: tuple[Rendered | Marched, ...], target: Tensor, seen: Tensor | None = None) -> Tensor:
        """The training loss: the mean squared error of the colours of every pass (NeRF, equation 6).

        If one field is evaluated twice, its first pass counts a tenth (mip-NeRF, section 3.2). Passes of a proposal
        have the `interlevel_loss` instead. The last pass has the `distortion_loss` and the `sighting_loss` too, where
        their factors are not 0.

        Args:
            passes: the result of :meth:`render`.
            target: [r, 3].
            seen: [s], the distances of points at which the last s rays end, or None.
        """
        *before, last = passes
        loss = (last.colour - target).square().mean()
        if self.distortion:
            assert isinstance(passes[0], Rendered) and isinstance(last, Rendered)
            near, far = passes[0].edges[:, 0], passes[0].edges[:, -1]
            spread = distortion_loss(normalised(last.edges, near, far, self.spacing), last.weights)
            loss = loss + self.distortion * spread
        if self.sightings and seen is not None and isinstance(last, Rendered):
            some = slice(len(target) - len(seen), None)
            missed = sighting_loss(last.depths[some], last.edges[some], last.weights[some], seen)
            loss = loss + self.sightings * missed
        for first in before:
            if "proposal" in self.fields:
                assert isinstance(first, Rendered) and isinstance(last, Rendered)
                loss = loss + interlevel_loss(last.edges, last.weights, first.edges, first.weights)
            else:
                share = 1.0 if "coarse" in self.fields else COARSE_SHARE
                loss = loss + share * (first.colour - target).square().mean()
        return loss

    def compare(
        self,
        rays: Rays,
        near: Tensor | float,
        far: Tensor | float,
        target: Tensor,
        *,
        background: Tensor | None = None,
        generator: torch.Generator | None = None,
        seen: Tensor | None = None,
    ) -> Comparison:
        """Renders rays at random samples and computes the :meth:`loss`: what a training step needs.

        Args:
            rays: as in :meth:`render`, like the next two.
            near: [r] or one for all.
            far: [r] or one for all.
            target: [r, 3].
            background: as in :meth:`render`.
            generator: of the samples.
            seen: as in :meth:`loss`.
        """
        near, far = per_ray(near, rays), per_ray(far, rays)
        given: dict[str, Any] = {"background": background, "generator": generator}
        found = compare_marched(self, rays, near, far, target, **given)
        if found is not None:
            return found
        passes = self.render(rays, near, far, jitter=True, **given)
        return compared(self.loss(passes, target, seen), passes[-1], target)

    def look(self, rays: Rays, near: Tensor, far: Tensor, background: Tensor | None, heaviest: bool) -> Seen:
        """What rays of a picture see, without randomness; without `heaviest` that part of the result means nothing."""
        if self.occupancy is not None:
            return render_until_opaque(
                self.field,
                rays,
                near,
                far,
                self.occupancy,
                samples=self.picture_samples,
                background=background,
                spacing=self.spacing,
                heaviest=heaviest,
                backend=self.backend,
            )
        last = self.render(rays, near, far, background=background)[-1]
        places = rays.origins
        if heaviest:
            places = last.positions[torch.arange(len(rays), device=places.device), last.weights.argmax(-1)]
        return Seen(last.colour, last.opacity, last.depth, places)

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
            heaviest: whether to look for each ray's heaviest sample; without it the result has every ray's far end.
            chunk: rays rendered at a time; bounds the memory. Default 4,096, and with a grid, which leaves few samples
                of a ray, 131,072.
        """
        grid = self.occupancy
        if chunk is None:
            chunk = 4096 if grid is None else 131_072
        if chunk < 1:
            raise ValueError(f"Renderer.image: chunk must be >= 1, got {chunk}")
        rays = cameras.image_rays(index, cones=self.cones)
        first, last, hit = intersect_box(rays.origins, rays.directions, box, near, far)
        colour = torch.zeros_like(rays.origins)
        colour = colour if background is None else background.to(colour).repeat(len(rays), 1)
        opacity, depth = torch.zeros_like(first), torch.full_like(first, far)
        places = rays.origins + far * rays.directions
        places = places if self.contraction is None else self.contraction.points(places)
        for rows in hit.nonzero()[:, 0].split(chunk):
            seen = self.look(rays[rows], first[rows], last[rows], background, heaviest)
            for whole, part in zip((colour, opacity, depth), seen):
                whole[rows] = part.to(whole.dtype)
            if heaviest:
                places[rows] = seen.heaviest
        size = cameras.size(index)[::-1]
        return RenderedImage(
            colour.reshape(*size, 3), opacity.reshape(size), depth.reshape(size), places.reshape(*size, 3)
        )
