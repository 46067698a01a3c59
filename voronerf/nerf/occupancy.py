"""An occupancy grid, which marks the empty voxels of a scene's box so that rays can skip them.

x, y, z voxels along the axes of the grid, q voxels to update, r rays, s strata per ray. Densities are per world unit.
With a contraction, the densities that a grid stores are per unit of contracted space, so a far and a near voxel that
absorb the same light have the same density.
Source: Mueller et al. 2022, "Instant Neural Graphics Primitives", appendix C (voxels keep the largest recent density,
which decays). This project adds updates from the samples of a batch, and marks hidden voxels as empty.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from voronerf.nerf.cameras import Rays
from voronerf.nerf.contraction import Contraction, Perspective
from voronerf.nerf.distributed import Ranks
from voronerf.nerf.field import Field
from voronerf.nerf.radiance import radiance_of
from voronerf.nerf.replay import replayed
from voronerf.nerf.sampling import random_uniforms
from voronerf.ops._core.checks import check_range
from voronerf.ops.draw_points import draw_points
from voronerf.ops.formulas import voxels_of
from voronerf.ops.march_rays import March, march_rays
from voronerf.ops.observe_occupancy import observe_occupancy
from voronerf.ops.render_opaque import RenderedRays, render_opaque

#: Voxels of a grid along each axis, for a box and for contracted space, which holds the whole world.
RESOLUTION, CONTRACTED_RESOLUTION = 64, 128
#: A voxel is empty if an average stratum in it has less than this opacity. A larger value would remove thin things:
#: masts, ropes and water.
OPACITY = 0.02
#: A voxel of contracted space is empty if the whole voxel has less than this opacity.
CONTRACTED_OPACITY = 0.1
#: A new voxel counts as empty after more than this number of batches in a row that have samples in the voxel, all of
#: negligible density. 8 such batches take about thirty steps; in this time the field learns something about most
#: voxels. In contracted space a smaller number is better: occupied voxels in front of the cameras keep fog that
#: explains one view and spoils the others.
PATIENCE, CONTRACTED_PATIENCE = 8, 4
#: Each training batch multiplies the stored densities of the voxels that contain its samples by this factor, once per
#: voxel.
DECAY = 0.8
CHUNK = 1 << 17  # points in one evaluation of a field
HIDDEN = 1e-3  # a sample is hidden if at most this fraction of the light reaches it
# A hole is an empty voxel whose 3 x 3 x 3 block has at least HOLE_NEIGHBOURS occupied voxels, and whose density is at
# least HOLE_DENSITY times the threshold at half of HOLE_POINTS random points. It may be the edge of a thin thing.
HOLE_NEIGHBOURS, HOLE_POINTS, HOLE_DENSITY = 3, 8, 4.0
#: A surface that fewer cameras see may be a floater, a cloud that fits their pictures alone.
FLOATER_CAMERAS = 3
#: A field can tell empty space once its densities have a mean deviation of at least `CONTRAST` times their mean, and at
#: most the fraction `LOST` of the density lies below the grid's threshold; both are measured at `CONTRAST_POINTS`
#: points. The deviation of an untrained field is below 0.01.
CONTRAST, LOST, CONTRAST_POINTS = 0.25, 0.5, 4096


@replayed
class OccupancyGrid:
    """A grid that stores the largest recent densities in a box; its dense voxels are occupied.

    A new grid is occupied everywhere; `update` and `observe` mark voxels as empty.

    Attributes:
        box: float32 [2, 3], lowest and highest corner.
        density: float32 [x, y, z], the stored density of each voxel.
        occupied: bool [x, y, z], density >= threshold.
        threshold: The minimum density of an occupied voxel, in the unit of `density`.
        contraction: The contraction that maps world space to the space of the box, or None.
        settled: The training step of the first update by `Occupancy`; None before this step.

    Examples:
        >>> import torch
        >>> from voronerf import OccupancyGrid
        >>> def ball(positions, directions, ray_index):  # a ball of radius 0.5
        ...     return torch.ones_like(positions), torch.where(positions.norm(dim=-1) < 0.5, 10.0, 0.0)
        >>> grid = OccupancyGrid(torch.tensor([[-1.0, -1, -1], [1.0, 1, 1]]), 16, threshold=1.0)
        >>> grid.share
        1.0
        >>> grid.update(ball)
        >>> grid.share < 0.1
        True
    """

    def __init__(
        self,
        box: Tensor,
        resolution: int | Sequence[int] = 64,
        *,
        threshold: float,
        remembered: float = 2.0,
        contraction: Contraction | Perspective | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        """Makes a grid that is occupied everywhere.

        Args:
            box: [2, 3], the lowest and the highest corner.
            resolution: The number of voxels along each axis, one number for all axes or three numbers.
            threshold: The minimum density of an occupied voxel, in the unit of `density`, > 0 and finite.
            remembered: The density of a new voxel as a multiple of ``threshold``, >= 1. With a larger density, the
                voxel counts as empty only after more batches of samples of negligible density.
            contraction: The contraction that maps world space to the space of the box, or None. The methods take
                positions in the space of the box, but rays in world coordinates.
            device: The device of the grid; None for the device of the box.
        """
        shape = (resolution,) * 3 if isinstance(resolution, int) else tuple(resolution)
        if tuple(box.shape) != (2, 3) or not bool((box[1] > box[0]).all()) or not bool(box.isfinite().all()):
            raise ValueError(f"OccupancyGrid: box must be finite corners [2, 3], low and high, got {box.tolist()}")
        if len(shape) != 3 or min(shape) < 1:
            raise ValueError(f"OccupancyGrid: resolution must be one or three numbers >= 1, got {resolution}")
        if not 0 < threshold < float("inf"):
            raise ValueError(f"OccupancyGrid: threshold must be positive and finite, got {threshold}")
        if not 1 <= remembered < float("inf"):
            raise ValueError(f"OccupancyGrid: remembered must be at least 1 and finite, got {remembered}")
        self.box = box.detach().to(device=device, dtype=torch.float32).clone()
        self.threshold = float(threshold)
        self.contraction = contraction
        self.settled: int | None = None
        self._numbers = None if contraction is None else contraction.numbers.to(self.box)
        self.density = torch.full(shape, remembered * self.threshold, dtype=torch.float32, device=self.box.device)
        self.occupied = torch.ones(shape, dtype=torch.bool, device=self.box.device)
        self._merged: Tensor | None = None

    @classmethod
    def for_training(
        cls,
        box: Tensor | None,
        samples: int,
        *,
        contraction: Contraction | Perspective | None = None,
        resolution: int | None = None,
        opacity: float = OPACITY,
        device: torch.device | str | None = None,
    ) -> OccupancyGrid:
        """Returns a grid with a threshold for training, over a box or over the cube of a contraction.

        At the threshold, an average stratum has opacity ``opacity``; the average length is the box's diagonal divided
        by ``samples``. In contracted space, a whole voxel has opacity `CONTRACTED_OPACITY` at the threshold.

        Args:
            box: [2, 3], the box of the scene; not used with a contraction.
            samples: Strata of a ray.
            contraction: The contraction of space for the field; None for world coordinates.
            resolution: Voxels along each axis; None for `RESOLUTION`, or `CONTRACTED_RESOLUTION`.
            opacity: The opacity of an average stratum at the threshold; not used with a contraction.
            device: The device of the grid; None for the device of the box.

        Raises:
            ValueError: There is neither a box nor a contraction.

        Examples:
            >>> import torch
            >>> from voronerf import OccupancyGrid
            >>> grid = OccupancyGrid.for_training(torch.tensor([[-1.0, -1, -1], [1.0, 1, 1]]), 64)
            >>> round(grid.threshold, 3), grid.occupied.shape
            (0.373, torch.Size([64, 64, 64]))
        """
        if contraction is not None:
            box, size, patience = contraction.cube, resolution or CONTRACTED_RESOLUTION, CONTRACTED_PATIENCE
            threshold = -math.log1p(-CONTRACTED_OPACITY) * size / float(box[1, 0] - box[0, 0])
        elif box is not None:
            size, patience = resolution or RESOLUTION, PATIENCE
            threshold = -math.log1p(-opacity) * samples / float((box[1] - box[0]).norm())
        else:
            raise ValueError("OccupancyGrid.for_training: box must be given without a contraction, got None")
        remembered = DECAY**-patience
        return cls(box, size, threshold=threshold, remembered=remembered, contraction=contraction, device=device)

    @property
    def share(self) -> float:
        """The fraction of occupied voxels, 0..1. Reading it makes the host wait for the device."""
        return float(self.occupied.float().mean())

    def points(self, voxels: Tensor, uniforms: Tensor | None = None) -> Tensor:
        """Returns a point in each voxel.

        Args:
            voxels: int [q], flat indices of voxels.
            uniforms: [q, 3] in 0..1, the position in the voxel; None for the middle.

        Returns:
            float32 [q, 3], in the space of the box.
        """
        shape = torch.tensor(self.occupied.shape, dtype=torch.float32, device=self.box.device)
        _, y, z = self.occupied.shape
        # Computed in float64, since torch divides integers slowly, and axis by axis, since operations on [q, 3] are
        # slow.
        voxels = voxels.double()
        line = (voxels / z).floor()
        plane = (line / y).floor()
        place = torch.stack((plane, line - y * plane, voxels - z * line)).float()
        place += 0.5 if uniforms is None else uniforms.T
        low, high = self.box[:, :, None]
        return torch.lerp(low, high, place / shape[:, None]).T.contiguous()

    @torch.no_grad()
    def can_learn_from(self, field: Field, *, fixed: Tensor | None = None) -> bool:
        """Returns whether a field has learnt to tell empty space from the rest. Waits for the device.

        A field that has learnt little is almost uniform, and its density may be below the threshold everywhere. If the
        grid were updated from this field, all voxels would become empty, and the field is not trained in empty voxels.
        So the field's densities must differ from place to place, and most of its density must lie in voxels that stay
        occupied.

        Args:
            field: The field, which is called without gradients.
            fixed: bool [x, y, z], voxels that do not count; None for none.

        Examples:
            >>> import torch
            >>> from voronerf import OccupancyGrid
            >>> grid = OccupancyGrid(torch.tensor([[-1.0, -1, -1], [1.0, 1, 1]]), 16, threshold=1.0)
            >>> def fog(positions, directions, ray_index):
            ...     return torch.ones_like(positions), torch.full_like(positions[:, 0], 0.5)
            >>> def ball(positions, directions, ray_index):
            ...     return torch.ones_like(positions), torch.where(positions.norm(dim=-1) < 0.5, 10.0, 0.5)
            >>> grid.can_learn_from(fog), grid.can_learn_from(ball)
            (False, True)
        """
        generator = torch.Generator().manual_seed(0)
        uniforms = torch.rand(CONTRAST_POINTS, 3, generator=generator, dtype=torch.float32, device="cpu")
        points = torch.lerp(self.box[0], self.box[1], uniforms.to(self.box))
        if fixed is not None:
            points = points[~fixed.view(-1)[self.voxels(points).long()]]
        density = density_of(field, points).nan_to_num().double()
        stored = density if self.contraction is None else density * self.contraction.stretch(points)
        lost = stored[stored < self.threshold].sum()
        contrast = (density - density.mean()).abs().mean() >= CONTRAST * density.mean()
        return bool(contrast & (lost <= LOST * stored.sum()) & (stored.sum() > 0))

    @torch.no_grad()
    def update(
        self,
        field: Field,
        voxels: Tensor | None = None,
        *,
        decay: float = 0.0,
        generator: torch.Generator | None = None,
        backend: str = "auto",
    ) -> None:
        """Evaluates a field at a random point of each voxel, and stores the maximum of new and decayed old density.

        Args:
            field: The field, which is called without gradients.
            voxels: int32 or int64 [q], flat indices of the voxels to update; None for all.
            decay: Factor on the old densities of these voxels, 0..1; 0 forgets them.
            generator: Random generator of the points, on any device.
            backend: The backend of the op.

        Raises:
            ValueError: The decay or a voxel is out of range (voxels are checked on the CPU only).
        """
        if not 0 <= decay <= 1:
            raise ValueError(f"OccupancyGrid.update: decay must lie in 0..1, got {decay}")
        if voxels is None:
            voxels = torch.arange(self.occupied.numel(), device=self.box.device)
        check_range("OccupancyGrid.update", "voxels", voxels, self.occupied.numel())
        # Enters all points in one call, since each call decays the old densities.
        points = [self.points(part, random_uniforms(len(part), 3, self.box, generator)) for part in voxels.split(CHUNK)]
        densities = [_density_of(field, part) for part in points]
        if densities:
            self._enter(torch.cat(points), torch.cat(densities), decay=decay, hidden=0.0, backend=backend)

    @torch.no_grad()
    def revisit(
        self, field: Field, count: int, seed: Tensor, *, fixed: Tensor | None = None, backend: str = "auto"
    ) -> None:
        """Evaluates a field at random points in the grid, and stores the maximum of new and old density per voxel.

        Args:
            field: The field, which is called without gradients.
            count: The number of points, at least 1.
            seed: int32 [1], the seed of the points, from `draw_seed`.
            fixed: bool [x, y, z], voxels that do not change; None for none.
            backend: The backend of the ops.
        """
        points = draw_points(seed, count, self.box, backend=backend)
        self._enter(points, _density_of(field, points), decay=1.0, hidden=0.0, fixed=fixed, backend=backend)

    @torch.no_grad()
    def observe(
        self,
        positions: Tensor,
        density: Tensor,
        deltas: Tensor,
        weights: Tensor,
        *,
        decay: float,
        fixed: Tensor | None = None,
        backend: str = "auto",
    ) -> None:
        """Updates voxels, in place, from samples that were already rendered.

        If at most the fraction `HIDDEN` of the ray's light reaches a sample, its density counts as 0. So voxels inside
        an opaque object become empty, which changes no picture. A voxel with a surface becomes empty too if few rays
        through the voxel see the surface; `update` can restore it.

        Args:
            positions: float32 [m, 3] in the box; a position outside counts for the nearest voxel at the border.
            density: [m], the densities at the positions; NaN counts as infinite.
            deltas: [m], lengths of the strata of the samples.
            weights: [m], contributions of the samples to their rays, from `composite`.
            decay: Factor on the old density of each voxel with samples, 0..1; applied once per call.
            fixed: bool [x, y, z], voxels that do not change; None for none.
            backend: "auto", "reference", "native" or "warp".

        Raises:
            ValueError: The decay is out of range.
        """
        if not 0 <= decay <= 1:
            raise ValueError(f"OccupancyGrid.observe: decay must lie in 0..1, got {decay}")
        options: dict[str, Any] = {"decay": decay, "hidden": HIDDEN, "fixed": fixed, "backend": backend}
        self._enter(positions, density.float(), deltas.float(), weights.float(), **options)

    @torch.no_grad()
    def fill_holes(self, field: Field, *, generator: torch.Generator | None = None) -> None:
        """Fills holes in surfaces: marks empty voxels with a dense field and many occupied neighbours as occupied.

        Call it after the training, since filled voxels would cost samples in every step. The field can be dense by
        chance where no ray samples it. So a voxel with few occupied neighbours, or with a low density at most points,
        stays empty.

        Args:
            field: The trained field, which is called without gradients.
            generator: Random generator of the points, on any device.
        """
        holes = ((self._neighbours() >= HOLE_NEIGHBOURS) & ~self.occupied).view(-1).nonzero()[:, 0]
        minimum = HOLE_DENSITY * self.threshold
        dense = [holes[:0]]
        for part in holes.split(CHUNK // HOLE_POINTS):
            count = HOLE_POINTS * len(part)
            points = self.points(part.repeat(HOLE_POINTS), random_uniforms(count, 3, self.box, generator))
            density = density_of(field, points)
            if self.contraction is not None:
                density = density * self.contraction.stretch(points)
            above = (density >= minimum).view(HOLE_POINTS, len(part)).sum(0)
            dense.append(part[above >= HOLE_POINTS / 2])
        holes = torch.cat(dense)
        self.density.view(-1)[holes] = minimum
        self.occupied.view(-1)[holes] = True

    def drop_floaters(self, seen: Tensor) -> None:
        """Marks voxels inside a contraction's sphere as empty, except near surfaces that several cameras see.

        A floater, a cloud in front of the scene, can fit the pictures of one or two cameras, and hides the scene from
        others. Outside the sphere, which goes around the cameras, few cameras may see a true surface.

        Args:
            seen: int [x, y, z], the number of cameras that see a surface in each voxel.
        """
        assert isinstance(self.contraction, Contraction)
        is_near = torch.nn.functional.max_pool3d(seen[None].float(), 3, 1, 1)[0] >= FLOATER_CAMERAS
        voxels = torch.arange(self.occupied.numel(), device=self.box.device)
        distances = (self.points(voxels) - self.contraction.centre.to(self.box)).norm(dim=-1)
        floaters = ~is_near & (distances < self.contraction.radius).view(is_near.shape)
        self.density[floaters] = 0
        self.occupied[floaters] = False

    def merge(self, ranks: Ranks) -> None:
        """Takes over the changes of all processes: a voxel gets the largest density of the processes that changed it.

        Args:
            ranks: The processes. Their grids must be equal at the first call.
        """
        if ranks.size == 1:
            return
        if self._merged is None:
            self._merged = torch.full_like(self.density, -1)
        changed = torch.where(self.density != self._merged, self.density, -1)
        ranks.maximum(changed)
        torch.where(changed < 0, self._merged, changed, out=self.density)
        torch.ge(self.density, self.threshold, out=self.occupied)
        self._merged.copy_(self.density)

    def drop_specks(self) -> None:
        """Marks isolated groups of one or two occupied voxels as empty; they look like dust in pictures."""
        neighbours = (self._neighbours() * self.occupied)[None]
        most = torch.nn.functional.max_pool3d(neighbours, 3, 1, 1)[0]
        specks = self.occupied & (most <= 2)
        self.density[specks] = 0
        self.occupied[specks] = False

    def _neighbours(self) -> Tensor:
        """Returns float32 [x, y, z], the number of occupied voxels in the 3 x 3 x 3 block around each voxel."""
        return torch.nn.functional.avg_pool3d(self.occupied[None].float(), 3, 1, 1, divisor_override=1)[0]

    def _enter(self, *samples: Tensor, **options: Any) -> None:
        """Updates the grid from samples with densities per world unit; see `voronerf.ops.observe_occupancy`."""
        options |= {"threshold": self.threshold, "contraction": self._numbers}
        observe_occupancy(self.density, self.occupied, self.box, *samples, **options)

    def voxels(self, points: Tensor) -> Tensor:
        """Returns int32 [n], the flat indices of the voxels of points [n, 3]; the nearest voxel for points outside."""
        return voxels_of(points, self.box, self.occupied.shape)

    def march(self, rays: Rays, near: Tensor, far: Tensor, samples: int, **options: Any) -> March:
        """Returns the samples of rays in occupied voxels; for the options see `voronerf.ops.march_rays`."""
        arguments = rays.origins, rays.directions, near, far, self.occupied, self.box, samples
        return march_rays(*arguments, contraction=self._numbers, **options)

    def render_colours(self, rays: Rays, near: Tensor, far: Tensor, samples: int, **options: Any) -> RenderedRays:
        """Renders rays by evaluating networks in occupied voxels; for the options see `voronerf.ops.render_opaque`."""
        arguments = rays.origins, rays.directions, near, far, self.occupied, self.box, samples
        return render_opaque(*arguments, contraction=self._numbers, **options)

    def state_dict(self) -> dict[str, Tensor]:
        """Returns the tensors from which `from_state` makes the same grid, bit for bit."""
        return {
            "box": self.box.clone(),
            "density": self.density.clone(),
            "occupied": self.occupied.clone(),
            "threshold": torch.tensor(self.threshold, dtype=torch.float64, device="cpu"),
            "settled": torch.tensor(-1 if self.settled is None else self.settled, device="cpu"),
        }

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Loads box, densities and threshold from another grid's `state_dict`.

        Raises:
            ValueError: An entry is missing or has a wrong shape.
        """
        other = OccupancyGrid.from_state(state, contraction=self.contraction, device=self.box.device)
        self.box, self.threshold, self.settled = other.box, other.threshold, other.settled
        self.density, self.occupied, self._merged = other.density, other.occupied, None

    @staticmethod
    def from_state(
        state: Mapping[str, Tensor],
        *,
        contraction: Contraction | Perspective | None = None,
        device: torch.device | str = "cpu",
    ) -> OccupancyGrid:
        """Returns a grid from its `state_dict` and its contraction, which is not part of the state.

        Raises:
            ValueError: An entry is missing or has a wrong shape.
        """
        missing = [name for name in ("box", "density", "occupied", "threshold") if name not in state]
        if missing:
            raise ValueError(
                f"OccupancyGrid: state must hold {', '.join(missing)}, got {', '.join(state) or 'nothing'}"
            )
        density, occupied = state["density"], state["occupied"]
        if density.dim() != 3 or density.shape != occupied.shape:
            raise ValueError(
                "OccupancyGrid: state must hold density and occupied of one shape [x, y, z], got "
                f"{list(density.shape)} and {list(occupied.shape)}"
            )
        threshold = float(state["threshold"])
        grid = OccupancyGrid(state["box"], density.shape, threshold=threshold, contraction=contraction, device=device)
        grid.density.copy_(density)
        grid.occupied.copy_(occupied)
        settled = int(state.get("settled", 0))  # earlier versions settled after a fixed number of steps
        grid.settled = None if settled < 0 else settled
        return grid


def draw_seed(device: torch.device, generator: torch.Generator | None) -> Tensor:
    """Draws a seed for an op such as ``march_rays``, int32 [1] on `device`, the device of the op's other arguments."""
    source = device if generator is None else generator.device
    return torch.randint(-(2**31), 2**31, (1,), device=source, dtype=torch.int32, generator=generator).to(device)


def density_of(field: Field, points: Tensor) -> Tensor:
    """Returns float32 [n], the density of a field at points [n, 3] seen along the z axis; NaN becomes infinity."""
    return _density_of(field, points).nan_to_num(nan=float("inf"), posinf=float("inf"))


def _density_of(field: Field, points: Tensor) -> Tensor:
    """Returns the density as in `density_of`, but keeps NaN."""
    direction = _along_z(points.device)
    radiance = radiance_of(field, (points, direction.expand(len(points), -1)))
    sigma = None if isinstance(radiance, str) else radiance.density(points)
    if sigma is None:
        _, sigma = field(points, direction, torch.zeros(len(points), dtype=torch.int32, device=points.device))
    return sigma.detach().float()


@functools.lru_cache(maxsize=8)
def _along_z(device: torch.device) -> Tensor:
    """Returns the direction of the z axis, [1, 3]."""
    return torch.tensor(((0.0, 0.0, 1.0),), dtype=torch.float32, device=device)
