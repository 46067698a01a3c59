"""Where along rays a field is asked: a sampler is a class here and a line in `SAMPLERS`.

r rays, m samples of all rays (packed), s samples a ray. All samplers give `Samples`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import torch
from torch import Tensor

from voronerf.nerf.cameras import Rays
from voronerf.nerf.occupancy import OccupancyGrid, draw_seed
from voronerf.nerf.sampling import (
    blurred_weights,
    colour_loss,
    interlevel_loss,
    strata_uniforms,
    stratified_depths,
    stratified_edges,
    union_depths,
)
from voronerf.nerf.volume import Rendered, Samples, Space
from voronerf.ops.resample import resample

#: Share of the first pass in the loss if one network is evaluated in two passes (mip-NeRF, section 3.2).
COARSE_SHARE = 0.1
#: One in so many strata is left while an occupancy grid settles.
SETTLING_PART = 4
#: Renders samples through one of the networks of a cell, given by its name.
Look = Callable[[str, Samples], Rendered]


class Stratified:
    """One sample in each of s strata of a ray (NeRF, section 4), and what all samplers have in common.

    Attributes:
        passes: How often a ray is sampled, each time with a number of samples of its own. Several territories need a
            single pass.
        skips: Whether an occupancy grid can leave out samples.
        whole: The networks of densities, which have a single cell however many the field has.

    Args:
        samples: s, of the first pass.
        space: How the field sees the scene.
        backend: Of the ops.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import Rays, Stratified
        >>> rays = Rays(torch.zeros(5, 3), torch.tensor([[0.0, 0, 1]]).expand(5, 3))
        >>> samples = Stratified(8).sample(rays, torch.ones(5), torch.full((5,), 3.0))
        >>> samples.positions.shape, samples.ray_offsets
        (torch.Size([40, 3]), tensor([ 0,  8, 16, 24, 32, 40], dtype=torch.int32))
    """

    passes: ClassVar[int] = 1
    skips: ClassVar[bool] = True
    whole: ClassVar[tuple[str, ...]] = ()

    def __init__(self, samples: int, *, space: Space | None = None, backend: str = "auto") -> None:
        if samples < 1:
            raise ValueError(f"{type(self).__name__}: samples must be >= 1, got {samples}")
        self.samples, self.space, self.backend = samples, space or Space(), backend

    @staticmethod
    def networks(cones: bool) -> tuple[str, ...]:
        """The names of a cell's networks; "field" gives the colours. Names that are there depend on cones or points."""
        return ("field",)

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
        space = self.space
        given: dict[str, Any] = {"jitter": jitter, "spacing": space.spacing, "generator": generator}
        if space.cones:
            edges = stratified_edges(near, far, self.samples, **given)
            depths = (edges[:, 1:] + edges[:, :-1]) / 2
        else:
            depths, _, edges = stratified_depths(near, far, self.samples, **given)
        return space.samples(rays, depths, edges)

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
        """The samples of the last pass, and what the passes before have seen; other arguments as in :meth:`sample`.

        Args:
            look: Renders the samples of a pass before.
            rays: r rays.
            near: [r].
            far: [r].
            jitter: Random samples.
            generator: Of the jitter.
        """
        return self.sample(rays, near, far, jitter=jitter, generator=generator), ()

    def loss_before(self, before: Rendered, last: Rendered, target: Tensor) -> Tensor:
        """What a pass adds to the loss of the last one.

        Args:
            before: The pass.
            last: The last one.
            target: [r, 3], the colours of the rays.
        """
        raise NotImplementedError


class Occupancy(Stratified):
    """`Stratified` without the samples in empty cells of a grid: rays have as many as are left.

    Attributes:
        grid: Which space is empty; all space outside its box is.
        settling: Whether the grid has learnt nothing yet. A training step then takes a part of the strata, since no
            space is skipped, and since a young field finds its surfaces sooner by fewer and longer ones.

    Args:
        grid: Can be set at any time. With a contraction it is in contracted space.
        samples: s, strata of a ray.
        picture_samples: Strata of a ray of a picture; None for as many. A picture is walked to the first surface
            alone, so that more of them cost little.
        space: How the field sees the scene.
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
        backend: str = "auto",
    ) -> None:
        super().__init__(samples, space=space, backend=backend)
        if self.space.cones or (grid.contraction is None) != (self.space.contraction is None):
            raise ValueError("Occupancy: grid must be of points, and in the space of the contraction")
        self.grid, self.picture_samples = grid, picture_samples or samples
        self.settling = False

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
        # A ray's jitter follows from the sum of the seed and of its number.
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
        """Samples of rays in occupied cells, and the stratum [r] behind the last of each; see `ops.march_rays`.

        Args:
            rays: r rays.
            near: [r].
            far: [r].
            seed: int32 [1], of random samples; None for the middles of the strata.
            start: int32 [r], the first stratum; None for 0.
            most: Samples of a ray; None for all.
            picture: Whether the strata are those of a picture.
        """
        samples = self.picture_samples if picture else self.samples
        if self.settling and not picture:
            samples = max(1, samples // SETTLING_PART)
        walk: dict[str, Any] = {"seed": seed, "start": start, "most": most, "backend": self.backend}
        if seed is not None and start is None and not _on_host(near):  # a training step waits for no device
            walk["capacity"] = max(1, len(near) * samples)
        found = self.grid.march(rays, near, far, samples, spacing=self.space.spacing, **walk)
        rows = found.ray_offsets[-1:] if "capacity" in walk else None
        parts = found.positions, found.ray_index, found.ray_offsets, found.depths, found.deltas
        return Samples(*parts, rows=rows), found.stop


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
        return self.space.samples(rays, *self.again(before, jitter, generator)), (before,)

    def again(self, before: Rendered, jitter: bool, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """Depths and edges of the second pass."""
        if self.space.cones:
            return self.intervals(before, jitter, generator)
        depths, weights = (before.samples.by_ray(x.detach()) for x in (before.samples.depths, before.weights))
        edges, count = before.samples.edges, self.fine_samples
        assert edges is not None
        uniforms = strata_uniforms(len(depths), count, depths, jitter, generator)
        return union_depths(depths, edges, weights, count, uniforms=uniforms, backend=self.backend)

    def intervals(self, before: Rendered, jitter: bool, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """New intervals where a pass has found something, and a sample in each."""
        wide, count = before.samples.edges, self.fine_samples
        assert wide is not None
        weights = blurred_weights(before.samples.by_ray(before.weights.detach()))
        uniforms = strata_uniforms(len(wide), count + 1, wide, jitter, generator)
        edges = resample(weights, wide, count + 1, uniforms=uniforms, backend=self.backend)
        if self.space.cones or not jitter:
            return (edges[:, 1:] + edges[:, :-1]) / 2, edges
        device = edges.device if generator is None else generator.device
        inside = torch.rand(len(wide), count, device=device, dtype=edges.dtype, generator=generator).to(edges.device)
        return torch.lerp(edges[:, :-1], edges[:, 1:], inside), edges

    def loss_before(self, before: Rendered, last: Rendered, target: Tensor) -> Tensor:
        """Loss of the colours of the coarse pass, []."""
        return (COARSE_SHARE if self.space.cones else 1.0) * colour_loss(before.colour, target)


class Proposal(Hierarchical):
    """A density network "proposal" says where the field is asked, and learns where that finds something.

    Its colours are not used (Barron et al. 2022, "Mip-NeRF 360", section 3, with one round).

    Examples:
        >>> from voronerf.nerf import Proposal
        >>> Proposal(32, 32).first
        'proposal'
    """

    whole: ClassVar[tuple[str, ...]] = ("proposal",)

    @staticmethod
    def networks(cones: bool) -> tuple[str, ...]:
        """Names of the networks: the field, and the one that proposes."""
        return ("field", "proposal")

    def again(self, before: Rendered, jitter: bool, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """Depths and edges of the second pass: the new intervals alone."""
        return self.intervals(before, jitter, generator)

    def loss_before(self, before: Rendered, last: Rendered, target: Tensor) -> Tensor:
        """The `interlevel_loss` of the proposed weights and those of the field, []."""
        assert last.samples.edges is not None and before.samples.edges is not None
        seen, proposed = (each.samples.by_ray(each.weights) for each in (last, before))
        return interlevel_loss(last.samples.edges, seen, before.samples.edges, proposed)


def _on_host(tensor: Tensor) -> bool:
    return tensor.is_cpu


#: By the names of ``--sampling``. An `Occupancy` takes the place of a sampler that ``skips``, where there is a grid.
SAMPLERS: dict[str, type[Stratified]] = {
    "stratified": Stratified,
    "hierarchical": Hierarchical,
    "proposal": Proposal,
}
