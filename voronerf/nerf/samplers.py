"""Where along rays a field is asked: a sampler is a class here and a line in `SAMPLERS`.

r rays, m samples of all rays (packed), s samples a ray. All samplers give `Samples`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
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
from voronerf.nerf.sampling import (
    blurred_weights,
    colour_loss,
    strata_uniforms,
    stratified_depths,
    stratified_edges,
    union_depths,
)
from voronerf.nerf.schedule import WARMUP_STEPS
from voronerf.nerf.segment import replayed
from voronerf.nerf.volume import RayColours, Rendered, RenderOutput, Samples, Space
from voronerf.ops._core.rows import fixed_count
from voronerf.ops.composite import composite
from voronerf.ops.formulas import Wave, walk
from voronerf.ops.render_opaque import NETWORK
from voronerf.ops.resample import resample

#: Share of the first pass in the loss if one network is evaluated in two passes (mip-NeRF, section 3.2).
COARSE_SHARE = 0.1
#: While an occupancy grid settles, a quarter of the strata are used.
SETTLING_PART = 4
#: The first steps of a training, in which the grid learns nothing, in a contracted sphere; elsewhere they are as many
#: as the learning rate may rise for. A young field is thin everywhere: a grid would take it for empty, and what is
#: emptied no longer learns. The more samples a step has, the fewer steps would empty all.
SETTLING_STEPS = 400
#: The share of all voxels of the occupancy grid that are evaluated at random before each `GROUP` of steps, and how many
#: at most: as many as a few steps have samples.
REVISITED, MOST_REVISITED = 1 / 8, 32_768
#: Samples of a ray of a picture for each of training, whose samples are jittered and so cover each stratum over time.
#: At most so many: of the 256 of a long training, twice as many would make no picture more than 0.05 dB better.
PICTURE_SAMPLES, MOST_PICTURE_SAMPLES = 2, 384
#: A ray of a picture ends when it lets less than this through: what is behind counts as of the colour before it.
OPAQUE = 0.05
#: Samples of a ray in a wave: fewer need more waves, more evaluate samples behind the surface in vain. Pictures of
#: contracted space, photographs, have so many rays that a wave's own costs count less.
WAVE, CONTRACTED_WAVE = 12, 8
#: The same where one operation takes all waves, which cost next to nothing then.
FINE_WAVE = 4
#: Samples of a ray through contracted space whose empty part is skipped, by the seconds of a training from which on it
#: has them: shorter strata make steps dearer at first, and sharper pictures in the end.
CONTRACTED_SAMPLES = {0.0: 128, LONG: 256, 90.0: 384}
#: In a box a training is long from so many seconds for each pixel along it, and has at most so many samples of a ray.
LONG_IN_BOX, LONG_SAMPLES = 0.45, 256
#: Renders samples through one of the networks of a cell, given by its name.
Look = Callable[[str, Samples], Rendered]


@replayed
class Sampler:
    """Where along rays a field is asked, and what becomes of that between the steps of a training.

    A subclass defines :meth:`sample`. One with several passes defines :meth:`draw` and :meth:`loss_before` too, one
    that learns from a training the two methods of steps, and one that skips empty space ``grid``. Nothing asks for the
    class of a sampler. A step of a training calls :meth:`step_pre_backward`, :meth:`sample` after its rays are drawn,
    and :meth:`step_post_backward` after the optimiser, once each. They may change the sampler and its grid; what they
    change of other objects counts from the next step on. Their tensors are the step's own memory, to be read before
    they return. A recorded step calls those that a subclass overrides, and makes the calls of the others again.

    Attributes:
        passes: How often a ray is sampled, each time with a number of samples of its own.
        skips: Whether `Occupancy` takes its place where there is a grid.
        samples: s, of the first pass.
        space: How the field sees the scene.
        backend: Of the ops.
        settling_steps: The first steps of a training, in which the grid learns nothing.

    Args:
        samples: s, of the first pass, at least 1.
        space: How the field sees the scene; None for the world, with even spacing.
        backend: Of the ops.

    Raises:
        ValueError: For fewer samples than 1.

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
        """The names of a cell's networks; "field" gives the colours."""
        return ("field",)

    @property
    def grid(self) -> OccupancyGrid | None:
        """Which space is empty and skipped; None for a sampler that skips nothing."""
        return None

    @property
    def strata(self) -> int:
        """The most samples of a ray of the next training step, of the first pass."""
        return self.samples

    def explain(self) -> str:
        """What is sampled, in a line."""
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
        """The samples of the first pass.

        Args:
            rays: r rays, with radii for cones.
            near: [r], where they begin.
            far: [r], where they end.
            jitter: Random samples, for training; else the same each time.
            generator: Of the jitter.
        """
        raise NotImplementedError

    def draw(
        self,
        look: Look,
        rays: Rays,
        near: Tensor,
        far: Tensor,
        *,
        jitter: bool = False,
        generator: torch.Generator | None = None,
    ) -> tuple[Samples, tuple[Rendered, ...]]:
        """The samples of the last pass, and what the passes before have rendered; other arguments as in :meth:`sample`.

        Args:
            look: Renders the samples of a pass before.
            rays: r rays.
            near: [r].
            far: [r].
            jitter: Random samples.
            generator: Of the jitter.
        """
        return self.sample(rays, near, far, jitter=jitter, generator=generator), ()

    def see(
        self, field: Field, rays: Rays, near: Tensor, far: Tensor, *, background: Tensor | None, heaviest: bool
    ) -> RayColours | None:
        """What rays of a picture see, where that needs fewer samples than :meth:`draw` gives; else None.

        Args:
            field: The field that has the colours.
            rays: r rays.
            near: [r].
            far: [r].
            background: [3] or [r, 3]; None is black.
            heaviest: Whether to find the heaviest samples; without it that part of the result means nothing.
        """
        return None

    def loss_before(self, before: Rendered, last: Rendered, target: Tensor) -> Tensor:
        """What a pass adds to the loss of the last one.

        Args:
            before: The pass.
            last: The last one.
            target: [r, 3], the colours of the rays.
        """
        raise NotImplementedError

    def step_pre_backward(self, field: Field, step: int, generator: torch.Generator) -> None:
        """Called before a training step draws its rays.

        Args:
            field: The field that learns.
            step: The number of the step, from 0.
            generator: Of random choices.
        """

    def asks_at(self, step: int) -> bool:
        """Whether :meth:`step_pre_backward` asks the field before a step.

        Args:
            step: The number of the step, from 0.
        """
        return False

    def steps_alike(self, step: int) -> int:
        """How many steps may follow one call of :meth:`step_pre_backward`.

        Args:
            step: The number of the first of them.
        """
        return 1

    def step_post_backward(self, output: RenderOutput) -> None:
        """Called after the loss of a step was computed.

        Args:
            output: What :class:`voronerf.nerf.RayLoss` gave.
        """

    def finish(self, field: Field, seed: int) -> None:
        """Called after the last step of a training.

        Args:
            field: The field that was trained.
            seed: Of random choices.
        """


@replayed
class Stratified(Sampler):
    """One sample in each of s strata of a ray (NeRF, section 4).

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
        given: dict[str, Any] = {"jitter": jitter, "spacing": space.spacing, "generator": generator}
        if space.cones:
            edges = stratified_edges(near, far, self.samples, **given)
            depths = (edges[:, 1:] + edges[:, :-1]) / 2
        else:
            depths, _, edges = stratified_depths(near, far, self.samples, **given)
        return space.samples(rays, depths, edges)


@replayed
class Occupancy(Sampler):
    """`Stratified` without the samples in empty voxels of a grid: rays have as many as are left.

    In a training the grid learns from the samples of each step. Before each `GROUP` of steps the field is evaluated in
    random voxels, so that what was wrongly found empty comes back.

    Attributes:
        grid: Which space is empty; all space outside its box is.
        settling: Whether the grid has learnt nothing yet. A training step then takes a part of the strata, since no
            space is skipped, and since a young field finds its surfaces sooner by fewer and longer ones.

    Args:
        grid: Can be set at any time. With a contraction it is in contracted space.
        samples: s, strata of a ray.
        picture_samples: Strata of a ray of a picture; None for `PICTURE_SAMPLES` as many. A picture is walked to the
            first surface alone, so that more of them cost little.
        space: How the field sees the scene.
        empty: bool [v], voxels that stay empty in a training; None for none.
        backend: Of the ops.

    Raises:
        ValueError: For cones, or a grid without the contraction of the space.

    Examples:
        >>> import torch
        >>> from voronerf import OccupancyGrid
        >>> from voronerf.nerf import Occupancy, Rays, render_rays
        >>> def fog(positions, directions, ray_index):
        ...     return torch.ones_like(positions), torch.full_like(positions[:, 0], 0.5)
        >>> grid = OccupancyGrid(torch.tensor([[-1.0, -1, -1], [1.0, 1, 1]]), 4, threshold=0.1)
        >>> rays = Rays(torch.tensor([[0.0, 0, -2]]), torch.tensor([[0.0, 0, 1]]))
        >>> samples = render_rays(fog, rays, 0.0, 4.0, samples=Occupancy(grid, 8)).samples
        >>> samples.positions[:, 2], samples.ray_index  # those inside of the box
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
            raise ValueError("Occupancy: grid must be of points, and in the space of the contraction")
        self.empty = None if empty is None else empty.view(grid.occupied.shape)
        self.grid = grid
        self.picture_samples = picture_samples or max(min(PICTURE_SAMPLES * samples, MOST_PICTURE_SAMPLES), samples)
        self.settling = False

    @property
    def grid(self) -> OccupancyGrid:
        """Which space is empty."""
        return self._grid

    @grid.setter
    def grid(self, grid: OccupancyGrid) -> None:
        self._grid = grid
        self._leave_empty()

    @property
    def settling_steps(self) -> int:  # type: ignore[override]
        """The first steps of a training, in which the grid learns nothing."""
        return SETTLING_STEPS if isinstance(self.grid.contraction, Contraction) else WARMUP_STEPS

    @property
    def strata(self) -> int:
        """Strata of a ray of a training step: `samples`, or a part of them while the grid settles."""
        return max(1, self.samples // SETTLING_PART) if self.settling else self.samples

    def explain(self) -> str:
        """What is sampled, and what the grid leaves of it."""
        return f"{super().explain()}, of which {self.grid.share:.0%} of the grid are left"

    @torch.no_grad()
    def see(
        self, field: Field, rays: Rays, near: Tensor, far: Tensor, *, background: Tensor | None, heaviest: bool
    ) -> RayColours:
        """Walks rays in waves, each until it is opaque; see :meth:`Sampler.see`.

        A wave is a few samples of every ray that is not opaque yet. So the field evaluates little more than the samples
        in front of the first surface of each ray. A ray that has ended counts as opaque, with the colour that it has by
        then. Samples are the middles of the strata for pictures.

        Examples:
            >>> import torch
            >>> from voronerf import OccupancyGrid
            >>> from voronerf.nerf import Occupancy, Rays
            >>> def wall(positions, directions, ray_index):  # from z = 0 on
            ...     return torch.ones_like(positions), torch.where(positions[:, 2] > 0, 1e9, 0.0)
            >>> grid = OccupancyGrid(torch.tensor([[-1.0, -1, -1], [1.0, 1, 1]]), 4, threshold=0.1)
            >>> rays = Rays(torch.tensor([[0.0, 0, -2]]), torch.tensor([[0.0, 0, 1]]))
            >>> ends = torch.zeros(1), torch.full((1,), 4.0)
            >>> seen = Occupancy(grid, 8).see(wall, rays, *ends, background=None, heaviest=True)
            >>> seen.colour, seen.depth
            (tensor([[1., 1., 1.]]), tensor([2.1250]))
        """
        contraction = self.space.contraction
        network = self._network(field, rays)
        if network is not None:
            rule = {"spacing": self.space.spacing, "backend": self.backend, "heaviest": heaviest, "wave": FINE_WAVE}
            rule |= {"opaque": OPAQUE, "background": None if background is None else background.to(near)}
            seen = self.grid.see(rays, near, far, self.picture_samples, **network, **rule)
        else:
            wave = WAVE if contraction is None else CONTRACTED_WAVE

            def look(live: Tensor, start: Tensor | None) -> Wave:
                now = rays if start is None else rays[live]
                samples, stop = self.march(now, near[live], far[live], start=start, most=wave, picture=True)
                rgb, sigma = (each.to(near.dtype) for each in field(samples.inputs, now.directions, samples.ray_index))
                along = samples.depths, samples.deltas
                part = composite(sigma, rgb, *along, ray_offsets=samples.ray_offsets, backend=self.backend)
                return Wave(part, samples.ray_index, samples.ray_offsets, samples.depths, stop)

            seen = walk(look, far, self.picture_samples, wave, OPAQUE, background, heaviest)
        places = rays.origins
        if heaviest:
            places = rays.origins + seen.heaviest[:, None] * rays.directions
            places = places if contraction is None else contraction.points(places)
        return RayColours(seen.colour, seen.opacity, seen.depth, places)

    def _network(self, field: Field, rays: Rays) -> dict[str, Any] | None:
        """The arguments with which `render_opaque` asks a field; None for more than networks, for Warp and CUDA."""
        router = router_of(field)
        if router is None or not rays.origins.is_cpu or "warp" in (self.backend, router.backend):
            return None
        known = radiance_of(field, (rays.origins, rays.directions))
        if isinstance(known, str):
            return None
        arguments = known.arguments(rays.origins, rays.directions, torch.empty(0, dtype=torch.int32))
        if "cells" in arguments:  # which each sample has of its own
            return None
        return {"network": {name: value for name, value in arguments.items() if name in NETWORK}, **known.rule}

    def _leave_empty(self) -> None:
        if self.empty is not None:
            self.grid.density[self.empty] = 0
            self.grid.occupied[self.empty] = False

    def step_pre_backward(self, field: Field, step: int, generator: torch.Generator) -> None:
        """Evaluates random voxels; see :meth:`Sampler.step_pre_backward`."""
        self.settling = step < self.settling_steps
        if step == 0:
            self._leave_empty()  # of a grid that begins again
        if not self.asks_at(step):
            return
        every = self.grid.occupied.numel()
        count = min(max(1, int(every * REVISITED)), MOST_REVISITED)
        seed = draw_seed(self.grid.box.device, generator)
        with evaluating(field):
            self.grid.revisit(field, fixed_count(count), seed, fixed=self.empty, backend=self.backend)

    def asks_at(self, step: int) -> bool:
        """Before each `GROUP` of steps, once the grid learns; see :meth:`Sampler.asks_at`."""
        return step >= self.settling_steps and step % schedule.GROUP == 0

    def steps_alike(self, step: int) -> int:
        """Up to the next evaluation of voxels; see :meth:`Sampler.steps_alike`."""
        settling = self.settling_steps - step
        return settling if settling > 0 else schedule.GROUP - step % schedule.GROUP

    def step_post_backward(self, output: RenderOutput) -> None:
        """Teaches the grid what the samples of a step found; see :meth:`Sampler.step_post_backward`."""
        if not self.settling:
            samples = output.samples
            found = samples.positions, output.density, samples.deltas, output.weights
            self.grid.observe(*found, decay=DECAY, fixed=self.empty, backend=self.backend)

    def finish(self, field: Field, seed: int) -> None:
        """Occupies voxels that were emptied in the middle of surfaces; see `OccupancyGrid`.

        In a contracted sphere alone: objects in a box and forward-facing scenes gain nothing by it.

        Args:
            field: The field that was trained.
            seed: Of the points at which it is asked.
        """
        if isinstance(self.grid.contraction, Contraction):
            with evaluating(field):
                self.grid.fill_holes(field, generator=torch.Generator().manual_seed(seed))
            self._leave_empty()

    def sample(
        self,
        rays: Rays,
        near: Tensor,
        far: Tensor,
        *,
        jitter: bool = False,
        generator: torch.Generator | None = None,
    ) -> Samples:
        """Samples of the occupied strata of each ray; arguments and result as in `Stratified.sample`."""
        # The jitter of each ray is seeded with the seed plus its number.
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
        most: int | None = None,
        picture: bool = False,
    ) -> tuple[Samples, Tensor]:
        """Samples of rays in occupied voxels, and the stratum [r] behind the last of each; see `ops.march_rays`.

        Args:
            rays: r rays.
            near: [r].
            far: [r].
            seed: int32 [1], of random samples; None for the middles of the strata.
            start: int32 [r], the first stratum; None for 0.
            most: Samples of a ray; None for all.
            picture: Whether the strata are those of a picture.
        """
        samples = self.picture_samples if picture else self.strata
        options: dict[str, Any] = {"seed": seed, "start": start, "most": most, "backend": self.backend}
        if seed is not None and start is None and not near.is_cpu:  # a training step waits for no device
            options["capacity"] = max(1, len(near) * samples)
        found = self.grid.march(rays, near, far, samples, spacing=self.space.spacing, **options)
        rows = found.ray_offsets[-1:] if "capacity" in options else None
        parts = found.positions, found.ray_index, found.ray_offsets, found.depths, found.deltas
        return Samples(*parts, rows=rows), found.stop


@replayed
class Hierarchical(Stratified):
    """Two passes: the second samples where the first found something (NeRF, section 5.2; mip-NeRF, section 3.2).

    Points have a network "coarse" for the first pass, and the second asks at the points of both. For cones "field" is
    evaluated twice, the second time in new intervals; the first loss counts a tenth.

    Args:
        samples: s, of the first pass.
        fine_samples: Of the second pass.
        space: How the fields see the scene.
        backend: Of the ops.

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
        """What is sampled in both passes."""
        return f"{type(self).__name__}, {self.samples} and {self.fine_samples} a ray"

    @staticmethod
    def networks(cones: bool) -> tuple[str, ...]:
        """Names of the networks; a field of cones serves both passes."""
        return ("field",) if cones else ("field", "coarse")

    def draw(
        self,
        look: Look,
        rays: Rays,
        near: Tensor,
        far: Tensor,
        *,
        jitter: bool = False,
        generator: torch.Generator | None = None,
    ) -> tuple[Samples, tuple[Rendered, ...]]:
        """Samples again where the coarse pass has seen something; as in `Stratified.draw`."""
        first = self.sample(rays, near, far, jitter=jitter, generator=generator)
        before = look(self.first, first)
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

    def loss_before(self, before: Rendered, last: Rendered, target: Tensor) -> Tensor:
        """Loss of the colours of the coarse pass, []."""
        return (COARSE_SHARE if self.space.cones else 1.0) * colour_loss(before.colour, target)


#: By the names of ``--sampling``.
SAMPLERS: dict[str, type[Sampler]] = {"stratified": Stratified, "hierarchical": Hierarchical}


@contextmanager
def evaluating(field: Field) -> Iterator[None]:
    """Puts a field into evaluation mode, as long as the context lasts."""
    training = isinstance(field, nn.Module) and field.training
    if isinstance(field, nn.Module):
        field.eval()
    try:
        yield
    finally:
        if isinstance(field, nn.Module):
            field.train(training)


def usual_samples(pixels: float, *, contracted: bool = False, seconds: float = 0.0) -> int:
    """Strata of a ray whose empty space is skipped, for a field on a hash grid.

    In a box they grow with the square root of its pixels: 64 for the 100 x 100 images of Lego, 128 for those of 400 x
    400. Every sample costs time, every pixel that a stratum is longer than costs sharpness. A long training, of 40
    seconds for the former and 160 for the latter, has twice as many, at most 256. Contracted space has 128, or 256 in a
    training of at least 25 seconds, or 384 in one of 90.

    Args:
        pixels: Of the training views along the largest side of the box.
        contracted: Whether space is contracted.
        seconds: Of the training, on two cores of an AMD EPYC (Zen 5).
    """
    if contracted:
        return max(samples for least, samples in CONTRACTED_SAMPLES.items() if seconds >= least)
    usual = min(max(8 * round(0.85 * math.sqrt(pixels)), 48), 192)
    return min(2 * usual, LONG_SAMPLES) if seconds >= LONG_IN_BOX * pixels else usual
