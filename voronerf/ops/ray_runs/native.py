"""Rays that pass through the cells of several ranks: samples, partial sums, rays put together, gradients, on the CPU.

No custom ops, because a step calls them inside of a node of autograd. n samples, m own ones, q runs, r rays.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared
from voronerf.ops.ray_runs.reference import OwnSamples

_OWN, _COMPOSE = declared("own_samples"), declared("compose_runs")
_known, _own = (
    _OWN.inputs(native.compiled.KnownSamples),
    _OWN.outputs(native.compiled.OwnSamples, offsets="run_offsets"),
)
_runs = _COMPOSE.inputs(native.compiled.RunsOfRays)


def own_samples(*flat: Any) -> OwnSamples:
    """Keeps the samples in own cells, and finds their runs; see ``voronerf.ops.own_samples``."""
    given = _OWN.Inputs._make(flat)
    found = _OWN.allocate(given)  # of as many samples as there are
    offsets = found.run_offsets[: native.compiled.own_samples(_known(given), _own(found), native.cpu()) + 1]
    m = int(offsets[-1])
    return OwnSamples._make([*(part[:m] for part in found[:5]), offsets])


def run_sums(raw: Tensor, samples: OwnSamples, density_scale: float) -> tuple[Tensor, Tensor]:
    """Partial sums [q, 6] and densities [m]; see ``voronerf.ops.run_sums``."""
    density, sums = raw.new_empty(len(raw)), raw.new_empty(len(samples.run_offsets) - 1, 6)
    given = _inputs(raw, samples, density_scale, 0.0)
    native.compiled.run_sums(given, samples.depths, samples.ray_index, density, sums, native.cpu())
    return sums, density


@_COMPOSE.plain
def compose_runs(given: Any, found: tuple[Tensor, Tensor]) -> None:
    """Answers [q, 6] to the sums, and the part [] of the loss; see ``voronerf.ops.compose_runs``."""
    answers, loss = found
    loss.fill_(native.compiled.compose_runs(_runs(given), answers, native.cpu()))


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
