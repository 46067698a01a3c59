"""The ops on rays through the cells of several ranks, by the compiled module on the CPU.

n samples, m of them in a rank's own cells, q runs, r rays.
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
def own_samples(arguments: Any) -> OwnSamples:
    """Selects the samples in this rank's own cells, and finds their runs; see ``voronerf.ops.own_samples``."""
    samples = _OWN.allocate(arguments)  # for all n samples; the unused rows are cut below
    offsets = samples.run_offsets[: native.compiled.own_samples(_known(arguments), _own(samples), native.cpu()) + 1]
    m = int(offsets[-1])
    return OwnSamples._make([*(part[:m] for part in samples[:5]), offsets])


@_SUMS.custom_op("run_sums_native", devices=("cpu",))
def run_sums(arguments: Any, results: tuple[Tensor, Tensor]) -> None:
    """Fills partial sums [q, 6] and densities [m]; see ``voronerf.ops.run_sums``."""
    sums, density = results
    samples = arguments.samples
    native.compiled.run_sums(
        _outputs_of_sums(arguments), samples.depths, samples.ray_index, density, sums, native.cpu()
    )


@_COMPOSE.custom_op("compose_runs_native", devices=("cpu",))
def compose_runs(arguments: Any, results: tuple[Tensor, Tensor]) -> None:
    """Fills the argument ``answers`` [q, 6] of `run_gradients`, and the contribution [] of the r rays to the loss.

    See ``voronerf.ops.compose_runs``.
    """
    answers, loss = results
    loss.fill_(native.compiled.compose_runs(_runs(arguments), answers, native.cpu()))


@_GRADIENTS.custom_op("run_gradients_native", devices=("cpu",))
def run_gradients(arguments: Any, results: tuple[Tensor, Tensor]) -> None:
    """Fills the gradient [m, 4] of the outputs, and weights [m]; see ``voronerf.ops.run_gradients``."""
    gradient, weights = results
    importance = new_empty(weights, arguments.m)
    native.compiled.run_gradients(_outputs(arguments), arguments.answers, gradient, weights, importance, native.cpu())
