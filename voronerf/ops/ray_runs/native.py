"""Rays that pass through the cells of several ranks, for ``voronerf.distributed``: its partial sums, on the CPU.

These are the calls of a training step after one another: own samples, sums, rays put together, gradients. Nothing is
differentiable: the last gives the gradients. n samples, m own ones, q runs, r rays.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf import native
from voronerf.ops.grouped_mlp import native as grouped_mlp
from voronerf.ops.march_rays.reference import March
from voronerf.ops.routed_mlp import native as routed_mlp


class OwnSamples(NamedTuple):
    """Samples of this rank, ray after ray, near to far.

    Attributes:
        positions: [m, 3].
        ray_index: int32 [m].
        depths: [m].
        deltas: [m], the lengths of their strata.
        cells: int32 [m], among those of this rank.
        run_offsets: int32 [q + 1], where each run begins.
    """

    positions: Tensor
    ray_index: Tensor
    depths: Tensor
    deltas: Tensor
    cells: Tensor
    run_offsets: Tensor


def own_samples(march: March, cells: Tensor, own: Tensor, *, bent: bool) -> OwnSamples:
    """Keeps the samples in own cells, and finds their runs; other ranks may have samples that are not among them.

    Args:
        march: Of all samples that this rank knows.
        cells: int32 [n], the cell of each.
        own: int32 [k], the number of each cell among those of this rank, or -1.
        bent: Whether rays are bent by a contraction.
    """
    n = len(cells)
    positions, (depths, deltas) = march.positions.new_empty(n, 3), march.depths.new_empty(2, n)
    ray_index, of_own, offsets = cells.new_empty(n), cells.new_empty(n), cells.new_empty(n + 1)
    known = native.compiled.KnownSamples(
        positions=march.positions,
        ray_index=march.ray_index,
        depths=march.depths,
        deltas=march.deltas,
        cells=cells,
        own=own,
        n=n,
        bent=bent,
    )
    found = native.compiled.OwnSamples(
        positions=positions, ray_index=ray_index, depths=depths, deltas=deltas, cells=of_own, offsets=offsets
    )
    offsets = offsets[: native.compiled.own_samples(known, found, native.cpu()) + 1]
    m = int(offsets[-1])
    return OwnSamples(positions[:m], ray_index[:m], depths[:m], deltas[:m], of_own[:m], offsets)


class Networks:
    """The outputs of the networks of own cells, and later their gradients, without a graph of autograd in between.

    Attributes:
        out: [m, 4].

    Args:
        routed: As of ``learn_rays``, whose positions are those of the samples.
        cells: int32 [m], of the samples.
    """

    def __init__(self, routed: dict[str, Any], cells: Tensor) -> None:
        network = {name: value for name, value in routed.items() if name not in routed_mlp.Where._fields}
        self._call, _ = routed_mlp.prepared(**network, where=routed_mlp.Where(cells=cells))
        with torch.no_grad():
            self.out, _, *self._sorted = routed_mlp.forward(*self._call)

    def backward(self, gradient: Tensor) -> None:
        """Adds to the gradients of the parameters, given that of the outputs."""
        network = self._call.network
        order, offsets, encoded = self._sorted
        parameters = [*network.weights, *network.biases, network.features]
        wanted = [tensor is not None and tensor.requires_grad for tensor in parameters]
        of_features = wanted.pop()
        asked = [any(wanted), False, False, of_features]
        sorted_by = order if order.numel() else None
        *found, _, _, to_features = grouped_mlp.backward(gradient, network, offsets, sorted_by, encoded, asked)
        for tensor, found_gradient, want in zip(parameters, (*found, to_features), (*wanted, of_features), strict=True):
            if tensor is None or not want:
                continue
            if tensor.is_leaf and tensor.grad is None:
                tensor.grad = found_gradient  # which autograd would copy
            else:
                tensor.backward(found_gradient)


def run_sums(raw: Tensor, samples: OwnSamples, density_scale: float) -> tuple[Tensor, Tensor]:
    """Partial sums [q, 6] and densities [m], from the outputs [m, 4] of the networks.

    A sum is colour (as if nothing were in front), optical depth, depth of the first sample, ray.
    """
    density, sums = raw.new_empty(len(raw)), raw.new_empty(len(samples.run_offsets) - 1, 6)
    given = _inputs(raw, samples, density_scale, 0.0)
    native.compiled.run_sums(given, samples.depths, samples.ray_index, density, sums, native.cpu())
    return sums, density


def compose_runs(
    sums: Tensor, target: Tensor, background: Tensor | None, *, first: int, rays: int
) -> tuple[Tensor, Tensor]:
    """What runs [q, 6] must be told of their rays, those from a first one on, and the part [] of these in the loss.

    An answer is the gradient of the loss to the ray's colour, what light behind the run adds to it, the optical depth
    in front, and the error of the ray.

    Args:
        sums: [q, 6] of all ranks, in any order.
        target: [r, 3], the colours of these rays.
        background: [r, 3] or [3], what is behind them, or None.
        first: The number of the first ray.
        rays: How many all ranks have.
    """
    answers = torch.empty_like(sums)
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
    return answers, sums.new_tensor(native.compiled.compose_runs(given, answers, native.cpu()))


def run_gradients(
    raw: Tensor, samples: OwnSamples, answers: Tensor, density_scale: float, hidden: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradient of the loss to the outputs [m, 4], weights [m] and their products with the errors of the rays [m].

    Args:
        raw: As of :func:`run_sums`, like the next.
        samples: Likewise.
        answers: [q, 6], as of :func:`compose_runs`.
        density_scale: As of ``render_loss``.
        hidden: Likewise.
    """
    gradient, (weights, importance) = torch.empty_like(raw), raw.new_empty(2, len(raw))
    given = _inputs(raw, samples, density_scale, hidden)
    native.compiled.run_gradients(given, answers, gradient, weights, importance, native.cpu())
    return gradient, weights, importance


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
