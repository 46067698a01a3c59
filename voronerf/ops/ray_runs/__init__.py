"""Rays through the cells of several ranks. n known samples, m of them in a rank's own cells, q runs, r rays, k cells.

Each rank evaluates the samples in its own cells and sums them over runs (`own_samples`, `run_sums`). A run is a
sequence of a rank's samples on one ray, with no samples of other ranks between them. The process with the runs of all
ranks composes the rays and returns to each run the totals of its ray (`compose_runs`), from which each rank computes
its gradients (`run_gradients`). Together the operations equal `render_loss` (Li et al. 2024, NeRF-XL). Nothing is
differentiable.
"""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import Implementation
from voronerf.ops._core.checks import INDEX, Row, check_range, check_rows, check_shape
from voronerf.ops._core.declare import declare
from voronerf.ops._core.rows import rows_of
from voronerf.ops.ray_runs.reference import OwnSamples

_NATIVE = Implementation(("cpu",), (torch.float32,), file="ray_runs")
_REFERENCE = Implementation(file="ray_runs")


def _check_cells(arguments: Any) -> Any:
    check_range("own_samples", "cells", arguments.cells, len(arguments.local_cells))
    return arguments


@declare(native=_NATIVE, reference=_REFERENCE, prepare=_check_cells)
def own_samples(
    positions: Annotated[Tensor, "float32|float64 [n, 3]"],
    ray_index: Annotated[Tensor, "int32 [n]"],
    depths: Annotated[Tensor, "same [n]"],
    deltas: Annotated[Tensor, "same [n]"],
    cells: Annotated[Tensor, "int32 [n]"],
    local_cells: Annotated[Tensor, "int32 [k]"],
    *,
    curved: bool = False,
    backend: str = "auto",
) -> OwnSamples:
    """Selects the samples in this rank's own cells, and finds their runs.

    Other ranks may hold samples that this rank does not know. A run therefore also ends between two samples that are in
    different cells and at least one stratum apart, since an unknown sample may lie between them. On a straight ray, no
    unknown sample can lie between two samples in the same cell, because cells are convex. On a ``curved`` ray this is
    possible, so a run ends between any two samples that are at least one stratum apart.

    Args:
        positions: the positions of all samples that this rank knows, ray after ray, near to far.
        ray_index: the ray of each sample.
        depths: the distance of each sample along its ray.
        deltas: the length of the stratum of each sample.
        cells: the cell of each sample, 0 to k - 1.
        local_cells: the local number of each cell on this rank, or -1 for cells of other ranks.
        curved: whether rays are curved by a contraction, and may leave a cell and come back.

    Returns:
        OwnSamples(positions, ray_index, depths, deltas, cells, run_offsets).

    Raises:
        ValueError: a cell is out of range (checked on the CPU only).

    Examples:
        >>> import torch
        >>> from voronerf.ops import own_samples
        >>> depths = torch.tensor([0.1, 0.5, 0.9])
        >>> cells, local_cells = torch.tensor([0, 1, 0]).int(), torch.tensor([0, -1]).int()
        >>> samples = torch.rand(3, 3), torch.zeros(3).int(), depths, torch.full((3,), 0.4)
        >>> mine = own_samples(*samples, cells, local_cells)
        >>> mine.depths, mine.run_offsets
        (tensor([0.1000, 0.9000]), tensor([0, 1, 2], dtype=torch.int32))
    """


@declare(
    native=_NATIVE,
    reference=_REFERENCE,
    sizes={"q": lambda arguments: rows_of(arguments.samples.run_offsets) - 1},
    prepare=lambda arguments: _check_samples("run_sums", arguments),
)
def run_sums(
    raw: Annotated[Tensor, "float32|float64 [m, 4]"],
    samples: OwnSamples,
    *,
    density_scale: Annotated[float, "positive"],
    backend: str = "auto",
) -> tuple[Annotated[Tensor, "same [q, 6]"], Annotated[Tensor, "same [m]"]]:
    """Returns the partial sums of runs, from the networks' outputs for their samples.

    Args:
        raw: colour and density before their activations, as in `render_loss`.
        samples: the result of `own_samples`.
        density_scale: the factor on the density, > 0.

    Returns:
        Sums [q, 6]: colour without occlusion by runs in front, optical depth, depth of the first sample, index of the
        ray; and densities [m].

    Examples:
        >>> import torch
        >>> from voronerf.ops import own_samples, run_sums
        >>> zeros = torch.zeros(1, dtype=torch.int32)
        >>> mine = own_samples(torch.zeros(1, 3), zeros + 7, torch.ones(1), torch.ones(1), zeros, zeros)
        >>> run_sums(torch.tensor([[0.0, 0, 0, 50.0]]), mine, density_scale=1.0)[0]  # grey, opaque, depth 1, ray 7
        tensor([[ 0.5000,  0.5000,  0.5000, 50.0000,  1.0000,  7.0000]])
    """


@declare(native=_NATIVE, reference=_REFERENCE)
def compose_runs(
    sums: Annotated[Tensor, "float32|float64 [q, 6]"],
    target: Annotated[Tensor, "same [r, 3]"],
    *,
    background: Annotated[Tensor | None, "same [3] or [r, 3]"] = None,
    first: Annotated[int, "0.."],
    rays: Annotated[int, "1.."],
    robust: Annotated[float, "[0, 1)"] = 0.0,
    backend: str = "auto",
) -> tuple[Annotated[Tensor, "same [q, 6]"], Annotated[Tensor, "same []"]]:
    """Composes rays from the runs of all ranks, and returns to each run the totals of its ray.

    Args:
        sums: the sums of `run_sums`, in any order.
        target: the target colours of the rays.
        background: the colours behind the rays; None is black.
        first: the index of the first of the r rays.
        rays: the total number of rays over all ranks, by which the loss is divided.
        robust: the scale of the robust error, as in `render_loss`.

    Returns:
        Answers [q, 6]: the gradient of the loss with respect to the ray's colour, the loss due to light from behind the
        run, the optical depth in front, and the squared error of the ray; and the contribution [] of the r rays to the
        loss.

    Raises:
        ValueError: a run's ray is outside ``first`` to ``first + r - 1`` (checked on the CPU only).

    Examples:
        >>> import torch
        >>> from voronerf.ops import compose_runs
        >>> sums = torch.tensor([[0.5, 0.5, 0.5, 50.0, 1.0, 0.0]])
        >>> answers, loss = compose_runs(sums, torch.ones(1, 3), first=0, rays=1)
        >>> float(loss), float(answers[0, 5])
        (0.25, 0.75)
    """


def _check_answers(arguments: Any) -> Any:
    runs = len(_check_samples("run_gradients", arguments).samples.run_offsets) - 1
    if len(arguments.answers) != runs:
        check_shape("run_gradients", "answers", arguments.answers, ("q", 6), {"q": runs})
    return arguments


@declare(native=_NATIVE, reference=_REFERENCE, prepare=_check_answers)
def run_gradients(
    raw: Annotated[Tensor, "float32|float64 [m, 4]"],
    samples: OwnSamples,
    answers: Annotated[Tensor, "same [q, 6]"],
    *,
    density_scale: Annotated[float, "positive"],
    hidden: Annotated[float, "[0, 1)"] = 0.0,
    backend: str = "auto",
) -> tuple[Annotated[Tensor, "same [m, 4]"], Annotated[Tensor, "same [m]"]]:
    """Returns the gradient of the loss with respect to the networks' outputs, from the result of `compose_runs`.

    Args:
        raw: colour and density before their activations, as in `run_sums`.
        samples: the result of `own_samples`.
        answers: the answers of `compose_runs`.
        density_scale: the factor on the density, as in `run_sums`.
        hidden: the transmittance, in [0, 1), up to which a sample counts as hidden. Hidden samples have no gradient.

    Returns:
        Gradient [m, 4], and the rendering weights [m] of the samples.

    Examples:
        >>> import torch
        >>> from voronerf.ops import compose_runs, own_samples, run_gradients, run_sums
        >>> zeros, raw = torch.zeros(1, dtype=torch.int32), torch.tensor([[0.0, 0, 0, 50.0]])
        >>> mine = own_samples(torch.zeros(1, 3), zeros, torch.ones(1), torch.ones(1), zeros, zeros)
        >>> sums, _ = run_sums(raw, mine, density_scale=1.0)
        >>> answers, _ = compose_runs(sums, torch.ones(1, 3), first=0, rays=1)
        >>> run_gradients(raw, mine, answers, density_scale=1.0)[0][:, :3].round(decimals=4)  # more light is better
        tensor([[-0.0833, -0.0833, -0.0833]])
    """


def _of_samples(dtype: torch.dtype) -> list[Row]:
    of_raw = [Row(name, (dtype,), ("m",), like="raw") for name in ("deltas", "depths")]
    rest = [Row("ray_index", INDEX, ("m",)), Row("run_offsets", INDEX, ("q+1",))]
    return [Row("raw", (dtype,), ("m", 4)), *of_raw, *rest]


def _check_samples(op: str, arguments: Any) -> Any:
    raw, samples = arguments.raw, arguments.samples
    tensors = [raw, samples.deltas, samples.depths, samples.ray_index, samples.run_offsets]
    check_rows(op, _of_samples, tensors, raw.dtype, smooth=False)
    if not raw.is_cpu or torch.compiler.is_compiling():
        return arguments
    m, offsets = len(raw), samples.run_offsets.numpy()  # numpy: a recording could not replay a torch operation
    if offsets[0] != 0 or offsets[-1] != m or not (offsets[1:] > offsets[:-1]).all():
        rule = f"run_offsets must strictly ascend from 0 to the number of samples, {m}"
        raise ValueError(f"{op}: {rule}, got {offsets.tolist()!s:.60}")
    return arguments
