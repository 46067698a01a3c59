"""``hash_encode`` of the compiled module, and its gradients. n points, k tables, e entries, f features of a level.

Sums are float32; the table's gradient is cast to the table's dtype at the end. Second derivatives use the same kernels,
higher derivatives the reference formula.
"""

from __future__ import annotations

import functools

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import custom_op
from voronerf.ops._core.grids import HashGrid
from voronerf.ops._core.memory import on_huge_pages
from voronerf.ops.hash_encode.autograd import HashDerivatives, Hashed, HashedGradient


def hash_encode(positions: Tensor, table: Tensor, grid: HashGrid, cells: Tensor | None = None) -> Tensor:
    """Returns the features [n, levels * f] of points; see ``voronerf.ops.hash_encode``."""
    encoded: Tensor = _encode(positions.float(), table, None, cells, grid.text)
    return encoded


@custom_op("hash_encode_native", Hashed.result)
def _encode(arguments: Hashed, out: Tensor) -> None:
    on_huge_pages(out)
    native.compiled.hash_encode(_inputs(arguments), compiled_grid(arguments.grid), out, native.machine(out))


@custom_op("hash_encode_native_backward", HashedGradient.results)
def _backward(arriving: HashedGradient, gradients: list[Tensor]) -> None:
    (gradient, arguments, to_positions, to_table), (of_positions, of_table) = arriving, gradients
    on_huge_pages(of_table)
    if to_table:
        native.refuse_where_deterministic("hash_encode", arguments.positions)
    native.compiled.hash_encode_backward(
        _inputs(arguments),
        compiled_grid(arguments.grid),
        native.aligned(gradient),
        of_table if to_table else None,
        of_positions if to_positions else None,
        native.machine(arguments.positions),
    )


def _inputs(arguments: Hashed) -> native.compiled.HashInputs:
    table, cells = arguments.table, arguments.cells
    return native.compiled.HashInputs(
        positions=arguments.positions,
        direction=arguments.direction,
        table=native.aligned(table),
        type=str(table.dtype).removeprefix("torch."),
        cells=cells,
        n=arguments.positions.shape[0],
        tables=1 if cells is None else table.shape[0],
        entries=table.shape[-2],
    )


@functools.lru_cache(maxsize=256)
def compiled_grid(text: str) -> native.compiled.HashGrid:
    """Returns the compiled module's struct of a grid, from the text of the grid."""
    grid = HashGrid.parse(text)
    return native.compiled.HashGrid(
        levels=[native.compiled.GridLevel(*level) for level in grid.rows],
        low=grid.box[0],
        high=grid.box[1],
        features=grid.features,
    )


HashDerivatives(_encode, _backward)
