"""The hash encoding of Instant NGP. n points, k tables, e entries of all levels, f features of a level."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import EVERYWHERE, FLOATS, Implementation
from voronerf.ops._core.checks import FLOATING, INDEX, TensorRule, check_rules
from voronerf.ops._core.grids import HashGrid

_OP = backends.declare(
    "hash_encode", native=Implementation(EVERYWHERE, FLOATS), warp=Implementation(EVERYWHERE, FLOATS)
)


def hash_encode(
    positions: Tensor, table: Tensor, grid: HashGrid, *, cells: Tensor | None = None, backend: str = "auto"
) -> Tensor:
    """Returns the features of points, interpolated on every level of a hash grid.

    Müller et al. 2022, section 3: on each level, the eight corners of the point's voxel select eight entries of the
    table, by their row-major index or by a hash, and the features are interpolated linearly. Positions and table have
    gradients of every order. The gradient of the positions is discontinuous at voxel faces. Sums have at least float32
    precision. Results do not depend on the number of threads; on CUDA the gradient of the table is summed in no fixed
    order.

    Args:
        positions: [n, 3] floating point, n < 2**31, in the units of ``grid.box``. A coordinate outside of the box is
            clamped to it and has no gradient. NaN gives NaN.
        table: [e, f], ``grid.table_shape``, floating point, level after level; or [k, e, f] with ``cells``.
        grid: the levels of the grid.
        cells: int32 [n], the table of each point, 0 to k - 1. The CPU refuses values out of range.
        backend: "auto", "reference", "native" or "warp".

    Returns:
        [n, grid.out_features], coarsest level first, in float32, or float64 if positions or table are float64.

    Raises:
        ValueError: a table whose size differs from the grid's; ``cells`` with a table [e, f].

    Examples:
        >>> import torch
        >>> from voronerf import HashGrid, hash_encode
        >>> grid = HashGrid(levels=2, features=1, log2_entries=10, base=2, finest=4)
        >>> table = torch.ones(grid.table_shape)
        >>> table[: grid.rows[1].offset] = 0.5  # the coarse level
        >>> hash_encode(torch.rand(3, 3), table, grid)
        tensor([[0.5000, 1.0000],
                [0.5000, 1.0000],
                [0.5000, 1.0000]])
    """
    if not isinstance(grid, HashGrid):
        raise TypeError(f"{_OP}: grid must be a HashGrid, got {type(grid).__name__}")
    check_rules(_OP, _rows, [positions, table] if cells is None else [positions, table, cells], grid, cells is not None)
    dtype = torch.promote_types(positions.dtype, table.dtype)
    run = backends.resolve(_OP, backend=backend, device=positions.device, dtype=dtype)
    encoded: Tensor = run(positions, table, grid, cells)
    return encoded


def _rows(grid: HashGrid, several: bool) -> list[TensorRule]:
    shape: tuple[int | str, ...] = ("k", *grid.table_shape) if several else grid.table_shape
    rows = [TensorRule("positions", FLOATING, ("n", 3)), TensorRule("table", FLOATING, shape)]
    return [*rows, TensorRule("cells", INDEX, ("n",))] if several else rows
