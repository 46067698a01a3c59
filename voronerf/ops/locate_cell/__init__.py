"""The leaf of a point in a tree of Voronoi diagrams. n points, m centres of all diagrams together, g diagrams."""

from __future__ import annotations

from typing import Annotated, Any

from torch import Tensor

from voronerf.ops._core.backends import COORDINATES, EVERYWHERE, Implementation
from voronerf.ops._core.checks import to_common_dtype
from voronerf.ops._core.declare import declare


def _prepare(arguments: Any) -> Any:
    m, g = arguments.child.shape[0], arguments.child_offsets.shape[0] - 1
    if m < 1 or g < 1:
        count = f"{m} centres in {g} diagrams"
        raise ValueError(f"locate_cell: centres must hold at least one centre of one diagram, got {count}")
    return (
        *to_common_dtype(arguments.points, arguments.centres),
        arguments.child_offsets,
        arguments.child,
        arguments.depth,
    )


@declare(
    native=Implementation(EVERYWHERE, COORDINATES),
    warp=Implementation(EVERYWHERE, COORDINATES),
    prepare=_prepare,
)
def locate_cell(
    points: Annotated[Tensor, "floating [n, 3]"],
    centres: Annotated[Tensor, "floating [m, 3]"],
    child_offsets: Annotated[Tensor, "int32 [g+1]"],
    child: Annotated[Tensor, "int32 [m]"],
    *,
    depth: Annotated[int, "1.."],
    backend: str = "auto",
) -> Annotated[Tensor, "int32 [n]"]:
    """Returns the leaf of every point in a tree of diagrams.

    On each level, a point goes to the nearest centre of its diagram. Diagram 0 is the root; diagram j owns rows
    ``child_offsets[j]`` to ``child_offsets[j + 1]`` of ``centres``. The result is exact, with ties to the lowest index,
    as in ``nearest_centre``; a point that is not finite takes the first centre on every level. Trees may be uneven. Not
    differentiable.

    The CPU refuses tables with a diagram without centres or with a child that is not a diagram, and refuses points that
    reach no leaf within ``depth`` levels. CUDA does not check the tables, to avoid a host read, but reads nothing
    outside them. On CUDA, a point whose path leaves the tables or ends at no leaf gets a negative number.

    Args:
        points: the points to locate, n < 2**31. float16 and bfloat16 are compared in float32.
        centres: the centres of all diagrams, finite, m >= 1; every diagram has at least one centre.
        child_offsets: the first row of each diagram, followed by m; g >= 1.
        child: if ``child[c] >= 0``, diagram ``child[c]`` refines centre c; if ``child[c] < 0``, centre c is leaf
            ``-child[c] - 1``.
        depth: the number of levels of the tree, 1 for a flat diagram.

    Returns:
        int32 [n], the leaf of each point.

    Raises:
        ValueError: the tables are not a tree, or a point reaches no leaf within ``depth`` levels (checked on the CPU
            only).

    Examples:
        >>> import torch
        >>> from voronerf import locate_cell
        >>> centres = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [0.8, 0, 0], [1.2, 0, 0]])
        >>> child_offsets = torch.tensor([0, 2, 4], dtype=torch.int32)  # two diagrams: rows 0 and 1, rows 2 and 3
        >>> child = torch.tensor([-1, 1, -2, -3], dtype=torch.int32)  # diagram 1 refines centre 1; the rest are leaves
        >>> points = torch.tensor([[0.1, 0, 0], [0.9, 0, 0], [1.3, 0, 0]])
        >>> locate_cell(points, centres, child_offsets, child, depth=2)
        tensor([0, 1, 2], dtype=torch.int32)
    """
