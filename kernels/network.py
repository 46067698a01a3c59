"""Programs whose layers run in Warp kernels; all other steps run in plain PyTorch.

n samples, k cells, t tiles of rows, c columns.

`lower` splits a program into three parts: the steps before the layers, such as encodings; the layers; all other steps.
A layer is a sum of biases and products; a product reads a value of the first part, or another layer through an
activation. If the third part still has layers, which read another step, it is split in turn.

Samples are sorted by cell, and the rows of each cell are padded to tiles of ``ROWS`` rows, so that a tile belongs to
one cell. Features are split into groups of ``WIDTH``, called columns here: each value that products read and each layer
is padded to whole columns. A matrix consists of blocks [WIDTH, WIDTH], each of which maps one column to another. Layers
of any widths that read any features are therefore a list of products of blocks::

    column o of the layers = bias o + sum over the products p of o: activation[p](column source[p]) @ block p ^T

One kernel runs any list of products, so a new program compiles no code. A block of threads runs the whole list for one
tile. A column of a layer stores the sums before the activation; each product that reads the column applies an
activation to it. The columns lie in global memory, because they do not all fit in shared memory. A block's recent
writes are in the cache, and no other block accesses its tile.

Padding has weight 0 and changes no finite result. Sums and columns are float32. If weights are float16 or bfloat16, the
operands of products are rounded to this dtype for the tensor cores.
"""
# mypy: disable-error-code="arg-type, operator"

from __future__ import annotations

import functools
import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
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
from voronerf.ops._core.checks import dtype_under_autocast
from voronerf.ops._core.compiler import constant_result
from voronerf.ops._core.custom_op import custom_op
from voronerf.ops._core.derivatives import register_derivatives
from voronerf.ops._core.encodings import ENCODINGS
from voronerf.ops._core.program import FUNCTIONS, HASH, PARAMETER, VALUE, Columns, Names, Program, Step, pruned
from voronerf.ops.grouped_linear.activation import one_layer
from voronerf.ops.network.cells import Sorted
from voronerf.ops.network.reference import Run, cells_of
from voronerf.ops.network.reference import network as in_torch

ROWS, WIDTH, THREADS = 64, 16, 128
"""The numbers of rows per tile, features per column and threads per block. Wider columns would hold more padding,
since heads have 1 to 4 outputs. Each thread accumulates 4 x 2 elements of a matrix [ROWS, WIDTH], one column of a tile;
with fewer threads per block, registers spill (.ci/warp_check.py)."""
_TYPES = {torch.float32: wp.float32, torch.float16: wp.float16, torch.bfloat16: wp.bfloat16}
_ACTIVATIONS = ("copy", 0, 0, 0), ("relu", 0, 0, 0), ("softplus", 0, 1, 20), ("sigmoid", 0, 0, 0), ("sine", 0, 1, 0)
"""The functions that products apply to columns, in the order of their numbers: `Step.name` and `Step.numbers`."""


@wp.func
def _activate(x: wp.float32, kind: wp.int32) -> wp.float32:
    """Applies one of ``_ACTIVATIONS``, by its number; softplus has no threshold."""
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
    """The products of all layers: products ``first[o]`` to ``first[o + 1]`` are added to column o of the layers.

    Product p reads the column ``source[p]`` and applies ``activation[p]`` to it.
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
        inputs = columns.shape[1] // WIDTH - outputs
        for o in range(outputs):
            # Filling a shared tile synchronises the block, so that all threads see the earlier stores of all threads.
            total = wp.tile_zeros(shape=(ROWS, WIDTH), dtype=wp.float32, storage="shared")
            for p in range(products.first[o], products.first[o + 1]):
                source = products.source[p]
                sums = wp.tile_load(columns, shape=(ROWS, WIDTH), offset=(row, source * WIDTH))
                x = wp.tile_astype(wp.tile_map(_activate, sums, products.activation[p]), dtype=scalar)
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
        inputs = columns.shape[1] // WIDTH - outputs
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
                x = wp.tile_astype(wp.tile_map(_activate, sums, products.activation[p]), dtype=scalar)
                of_weight = wp.tile_zeros(shape=(WIDTH, WIDTH), dtype=wp.float32, storage="shared")
                wp.tile_matmul(wp.tile_transpose(g), x, of_weight)
                wp.tile_atomic_add(of_blocks, of_weight, offset=(at, 0))
                if source >= lowest:
                    weight = wp.tile_load(blocks, shape=(WIDTH, WIDTH), offset=(at, 0), storage="shared")
                    of_x = wp.tile_zeros(shape=(ROWS, WIDTH), dtype=wp.float32, storage="shared")
                    wp.tile_matmul(g, weight, of_x)
                    slope = wp.tile_map(_slope, sums, products.activation[p])
                    before = wp.tile_load(gradients, shape=(ROWS, WIDTH), offset=(row, source * WIDTH))
                    wp.tile_store(gradients, before + of_x * slope, offset=(row, source * WIDTH))

    return forward, backward


class _Tiles(NamedTuple):
    """The arguments of the kernels.

    Attributes:
        x: the values before the layers in padded columns, float32 [t * ROWS, inputs * WIDTH].
        blocks: the weight blocks of each cell, [k, products, WIDTH, WIDTH].
        biases: the biases of each cell for the columns of the layers, float32 [k, columns, WIDTH].
        cells: the cell of each tile, int32 [t]; -1 for none.
        plan: `Lowered.plan`.
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
        columns = F.pad(x, (0, (len(products.first) - 1) * WIDTH))
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


@custom_op("network_warp", _Tiles.results)
def _layers(tiles: _Tiles, out: Tensor) -> None:
    columns = tiles.columns()
    torch.cat([columns[:, o * WIDTH : (o + 1) * WIDTH] for o in json.loads(tiles.plan)[-1]], dim=1, out=out)


@custom_op("network_warp_backward", _TilesGradient.results)
def _layers_backward(arriving: _TilesGradient, results: list[Tensor]) -> None:
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
            name, _, *numbers = _ACTIVATIONS[activation[p]]
            read = FUNCTIONS[name].formula(columns[source[p]], *numbers)
            total = total + read.to(blocks.dtype).to(x.dtype) @ blocks[:, p].index_select(0, cell).to(x.dtype).mT
        columns.append(total * has_cell)
    return torch.cat([columns[o] for o in outputs], dim=2).view(x.shape[0], -1)


register_derivatives(_layers, _layers_backward, _formula, places=(0, 1, 2), width=5, count=1)


@functools.lru_cache(maxsize=256)
def _products(plan: str, device: torch.device) -> Any:
    first, source, activation, _ = (torch.tensor(part, dtype=torch.int32, device=device) for part in json.loads(plan))
    return filled(Products(), first=first, source=source, activation=activation)


class Product(NamedTuple):
    """The product of a linear step.

    Attributes:
        step: the step.
        source: the columns that the product reads, before their activation.
        activation: the number of their activation.
    """

    step: Step
    source: Columns
    activation: int


Terms = tuple[Product | Columns, ...]
"""The terms of a sum: products and biases, which are columns of parameters; () for a value that is no such sum."""


class Layer(NamedTuple):
    """A layer: the sum of products and biases, [n, width]."""

    width: int
    products: tuple[Product, ...]
    biases: tuple[Columns, ...]


class Lowered(NamedTuple):
    """A program in three parts.

    Attributes:
        before: the program of the steps before the layers; its outputs are the values that layers read.
        layers: the layers, in order.
        plan: the lists of `Products` and the columns of the layers that ``after`` reads, as JSON.
        widths: the widths of the layers that ``after`` reads.
        after: the program of all other steps; its inputs are the inputs of the whole program, then these layers.
    """

    before: Program
    layers: tuple[Layer, ...]
    plan: str
    widths: tuple[int, ...]
    after: Program


@constant_result  # not on the cached function, which torch.compile would trace
def lower(text: str) -> Lowered | None:
    """Returns the parts of a program; None if it has no layer that the kernels can run, or sums over rows."""
    return _lower(text)


@functools.lru_cache(maxsize=256)
def _lower(text: str) -> Lowered | None:
    program = Program.parse(text)
    if program.sums:
        return None
    whole = {step.out: Columns(VALUE, step.out, 0, step.width) for step in program.steps}
    before, layers = _terms(program, whole)

    def after(outputs: Sequence[int]) -> Program:
        """Returns the program that takes some layers as additional inputs."""
        place = {out: i for i, out in enumerate(outputs, len(program.inputs))}
        steps = [Step("input", s.out, s.width, (), (place[s.out],)) if s.out in place else s for s in program.steps]
        inputs = (*program.inputs, *(whole[out].width for out in outputs))
        return pruned(replace(program, inputs=inputs, steps=tuple(steps)))

    outputs = [step.out for step in after([*layers]).steps if step.out in layers]
    if not outputs:
        return None
    needed = set(outputs)
    for out in reversed(layers):
        if out in needed:
            needed.update(term.source.index for term in layers[out] if isinstance(term, Product))
    read, kept = ([out for out in values if out in needed] for values in (before, layers))
    columns, count = dict[int, int](), 0  # value -> its first column
    for out in (*read, *kept):
        columns[out], count = count, _span(whole[out], count).stop
    table, first, source, activation = list[Layer](), [0], list[int](), list[int]()
    for out in kept:
        products = tuple(term for term in layers[out] if isinstance(term, Product))
        biases = tuple(term for term in layers[out] if isinstance(term, Columns))
        table.append(Layer(whole[out].width, products, biases))
        for _ in _span(whole[out]):
            for product in products:
                sources = _span(product.source, columns[product.source.index])
                source += sources
                activation += [product.activation] * len(sources)
            first.append(len(source))
    written = [column for out in outputs for column in _span(whole[out], columns[out])]
    steps = tuple(step for step in program.steps if step.out in before)
    return Lowered(
        pruned(replace(program, steps=steps, outputs=tuple(whole[out] for out in read), by_ray=())),
        tuple(table),
        json.dumps([first, source, activation, written]),
        tuple(whole[out].width for out in outputs),
        after(outputs),
    )


def _terms(program: Program, whole: dict[int, Columns]) -> tuple[dict[int, Columns], dict[int, Terms]]:
    """Returns the values that depend on no layer, and the terms of each layer."""
    before, layers = dict[int, Columns](), dict[int, Terms]()
    readable = dict[int, tuple[Columns, int]]()  # value -> its columns before the activation, and the activation

    def terms(addend: Columns) -> Terms:
        if addend.of == PARAMETER and not addend.spread:
            return (addend,)
        return layers.get(addend.index, ()) if addend == whole.get(addend.index) else ()

    for step in program.steps:
        op, out, _, operands, numbers, name = step
        parts = list[Terms]()
        if op == "linear" and not name and operands[0].index in readable:
            columns, activation = readable[operands[0].index]
            product = Product(step, columns.part(operands[0].start, operands[0].width), activation)
            parts = [(product,), *map(terms, operands[1:])]
        elif name == "add":
            parts = [*map(terms, operands)]
        if op != "linear" and all(c.of == PARAMETER or c.index in before for c in operands):
            before[out], readable[out] = whole[out], (whole[out], 0)
        elif parts and all(parts):
            layers[out], readable[out] = tuple(itertools.chain(*parts)), (whole[out], 0)
        elif op == "function" and (name, *numbers) in _ACTIVATIONS and len(operands) == 1:
            (x,) = operands
            if x.index in layers and not x.spread:
                readable[out] = x, _ACTIVATIONS.index((name, *numbers))
    return before, layers


def _span(columns: Columns, first: int = 0) -> range:
    """Returns the columns [ROWS, WIDTH] that hold features of a value, whose first column is ``first``."""
    return range(first + columns.start // WIDTH, first - (-(columns.start + columns.width) // WIDTH))


class _Before(Run):
    """A :class:`Run` of the steps before the layers, with Warp kernels for encodings."""

    def encoded(self, step: Step, operands: Sequence[Tensor]) -> Tensor:
        """Returns an encoding or one of its derivatives, [n, w]."""
        (x, *others), (size, parameter, *_) = operands, map(int, step.numbers)
        if others:  # a derivative
            return super().encoded(step, operands)
        if step.name == HASH:
            table, is_shared = self.tables[parameter], len(self.tables[parameter]) == 1
            return hash_encode(x, table[0] if is_shared else table, self.grids[size], None if is_shared else self.cells)
        return _ENCODINGS.get(step.name, ENCODINGS[step.name].formula)(x, size)


_ENCODINGS: dict[str, Callable[[Tensor, int], Tensor]] = {
    "frequency": lambda x, octaves: frequency_encode(x, octaves, True),
    "spherical": spherical_harmonics,
}
"""The encodings that have a Warp kernel, by name."""


def _run(
    program: Program,
    rows: Sequence[Tensor],
    parameters: Sequence[Tensor],
    offsets: Tensor,
    inside: Tensor,
    dtype: torch.dtype,
) -> Run:
    """Runs a program, as `Run` does, with its layers in the kernels."""
    lowered = lower(program.text)
    if lowered is None:
        return Run(program, rows, parameters, offsets, inside, dtype)
    run = _Before(lowered.before, rows, parameters, offsets, inside, dtype)
    tiles, place = _tiles(offsets, inside)
    x = torch.cat([_padded(run.columns(c).to(dtype).float()) for c in lowered.before.outputs], dim=1)
    x = x.new_zeros(len(tiles) * ROWS, x.shape[1]).index_copy(0, place, x)
    blocks, biases = [], []
    for layer in lowered.layers:
        wide = torch.cat([_padded(run.matrix(p.step).to(dtype), p.source.start) for p in layer.products], dim=2)
        high = _padded(wide.mT).mT.unflatten(2, (-1, WIDTH)).unflatten(1, (-1, WIDTH))
        blocks.append(high.transpose(2, 3).flatten(1, 2))
        bias = x.new_zeros(run.k, layer.width)
        for columns in layer.biases:
            bias = bias + run.vectors(columns, columns.width)
        biases.append(_padded(bias).unflatten(1, (-1, WIDTH)))
    sums = _layers(x, torch.cat(blocks, dim=1), torch.cat(biases, dim=1), tiles, lowered.plan).index_select(0, place)
    parts = sums.split([width + -width % WIDTH for width in lowered.widths], dim=1)
    values = [part[:, :width] for part, width in zip(parts, lowered.widths)]
    return _run(lowered.after, [*rows, *values], parameters, offsets, inside, dtype)


def _tiles(offsets: Tensor, inside: Tensor) -> tuple[Tensor, Tensor]:
    """Returns each tile's cell, int32 [t], and each sample's row in the tiles, [n].

    The number of tiles t is an upper bound from n and k, so that the host reads no offsets. The last tile has no cell
    and takes samples without a cell.
    """
    n, k = len(inside), offsets.shape[0] - 1
    tiles = (offsets.diff() + (ROWS - 1)) // ROWS
    ends = tiles.cumsum(0)
    count = min(n, n // ROWS + k) + 1
    of_tiles = torch.searchsorted(ends, torch.arange(count, device=ends.device), right=True)
    cell, row = cells_of(offsets, inside), torch.arange(n, device=ends.device)
    place = row - offsets.index_select(0, cell) + ROWS * (ends - tiles).index_select(0, cell)
    return torch.where(of_tiles < k, of_tiles, -1).int(), torch.where(inside[:, 0], place, count * ROWS - 1)


def _padded(x: Tensor, start: int = 0) -> Tensor:
    """Pads the last dimension to whole columns, before which ``start`` features of the first column lie."""
    return F.pad(x, (start % WIDTH, -(start + x.shape[-1]) % WIDTH))


def network(*arguments: Any) -> list[Tensor]:
    """Runs a program on the rows of each cell; see ``voronerf.ops.network.Network``."""
    return in_torch(*arguments, run=_run)


def grouped_linear(
    x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None = None, activation: str = "none"
) -> Tensor:
    """Runs a program of one layer; see ``voronerf.ops.grouped_linear``."""
    dtype = dtype_under_autocast(x.dtype, x)
    parameters, program = [weight] if bias is None else [weight, bias], one_layer(weight, bias, activation)
    rows = Sorted(None, None, offsets)
    return network(program, parameters, Names("grouped_linear"), [x], None, rows, dtype)[0]
