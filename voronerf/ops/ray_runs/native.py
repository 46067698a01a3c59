"""Rays that pass through the cells of several ranks: samples, partial sums, rays put together, gradients, on the CPU.

n samples, m own ones, q runs, r rays.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared
from voronerf.ops._core.rows import new_empty
from voronerf.ops.ray_runs.reference import OwnSamples

_OWN, _SUMS, _COMPOSE = declared("own_samples"), declared("run_sums"), declared("compose_runs")
_GRADIENTS = declared("run_gradients")
_known = _OWN.inputs(native.compiled.KnownSamples)
_own = _OWN.outputs(native.compiled.OwnSamples, offsets="run_offsets")
_runs = _COMPOSE.inputs(native.compiled.RunsOfRays)
_NO_RAYS: dict[str, Any] = {"deltas": "samples.deltas", "offsets": "samples.run_offsets", "r": "q", "triples": 0}
_NO_RAYS |= {"target": None, "background": None, "background_per_ray": False, "activated": False, "robust": 0.0}
_outputs_of_sums = _SUMS.inputs(native.compiled.RenderLossInputs, **_NO_RAYS, hidden=0.0)
_outputs = _GRADIENTS.inputs(native.compiled.RenderLossInputs, **_NO_RAYS)


@_OWN.custom_op("own_samples_native", devices=("cpu",), fake=OwnSamples.fake)
def own_samples(given: Any) -> OwnSamples:
    """Keeps the samples in own cells, and finds their runs; see ``voronerf.ops.own_samples``."""
    found = _OWN.allocate(given)  # of as many samples as there are
    offsets = found.run_offsets[: native.compiled.own_samples(_known(given), _own(found), native.cpu()) + 1]
    m = int(offsets[-1])
    return OwnSamples._make([*(part[:m] for part in found[:5]), offsets])


@_SUMS.custom_op("run_sums_native", devices=("cpu",))
def run_sums(given: Any, found: tuple[Tensor, Tensor]) -> None:
    """Partial sums [q, 6] and densities [m]; see ``voronerf.ops.run_sums``."""
    sums, density = found
    samples = given.samples
    native.compiled.run_sums(_outputs_of_sums(given), samples.depths, samples.ray_index, density, sums, native.cpu())


@_COMPOSE.custom_op("compose_runs_native", devices=("cpu",))
def compose_runs(given: Any, found: tuple[Tensor, Tensor]) -> None:
    """Answers [q, 6] to the sums, and the part [] of the loss; see ``voronerf.ops.compose_runs``."""
    answers, loss = found
    loss.fill_(native.compiled.compose_runs(_runs(given), answers, native.cpu()))


@_GRADIENTS.custom_op("run_gradients_native", devices=("cpu",))
def run_gradients(given: Any, found: tuple[Tensor, Tensor]) -> None:
    """Gradient of the loss to the outputs [m, 4], and weights [m]; see ``voronerf.ops.run_gradients``."""
    gradient, weights = found
    importance = new_empty(weights, given.m)
    native.compiled.run_gradients(_outputs(given), given.answers, gradient, weights, importance, native.cpu())
