"""Partial sums of rays through the cells of several ranks, and their composition to colours.

r rays, n known samples, m of them in a rank's own cells (packed), q runs, c colours. A run is a sequence of a rank's
samples on one ray, with no samples of other ranks between them. With the optical depth tau in front of each run, the
colour of a ray is ``sum exp(-tau) * colour of run`` (NeRF, equation 3, in pieces; Li et al. 2024, NeRF-XL).
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor

from voronerf.ops.composite.reference import composite, optical_depth, saveable
from voronerf.ops.formulas import activate, along_rays, compose
from voronerf.ops.render_loss.reference import robust_error


class OwnSamples(NamedTuple):
    """The samples in this rank's own cells, ray after ray, near to far.

    Attributes:
        positions: [m, 3], the positions of the samples.
        ray_index: int32 [m], the ray of each sample.
        depths: [m], the distance of each sample along its ray.
        deltas: [m], the length of the stratum of each sample.
        cells: int32 [m], the local number of each sample's cell on this rank.
        run_offsets: int32 [q + 1], the first sample of each run, and m.

    Examples:
        >>> import torch
        >>> from voronerf.ops import own_samples
        >>> zeros = torch.zeros(1, dtype=torch.int32)
        >>> own_samples(torch.zeros(1, 3), zeros, torch.ones(1), torch.ones(1), zeros, zeros).run_offsets
        tensor([0, 1], dtype=torch.int32)
    """

    positions: Annotated[Tensor, "same [n, 3]"]
    ray_index: Annotated[Tensor, "int32 [n]"]
    depths: Annotated[Tensor, "same [n]"]
    deltas: Annotated[Tensor, "same [n]"]
    cells: Annotated[Tensor, "int32 [n]"]
    run_offsets: Annotated[Tensor, "int32 [n + 1]"]

    @staticmethod
    def fake(arguments: Any) -> OwnSamples:
        """Allocates fake results; the numbers of samples and runs are dynamic sizes."""
        m, ends = (torch.library.get_ctx().new_dynamic_size() for _ in range(2))
        kept = [part.new_empty((m, *part.shape[1:])) for part in arguments[:5]]
        return OwnSamples._make([*kept, arguments.cells.new_empty(ends)])


class Runs(NamedTuple):
    """The partial sums of runs. Only colour and optical depth have gradients.

    Attributes:
        colour: [q, c], the colour of each run without occlusion by runs in front.
        optical: [q], the optical depth of each run.
        ray: int64 [q], the ray of each run.
        start: [q], the depth of the first sample of each run.
        weights: [m], the rendering weights of the samples without occlusion by runs in front.
    """

    colour: Tensor
    optical: Tensor
    ray: Tensor
    start: Tensor
    weights: Tensor


def own_samples(
    positions: Tensor,
    ray_index: Tensor,
    depths: Tensor,
    deltas: Tensor,
    cells: Tensor,
    local_cells: Tensor,
    curved: bool,
) -> OwnSamples:
    """Selects the samples in this rank's own cells, and finds their runs; see ``voronerf.ops.own_samples``."""
    numbers = local_cells[cells.long()]
    kept = (numbers >= 0).nonzero()[:, 0]
    ray, at, length, cell = ray_index[kept], depths[kept], deltas[kept], numbers[kept]
    near = at.diff() < torch.minimum(length[1:], length[:-1])  # no stratum fits in between
    begins = (kept.diff() != 1) | (ray.diff() != 0) | (~near if curved else (cell.diff() != 0) & ~near)
    first = 1 + begins.nonzero()[:, 0]
    ends = torch.tensor([len(kept)], device=kept.device)
    offsets = torch.cat((ends.new_zeros(min(len(kept), 1)), first, ends)).to(torch.int32)
    return OwnSamples(positions[kept], ray, at, length, cell, offsets)


def sum_runs(samples: OwnSamples, colour: Tensor, density: Tensor) -> Runs:
    """Returns the partial sums of runs from the colours [m, c] and densities [m] of their samples."""
    offsets = samples.run_offsets
    first = offsets[:-1].long()
    run = torch.repeat_interleave(offsets.diff())
    composed = composite(density, colour, samples.depths, samples.deltas, ray_offsets=offsets)
    optical = torch.zeros_like(samples.depths[first]).index_add(0, run, optical_depth(density, samples.deltas))
    ray, start = samples.ray_index[first].long(), samples.depths[first]
    return Runs(composed.colour, optical, ray, start, composed.weights.detach())


def run_sums(raw: Tensor, samples: OwnSamples, density_scale: float) -> tuple[Tensor, Tensor]:
    """Returns partial sums [q, 6] and densities [m]; see ``voronerf.ops.run_sums``."""
    colour, density = activate(raw, density_scale)
    runs = sum_runs(samples, colour, density)
    return torch.cat((runs.colour, runs.optical[:, None], runs.start[:, None], runs.ray[:, None]), 1), density


def compose_runs(
    sums: Tensor, target: Tensor, background: Tensor | None, first: int, rays: int, robust: float
) -> tuple[Tensor, Tensor]:
    """Returns the argument ``answers`` [q, 6] of `run_gradients`, and the contribution [] of the r rays to the loss.

    See ``voronerf.ops.compose_runs``.
    """
    number = sums[:, 5].double()
    wrong = number[~((number >= first) & (number < first + len(target)))]
    if len(wrong):
        allowed = f"{first} to {first + len(target) - 1}"
        raise ValueError(f"compose_runs: rays must be {allowed}, got {float(wrong[0]):g}")
    ray = number.long() - first
    order = along_rays(ray, sums[:, 4])
    part, optical, ray = sums[order, :3], sums[order, 3], ray[order]
    whole = compose(part, optical, ray, len(target))
    behind = torch.zeros_like(target) if background is None else background.expand_as(target)
    off = whole.colour + whole.through[:, None] * behind - target
    error = off.square().sum(-1)
    slope = robust / (error + robust**2).sqrt() if robust else torch.ones_like(error)
    slopes, loss = off * (2 / (3 * rays) * slope)[:, None], robust_error(error, robust).sum() / (3 * rays)
    behind_runs = whole.loss_behind(part, ray, slopes, behind)
    answers = torch.cat((slopes[ray], torch.stack((behind_runs, whole.optical_in_front, error[ray]), 1)), 1)
    return torch.empty_like(answers).index_copy(0, order, answers), loss


@torch.inference_mode(False)
@torch.enable_grad()
def run_gradients(
    raw: Tensor, samples: OwnSamples, answers: Tensor, density_scale: float, hidden: float
) -> tuple[Tensor, Tensor]:
    """Returns the gradient [m, 4] of the outputs, and weights [m]; see ``voronerf.ops.run_gradients``."""
    samples, answers = OwnSamples._make(map(saveable, samples)), saveable(answers)
    raw = saveable(raw.detach()).requires_grad_()
    colour, density = activate(raw, density_scale)
    runs, front = sum_runs(samples, colour, density), torch.exp(-answers[:, 4])
    run = torch.repeat_interleave(samples.run_offsets.diff())
    weights = runs.weights * front[run]
    of_sums = front[:, None] * answers[:, :3], -answers[:, 3]
    (gradient,) = torch.autograd.grad((runs.colour, runs.optical), raw, of_sums)
    unseen = weights <= hidden * -torch.expm1(-density.detach() * samples.deltas)
    return gradient.masked_fill(unseen[:, None], 0), weights
