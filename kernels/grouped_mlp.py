"""Warp kernels for one network per cell, and for ``grouped_linear``, a network of one layer.

n samples, k cells, t tiles of rows, c columns.

Samples are sorted by cell, and the rows of each cell are padded to tiles of ``ROWS`` rows, so that a tile belongs to
one cell. Features are split into groups of ``WIDTH``, called columns here: the features of the encoded positions, of
the directions and of each layer's output are each padded to whole columns. A weight matrix consists of blocks
[WIDTH, WIDTH], each of which maps one column to another. A network with skips, branches and any widths is therefore a
list of products::

    column o of the layers = bias o + sum over the products p of o: activation(column source[p]) @ block p ^T

One kernel runs any list of products, so a new network compiles no code. A block of threads runs the whole list for one
tile. A column of a layer stores the sums before the activation; each product that reads the column applies the
activation to it. The columns lie in global memory, because they do not all fit in shared memory. A block's recent
writes are in the cache, and no other block accesses its tile.

Padding has weight 0 and changes no result. The encodings run in earlier launches. Sums and columns are float32. If
weights are float16 or bfloat16, the operands of products are rounded to this dtype for the tensor cores.
"""
# mypy: disable-error-code="arg-type, operator"

from __future__ import annotations

import functools
import itertools
import json
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
import warp as wp
from torch import Tensor

from voronerf.kernels._launch import array, filled, launch_tiles
from voronerf.kernels.frequency_encode import frequency_encode
from voronerf.kernels.hash_encode import hash_encode
from voronerf.kernels.render_loss import sigmoid, softplus
from voronerf.kernels.spherical_harmonics import spherical_harmonics
from voronerf.ops._core.compiler import constant_result
from voronerf.ops._core.custom_op import custom_op
from voronerf.ops._core.derivatives import register_derivatives
from voronerf.ops._core.encodings import ENCODINGS
from voronerf.ops._core.layers import ACTIVATIONS, DIRECTIONS, MLP, POSITIONS, Layer
from voronerf.ops.grouped_linear.activation import activate
from voronerf.ops.grouped_linear.reference import check_offsets
from voronerf.ops.network.reference import cells_of

ROWS, WIDTH, THREADS = 64, 16, 128
"""The numbers of rows per tile, features per column and threads per block. Wider columns would hold more padding,
since heads have 1 to 4 outputs. Each thread accumulates 4 x 2 elements of a matrix [ROWS, WIDTH], one column of a tile;
with fewer threads per block, registers spill (.ci/warp_check.py)."""
_LINEAR = {activation: MLP((Layer((POSITIONS,), 1, activation),), (0,)) for activation in ACTIVATIONS}
_TYPES = {torch.float32: wp.float32, torch.float16: wp.float16, torch.bfloat16: wp.bfloat16}


@wp.func
def _activate(x: wp.float32, kind: wp.int32) -> wp.float32:
    """Applies one of ``ACTIVATIONS``, by its number."""
    y = x
    if kind == 1:
        y = wp.where(x < 0.0, 0.0, x)  # NaN stays NaN
    elif kind == 2:
        y = softplus(x)
    elif kind == 3:
        y = sigmoid(x)
    elif kind == 4:
        y = wp.sin(x)
    return y


@wp.func
def _slope(x: wp.float32, kind: wp.int32) -> wp.float32:
    """Returns the derivative of an activation."""
    y = wp.float32(1.0)
    if kind == 1:
        y = wp.where(x <= 0.0, 0.0, 1.0)
    elif kind == 2:
        y = sigmoid(x)
    elif kind == 3:
        y = sigmoid(x) * (1.0 - sigmoid(x))
    elif kind == 4:
        y = wp.cos(x)
    return y


@wp.struct
class Products:
    """The products of a network: products ``first[o]`` to ``first[o + 1]`` are added to column o of the layers.

    Product p reads the column ``source[p]`` and applies ``activation[source[p]]`` to it.
    """

    first: wp.array(dtype=wp.int32)
    source: wp.array(dtype=wp.int32)
    activation: wp.array(dtype=wp.int32)


@functools.cache
def kernels(dtype: torch.dtype) -> tuple[Any, Any]:
    """Returns the forward and the backward kernel for a dtype of weights; each is compiled on first use."""
    scalar: Any = _TYPES[dtype]
    # MathDx multiplies 16-bit types on tensor cores. float32 products use plain Warp code, which compiles in one second
    # instead of twenty.
    options = {"enable_backward": False, "enable_mathdx_gemm": dtype != torch.float32}
    kernel = functools.partial(wp.kernel, module="unique", module_options=options)

    @kernel
    def forward(
        cells: wp.array(dtype=wp.int32),  # the cell of each tile, -1 for none
        blocks: wp.array2d(dtype=scalar),
        biases: wp.array(dtype=wp.float32),
        products: Products,
        columns: wp.array2d(dtype=wp.float32),
    ) -> None:
        """Evaluates all layers of one tile per block of threads, without a launch or a grid barrier per layer."""
        tile = wp.tid()
        cell = cells[tile]
        if cell < 0:
            return
        row = tile * ROWS
        outputs = products.first.shape[0] - 1
        inputs = products.activation.shape[0] - outputs
        for o in range(outputs):
            # Filling a shared tile synchronises the block, so that all threads see the earlier stores of all threads.
            total = wp.tile_zeros(shape=(ROWS, WIDTH), dtype=wp.float32, storage="shared")
            for p in range(products.first[o], products.first[o + 1]):
                source = products.source[p]
                sums = wp.tile_load(columns, shape=(ROWS, WIDTH), offset=(row, source * WIDTH))
                x = wp.tile_astype(wp.tile_map(_activate, sums, products.activation[source]), dtype=scalar)
                at = (cell * products.source.shape[0] + p) * WIDTH
                weight = wp.tile_load(blocks, shape=(WIDTH, WIDTH), offset=(at, 0), storage="shared")
                wp.tile_matmul(x, wp.tile_transpose(weight), total)
            bias = wp.tile_load(biases, shape=WIDTH, offset=(cell * outputs + o) * WIDTH)
            biased = total + wp.tile_broadcast(bias, shape=(ROWS, WIDTH))
            wp.tile_store(columns, biased, offset=(row, (inputs + o) * WIDTH))

    @kernel
    def backward(
        cells: wp.array(dtype=wp.int32),
        blocks: wp.array2d(dtype=scalar),
        products: Products,
        columns: wp.array2d(dtype=wp.float32),
        lowest: wp.int32,
        gradients: wp.array2d(dtype=wp.float32),
        of_blocks: wp.array2d(dtype=wp.float32),
        of_biases: wp.array(dtype=wp.float32),
    ) -> None:
        """Runs each product in reverse twice: for the gradient of its weights and for the gradient of its source.

        ``gradients`` holds the gradients of the sums; initially only the gradients of the outputs are set. A column's
        gradient is complete when the loop reaches it, since all products that read the column come later in the list.
        Columns below ``lowest`` need no gradient. The tiles of a cell add the gradients of its weights by atomics, so
        the order of this sum varies on a GPU.
        """
        tile = wp.tid()
        cell = cells[tile]
        if cell < 0:
            return
        row = tile * ROWS
        outputs = products.first.shape[0] - 1
        inputs = products.activation.shape[0] - outputs
        for reverse in range(outputs):
            o = outputs - 1 - reverse
            # Loading into a shared tile synchronises the block, so that values which other threads have just stored are
            # visible.
            arrived = wp.tile_load(gradients, shape=(ROWS, WIDTH), offset=(row, (inputs + o) * WIDTH), storage="shared")
            wp.tile_atomic_add(of_biases, wp.tile_sum(arrived, axis=0), offset=(cell * outputs + o) * WIDTH)
            g = wp.tile_astype(arrived, dtype=scalar)
            for p in range(products.first[o], products.first[o + 1]):
                source = products.source[p]
                at = (cell * products.source.shape[0] + p) * WIDTH
                sums = wp.tile_load(columns, shape=(ROWS, WIDTH), offset=(row, source * WIDTH))
                x = wp.tile_astype(wp.tile_map(_activate, sums, products.activation[source]), dtype=scalar)
                of_weight = wp.tile_zeros(shape=(WIDTH, WIDTH), dtype=wp.float32, storage="shared")
                wp.tile_matmul(wp.tile_transpose(g), x, of_weight)
                wp.tile_atomic_add(of_blocks, of_weight, offset=(at, 0))
                if source >= lowest:
                    weight = wp.tile_load(blocks, shape=(WIDTH, WIDTH), offset=(at, 0), storage="shared")
                    of_x = wp.tile_zeros(shape=(ROWS, WIDTH), dtype=wp.float32, storage="shared")
                    wp.tile_matmul(g, weight, of_x)
                    slope = wp.tile_map(_slope, sums, products.activation[source])
                    before = wp.tile_load(gradients, shape=(ROWS, WIDTH), offset=(row, source * WIDTH))
                    wp.tile_store(gradients, before + of_x * slope, offset=(row, source * WIDTH))

    return forward, backward


class _Tiles(NamedTuple):
    """The arguments of the kernels.

    Attributes:
        x: the encoded inputs of the samples in padded columns, float32 [t * ROWS, inputs * WIDTH].
        blocks: the weight blocks of each cell, [k, products, WIDTH, WIDTH].
        biases: the biases of each cell for the columns of the layers, float32 [k, columns, WIDTH].
        cells: the cell of each tile, int32 [t]; -1 for none.
        plan: the products and the output columns, as JSON; the result of `_plan`.
    """

    x: Tensor
    blocks: Tensor
    biases: Tensor
    cells: Tensor
    plan: str

    def results(self: _Tiles) -> Tensor:
        """Returns memory for the sums of the output columns, [t * ROWS, outputs * WIDTH]."""
        return self.x.new_empty(self.x.shape[0], len(json.loads(self.plan)[-1]) * WIDTH)

    def columns(self) -> Tensor:
        """Computes all columns [t * ROWS, c * WIDTH]."""
        x, blocks, biases, cells, plan = self
        products = _products(plan, x.device)
        columns = x.new_zeros(x.shape[0], products.activation.shape[0] * WIDTH)
        columns[:, : x.shape[1]] = x
        inputs = [array(cells, x), array(blocks.view(-1, WIDTH), x), array(biases.view(-1), x), products]
        launch_tiles(kernels(blocks.dtype)[0], len(cells), THREADS, [*inputs, array(columns, x)], x)
        return columns


class _TilesGradient(NamedTuple):
    gradient: Tensor
    x: Tensor
    blocks: Tensor
    biases: Tensor
    cells: Tensor
    plan: str
    wanted: Sequence[bool]

    def results(self: _TilesGradient) -> list[Tensor]:
        """Returns memory for the gradients of x, blocks and biases."""
        return [self.x.new_zeros(part.shape) for part in self[1:4]]


@custom_op("grouped_mlp_warp", _Tiles.results)
def _run(tiles: _Tiles, out: Tensor) -> None:
    columns = tiles.columns()
    torch.cat([columns[:, o * WIDTH : (o + 1) * WIDTH] for o in json.loads(tiles.plan)[-1]], dim=1, out=out)


@custom_op("grouped_mlp_warp_backward", _TilesGradient.results)
def _run_backward(arriving: _TilesGradient, results: list[Tensor]) -> None:
    """Computes the gradients. Columns are recomputed, so only the inputs are saved for the backward pass."""
    (gradient, x, blocks, _, cells, plan, wanted), (of_x, of_blocks, of_biases) = arriving, results
    products, columns = _products(plan, x.device), _Tiles(*arriving[1:6]).columns()
    gradients = torch.zeros_like(columns)
    for o, part in zip(json.loads(plan)[-1], gradient.split(WIDTH, dim=1)):
        gradients[:, o * WIDTH : (o + 1) * WIDTH] += part
    lowest = 0 if wanted[0] else x.shape[1] // WIDTH
    inputs = [array(cells, x), array(blocks.view(-1, WIDTH), x), products, array(columns, x), lowest]
    inputs += [array(gradients, x), array(of_blocks.view(-1, WIDTH), x), array(of_biases.view(-1), x)]
    launch_tiles(kernels(blocks.dtype)[1], len(cells), THREADS, inputs, x)
    of_x.copy_(gradients[:, : x.shape[1]])


def _formula(x: Tensor, blocks: Tensor, biases: Tensor, cells: Tensor, plan: str) -> Tensor:
    """Computes the output columns in plain PyTorch, for second derivatives."""
    first, source, activation, outputs = json.loads(plan)
    columns = list(x.view(len(cells), ROWS, -1).split(WIDTH, dim=2))
    has_cell, cell = (cells >= 0)[:, None, None], cells.clamp(min=0)
    for o, (begin, end) in enumerate(itertools.pairwise(first)):
        total = biases[:, o].index_select(0, cell)[:, None]
        for p in range(begin, end):
            read = activate(ACTIVATIONS[activation[source[p]]], columns[source[p]])
            total = total + read.to(blocks.dtype).to(x.dtype) @ blocks[:, p].index_select(0, cell).to(x.dtype).mT
        columns.append(total * has_cell)
    return torch.cat([columns[o] for o in outputs], dim=2).view(x.shape[0], -1)


register_derivatives(_run, _run_backward, _formula, places=(0, 1, 2), width=5, count=1)


@constant_result  # torch.compile would trace a cached function
def _plan(text: str, widths: tuple[int, ...]) -> str:
    return _plan_once(text, widths)


@functools.lru_cache(maxsize=256)
def _plan_once(text: str, widths: tuple[int, ...]) -> str:
    """Returns the lists of `Products` and the output columns, as JSON.

    Args:
        text: a layer table (``MLP.text``).
        widths: the widths of the encoded positions, the directions (0 if no layer reads them) and the layers.
    """
    layers, first, source, activation = MLP.parse(text), [0], list[int](), list[int]()
    columns: dict[int | str, range] = {}
    for name, width in zip((POSITIONS, DIRECTIONS, *range(len(layers.layers))), widths):
        columns[name] = range(len(activation), len(activation) - (-width // WIDTH))
        layer = layers.layers[name] if isinstance(name, int) else None
        for _ in columns[name]:
            activation.append(ACTIVATIONS.index(layer.activation) if layer else 0)
            if layer:
                source += [column for other in layer.inputs for column in columns[other]]
                first.append(len(source))
    return json.dumps([first, source, activation, [column for output in layers.outputs for column in columns[output]]])


@functools.lru_cache(maxsize=256)
def _products(plan: str, device: torch.device) -> Any:
    first, source, activation, _ = (torch.tensor(part, dtype=torch.int32, device=device) for part in json.loads(plan))
    return filled(Products(), first=first, source=source, activation=activation)


def layers_of_cells(
    inputs: Sequence[Tensor],
    offsets: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    layers: MLP,
    ray_index: Tensor | None,
    features: Tensor | None,
    dtype: torch.dtype,
) -> Tensor:
    """Returns the outputs of a layer table on rows sorted by cell, float32 [n, layers.out_features].

    Args:
        inputs: positions [n, p]; then, if a layer reads directions, directions [n, q], or [r, q] with ``ray_index``.
        offsets: the first row of each cell, then the end of the last cell, int32 [k + 1].
        weights: the weights of each layer, [k, o, i].
        biases: the bias of each layer, [k, o] or None.
        layers: the layer table; its widths match the weights.
        ray_index: the row of the directions for each sample, int32 [n]; None if directions have a row per sample.
        features: the entries of the hash grid, [e, f], or [k, e, f] for a grid per cell; None without a hash encoding.
        dtype: the dtype to which operands of products are rounded.
    """
    positions, cell = inputs[0], cells_of(offsets, inputs[0])
    of_positions, of_directions = _encodings(layers.text)
    if features is not None and layers.grid is not None:
        where = hash_encode(positions, features, layers.grid, cell if features.dim() == 3 else None)
    else:
        where = _encoded(positions, of_positions)
    encoded = {POSITIONS: where, DIRECTIONS: positions[:, :0]}
    if len(inputs) > 1:
        directions = _encoded(inputs[1], of_directions)
        encoded[DIRECTIONS] = directions if ray_index is None else directions.index_select(0, ray_index)
    widths = {name: len(range(part.shape[1])) for name, part in (*encoded.items(), *enumerate(weights))}  # no symbols
    tiles, place, inside = _tiles(offsets, cell)
    x = torch.cat([_padded(part.to(dtype).float()) for part in encoded.values()], dim=1)
    x = x.new_zeros(len(tiles) * ROWS, x.shape[1]).index_copy(0, place, x)
    blocks, rows = [], []
    for layer, weight, bias in zip(layers.layers, weights, biases):
        blocks.append(_blocks(weight.to(dtype), [widths[name] for name in layer.inputs]))
        bias = weight.new_zeros(weight.shape[:2]) if bias is None else bias
        rows.append(_padded(bias.to(dtype).float()).unflatten(1, (-1, WIDTH)))
    plan = _plan(layers.text, tuple(widths.values()))
    sums = _run(x, torch.cat(blocks, dim=1), torch.cat(rows, dim=1), tiles, plan).index_select(0, place)
    results = []
    for output in layers.outputs:
        results.append(activate(layers.layers[output].activation, sums[:, : widths[output]]))
        sums = sums[:, widths[output] + -widths[output] % WIDTH :]
    return torch.where(inside[:, None], torch.cat(results, dim=1), 0)


def grouped_linear(
    x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None = None, activation: str = "none"
) -> Tensor:
    """Returns the outputs of a network of one layer per cell; see ``voronerf.ops.grouped_linear``."""
    kind, dtype = x.device.type, x.dtype
    if torch.is_autocast_enabled(kind) and dtype != torch.float64:
        dtype = torch.get_autocast_dtype(kind)
    if kind == "cpu" and not torch.compiler.is_compiling():
        check_offsets("grouped_linear", offsets, x.shape[0])
    with torch.autocast(kind, enabled=False):
        return layers_of_cells([x], offsets, [weight], [bias], _LINEAR[activation], None, None, dtype).to(dtype)


def _tiles(offsets: Tensor, cell: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns each tile's cell, int32 [t], each sample's row in the tiles, [n], and whether the sample has a cell, [n].

    The number of tiles t is an upper bound from n and k, so that the host reads no offsets. The last tile has no cell
    and takes samples without a cell.
    """
    (n,), k = cell.shape, offsets.shape[0] - 1
    tiles = (offsets.diff() + (ROWS - 1)) // ROWS
    ends = tiles.cumsum(0)
    count = min(n, n // ROWS + k) + 1
    of_tiles = torch.searchsorted(ends, torch.arange(count, device=ends.device), right=True)
    row = torch.arange(n, device=ends.device)
    inside = (row >= offsets[0]) & (row < offsets[-1])
    place = row - offsets.index_select(0, cell) + ROWS * (ends - tiles).index_select(0, cell)
    return torch.where(of_tiles < k, of_tiles, -1).int(), torch.where(inside, place, count * ROWS - 1), inside


def _blocks(weight: Tensor, widths: Sequence[int]) -> Tensor:
    """Returns the blocks [k, products, WIDTH, WIDTH] of a weight matrix [k, o, i].

    ``widths`` are the widths of the inputs that are concatenated to the i features.
    """
    wide = torch.cat([_padded(part) for part in weight.split(widths, dim=2)], dim=2)
    high = _padded(wide.mT).mT.unflatten(2, (-1, WIDTH)).unflatten(1, (-1, WIDTH))
    return high.transpose(2, 3).flatten(1, 2)


def _padded(x: Tensor) -> Tensor:
    return F.pad(x, (0, -x.shape[-1] % WIDTH))


@constant_result
def _encodings(text: str) -> tuple[tuple[str, int] | None, ...]:
    """Returns a layer table's encodings of positions and directions, as names and sizes."""
    return tuple(MLP.parse(text).encoding(source) for source in (POSITIONS, DIRECTIONS))


_ENCODINGS: dict[str, Callable[[Tensor, int], Tensor]] = {
    "frequency": lambda x, octaves: frequency_encode(x, octaves, True),
    "spherical": spherical_harmonics,
}
"""The encodings that have a Warp kernel, by name."""


def _encoded(x: Tensor, encoding: tuple[str, int] | None) -> Tensor:
    """Encodes raw features in float32; without an encoding returns x unchanged."""
    if encoding is None:
        return x
    name, size = encoding
    return _ENCODINGS.get(name, ENCODINGS[name].formula)(x.float(), size)
