"""Networks of many cells run piece by piece: one cell's rows, a few thousand at a time, through all layers.

What a piece needs stays in cache from one layer to the next, and gradients of activations never become arrays of n
rows. This is code for the inside of the operators in ``grouped_linear`` and ``grouped_mlp``: autograd does not see it.

n samples, k cells, m rows of a piece, i inputs and o outputs of a layer, p and q raw features of a position and a
direction, e encoded features.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from voronerf.layers import DIRECTIONS, MLP, POSITIONS
from voronerf.reference.activation import activate_, times_derivative_
from voronerf.reference.specification import encode, encode_positions

PIECE = 4096
"""Most rows of a piece. Fewer pay for the calls (a tenth more time at 1,024 rows), more gain nothing."""


def pieces(op: str, offsets: Tensor, rows: int) -> Iterator[tuple[int, slice]]:
    """Cells that have samples, in slices of at most ``PIECE`` rows. Reads ``offsets`` on the host."""
    bounds = offsets.tolist()
    if bounds[0] < 0 or bounds[-1] > rows or any(low > high for low, high in itertools.pairwise(bounds)):
        raise ValueError(f"{op}: offsets must rise from 0 or more to at most the number of rows, {rows}, got {bounds}")
    for cell, (low, high) in enumerate(itertools.pairwise(bounds)):
        for start in range(low, high, PIECE):
            yield cell, slice(start, min(start + PIECE, high))


def zero_strays(y: Tensor, offsets: Tensor) -> Tensor:
    """``y`` with zeros in the rows that belong to no cell, before ``offsets[0]`` and from ``offsets[k]`` on."""
    y[: int(offsets[0])].zero_()
    y[int(offsets[-1]) :].zero_()
    return y


def compute_dtype(tensor: Tensor) -> torch.dtype:
    """What products run in. On a CPU torch's float16 products take a minute where float32 takes milliseconds."""
    if tensor.dtype == torch.float16 and tensor.device.type == "cpu":
        return torch.float32
    return tensor.dtype


def wide_dtype(tensor: Tensor) -> torch.dtype:
    """What sums over samples are taken in: float32 at least."""
    return torch.promote_types(tensor.dtype, torch.float32)


def add_product(total: Tensor, left: Tensor, right: Tensor) -> None:
    """Adds the matrix product of ``left`` and ``right`` to ``total``, which may be of a wider type."""
    if total.dtype == left.dtype:
        total.addmm_(left, right)
    else:
        total.add_(torch.mm(left, right))


class Network:
    """A layer table with its parameters cut up by layer, source and cell, and the samples it is to run on.

    Attributes:
        table: the layer table.
        dtype: what products run in; parameters are converted once.
        columns: for every layer, its sources and which columns of the weight each of them meets. A concatenation is a
            sum of partial products: nothing is copied.
        weights: views [o, columns] by layer, source and cell.
        transposed: the same, as [columns, o].
        biases: views [o] by layer and cell, None for a layer without.
        outputs: layers that make up the output, and the columns they fill.
    """

    def __init__(
        self,
        table: MLP,
        positions: Tensor,
        directions: Tensor | None,
        direction_index: Tensor | None,
        offsets: Tensor,
        parameters: Sequence[Tensor],
        has_bias: Sequence[bool],
    ) -> None:
        self.table, self.positions, self.offsets = table, positions, offsets
        self.directions, self.direction_index = directions, direction_index
        self.parameters, self.has_bias = parameters, has_bias
        self.storage, self.dtype = parameters[0].dtype, compute_dtype(parameters[0])
        self.encoded_directions: Tensor | None = None
        if directions is not None:
            self.encoded_directions = encode(directions, table.direction_octaves).to(self.dtype)
        directions_d = 0 if directions is None else directions.shape[1]
        self.columns = [
            _columns(
                layer.inputs, [table.source_width(source, positions.shape[1], directions_d) for source in layer.inputs]
            )
            for layer in table.layers
        ]
        self.outputs = _columns(table.outputs, [table.layers[output].width for output in table.outputs])
        weights, biases = split_parameters([parameter.to(self.dtype) for parameter in parameters], has_bias)
        self.weights = [
            [weight[:, :, columns].unbind() for _, columns in sources] for weight, sources in zip(weights, self.columns)
        ]
        self.transposed = [[[view.t() for view in cells] for cells in sources] for sources in self.weights]
        self.biases = [bias if bias is None else bias.unbind() for bias in biases]

    def sources(self, rows: slice, encoded: Tensor | None) -> dict[int | str, Tensor]:
        """Positions and directions of a piece, as the layers read them; ``encoded`` holds the positions if encoded."""
        found: dict[int | str, Tensor] = {
            POSITIONS: self.positions[rows].to(self.dtype) if encoded is None else encoded
        }
        if self.encoded_directions is not None:
            index = rows if self.direction_index is None else self.direction_index[rows]
            found[DIRECTIONS] = self.encoded_directions[index]
        return found


class Kept:
    """What the backward reads, by name: encoded positions, outputs of layers, slopes of sines."""

    def __init__(self, table: MLP, arrays: Sequence[Tensor]) -> None:
        rest = iter(arrays)
        self.encoded = None if table.position_octaves is None else next(rest)
        self.values = [next(rest) for _ in table.layers]
        self.slopes = [next(rest) if layer.activation == "sine" else None for layer in table.layers]


def kept_widths(table: MLP, positions_d: int) -> list[int]:
    """Columns of each array in ``Kept``, in order. One large array would be fresh memory every time."""
    encoded = [] if table.position_octaves is None else [table.source_width(POSITIONS, positions_d)]
    slopes = [layer.width for layer in table.layers if layer.activation == "sine"]
    return encoded + [layer.width for layer in table.layers] + slopes


def forward(network: Network, keep: bool) -> tuple[Tensor, list[Tensor]]:
    """Output [n, out], and the arrays that the backward reads, none without ``keep``."""
    table, positions = network.table, network.positions
    n = positions.shape[0]
    out = positions.new_empty(n, table.out_features, dtype=network.storage)
    held = n if keep else min(n, PIECE)
    widths = kept_widths(table, positions.shape[1])
    hidden = [positions.new_empty(held, width, dtype=network.dtype) for width in widths]
    kept = Kept(table, hidden)
    for cell, rows in pieces("grouped_mlp", network.offsets, n):
        at = rows if keep else slice(0, rows.stop - rows.start)
        encoded = None
        if kept.encoded is not None:
            encoded = kept.encoded[at].copy_(encode_positions(positions[rows], table))
        sources = network.sources(rows, encoded)
        for index, layer in enumerate(table.layers):
            y = kept.values[index][at]
            _linear(network, index, cell, sources, y)
            slope = kept.slopes[index]
            if slope is not None:
                torch.cos(y, out=slope[at])
            sources[index] = activate_(layer.activation, y)
        for output, columns in network.outputs:
            out[rows, columns] = sources[output]
    return zero_strays(out, network.offsets), hidden if keep else []


def backward(network: Network, g: Tensor, hidden: Sequence[Tensor], needs: list[bool]) -> list[Tensor]:
    """Gradients of positions, directions and parameters, as many of them as ``needs`` says, in this order."""
    table, positions, directions = network.table, network.positions, network.directions
    kept = Kept(table, hidden)
    to_positions, to_directions, *to_parameters = needs
    wanted: set[int | str] = set(range(len(table.layers)))
    totals = [
        torch.zeros_like(parameter, dtype=wide_dtype(parameter)) if need else None
        for parameter, need in zip(network.parameters, to_parameters)
    ]
    weight_totals, bias_totals = split_parameters(totals, network.has_bias)
    position_total = torch.zeros_like(positions) if to_positions else None
    if to_positions:
        wanted.add(POSITIONS)
    direction_total = None
    if to_directions:
        wanted.add(DIRECTIONS)
        assert network.encoded_directions is not None
        direction_total = torch.zeros_like(network.encoded_directions, dtype=wide_dtype(network.encoded_directions))
    flow = _Flow(network)

    for cell, rows in pieces("grouped_mlp", network.offsets, positions.shape[0]):
        sources = network.sources(rows, None if kept.encoded is None else kept.encoded[rows])
        sources.update((index, values[rows]) for index, values in enumerate(kept.values))
        flow.begin(rows.stop - rows.start)
        for output, columns in network.outputs:
            flow.add(output, g[rows, columns].to(network.dtype))
        for index in reversed(range(len(table.layers))):
            if index not in flow.gradients:
                continue
            gradient = flow.gradients[index]
            slope = kept.slopes[index]
            values = sources[index] if slope is None else slope[rows]
            times_derivative_(table.layers[index].activation, gradient, values)
            bias_total, weight_total = bias_totals[index], weight_totals[index]
            if bias_total is not None:
                bias_total[cell] += gradient.sum(dim=0, dtype=bias_total.dtype)
            for number, (source, columns) in enumerate(network.columns[index]):
                if weight_total is not None:
                    add_product(weight_total[cell, :, columns], gradient.t(), sources[source])
                if source in wanted:
                    flow.add_product(source, gradient, network.weights[index][number][cell])
            flow.done(index)
        if position_total is not None and POSITIONS in flow.gradients:
            position_total[rows] = encode_backward(
                flow.gradients[POSITIONS], sources[POSITIONS], table.position_octaves, integrated=table.integrated
            )
        if direction_total is not None and DIRECTIONS in flow.gradients:
            gradient = flow.gradients[DIRECTIONS].to(direction_total.dtype)
            if network.direction_index is None:
                direction_total[rows] = gradient
            else:
                direction_total.index_add_(0, network.direction_index[rows], gradient)

    found = [] if position_total is None else [position_total]
    if direction_total is not None and directions is not None and network.encoded_directions is not None:
        raw = encode_backward(direction_total, network.encoded_directions, table.direction_octaves)
        found.append(raw.to(directions.dtype))
    found += [total.to(network.storage) for total in totals if total is not None]
    return found


class _Flow:
    """Gradients flowing back through a piece, by source, in few arrays used again and again: what is small stays
    cached."""

    def __init__(self, network: Network) -> None:
        self.gradients: dict[int | str, Tensor] = {}
        self._like = network.positions.new_empty(0, dtype=network.dtype)
        self._most = min(network.positions.shape[0], PIECE)
        self._rows = 0
        self._taken: dict[int | str, Tensor] = {}
        self._idle: dict[int, list[Tensor]] = {}

    def begin(self, rows: int) -> None:
        """Starts on a piece of so many rows, with no gradients."""
        for source in list(self.gradients):
            self.done(source)
        self._rows = rows

    def done(self, source: int | str) -> None:
        """Drops a gradient that has been passed on."""
        del self.gradients[source]
        array = self._taken.pop(source)
        self._idle.setdefault(array.shape[1], []).append(array)

    def add(self, source: int | str, gradient: Tensor) -> None:
        """Adds to the gradient of a source."""
        if source in self.gradients:
            self.gradients[source].add_(gradient)
        else:
            self._take(source, gradient.shape[1]).copy_(gradient)

    def add_product(self, source: int | str, left: Tensor, right: Tensor) -> None:
        """Adds a matrix product to the gradient of a source."""
        if source in self.gradients:
            self.gradients[source].addmm_(left, right)
        else:
            torch.mm(left, right, out=self._take(source, right.shape[1]))

    def _take(self, source: int | str, width: int) -> Tensor:
        idle = self._idle.get(width)
        self._taken[source] = idle.pop() if idle else self._like.new_empty(self._most, width)
        self.gradients[source] = self._taken[source][: self._rows]
        return self.gradients[source]


def encode_backward(gradient: Tensor, encoded: Tensor, octaves: int | None, *, integrated: bool = False) -> Tensor:
    """Gradient of the raw features [m, d] from that of their encoding [m, e], whose sines and cosines are at hand.

    Of the integrated encoding the raw features are means and variances, and e^(-4^l variance / 2) is a factor of both
    sine and cosine: its derivative is -4^l / 2 times itself.
    """
    if octaves is None:
        return gradient
    gradient, encoded = gradient.to(wide_dtype(gradient)), encoded.to(wide_dtype(encoded))
    d = gradient.shape[1] // (2 * octaves if integrated else 1 + 2 * octaves)
    first = 0 if integrated else d
    waves, slopes = (part[:, first:].unflatten(1, (octaves, 2, d)) for part in (gradient, encoded))
    frequency = 2.0 ** torch.arange(octaves, dtype=gradient.dtype, device=gradient.device)[:, None]
    through = waves[:, :, 0] * slopes[:, :, 1] - waves[:, :, 1] * slopes[:, :, 0]
    means = (through * frequency).sum(dim=1)
    if not integrated:
        return gradient[:, :d] + means
    return torch.cat([means, ((waves * slopes).sum(dim=2) * frequency.square()).sum(dim=1) * -0.5], dim=1)


def split_parameters(parameters: Sequence[Tensor | None], has_bias: Sequence[bool]) -> tuple[list, list]:
    """Weights and biases of every layer from one list: all weights, then the biases that there are."""
    biases = iter(parameters[len(has_bias) :])
    return list(parameters[: len(has_bias)]), [next(biases) if has else None for has in has_bias]


def _linear(network: Network, index: int, cell: int, sources: dict[int | str, Tensor], out: Tensor) -> None:
    biases = network.biases[index]
    for number, (source, _) in enumerate(network.columns[index]):
        weight = network.transposed[index][number][cell]
        if number > 0:
            out.addmm_(sources[source], weight)
        elif biases is None:
            torch.mm(sources[source], weight, out=out)
        else:
            torch.addmm(biases[cell], sources[source], weight, out=out)


def _columns(sources: Sequence[int | str], widths: Sequence[int]) -> list[tuple[int | str, slice]]:
    ends = list(itertools.accumulate(widths))
    return [(source, slice(end - width, end)) for source, width, end in zip(sources, widths, ends)]
