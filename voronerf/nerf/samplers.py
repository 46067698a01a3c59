"""Samplers, which choose the points along rays where a field is evaluated.

A new sampler is a class here and a line in `SAMPLERS`. r rays, m samples of all rays (packed), s samples per ray.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from voronerf.nerf import schedule
from voronerf.nerf.cameras import Rays
from voronerf.nerf.contraction import Contraction
from voronerf.nerf.field import Field
from voronerf.nerf.fields.hashgrid import LONG
from voronerf.nerf.occupancy import DECAY, OccupancyGrid, draw_seed
from voronerf.nerf.radiance import radiance_of, router_of
from voronerf.nerf.replay import replayed
from voronerf.nerf.sampling import (
    blurred_weights,
    colour_loss,
    strata_uniforms,
    stratified_depths,
    stratified_edges,
    union_depths,
)
from voronerf.nerf.schedule import WARMUP_STEPS
from voronerf.nerf.volume import RayColours, Rendered, RenderOutput, Samples, Space
from voronerf.ops._core.rows import fixed_count
from voronerf.ops.composite import composite
from voronerf.ops.formulas import Wave, walk
from voronerf.ops.resample import resample

#: The weight of the first pass in the loss if one network serves two passes (mip-NeRF, section 3.2).
COARSE_SHARE = 0.1
#: The divisor of the number of strata per ray in the first steps, while an occupancy grid is not updated yet.
SETTLING_PART = 4
#: The least number of first steps in which a grid over space contracted to a ball (`Contraction`) is not updated; other
#: grids use `WARMUP_STEPS`. After these steps, the grid still waits until the field has learnt enough, which takes the
#: longer the lower the learning rate is: see `OccupancyGrid.can_learn_from`.
SETTLING_STEPS = 400
#: The fraction of voxels that are evaluated at random before each `GROUP` of steps, and the maximum number of these
#: voxels: about the number of samples of a few steps.
REVISITED, MOST_REVISITED = 1 / 8, 32_768
#: Above this fraction of occupied voxels after a training, `Occupancy.finish` evaluates every voxel of a box.
FULL = 0.5
#: The number of strata per ray in pictures: the ratio to the number in training, and the maximum in a box and in
#: contracted space. A training needs fewer strata, since its jittered samples cover each stratum over time. In a box,
#: twice the 256 strata of a long training would improve no picture by more than 0.05 dB. Photographs with 576 strata
#: instead of 384 have less grain at edges: 0.08 dB and 0.006 of SSIM on bonsai.
PICTURE_SAMPLES, MOST_PICTURE_SAMPLES, MOST_CONTRACTED_SAMPLES = 2, 384, 576
#: The transmittance below which a ray of a picture ends; the ray then counts as opaque with its colour so far.
OPAQUE = 0.05
#: Pictures are rendered in waves. A wave evaluates the next few samples of each ray that is not yet opaque. These are
#: the numbers of samples per ray and wave, in a box and in contracted space. Small waves have more overhead, large
#: waves evaluate samples behind the surface in vain. Photographs need contracted space and have more rays, so the
#: overhead of a wave counts less.
WAVE, CONTRACTED_WAVE = 12, 8
#: The samples per ray of a wave if one operation runs all waves; the overhead of a wave is then negligible.
FINE_WAVE = 4
#: The number of strata per ray in contracted space, by the minimum training time in seconds. More strata make steps
#: slower, but pictures sharper in the end.
CONTRACTED_SAMPLES = {0.0: 128, LONG: 256, 90.0: 384}
#: A training in a box is long if it has at least `LONG_IN_BOX` seconds for each pixel that the longest side of the box
#: spans in the training views. A long training has at most `LONG_SAMPLES` strata per ray.
LONG_IN_BOX, LONG_SAMPLES = 0.45, 256
#: A function (name, samples) that renders the samples with the field of this name.
RenderPass = Callable[[str, Samples], Rendered]


@replayed
class Sampler:
    """A method that chooses the sample points of rays; it may learn from the steps of a training.

    A subclass defines :meth:`sample`. A subclass with several passes also defines :meth:`draw` and
    :meth:`earlier_loss`. A subclass that learns defines :meth:`step_pre_backward` and :meth:`step_post_backward`. A
    subclass that skips empty space defines ``grid``. The library uses only these members, never the class of a sampler.

    Each training step calls :meth:`step_pre_backward`, then :meth:`sample` after drawing its rays, then
    :meth:`step_post_backward` after the optimiser. These hooks may change the sampler and its grid; after changes to
    other objects, the rest of the step runs eagerly. The tensors that a hook receives belong to the step, and must be
    read before the hook returns. A subclass's own hooks run in Python in every step; see :class:`TrainingStep`.

    Attributes:
        passes: The number of passes over a ray, each with its own number of samples.
        skips: Whether `Occupancy` replaces this sampler if there is a grid.
        samples: s, the number of samples per ray in the first pass.
        space: The coordinates in which rays are sampled and the field is evaluated.
        backend: The backend of the ops.
        settling_steps: The minimum number of training steps before the first update of the grid.

    Args:
        samples: s, the number of samples per ray in the first pass, at least 1.
        space: The coordinates of samples and field; None for world coordinates with even spacing.
        backend: The backend of the ops.

    Raises:
        ValueError: ``samples`` is below 1.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import Rays, Sampler, render_rays
        >>> class Middle(Sampler):  # one sample in the middle of each ray
        ...     def sample(self, rays, near, far, *, jitter=False, generator=None):
        ...         return self.space.samples(rays, (near + far)[:, None] / 2, torch.stack((near, far), 1))
        >>> def fog(positions, directions, ray_index):
        ...     return torch.ones_like(positions), torch.full_like(positions[:, 0], 0.5)
        >>> rays = Rays(torch.zeros(1, 3), torch.tensor([[0.0, 0, 1]]))
        >>> render_rays(fog, rays, 0.0, 2.0, samples=Middle(1)).depth
        tensor([1.])
    """

    passes: ClassVar[int] = 1
    skips: ClassVar[bool] = False
    settling_steps: int = 0

    def __init__(self, samples: int, *, space: Space | None = None, backend: str = "auto") -> None:
        if samples < 1:
            raise ValueError(f"{type(self).__name__}: samples must be >= 1, got {samples}")
        self.samples, self.space, self.backend = samples, space or Space(), backend

    @staticmethod
    def networks(cones: bool) -> tuple[str, ...]:
        """Returns the names of a cell's networks; "field" gives the colours."""
        return ("field",)

    @property
    def grid(self) -> OccupancyGrid | None:
        """The occupancy grid, whose empty space is skipped; None for a sampler that skips nothing."""
        return None

    @property
    def strata(self) -> int:
        """The maximum number of samples per ray in the first pass of the next training step."""
        return self.samples

    def explain(self) -> str:
        """Describes the sampler in one line."""
        return f"{type(self).__name__}, {self.samples} a ray"

    def sample(
        self,
        rays: Rays,
        near: Tensor,
        far: Tensor,
        *,
        jitter: bool = False,
        generator: torch.Generator | None = None,
    ) -> Samples:
        """Returns the samples of the first pass.

        Args:
            rays: r rays, with radii for cones.
            near: [r], the distances at which the rays begin.
            far: [r], the distances at which the rays end.
            jitter: Whether the samples are random, for training; else they are the same in each call.
            generator: Random generator of the jitter.
        """
        raise NotImplementedError

    def draw(
        self,
        render: RenderPass,
        rays: Rays,
        near: Tensor,
        far: Tensor,
        *,
        jitter: bool = False,
        generator: torch.Generator | None = None,
    ) -> tuple[Samples, tuple[Rendered, ...]]:
        """Returns the samples of the last pass, and the rendered results of the earlier passes.

        Args:
            render: Function (name, samples) that renders the samples of an earlier pass with the field of this name.
            rays: r rays.
            near: [r], the distances at which the rays begin.
            far: [r], the distances at which the rays end.
            jitter: Whether the samples are random.
            generator: Random generator of the jitter.
        """
        return self.sample(rays, near, far, jitter=jitter, generator=generator), ()

    def render_colours(
        self, field: Field, rays: Rays, near: Tensor, far: Tensor, *, background: Tensor | None, heaviest: bool
    ) -> RayColours | None:
        """Renders rays of a picture with fewer samples than :meth:`draw`; returns None if this is not possible.

        Args:
            field: The field that gives the colours.
            rays: r rays.
            near: [r], the distances at which the rays begin.
            far: [r], the distances at which the rays end.
            background: [3] or [r, 3], the colour behind the scene; None is black.
            heaviest: Whether to find the samples with the largest weights; else `heaviest` of the result is undefined.
        """
        return None

    def earlier_loss(self, earlier: Rendered, last: Rendered, target: Tensor) -> Tensor:
        """Returns the loss [] that an earlier pass adds to the loss of the last pass.

        Args:
            earlier: The rendered result of the earlier pass.
            last: The rendered result of the last pass.
            target: [r, 3], the colours of the rays.
        """
        raise NotImplementedError

    def step_pre_backward(self, field: Field, step: int, generator: torch.Generator) -> None:
        """Updates the sampler before a training step draws its rays.

        Args:
            field: The field being trained.
            step: The number of the step, from 0.
            generator: Random generator for the sampler.
        """

    def evaluates_at(self, step: int) -> bool:
        """Returns whether :meth:`step_pre_backward` evaluates the field before a step.

        Args:
            step: The number of the step, from 0.
        """
        return False

    def steps_per_update(self, step: int) -> int:
        """Returns the number of steps, from ``step`` on, for which one call of :meth:`step_pre_backward` suffices.

        Args:
            step: The number of the first step after the call, from 0.
        """
        return 1

    def step_post_backward(self, output: RenderOutput) -> None:
        """Learns from a step after its loss was computed.

        Args:
            output: The result of :class:`voronerf.nerf.RayLoss`.
        """

    def finish(self, field: Field, seed: int) -> None:
        """Called after the last step of a training, for example to clean a grid; does nothing by default.

        Args:
            field: The trained field.
            seed: Seed of the random choices.
        """


@replayed
class Stratified(Sampler):
    """A sampler with one sample in each of s strata of a ray (NeRF, section 4).

    Examples:
        >>> import torch
        >>> from voronerf.nerf import Rays, Stratified
        >>> rays = Rays(torch.zeros(5, 3), torch.tensor([[0.0, 0, 1]]).expand(5, 3))
        >>> samples = Stratified(8).sample(rays, torch.ones(5), torch.full((5,), 3.0))
        >>> samples.positions.shape, samples.ray_offsets
        (torch.Size([40, 3]), tensor([ 0,  8, 16, 24, 32, 40], dtype=torch.int32))
    """

    skips = True

    def sample(
        self,
        rays: Rays,
        near: Tensor,
        far: Tensor,
        *,
        jitter: bool = False,
        generator: torch.Generator | None = None,
    ) -> Samples:
        """See :meth:`Sampler.sample`."""
        space = self.space
        options: dict[str, Any] = {"jitter": jitter, "spacing": space.spacing, "generator": generator}
        if space.cones:
            edges = stratified_edges(near, far, self.samples, **options)
            depths = (edges[:, 1:] + edges[:, :-1]) / 2
        else:
            depths, _, edges = stratified_depths(near, far, self.samples, **options)
        return space.samples(rays, depths, edges)


@replayed
class Occupancy(Sampler):
    """A stratified sampler that skips the empty voxels of a grid, so rays differ in their number of samples.

    In a training the grid learns from the samples of each step, once `settling_steps` are done and the field can tell
    empty space from the rest (`OccupancyGrid.can_learn_from`). Before each `GROUP` of steps the field is evaluated in
    random voxels, which restores voxels that were emptied by mistake.

    Attributes:
        grid: The occupancy grid; all space outside its box is empty.
        settling: Whether the grid is not updated yet. A training step then uses only a fraction of the strata: no space
            is skipped yet, and an untrained field finds its surfaces sooner with fewer and longer strata.

    Args:
        grid: The occupancy grid, in contracted space if there is a contraction. It can be replaced at any time.
        samples: s, the number of strata per ray.
        picture_samples: The number of strata per ray in pictures; None for `PICTURE_SAMPLES` times ``samples``. Since
            rays of a picture end at the first surface, additional strata cost little.
        space: The coordinates in which rays are sampled and the field is evaluated.
        empty: bool [v] for all v voxels of the grid, True for voxels that stay empty in a training; None for none.
        backend: The backend of the ops.

    Raises:
        ValueError: The space has cones, or only one of the grid and the space has a contraction.

    Examples:
        >>> import torch
        >>> from voronerf import OccupancyGrid
        >>> from voronerf.nerf import Occupancy, Rays, render_rays
        >>> def fog(positions, directions, ray_index):
        ...     return torch.ones_like(positions), torch.full_like(positions[:, 0], 0.5)
        >>> grid = OccupancyGrid(torch.tensor([[-1.0, -1, -1], [1.0, 1, 1]]), 4, threshold=0.1)
        >>> rays = Rays(torch.tensor([[0.0, 0, -2]]), torch.tensor([[0.0, 0, 1]]))
        >>> samples = render_rays(fog, rays, 0.0, 4.0, samples=Occupancy(grid, 8)).samples
        >>> samples.positions[:, 2], samples.ray_index  # the samples inside the box
        (tensor([-0.7500, -0.2500,  0.2500,  0.7500]), tensor([0, 0, 0, 0], dtype=torch.int32))
    """

    def __init__(
        self,
        grid: OccupancyGrid,
        samples: int,
        *,
        picture_samples: int | None = None,
        space: Space | None = None,
        empty: Tensor | None = None,
        backend: str = "auto",
    ) -> None:
        super().__init__(samples, space=space, backend=backend)
        if self.space.cones or (grid.contraction is None) != (self.space.contraction is None):
            raise ValueError("Occupancy: grid requires point samples and the same contraction as the space")
        self.empty = None if empty is None else empty.view(grid.occupied.shape)
        self.grid = grid
        most = MOST_PICTURE_SAMPLES if grid.contraction is None else MOST_CONTRACTED_SAMPLES
        self.picture_samples = picture_samples or max(min(PICTURE_SAMPLES * samples, most), samples)
        self.settling = False

    @property
    def grid(self) -> OccupancyGrid:
        """The occupancy grid."""
        return self._grid

    @grid.setter
    def grid(self, grid: OccupancyGrid) -> None:
        self._grid = grid
        self._leave_empty()

    @property
    def settling_steps(self) -> int:  # type: ignore[override]
        """The minimum number of training steps before the first update of the grid."""
        return SETTLING_STEPS if isinstance(self.grid.contraction, Contraction) else WARMUP_STEPS

    @property
    def strata(self) -> int:
        """The number of strata per ray in a training step: `samples`, or a fraction of it while the grid settles."""
        return max(1, self.samples // SETTLING_PART) if self.settling else self.samples

    def explain(self) -> str:
        """Describes the sampler and the occupied fraction of its grid in one line."""
        return f"{super().explain()}; {self.grid.share:.0%} of the grid is occupied"

    @torch.no_grad()
    def render_colours(
        self, field: Field, rays: Rays, near: Tensor, far: Tensor, *, background: Tensor | None, heaviest: bool
    ) -> RayColours:
        """Renders rays in waves, each ray until it is opaque; see :meth:`Sampler.render_colours`.

        A wave is a few samples of every ray that is not yet opaque, so the field evaluates few samples behind the first
        surface of each ray. A ray that ends early counts as opaque with its colour at that point. The samples are the
        middles of the ``picture_samples`` strata.

        Examples:
            >>> import torch
            >>> from voronerf import OccupancyGrid
            >>> from voronerf.nerf import Occupancy, Rays
            >>> def wall(positions, directions, ray_index):  # opaque where z > 0
            ...     return torch.ones_like(positions), torch.where(positions[:, 2] > 0, 1e9, 0.0)
            >>> grid = OccupancyGrid(torch.tensor([[-1.0, -1, -1], [1.0, 1, 1]]), 4, threshold=0.1)
            >>> rays = Rays(torch.tensor([[0.0, 0, -2]]), torch.tensor([[0.0, 0, 1]]))
            >>> ends = torch.zeros(1), torch.full((1,), 4.0)
            >>> seen = Occupancy(grid, 8).render_colours(wall, rays, *ends, background=None, heaviest=True)
            >>> seen.colour, seen.depth
            (tensor([[1., 1., 1.]]), tensor([2.1250]))
        """
        contraction = self.space.contraction
        network = self._network_arguments(field, rays)
        if network is not None:
            options = {"spacing": self.space.spacing, "backend": self.backend, "heaviest": heaviest, "wave": FINE_WAVE}
            options |= {"opaque": OPAQUE, "background": None if background is None else background.to(near)}
            seen = self.grid.render_colours(rays, near, far, self.picture_samples, **network, **options)
        else:
            wave = WAVE if contraction is None else CONTRACTED_WAVE

            def render_wave(live: Tensor, start: Tensor | None) -> Wave:
                live_rays = rays if start is None else rays[live]
                ends = near[live], far[live]
                samples, stop = self.march(live_rays, *ends, start=start, max_samples=wave, picture=True)
                rgb, sigma = (
                    values.to(near.dtype) for values in field(samples.inputs, live_rays.directions, samples.ray_index)
                )
                intervals = samples.depths, samples.deltas
                part = composite(sigma, rgb, *intervals, ray_offsets=samples.ray_offsets, backend=self.backend)
                return Wave(part, samples.ray_index, samples.ray_offsets, samples.depths, stop)

            seen = walk(render_wave, far, self.picture_samples, wave, OPAQUE, background, heaviest)
        positions = rays.origins
        if heaviest:
            positions = rays.origins + seen.heaviest[:, None] * rays.directions
            positions = positions if contraction is None else contraction.points(positions)
        return RayColours(seen.colour, seen.opacity, seen.depth, positions)

    def _network_arguments(self, field: Field, rays: Rays) -> dict[str, Any] | None:
        """Returns a field's arguments for `render_opaque`; None if the op cannot run the field, or for Warp or CUDA."""
        router = router_of(field)
        if router is None or not rays.origins.is_cpu or "warp" in (self.backend, router.backend):
            return None
        radiance = radiance_of(field, (rays.origins, rays.directions))
        if isinstance(radiance, str):
            return None
        cells = router.places(rays.origins)
        if cells.cells is not None:  # each sample has its own cell
            return None
        return {"network": radiance.network(radiance.networks.program), "cells": cells._replace(coords=None)}

    def _leave_empty(self) -> None:
        if self.empty is not None:
            self.grid.density[self.empty] = 0
            self.grid.occupied[self.empty] = False

    def step_pre_backward(self, field: Field, step: int, generator: torch.Generator) -> None:
        """Evaluates random voxels; see :meth:`Sampler.step_pre_backward`."""
        if step == 0:
            self._leave_empty()  # the grid was reset
        first, grid = self.settling_steps, self.grid
        if grid.settled is None and step >= first and (step == first or step % schedule.GROUP == 0):
            with evaluating(field):
                grid.settled = step if grid.can_learn_from(field, fixed=self.empty) else None
        self.settling = step < first or grid.settled is None
        if not self.evaluates_at(step):
            return
        voxels = self.grid.occupied.numel()
        count = min(max(1, int(voxels * REVISITED)), MOST_REVISITED)
        seed = draw_seed(self.grid.box.device, generator)
        with evaluating(field):
            self.grid.revisit(field, fixed_count(count), seed, fixed=self.empty, backend=self.backend)

    def evaluates_at(self, step: int) -> bool:
        """Returns True before each `GROUP` of steps once the grid has settled; see :meth:`Sampler.evaluates_at`."""
        settled = step >= self.settling_steps and self.grid.settled is not None
        return settled and step % schedule.GROUP == 0

    def steps_per_update(self, step: int) -> int:
        """Returns the number of steps until the grid has settled; later, until the next evaluation of voxels.

        See :meth:`Sampler.steps_per_update`.
        """
        settling = self.settling_steps - step
        return settling if settling > 0 else schedule.GROUP - step % schedule.GROUP

    def step_post_backward(self, output: RenderOutput) -> None:
        """Updates the grid from the samples of a step; see :meth:`Sampler.step_post_backward`."""
        if not self.settling:
            samples = output.samples
            values = samples.positions, output.density, samples.deltas, output.weights
            self.grid.observe(*values, decay=DECAY, fixed=self.empty, backend=self.backend)

    def finish(self, field: Field, seed: int) -> None:
        """Removes specks from a grid over a box; fills holes in surfaces in a grid over space contracted to a ball.

        See `OccupancyGrid.drop_specks` and `OccupancyGrid.fill_holes`. Other grids gain nothing from either method. If
        most of a box is still occupied, as after a short training, the field is evaluated in every voxel, since a
        picture of a full grid takes 2 to 4 times as long.

        Args:
            field: The trained field.
            seed: Seed of the points at which the field is evaluated.
        """
        grid, generator = self.grid, torch.Generator().manual_seed(seed)
        with evaluating(field):
            if grid.contraction is None:
                if grid.share > FULL and grid.can_learn_from(field, fixed=self.empty):
                    grid.update(field, generator=generator, backend=self.backend)
                grid.drop_specks()
            elif isinstance(grid.contraction, Contraction):
                grid.fill_holes(field, generator=generator)
        self._leave_empty()

    @torch.no_grad()
    def drop_floaters(self, field: Field, views: Iterable[Rays], *, near: float, far: float) -> None:
        """Removes floaters from a grid over space contracted to a ball; see `OccupancyGrid.drop_floaters`.

        Args:
            field: The trained field.
            views: Rays of the training views, evenly distributed over the pixels of each view.
            near: The distance along a ray at which the scene begins.
            far: The distance along a ray at which the scene ends.
        """
        grid = self.grid
        if not isinstance(grid.contraction, Contraction):
            return
        seen = torch.zeros(grid.occupied.numel(), dtype=torch.int32, device=grid.box.device)
        with evaluating(field):
            for rays in views:
                ends = (rays.origins.new_full((len(rays),), distance) for distance in (near, far))
                image = self.render_colours(field, rays, *ends, background=None, heaviest=True)
                seen[grid.voxels(image.heaviest[image.opacity > 0.5]).long().unique()] += 1
        grid.drop_floaters(seen.view(grid.occupied.shape))

    def sample(
        self,
        rays: Rays,
        near: Tensor,
        far: Tensor,
        *,
        jitter: bool = False,
        generator: torch.Generator | None = None,
    ) -> Samples:
        """Returns the samples of the occupied strata of each ray; see :meth:`Sampler.sample`."""
        # The seed of a ray's jitter is ``seed`` plus the number of the ray.
        seed = draw_seed(near.device, generator) if jitter else None
        return self.march(rays, near, far, seed=seed)[0]

    def march(
        self,
        rays: Rays,
        near: Tensor,
        far: Tensor,
        *,
        seed: Tensor | None = None,
        start: Tensor | None = None,
        max_samples: int | None = None,
        picture: bool = False,
    ) -> tuple[Samples, Tensor]:
        """Returns the samples in occupied voxels, and the index [r] of the stratum after each ray's last sample.

        See `ops.march_rays`.

        Args:
            rays: r rays.
            near: [r], the distances at which the rays begin.
            far: [r], the distances at which the rays end.
            seed: int32 [1], the seed of random samples; None for the middles of the strata.
            start: int32 [r], the first stratum of each ray; None for 0.
            max_samples: The maximum number of samples per ray; None for no limit.
            picture: Whether each ray has ``picture_samples`` strata instead of ``strata``.
        """
        samples = self.picture_samples if picture else self.strata
        options: dict[str, Any] = {"seed": seed, "start": start, "max_samples": max_samples, "backend": self.backend}
        if seed is not None and start is None and not near.is_cpu:  # a training step does not wait for the device
            options["capacity"] = max(1, len(near) * samples)
        result = self.grid.march(rays, near, far, samples, spacing=self.space.spacing, **options)
        rows = result.ray_offsets[-1:] if "capacity" in options else None
        parts = result.positions, result.ray_index, result.ray_offsets, result.depths, result.deltas
        return Samples(*parts, rows=rows), result.stop


@replayed
class Hierarchical(Stratified):
    """A sampler with two passes; the second pass draws more samples where the weights of the first pass are larger.

    Source: NeRF, section 5.2; mip-NeRF, section 3.2. For points, the network "coarse" renders the first pass, and
    "field" renders the points of both passes. For cones, "field" renders both passes, the second one in new intervals,
    and the loss of the first pass is multiplied by 0.1.

    Args:
        samples: s, the number of samples per ray in the first pass.
        fine_samples: The number of new samples per ray in the second pass.
        space: The coordinates in which rays are sampled and the fields are evaluated.
        backend: The backend of the ops.

    Examples:
        >>> from voronerf.nerf import Hierarchical, Space
        >>> Hierarchical.networks(cones=False), Hierarchical(32, 32, space=Space(cones=True)).first
        (('field', 'coarse'), 'field')
    """

    passes = 2
    skips = False

    def __init__(self, samples: int, fine_samples: int, *, space: Space | None = None, backend: str = "auto") -> None:
        super().__init__(samples, space=space, backend=backend)
        if fine_samples < 1:
            raise ValueError(f"{type(self).__name__}: fine_samples must be >= 1, got {fine_samples}")
        self.fine_samples = fine_samples
        *_, self.first = self.networks(self.space.cones)

    def explain(self) -> str:
        """Describes both passes in one line."""
        return f"{type(self).__name__}, {self.samples} and {self.fine_samples} a ray"

    @staticmethod
    def networks(cones: bool) -> tuple[str, ...]:
        """Returns the names of the networks; with cones, one network renders both passes."""
        return ("field",) if cones else ("field", "coarse")

    def draw(
        self,
        render: RenderPass,
        rays: Rays,
        near: Tensor,
        far: Tensor,
        *,
        jitter: bool = False,
        generator: torch.Generator | None = None,
    ) -> tuple[Samples, tuple[Rendered, ...]]:
        """Renders the first pass, and draws the second from its distribution of weights; see :meth:`Sampler.draw`."""
        first = self.sample(rays, near, far, jitter=jitter, generator=generator)
        before = render(self.first, first)
        edges, weights, count = first.edges, first.by_ray(before.weights.detach()), self.fine_samples
        assert edges is not None
        if self.space.cones:
            uniforms = strata_uniforms(len(edges), count + 1, edges, jitter, generator)
            blurred = blurred_weights(weights)
            edges = resample(blurred, edges, count + 1, uniforms=uniforms, backend=self.backend)
            depths = (edges[:, 1:] + edges[:, :-1]) / 2
        else:
            depths = first.by_ray(first.depths.detach())
            uniforms = strata_uniforms(len(depths), count, depths, jitter, generator)
            depths, edges = union_depths(depths, edges, weights, count, uniforms=uniforms, backend=self.backend)
        return self.space.samples(rays, depths, edges), (before,)

    def earlier_loss(self, earlier: Rendered, last: Rendered, target: Tensor) -> Tensor:
        """Returns the loss [] of the colours of the first pass."""
        return (COARSE_SHARE if self.space.cones else 1.0) * colour_loss(earlier.colour, target)


#: The samplers by the names of ``--sampling``.
SAMPLERS: dict[str, type[Sampler]] = {"stratified": Stratified, "hierarchical": Hierarchical}


@contextmanager
def evaluating(field: Field) -> Iterator[None]:
    """Puts a field into evaluation mode within the context."""
    training = isinstance(field, nn.Module) and field.training
    if isinstance(field, nn.Module):
        field.eval()
    try:
        yield
    finally:
        if isinstance(field, nn.Module):
            field.train(training)


def usual_samples(pixels: float, *, contracted: bool = False, seconds: float = 0.0) -> int:
    """Returns the number of strata per ray for a hash-grid field with an occupancy grid.

    In a box, the number grows with the square root of ``pixels``: 64 for the 100 x 100 images of Lego, 128 for images
    of 400 x 400. More strata cost time; strata longer than a pixel cost sharpness. A long training (at least 40 seconds
    at 100 x 100, or 160 seconds at 400 x 400) has twice as many strata, at most 256. Contracted space has 128 strata,
    256 in a training of at least 25 seconds, or 384 in a training of at least 90 seconds.

    Args:
        pixels: The length in pixels of the longest side of the box in the training views.
        contracted: Whether space is contracted.
        seconds: The training time in seconds, on two cores of an AMD EPYC (Zen 5).
    """
    if contracted:
        return max(samples for least, samples in CONTRACTED_SAMPLES.items() if seconds >= least)
    usual = min(max(8 * round(0.85 * math.sqrt(pixels)), 48), 192)
    return min(2 * usual, LONG_SAMPLES) if seconds >= LONG_IN_BOX * pixels else usual
