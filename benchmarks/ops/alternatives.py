"""Alternatives to grouped_mlp and grouped_linear, each at its best setting.

Samples are sorted by cell. The alternatives get encoded inputs; the encoding is not timed. grouped_mlp encodes its
inputs itself. Every call returns its output as one new tensor; in backward cases, it also returns the gradients of the
parameters. n samples, k cells, i inputs and o outputs of a layer.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ops.case import BACKWARD, Contender, NotApplicable
from ops.networks import Batch, with_gradients
from voronerf import ops
from voronerf.ops._core.encodings import ENCODINGS
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS

PIECE = 4096
"""Rows of a piece, small enough for its activations to stay in cache."""
MOST_BYTES = 3 << 30
"""The largest memory in bytes that padding may take."""

Linear = Callable[[Tensor, Any, Any, str], Tensor]


class Encoded:
    """The encoded inputs of two sets of samples in a dtype, shared by alternatives because they are large."""

    def __init__(self, batch: Batch, dtype: torch.dtype) -> None:
        sets = batch.positions[:2]
        self.positions = [encoded(x, batch.net, POSITIONS).to(dtype) for x in sets]
        self.directions: Tensor | None = None
        if batch.directions is not None:
            seen = encoded(batch.directions, batch.net, DIRECTIONS).to(dtype)
            self.directions = seen[batch.direction_index]


def encoded(x: Tensor, net: MLP, source: str) -> Tensor:
    """Encodes positions or directions as the layer table prescribes."""
    encoding = net.encoding(source)
    return x if encoding is None else ENCODINGS[encoding[0]].formula(x, encoding[1])


def evaluate(net: MLP, x: Any, d: Any, weights: Sequence[Any], biases: Sequence[Any], linear: Linear) -> list[Any]:
    """Returns the results of the output layers; ``linear`` computes each layer."""
    results: list[Any] = []
    for layer, weight, bias in zip(net.layers, weights, biases):
        sources = [x if s == POSITIONS else d if s == DIRECTIONS else results[s] for s in layer.inputs]
        joined = sources[0] if len(sources) == 1 else torch.cat(sources, -1)
        results.append(linear(joined, weight, bias, layer.activation))
    return [results[index] for index in net.outputs]


def torch_linear(x: Tensor, weight: Tensor, bias: Tensor, activation: str) -> Tensor:
    """Computes a linear layer with ReLU in place; the gradient needs only the ReLU's output."""
    y = F.linear(x, weight, bias)
    return y.relu_() if activation == "relu" else y


def join(parts: list[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(parts, -1)


def row_pieces(bounds: Sequence[int], piece: int | None) -> Iterator[tuple[int, int, int]]:
    """Yields (cell, first row, row after the last) of each piece; empty cells have no pieces."""
    for cell, (start, stop) in enumerate(itertools.pairwise(bounds)):
        step = piece or max(stop - start, 1)
        for first in range(start, stop, step):
            yield cell, first, min(first + step, stop)


class Parameters:
    """The leaf tensors of a contender: one for each parameter and cell or, if ``stacked``, one for each parameter."""

    def __init__(self, batch: Batch, dtype: torch.dtype, stacked: bool = False) -> None:
        self.net, self.count, self.k, self.stacked = batch.net, len(batch.weights), batch.k, stacked
        tensors, training = [tensor.detach().to(dtype) for tensor in batch.parameters], batch.direction == BACKWARD
        parts = [[tensor] if stacked else tensor.unbind() for tensor in tensors]
        self.parts = [[part.clone().requires_grad_(training) for part in each] for each in parts]
        self.leaves = [leaf for each in self.parts for leaf in each]

    def cells(self) -> list[tuple[Tensor, ...]]:
        """Returns weights and biases of each cell."""
        return list(zip(*[each[0].unbind() if self.stacked else each for each in self.parts]))

    def network(self, cell: tuple[Tensor, ...], x: Tensor, d: Tensor | None) -> Tensor:
        """Computes a cell's plain torch network."""
        return join(evaluate(self.net, x, d, cell[: self.count], cell[self.count :], torch_linear))

    def stack(self, found: tuple[Tensor | None, ...]) -> list[Tensor]:
        """Returns the gradients [k, ...] of the parameters from the gradients of the leaves."""
        full = [torch.zeros_like(leaf) if one is None else one for leaf, one in zip(self.leaves, found)]
        return full if self.stacked else [torch.stack(full[at : at + self.k]) for at in range(0, len(full), self.k)]


def loop(batch: Batch, encoded: Encoded, *, piece: int | None = None, stacked: bool = False) -> Contender:
    """Returns a loop over cells, each a plain torch network."""
    dtype, device = encoded.positions[0].dtype, encoded.positions[0].device
    own, pieces = Parameters(batch, dtype, stacked), list(row_pieces(batch.bounds, piece))

    def outputs(call: int) -> Iterator[tuple[slice, Tensor]]:
        x, d, cells = encoded.positions[call % 2], encoded.directions, own.cells()
        for cell, first, last in pieces:
            rows = slice(first, last)
            yield rows, own.network(cells[cell], x[rows], None if d is None else d[rows])

    def forward(call: int) -> Tensor:
        out = torch.empty(batch.n, batch.net.out_features, dtype=dtype, device=device)
        with torch.no_grad():
            for rows, result in outputs(call):
                out[rows] = result
        return out

    def both(call: int) -> tuple[Tensor, tuple[Tensor | None, ...]]:
        out = torch.cat([result for _, result in outputs(call)])
        return out, torch.autograd.grad(out, own.leaves, batch.gradient(call).to(dtype), allow_unused=True)

    if batch.direction != BACKWARD:
        return Contender(forward)
    return Contender(both, lambda result: (result[0], own.stack(result[1])))


def compile_now(run: Callable[[], Any]) -> None:
    """Compiles outside the timing; raises NotApplicable if the compiler fails."""
    try:
        run()
    except Exception as error:
        reason = (str(error).strip().splitlines() or [""])[0]
        raise NotApplicable(f"torch.compile failed: {type(error).__name__}: {reason}"[:300]) from error


def padded_bmm(batch: Batch, encoded: Encoded) -> Contender:
    """Returns a contender that pads all cells to the largest cell's rows and runs one batched product per layer."""
    net, bounds, dtype = batch.net, torch.tensor(batch.bounds), encoded.positions[0].dtype
    most, device = int(bounds.diff().max()), batch.positions[0].device
    kept = sum(layer.width for layer in net.layers) * (2 if batch.direction == BACKWARD else 0)
    widest = max(layer.width for layer in net.layers)
    size = batch.k * most * (encoded.positions[0].shape[1] + kept + 2 * widest) * dtype.itemsize
    if size > MOST_BYTES:
        raise NotApplicable(f"padding {batch.k} cells to {most} rows would take {size / 2**30:.1f} GiB")
    row = torch.arange(batch.n)
    cell = torch.searchsorted(bounds, row, right=True) - 1
    slot = (cell * most + row - bounds[cell]).to(device)
    source = torch.zeros(batch.k * most, dtype=torch.int64, device=device)
    source[slot] = row.to(device)
    leaves = _leaves(batch, dtype)
    transposed = [weight.transpose(1, 2) for weight in leaves[: len(batch.weights)]]
    biases = [bias[:, None] for bias in leaves[len(batch.weights) :]]

    def product(x: Tensor, weight: Tensor, bias: Tensor, activation: str) -> Tensor:
        y = torch.baddbmm(bias, x, weight)
        return y.relu_() if activation == "relu" else y

    def pad(x: Tensor | None) -> Tensor | None:
        return None if x is None else x[source].view(batch.k, most, -1)

    def forward(call: int) -> Tensor:
        x, d = pad(encoded.positions[call % 2]), pad(encoded.directions)
        out = join(evaluate(net, x, d, transposed, biases, product))
        return out.view(batch.k * most, -1)[slot]

    return _finish(batch, forward, leaves)


def _leaves(batch: Batch, dtype: torch.dtype) -> list[Tensor]:
    training = batch.direction == BACKWARD
    return [tensor.detach().to(dtype).clone().requires_grad_(training) for tensor in batch.parameters]


def _finish(batch: Batch, forward: Callable[[int], Tensor], leaves: list[Tensor], *, same: bool = True) -> Contender:
    run = with_gradients(batch, forward, leaves)
    if same or batch.direction != BACKWARD:
        return Contender(run)
    return Contender(run, lambda result: (result[0], None))


def grouped_mm(batch: Batch, encoded: Encoded) -> Contender:
    """Returns a contender that uses torch's grouped product.

    ``F.grouped_mm`` takes no bias, and its rows must be multiples of 16 bytes long. Every source has an additional
    column of ones, whose weights are the bias, and is zero-padded to a multiple of eight columns.
    """
    net, dtype = batch.net, encoded.positions[0].dtype
    if not hasattr(F, "grouped_mm"):
        raise NotApplicable("this torch has no F.grouped_mm")
    x = [_with_one(tensor) for tensor in encoded.positions]
    d = None if encoded.directions is None else _with_one(encoded.directions)
    widths: dict[int | str, int] = {POSITIONS: encoded.positions[0].shape[1]}
    if encoded.directions is not None:
        widths[DIRECTIONS] = encoded.directions.shape[1]
    leaves = []
    for index, (layer, weight, bias) in enumerate(zip(net.layers, batch.weights, batch.biases)):
        widths[index] = layer.width
        rows = [_eights(widths[source]) for source in layer.inputs]
        full = torch.zeros(batch.k, sum(rows), _eights(layer.width), dtype=dtype, device=weight.device)
        at = taken = 0
        for source, length in zip(layer.inputs, rows):
            width = widths[source]
            full[:, at : at + width, : layer.width] = weight.detach()[:, :, taken : taken + width].transpose(1, 2)
            at, taken = at + length, taken + width
        one = widths[layer.inputs[0]]
        full[:, one, : layer.width] = bias.detach()
        full[:, one, layer.width] = 1
        leaves.append(full.requires_grad_(batch.direction == BACKWARD))
    ends = batch.offsets[1:].contiguous()

    def product(x: Tensor, weight: Tensor, _: Any, activation: str) -> Tensor:
        y = F.grouped_mm(x, weight, offs=ends)
        return y.relu_() if activation == "relu" else y

    def forward(call: int) -> Tensor:
        parts = evaluate(net, x[call % 2], d, leaves, leaves, product)
        return join([part[:, : net.layers[index].width] for part, index in zip(parts, net.outputs)])

    return _finish(batch, forward, leaves, same=False)


def _eights(width: int) -> int:
    return -(-(width + 1) // 8) * 8


def _with_one(x: Tensor) -> Tensor:
    padded = x.new_zeros(x.shape[0], _eights(x.shape[1]))
    padded[:, : x.shape[1]] = x
    padded[:, x.shape[1]] = 1
    return padded


def onednn(batch: Batch, encoded: Encoded, *, piece: int | None = None) -> Contender:
    """Returns a loop over cells with oneDNN's linear op, as torch.compile uses it: prepacked weights, fused ReLU."""
    if batch.direction == BACKWARD:
        raise NotApplicable("the op has no gradient")
    if batch.positions[0].device.type != "cpu":
        raise NotApplicable("runs on the CPU")
    try:
        linear, pack = torch.ops.mkldnn._linear_pointwise, torch.ops.mkldnn._reorder_linear_weight
    except AttributeError as error:
        raise NotApplicable(f"this torch has no such op: {error}") from error
    net, dtype = batch.net, encoded.positions[0].dtype
    rows = piece or max(max(b - a for a, b in itertools.pairwise(batch.bounds)), 1)
    try:
        packed = [[pack(own.to(dtype), rows) for own in weight.detach()] for weight in batch.weights]
    except RuntimeError as error:  # bfloat16 on a processor with only AVX2
        raise NotApplicable(str(error)) from error
    cells = list(zip(*packed)), list(zip(*[bias.detach().to(dtype).unbind() for bias in batch.biases]))
    pieces = list(row_pieces(batch.bounds, piece))

    def product(x: Tensor, weight: Tensor, bias: Tensor, activation: str) -> Tensor:
        return linear(x, weight, bias, activation, [], "")

    def forward(call: int) -> Tensor:
        x, d = encoded.positions[call % 2], encoded.directions
        out = torch.empty(batch.n, net.out_features, dtype=dtype)
        for cell, first, last in pieces:
            own = slice(first, last)
            columns = None if d is None else d[own]
            out[own] = join(evaluate(net, x[own], columns, cells[0][cell], cells[1][cell], product))
        return out

    return _finish(batch, forward, [])


def alternatives(batch: Batch) -> dict[str, Callable[[], Contender]]:
    """Returns the applicable alternatives for a batch, by name; for a bfloat16 batch, also loops in float32."""
    inputs: dict[torch.dtype, Encoded] = {}

    def encoded(dtype: torch.dtype) -> Encoded:
        if dtype not in inputs:
            inputs[dtype] = Encoded(batch, dtype)
        return inputs[dtype]

    def own() -> Encoded:
        return encoded(batch.dtype)

    contenders: dict[str, Callable[[], Contender]] = {
        "torch loop": lambda: loop(batch, own()),
        f"torch loop, {PIECE} rows": lambda: loop(batch, own(), piece=PIECE),
    }
    if batch.dtype != torch.float32:
        contenders["torch loop, float32"] = lambda: loop(batch, encoded(torch.float32))
        contenders[f"torch loop, {PIECE} rows, float32"] = lambda: loop(batch, encoded(torch.float32), piece=PIECE)
    if batch.direction == BACKWARD and batch.k > 1:
        contenders["torch loop, stacked"] = lambda: loop(batch, own(), stacked=True)
    if batch.k > 1:
        contenders["padded bmm"] = lambda: padded_bmm(batch, own())
        contenders["F.grouped_mm"] = lambda: grouped_mm(batch, own())
    if batch.direction != BACKWARD:
        contenders["oneDNN"] = lambda: onednn(batch, own())
        contenders[f"oneDNN, {PIECE} rows"] = lambda: onednn(batch, own(), piece=PIECE)
    return contenders


def ours(batch: Batch, backend: str) -> Contender:
    """Returns grouped_mlp on a backend, or grouped_linear for a single layer without encoding."""
    single = len(batch.net.layers) == 1 and batch.net.position_octaves is None

    def forward(call: int) -> Tensor:
        x = batch.positions[call % len(batch.positions)]
        if single:
            activation = batch.net.layers[0].activation
            return ops.grouped_linear(
                x, batch.offsets, batch.weights[0], batch.biases[0], activation=activation, backend=backend
            )
        return ops.grouped_mlp(
            x,
            batch.offsets,
            batch.weights,
            batch.biases,
            layers=batch.net,
            directions=batch.directions,
            direction_index=batch.direction_index,
            backend=backend,
        )

    return Contender(with_gradients(batch, forward, batch.parameters))
