"""Sorting samples by cell. n samples, k cells."""

from __future__ import annotations

from typing import Annotated

from torch import Tensor

from voronerf.ops._core.backends import EVERYWHERE, Implementation
from voronerf.ops._core.checks import INDEX
from voronerf.ops._core.declare import declare


@declare(native=Implementation(EVERYWHERE, INDEX), warp=Implementation(EVERYWHERE, INDEX))
def cell_sort(
    cells: Annotated[Tensor, "int32 [n]"], k: Annotated[int, "1..134217728"], *, backend: str = "auto"
) -> tuple[Annotated[Tensor, "int32 [n]"], Annotated[Tensor, "int32 [k + 1]"]]:
    """Returns the stable order of samples by cell, and the offset of each cell.

    ``x[order]`` is sorted by cell, and the samples of a cell keep their order. ``y[order] = y_sorted`` undoes the
    sorting. The result is bitwise the same on every backend. Cells may be empty.

    Args:
        cells: the cell of each sample, 0 to k - 1; n < 2**31.
        k: the number of cells, 1 to 2**27.

    Returns:
        order int32 [n], the original row of each sorted row; offsets int32 [k + 1]: cell c owns sorted rows
        ``offsets[c]`` to ``offsets[c + 1]``.

    Raises:
        ValueError: a cell is outside 0 to k - 1 (not checked on a GPU or in a compiled graph, where values below 0 are
            sorted before ``offsets[0]`` and values above k - 1 after the last cell, from ``offsets[k]`` on).

    Examples:
        >>> import torch
        >>> from voronerf import cell_sort
        >>> cells = torch.tensor([2, 0, 2, 0], dtype=torch.int32)
        >>> order, offsets = cell_sort(cells, 3)
        >>> order
        tensor([1, 3, 0, 2], dtype=torch.int32)
        >>> offsets
        tensor([0, 2, 2, 4], dtype=torch.int32)
        >>> x = torch.tensor([10, 11, 12, 13])
        >>> x[order]  # cells 0, 0, 2, 2; cell 1 is empty
        tensor([11, 13, 10, 12])
    """
