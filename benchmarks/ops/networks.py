"""The networks of the throughput table, their inputs, their cost, and their gradients in float64.

n samples, r rays, k cells, i inputs and o outputs of a layer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ops.case import BACKWARD, generator, relative_error, rotation, uniform_points
from voronerf import ops
from voronerf.nerf.fields import NeRF
from voronerf.ops._core.layers import MLP, POSITIONS, Layer

RAY = 64
"""The number of consecutive samples with the same view direction."""
CHECKED = 4096
"""The number of samples whose results and gradients are compared with float64."""


def _plain(width: int, depth: int) -> MLP:
    hidden = [Layer((POSITIONS,), width, "relu"), *[Layer((i,), width, "relu") for i in range(depth - 1)]]
    return MLP((*hidden, Layer((depth - 1,), 4)), (depth,), position_octaves=10)


def _linear(o: int) -> MLP:
    return MLP((Layer((POSITIONS,), o, "relu"),), (0,))


NETS: dict[str, MLP] = {
    "w64d4": _plain(64, 4),
    "mlp32": _plain(32, 3),
    "nerf64": NeRF(width=64).layers,
    "nerf128": NeRF(width=128).layers,
    "nerf256": NeRF(width=256).layers,
}
# Single layers with ReLU, named INPUTS-OUTPUTS: first layers on encoded positions, and middle layers.
LAYERS: dict[str, tuple[int, MLP]] = {
    "63-64": (63, _linear(64)),
    "64-64": (64, _linear(64)),
    "256-256": (256, _linear(256)),
}


@dataclass(frozen=True)
class Cost:
    """The floating-point operations of matrix products, per sample.

    Attributes:
        forward: Two operations for each weight.
        backward: Operations for the gradients of all weights and of inputs from earlier layers.
        again: Operations to recompute activations in the backward pass, for code that does not store them.
    """

    forward: float
    backward: float
    again: float


def cost(net: MLP, features: int = 3) -> Cost:
    """Returns the cost of a network with raw inputs of ``features`` columns."""
    shapes = net.weight_shapes(features, 3)
    forward = 2.0 * sum(o * i for o, i in shapes)
    inner = 2.0 * sum(
        layer.width * net.layers[source].width
        for layer in net.layers
        for source in layer.inputs
        if isinstance(source, int)
    )
    read = {source for layer in net.layers for source in layer.inputs}
    again = 2.0 * sum(o * i for index, (o, i) in enumerate(shapes) if index in read)
    return Cost(forward, forward + inner, again)


@dataclass
class Batch:
    """The inputs of a case: sets of samples, and one network per cell.

    Samples of a set are sorted by cell, except in cases of routed_mlp, which sorts them itself. All sets share
    ``offsets``, so that no alternative is recompiled for other sizes.

    Attributes:
        net: The layer table.
        positions: Sets of raw positions [n, 3], or inputs [n, d] of a single layer.
        bounds: The values of ``offsets`` on the host.
        offsets: The row offsets of the cells, int32 [k + 1].
        directions: Directions [r, 3], or None if the network reads none.
        direction_index: The direction of each sample, int32 [n].
        weights: A tensor [k, o, i] for each layer.
        biases: A tensor [k, o] for each layer.
        gradients: Two output gradients [n, out]: for call 0, zero except in checked rows; for later calls, dense.
        checked: The rows compared with float64, in rising order.
        direction: ``FORWARD`` or ``BACKWARD``.
    """

    net: MLP
    positions: list[Tensor]
    bounds: list[int]
    offsets: Tensor
    directions: Tensor | None
    direction_index: Tensor | None
    weights: list[Tensor]
    biases: list[Tensor]
    gradients: list[Tensor]
    checked: Tensor
    direction: str

    @property
    def n(self) -> int:
        return self.positions[0].shape[0]

    @property
    def k(self) -> int:
        return len(self.bounds) - 1

    @property
    def dtype(self) -> torch.dtype:
        return self.weights[0].dtype

    @property
    def parameters(self) -> list[Tensor]:
        return [*self.weights, *self.biases]

    def gradient(self, call: int) -> Tensor:
        return self.gradients[min(call, 1)]


def parameters(net: MLP, k: int, features: int, dtype: torch.dtype, device: torch.device) -> list[list[Tensor]]:
    """Draws weights and biases that keep activations of order one."""
    random = generator(7)
    lists: list[list[Tensor]] = [[], []]
    for o, i in net.weight_shapes(features, 3):
        lists[0].append(torch.randn(k, o, i, generator=random) * (2 / i) ** 0.5)
        lists[1].append(torch.randn(k, o, generator=random) * 0.1)
    return [[tensor.to(device, dtype) for tensor in tensors] for tensors in lists]


def make_batch(
    net: MLP,
    n: int,
    k: int,
    dtype: torch.dtype,
    direction: str,
    device: torch.device,
    *,
    features: int | None = None,
    centres: Tensor | None = None,
) -> Batch:
    """Draws uniform samples, cells with random centres, and networks.

    Args:
        net: The layer table.
        n: The number of samples.
        k: The number of cells.
        dtype: The type of the parameters.
        direction: ``FORWARD`` or ``BACKWARD``.
        device: The device of all tensors.
        features: The input width of a single layer; None for positions.
        centres: Centres [k, 3] for routed_mlp, whose samples are unsorted; None for samples sorted by cell.
    """
    sets = rotation(4 * n * (features or 3))
    points = [uniform_points(n, seed, device) for seed in range(sets)]
    order, offsets = ops.cell_sort(
        ops.nearest_centre(points[0], uniform_points(k, 1000, device) if centres is None else centres), k
    )
    positions = points
    if features is not None:
        positions = [torch.randn(n, features, generator=generator(seed)).to(device, dtype) for seed in range(sets)]
    elif centres is None:
        # The second set stays in the same cells: samples of the first set, moved a little.
        first = points[0][order]
        positions = [first + seed * 1e-4 for seed in range(sets)]
    rays = max(1, n // RAY)
    directions = torch.nn.functional.normalize(torch.randn(rays, 3, generator=generator(3)), dim=1).to(device)
    index = (torch.arange(n, dtype=torch.int32, device=device) // RAY).clamp(max=rays - 1)
    weights, biases = parameters(net, k, features or 3, dtype, device)
    checked = torch.arange(0, n, max(1, n // CHECKED), device=device)
    gradients = []
    if direction == BACKWARD:
        for tensor in (*weights, *biases):
            tensor.requires_grad_()
        dense = torch.randn(n, net.out_features, generator=generator(5)).to(device, dtype)
        gradients = [torch.zeros_like(dense).index_copy_(0, checked, dense[checked]), dense]
    return Batch(
        net,
        positions,
        offsets.tolist(),
        offsets,
        directions if net.uses_directions else None,
        (index if centres is not None else index[order]) if net.uses_directions else None,
        weights,
        biases,
        gradients,
        checked,
        direction,
    )


def with_gradients(batch: Batch, forward: Callable[[int], Tensor], leaves: Sequence[Tensor]) -> Callable[[int], Any]:
    """Returns ``forward`` without autograd for a forward case, else a function: call -> (output, leaf gradients)."""
    if batch.direction != BACKWARD:

        def run(call: int) -> Tensor:
            with torch.no_grad():
                return forward(call)

        return run

    def run_both(call: int) -> tuple[Tensor, tuple[Tensor | None, ...]]:
        out = forward(call)
        return out, torch.autograd.grad(out, leaves, batch.gradient(call), allow_unused=True)

    return run_both


def network_error(batch: Batch, cells: Tensor | None = None) -> Callable[[Any], float]:
    """Returns a function that computes the largest relative error of outputs and gradients from call 0's result.

    Call 0 has output gradients only in the rows ``Batch.checked``, so that the float64 reference needs only these
    rows. A result (output, None) has no comparable gradients; only its output is checked.

    Args:
        batch: The inputs.
        cells: The cell of every sample, for routed_mlp; None for sorted samples.
    """
    expected: list[Tensor] = []

    def error(result: Any) -> float:
        if not expected:
            expected.extend(_exact(batch, cells))
        out, gradients = result if isinstance(result, tuple) else (result, None)
        found = [out[batch.checked], *(gradients or [])]
        return max(relative_error(a, b) for a, b in zip(found, expected))

    return error


def _exact(batch: Batch, cells: Tensor | None) -> list[Tensor]:
    """Returns in float64 the outputs of the checked rows and the gradients of all parameters."""
    rows = batch.checked
    if cells is None:
        counts = torch.searchsorted(rows.cpu(), torch.tensor(batch.bounds))
        offsets, back = counts.to(torch.int32).to(rows.device), torch.arange(rows.shape[0], device=rows.device)
    else:
        order, offsets = ops.cell_sort(cells[rows].contiguous(), batch.k)
        rows, back = rows[order], torch.argsort(order)
    weights = [weight.detach().double() for weight in batch.weights]
    biases = [bias.detach().double() for bias in batch.biases]
    if batch.direction == BACKWARD:
        for tensor in (*weights, *biases):
            tensor.requires_grad_()
    out = ops.grouped_mlp(
        batch.positions[0][rows].double(),
        offsets,
        weights,
        biases,
        layers=batch.net,
        directions=None if batch.directions is None else batch.directions.double(),
        direction_index=None if batch.direction_index is None else batch.direction_index[rows],
        backend="reference",
    )
    if batch.direction != BACKWARD:
        return [out[back]]
    gradient = batch.gradients[0][rows].double()
    return [out[back].detach(), *torch.autograd.grad(out, [*weights, *biases], gradient)]
