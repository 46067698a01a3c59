"""Rays that pass through the cells of several ranks: samples, partial sums, rays put together, gradients, on the CPU.

No custom ops, because a step calls them inside of a node of autograd. n samples, m own ones, q runs, r rays.
"""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops.ray_runs.reference import OwnSamples


def own_samples(
    positions: Tensor, ray_index: Tensor, depths: Tensor, deltas: Tensor, cells: Tensor, own: Tensor, *, bent: bool
) -> OwnSamples:
    """Keeps the samples in own cells, and finds their runs; see ``voronerf.ops.own_samples``."""
    n = len(cells)
    found_positions, (found_depths, found_deltas) = positions.new_empty(n, 3), depths.new_empty(2, n)
    found_index, of_own, offsets = cells.new_empty(n), cells.new_empty(n), cells.new_empty(n + 1)
    known = native.compiled.KnownSamples(
        positions=positions, ray_index=ray_index, depths=depths, deltas=deltas, cells=cells, own=own, n=n, bent=bent
    )
    found = native.compiled.OwnSamples(
        positions=found_positions,
        ray_index=found_index,
        depths=found_depths,
        deltas=found_deltas,
        cells=of_own,
        offsets=offsets,
    )
    offsets = offsets[: native.compiled.own_samples(known, found, native.cpu()) + 1]
    m = int(offsets[-1])
    return OwnSamples(found_positions[:m], found_index[:m], found_depths[:m], found_deltas[:m], of_own[:m], offsets)


def run_sums(raw: Tensor, samples: OwnSamples, density_scale: float) -> tuple[Tensor, Tensor]:
    """Partial sums [q, 6] and densities [m]; see ``voronerf.ops.run_sums``."""
    density, sums = raw.new_empty(len(raw)), raw.new_empty(len(samples.run_offsets) - 1, 6)
    given = _inputs(raw, samples, density_scale, 0.0)
    native.compiled.run_sums(given, samples.depths, samples.ray_index, density, sums, native.cpu())
    return sums, density


def compose_runs(
    sums: Tensor, target: Tensor, background: Tensor | None, first: int, rays: int
) -> tuple[Tensor, Tensor]:
    """Answers [q, 6] to the sums, and the part [] of the loss; see ``voronerf.ops.compose_runs``."""
    answers = sums.new_empty(sums.shape)
    given = native.compiled.RunsOfRays(
        sums=sums,
        target=target,
        background=background,
        background_per_ray=background is not None and background.dim() == 2,
        q=len(sums),
        first=first,
        r=len(target),
        rays=rays,
    )
    return answers, torch.tensor(native.compiled.compose_runs(given, answers, native.cpu()), dtype=sums.dtype)


def run_gradients(
    raw: Tensor, samples: OwnSamples, answers: Tensor, density_scale: float, hidden: float
) -> tuple[Tensor, Tensor]:
    """Gradient of the loss to the outputs [m, 4], and weights [m]; see ``voronerf.ops.run_gradients``."""
    gradient, (weights, importance) = raw.new_empty(raw.shape), raw.new_empty(2, len(raw))
    given = _inputs(raw, samples, density_scale, hidden)
    native.compiled.run_gradients(given, answers, gradient, weights, importance, native.cpu())
    return gradient, weights


def _inputs(raw: Tensor, samples: OwnSamples, density_scale: float, hidden: float) -> native.compiled.RenderLossInputs:
    return native.compiled.RenderLossInputs(
        raw=raw,
        deltas=samples.deltas,
        offsets=samples.run_offsets,
        target=None,
        background=None,
        background_per_ray=False,
        density_scale=density_scale,
        hidden=hidden,
        r=len(samples.run_offsets) - 1,
        m=len(raw),
    )
