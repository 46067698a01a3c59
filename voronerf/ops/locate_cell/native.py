"""``locate_cell`` of the compiled module. n points, m centres of g diagrams."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared
from voronerf.ops._core.rows import rows_of


@declared("locate_cell").custom_op()
def locate_cell(arguments: Any, leaves: Tensor) -> None:
    """Fills the leaf of every point in a tree of diagrams; see ``voronerf.ops.locate_cell``."""
    points, centres, *tree = arguments
    find(leaves, points, centres, tree, "locate_cell")


def find(
    leaves: Tensor,
    points: Tensor,
    centres: Tensor,
    tree: Sequence[Any],
    caller: str,
    rows: Tensor | None = None,
) -> None:
    """Fills ``leaves``, int32 [n], the leaf of each point.

    ``rows``, int32 [1], is used on CUDA only: the number of leading points to locate. The other points get -1. If
    ``rows`` is None, all points are located. Points and centres have one dtype. ``tree`` is child_offsets, child and
    depth; ``caller`` is the op's name for error messages.
    """
    child_offsets, child, depth = tree
    compiled, machine = native.compiled, native.machine(points)
    n, m, g = rows_of(points), centres.shape[0], child_offsets.shape[0] - 1
    arguments = points, centres, child_offsets, child
    if isinstance(machine, compiled.Cuda):
        compiled.locate_cell(*arguments, rows, leaves, n, m, g, depth, machine)
        return
    check_tree(child_offsets, child, m, caller)
    workspace = leaves.new_empty(compiled.locate_cell_workspace(m, machine))
    if not compiled.locate_cell(*arguments, leaves, workspace, n, m, depth, machine):
        raise too_shallow(depth, caller)


def check_tree(child_offsets: Tensor, child: Tensor, m: int, caller: str) -> None:
    """Raises ValueError for tables on the CPU that are not a tree."""
    fault = native.compiled.locate_cell_fault(child_offsets, child, child_offsets.shape[0] - 1, m)
    if fault is not None:
        raise ValueError(f"{caller}: {fault}")


def too_shallow(depth: int, caller: str) -> ValueError:
    """Returns the error for a point that has reached no leaf after ``depth`` levels."""
    return ValueError(f"{caller}: depth must be the number of levels of the tree, got {depth}, which is too few")
