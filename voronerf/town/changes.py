"""Where a scene has changed: new pictures against what a run shows.

r rays, k cells, q voxels.

A ray of a new picture is off if its error is larger than that of nine of ten training rays of its cell. Space where a
scene has changed is told from what lies behind it by all views together: most rays through it are off, where rays
through what stands before or behind a change are off from some places only (Taneja et al. 2011, "Image based detection
of geometric changes in urban environments"). So two things are found: voxels most of whose rays are off, and cells too
many of whose rays are off for no such voxel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from voronerf.app.train.batches import RayBatches
from voronerf.nerf import Batch
from voronerf.nerf.cameras import Rays
from voronerf.nerf.contraction import Contraction, Perspective
from voronerf.nerf.renderer import Renderer
from voronerf.ops.observe_occupancy.reference import cells_of
from voronerf.town.errors import Cells, SeenErrors, see_errors

#: Rays of the new pictures that are rendered.
RAYS = 1 << 15
#: The least squared error of a ray that is off, whatever is usual in its cell: a tone of 1 in 64.
LEAST = 3 / 64**2
#: Voxels along the longest side, and points on a ray that find them.
VOXELS, STEPS = 40, 96
#: A voxel has changed if it has so many rays, this share of them is off, and a neighbour has changed, too.
VOXEL_RAYS, VOXEL_SHARE = 10, 0.6
#: ... or if so many new and so many old rays end there or in a voxel next to it, and the mean colours that they are off
#: by differ so much, and (squared) so many times what chance makes of it: a shadow is less than one ray may be off by.
TONE_RAYS, TONE, TONE_CHANCE = 16, 0.05, 20.0
#: ... or if of so many rays that end there and pass no voxel of the first kind this share more are off than of the old
#: ones, and (squared) so many times what chance makes of it, and twice as much in a voxel next to it: what is smaller
#: than a voxel is off in few of its rays.
OFF_RAYS, OFF_SHARE, OFF_CHANCE = 12, 0.15, 6.0
#: A cell has changed if it has so many voxels that have, and they are this share of those that enough rays pass, or so
#: many of another tone, ...
CELL_VOXELS, CELL_SPACE = 6, 0.02
#: ... or so many rays that meet no such voxel, and this share of them is off, where 1 in 10 is expected.
CELL_RAYS, CELL_SHARE = 32, 0.3
#: Pictures show another scene if more of their rays that meet a cell are off, and none if fewer of all meet a cell. Of
#: those that meet it 14% were off in a city with one of 16 blocks rebuilt, 21% in Lego with another bucket, 54% in Lego
#: turned by 3 degrees, 58% in a city turned by 90.
MOST_OFF, LEAST_MET = 0.5, 0.002


@dataclass(frozen=True)
class Voxels:
    """Some of the voxels of a box."""

    box: Tensor  # [2, 3], in the space of the contraction
    chosen: Tensor  # bool [x, y, z]
    contraction: Contraction | Perspective | None = None  # of the space that the box is in, or None

    def numbers(self, positions: Tensor) -> Tensor:
        """The voxel of each position [n, 3] of the world, int64 [n]; -1 outside of the box."""
        points = positions if self.contraction is None else self.contraction.points(positions)
        inside = ((points >= self.box[0]) & (points <= self.box[1])).all(-1)
        return torch.where(inside, cells_of(points, self.box, self.chosen.shape).long(), -1)

    def has(self, positions: Tensor) -> Tensor:
        """Which positions [n, 3] of the world lie in chosen voxels, bool [n]."""
        numbers = self.numbers(positions)
        return self.chosen.reshape(-1)[numbers.clamp(min=0)] & (numbers >= 0)

    def centres(self) -> Tensor:
        """The middles of the chosen voxels in the world, [q, 3]."""
        place = self.chosen.nonzero() + 0.5
        points = torch.lerp(self.box[0], self.box[1], place / torch.tensor(self.chosen.shape, device=place.device))
        return points if self.contraction is None else self.contraction.inverse(points)

    def meet(self, rays: Rays, near: Tensor, far: Tensor) -> Tensor:
        """Which rays pass a chosen voxel between two depths, bool [r]."""
        numbers = along(self, rays, near, far)
        return (self.chosen.reshape(-1)[numbers.clamp(min=0)] & (numbers >= 0)).any(1)


def along(voxels: Voxels, rays: Rays, near: Tensor, far: Tensor) -> Tensor:
    """The voxels at evenly spaced points of rays, int64 [r, STEPS]; -1 outside."""
    place = (torch.arange(STEPS, device=near.device) + 0.5) / STEPS
    depths = near[:, None] + (far - near)[:, None] * place
    points = torch.addcmul(rays.origins[:, None], depths[..., None], rays.directions[:, None])
    return voxels.numbers(points.reshape(-1, 3)).reshape(depths.shape)


@dataclass(frozen=True)
class Changes:
    """What new pictures show."""

    worse: Tensor  # bool [k], the cells that are worse in the new pictures than they were in training
    rebuilt: Tensor  # bool [k], those some of whose space has changed
    voxels: Voxels  # the space that has changed
    off: float  # the share of those of the new rays that meet a cell that are off
    met: float  # the share of the new rays that meet a cell
    shares: Tensor  # [k], the share of each cell's rays that are off and meet no changed voxel


@torch.no_grad()
def find_changes(
    renderer: Renderer, cells: Cells, batches: RayBatches, usual: Tensor, space: Voxels, old: RayBatches | None = None
) -> Changes:
    """Compares the pictures of a changed scene with what a run shows.

    Args:
        renderer: Of the run.
        cells: The cells of its field.
        batches: Of the new pictures.
        usual: [k + 1], see `usual_errors`.
        space: All voxels; which are chosen does not matter.
        old: Of the pictures that the run has learnt from; None where they are not known.
    """
    renderer.train(False)
    generator = torch.Generator(batches.device).manual_seed(1)
    batch = batches.draw(RAYS, generator, random_background=False)
    seen = see_errors(renderer, cells, batch)
    off = seen.error > usual[seen.cell].clamp(min=LEAST)
    # Past the surface by a step, so that its own voxel counts.
    numbers = along(space, batch.rays, batch.near, torch.minimum(seen.depth * (1 + 1 / STEPS), batch.far))
    first = torch.ones_like(numbers, dtype=torch.bool)
    first[:, 1:] = numbers[:, 1:] != numbers[:, :-1]
    first &= numbers >= 0  # each voxel counts once for a ray
    size = space.chosen.numel()
    passed = numbers[first].bincount(minlength=size)
    wrong = numbers[first & off[:, None]].bincount(minlength=size)
    changed = ((passed >= VOXEL_RAYS) & (wrong >= VOXEL_SHARE * passed)).reshape(space.chosen.shape)
    changed &= near_by(changed) > 1
    toned = torch.zeros_like(changed)
    if old is not None:
        before = old.draw(RAYS, generator, random_background=False)
        usual_seen = see_errors(renderer, cells, before)
        were = usual_seen.error > usual[usual_seen.cell].clamp(min=LEAST)
        shown = ~(changed.reshape(-1)[numbers.clamp(min=0)] & first).any(1)
        toned = other_tone(batch, seen, before, usual_seen, space)
        toned |= more_off(batch, seen, off, shown, before, usual_seen, were, space)
    known = (passed >= VOXEL_RAYS).reshape(changed.shape)
    counts = [
        own[own >= 0].bincount(minlength=cells.num_cells)
        for chosen in (changed, known, toned)
        for own in (cells.assign(replace(space, chosen=chosen).centres()).long(),)
    ]
    rebuilt = ((counts[0] >= CELL_VOXELS) & (counts[0] >= CELL_SPACE * counts[1])) | (counts[2] >= CELL_VOXELS)
    changed |= toned
    voxels = Voxels(space.box, changed, space.contraction)
    changed = changed.reshape(-1)
    explained = (changed[numbers.clamp(min=0)] & first).any(1)
    k = cells.num_cells
    rest, bad = (seen.cell[rows].bincount(minlength=k + 1)[:k] for rows in (~explained, ~explained & off))
    shares = bad / rest.clamp(min=1)
    worse = (rest >= CELL_RAYS) & (shares > CELL_SHARE)
    met = seen.cell < k
    differ = int((off & met).sum()) / max(int(met.sum()), 1)
    return Changes(worse, rebuilt, voxels, differ, float(met.float().mean()), shares)


def other_tone(now: Batch, seen: SeenErrors, before: Batch, usual: SeenErrors, space: Voxels) -> Tensor:
    """Voxels in which surfaces of the new pictures have another tone than in the old ones, bool [x, y, z].

    Args:
        now: Rays of the new pictures.
        seen: How far they are off.
        before: Rays of the old pictures.
        usual: How far these are off, which is what the training leaves.
        space: All voxels.
    """
    means, chances, enough = [], [], torch.ones_like(space.chosen)
    for batch, found in ((now, seen), (before, usual)):
        around = where_they_end(batch, found, torch.cat((found.error[:, None], found.lighter), 1), space)
        count = around[0].clamp(min=1)
        means.append(around[2:] / count)
        chances.append((around[1] / count - means[-1].square().sum(0)).clamp(min=0) / count)
        enough &= around[0] >= TONE_RAYS
    squared = (means[0] - means[1]).square().sum(0)
    return enough & (squared > TONE**2) & (squared > TONE_CHANCE * (chances[0] + chances[1]))


def more_off(
    now: Batch,
    seen: SeenErrors,
    off: Tensor,
    shown: Tensor,
    before: Batch,
    usual: SeenErrors,
    were: Tensor,
    space: Voxels,
) -> Tensor:
    """Voxels in which more of the new rays that end there are off than of the old ones, bool [x, y, z].

    Args:
        now: Rays of the new pictures.
        seen: Where they end.
        off: Which are off, bool [r].
        shown: Which of them count, bool [r].
        before: Rays of the old pictures.
        usual: Where they end.
        were: Which of these are off, bool [r].
        space: All voxels.
    """
    new = where_they_end(now, seen, off.float()[:, None], space, shown)
    old = where_they_end(before, usual, were.float()[:, None], space)
    counts = new[0].clamp(min=1), old[0].clamp(min=1)
    both = (new[1] + old[1]) / (counts[0] + counts[1])
    chance = (both * (1 - both)).clamp(min=0.01) * (1 / counts[0] + 1 / counts[1])
    more = (new[1] / counts[0] - old[1] / counts[1]).clamp(min=0)
    enough = (new[0] >= OFF_RAYS) & (old[0] >= OFF_RAYS)
    off_more = enough & (more > OFF_SHARE) & (more.square() > OFF_CHANCE * chance)
    return off_more & (near_by(off_more & (more.square() > 2 * OFF_CHANCE * chance)) > 0)


def where_they_end(
    batch: Batch, seen: SeenErrors, values: Tensor, space: Voxels, chosen: Tensor | None = None
) -> Tensor:
    """How many rays end in and around each voxel, and the sums of their values [r, c]: [1 + c, x, y, z].

    Args:
        batch: The rays.
        seen: Their depths.
        values: Of each ray.
        space: All voxels.
        chosen: Which rays count, bool [r]; None for all.
    """
    numbers = space.numbers(torch.addcmul(batch.rays.origins, seen.depth[:, None], batch.rays.directions))
    ends = (numbers >= 0) & (seen.depth < batch.far)
    ends = ends if chosen is None else ends & chosen
    every = torch.cat((torch.ones_like(values[:, :1]), values), 1)[ends]
    sums = every.new_zeros(space.chosen.numel(), every.shape[1]).index_add(0, numbers[ends], every)
    return torch.nn.functional.avg_pool3d(sums.T.reshape(-1, *space.chosen.shape), 3, 1, 1, divisor_override=1)


def near_by(chosen: Tensor) -> Tensor:
    """How many of the 27 voxels around each, itself included, are chosen: bool [x, y, z] -> float32 [x, y, z]."""
    return torch.nn.functional.avg_pool3d(chosen[None].float(), 3, 1, 1, divisor_override=1)[0]


def space_voxels(box: Tensor, contraction: Contraction | Perspective | None = None) -> Voxels:
    """The voxels of a box [2, 3], near enough to cubes; none is chosen."""
    sides = box[1] - box[0]
    shape = (VOXELS * sides / sides.max()).ceil().long().clamp(min=4).tolist()
    return Voxels(box, torch.zeros(shape, dtype=torch.bool, device=box.device), contraction)
