"""``nearest_centre`` of the compiled module. n points, k centres, d coordinates."""

from __future__ import annotations

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared
from voronerf.ops._core.rows import rows_of
from voronerf.ops.nearest_centre import check_sizes


def _check(centres: Tensor, index: Tensor | None) -> None:
    """Raises ValueError for arguments that the compiled function has refused."""
    check_sizes("nearest_centre", centres)
    if index is not None:
        check_index("nearest_centre", centres, index)


def check_index(op: str, centres: Tensor, index: Tensor) -> None:
    """Raises ValueError unless the index was made for the shape and the dtype of the centres."""
    (k, d), size, got = centres.shape, centres.itemsize, f"int32 {list(index.shape)}"
    if len(index) == native.compiled.centre_index_words(k, d, size):
        if index.is_cuda or (head := index[:3].tolist()) == [k, d, size]:
            return
        got = f"an index of float{8 * head[2]} {head[:2]}"
    raise ValueError(f"{op}: index must belong to these centres, float{8 * size} [{k}, {d}], got {got}")


nearest_centre = declared("nearest_centre").compiled_op(
    "",
    "nearest_centre",
    *("points", "centres", "index", "result", "n", "k", "d", "w"),
    on_cuda=lambda arguments, cells, _: find(cells, arguments.points, arguments.centres, index=arguments.index),
    fault=lambda arguments: _check(arguments.centres, arguments.index),
)


def find(
    cells: Tensor, points: Tensor, centres: Tensor, rows: Tensor | None = None, index: Tensor | None = None
) -> None:
    """Fills ``cells``, int32 [n], the cell of each point, for points and centres of one dtype.

    ``rows``, int32 [1], is used on CUDA only: the number of leading points to locate. The other points get -1. If
    ``rows`` is None, all points are located.
    """
    compiled, machine = native.compiled, native.machine(points)
    n, (k, d), words = rows_of(points), centres.shape, 0 if index is None else len(index)
    if isinstance(machine, compiled.Cuda):
        fits = compiled.nearest_centre(points, centres, index, rows, cells, n, k, d, words, machine)
    else:
        fits = compiled.nearest_centre(points, centres, index, cells, n, k, d, words, machine)
    if not fits:
        _check(centres, index)
