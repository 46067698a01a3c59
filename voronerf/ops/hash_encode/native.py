"""``hash_encode`` of the compiled module, and its gradients. n points, k tables, e entries, f features of a level.

Sums are float32, and so is the table's gradient until the end. Second derivatives come from the same kernels, further
ones from the reference formula.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator

from torch import Tensor

from voronerf import native
from voronerf.grids import HashGrid
from voronerf.native.custom_op import custom_op, on_huge_pages
from voronerf.ops.hash_encode.autograd import HashDerivatives


def hash_encode(positions: Tensor, table: Tensor, grid: HashGrid, *, cells: Tensor | None = None) -> Tensor:
    """Features of points [n, levels * f] from a table [e, f] or [k, e, f]; see ``voronerf.ops.hash_encode``."""
    encoded: Tensor = _encode(positions.float(), table, None, cells, grid.text)
    return encoded


@custom_op("hash_encode_native")
def _encode(
    positions: Tensor, table: Tensor, direction: Tensor | None, cells: Tensor | None, grid: str
) -> Iterator[Tensor]:
    """The features or, with directions [n, 3], their derivatives along them."""
    out = positions.new_empty(positions.shape[0], HashGrid.parse(grid).out_features)
    yield out
    on_huge_pages(out)
    given = _inputs(positions, table, direction, cells)
    native.compiled.hash_encode(given, compiled_grid(grid), out, native.machine(positions))


@custom_op("hash_encode_native_backward")
def _backward(
    gradient: Tensor,
    positions: Tensor,
    table: Tensor,
    direction: Tensor | None,
    cells: Tensor | None,
    grid: str,
    to_positions: bool,
    to_table: bool,
) -> Iterator[list[Tensor]]:
    """Gradients to positions and table, in float32, empty where not wanted."""
    of_positions = positions.new_empty(positions.shape if to_positions else 0)
    of_table = positions.new_empty(table.shape if to_table else 0)
    yield [of_positions, of_table]
    on_huge_pages(of_table)
    if to_table:
        native.refuse_where_deterministic("hash_encode", positions)
    native.compiled.hash_encode_backward(
        _inputs(positions, table, direction, cells),
        compiled_grid(grid),
        gradient,
        of_table if to_table else None,
        of_positions if to_positions else None,
        native.machine(positions),
    )


def _inputs(
    positions: Tensor, table: Tensor, direction: Tensor | None, cells: Tensor | None
) -> native.compiled.HashInputs:
    return native.compiled.HashInputs(
        positions=positions,
        direction=direction,
        table=table,
        type=str(table.dtype).removeprefix("torch."),
        cells=cells,
        n=positions.shape[0],
        tables=1 if cells is None else table.shape[0],
        entries=table.shape[-2],
    )


@functools.lru_cache(maxsize=256)
def compiled_grid(text: str) -> native.compiled.HashGrid:
    """A grid, as its text, as compiled functions take it."""
    grid = HashGrid.parse(text)
    return native.compiled.HashGrid(
        levels=[native.compiled.GridLevel(*level) for level in grid.rows],
        low=grid.box[0],
        high=grid.box[1],
        features=grid.features,
        smooth=grid.interpolation == "smoothstep",
    )


_derivatives = HashDerivatives(_encode, _backward)
_encode.register_autograd(_derivatives.encode, setup_context=_derivatives.encode_setup)
_backward.register_autograd(_derivatives.backward, setup_context=_derivatives.backward_setup)
