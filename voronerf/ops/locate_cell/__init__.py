"""Which leaf of a tree of Voronoi diagrams a point lies in. n points, m centres of all diagrams together, g
diagrams."""

from __future__ import annotations

from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import COORDINATES, EVERYWHERE, Implementation
from voronerf.ops._core.checks import FLOATING, INDEX, Checked, check_integer
from voronerf.ops.nearest_centre import of_one_dtype

_OP = backends.declare(
    "locate_cell", native=Implementation(EVERYWHERE, COORDINATES), warp=Implementation(EVERYWHERE, COORDINATES)
)


def locate_cell(
    points: Tensor, centres: Tensor, child_offsets: Tensor, child: Tensor, *, depth: int, backend: str = "auto"
) -> Tensor:
    """Leaf of every point in a tree of diagrams: on each level, the nearest centre of the diagram that holds the point.

    Diagram 0 is the root; diagram j owns rows ``child_offsets[j]`` to ``child_offsets[j + 1]`` of ``centres``. Exact,
    with ties to the lowest index, as ``nearest_centre``; a point that is not finite takes the first centre at every
    level. Trees may be uneven. Not differentiable.

    On the CPU, "native" raises for tables that are not a tree of this depth: a diagram without centres, a child that is
    not a diagram, a path longer than ``depth``. On CUDA that would need a host read. There nothing outside the tables
    is read, and a point whose path leaves the tables, or does not end at a leaf, gets a negative number.

    Args:
        points: [n, 3] floating point, n < 2**31. float16 and bfloat16 are compared in float32.
        centres: [m, 3] floating point, finite, m >= 1; every diagram has at least one.
        child_offsets: int32 [g + 1], g >= 1.
        child: int32 [m]. ``child[c] >= 0``: centre c is refined by diagram ``child[c]``; ``child[c] < 0``: centre c is
            leaf number ``-child[c] - 1``.
        depth: levels of the tree, 1 for a flat diagram.
        backend: "auto", "reference", "native" or "warp".

    Returns:
        leaf int32 [n].

    Raises:
        ValueError: with "native" on the CPU tables that are not a tree.

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
    given = Checked(_OP)
    given.tensor("points", points, FLOATING, "n", 3)
    given.tensor("centres", centres, FLOATING, "m", 3)
    given.tensor("child_offsets", child_offsets, INDEX, "g+1")
    given.tensor("child", child, INDEX, "m")
    check_integer(_OP, "depth", depth, 1)
    if given.sizes["m"] < 1 or given.sizes["g"] < 1:
        count = f"{given.sizes['m']} centres in {given.sizes['g']} diagrams"
        raise ValueError(f"{_OP}: centres must hold at least one centre of one diagram, got {count}")
    points, centres = of_one_dtype(points, centres)
    run = backends.resolve(_OP, backend=backend, device=points.device, dtype=points.dtype)
    leaf: Tensor = run(points, centres, child_offsets, child, depth)
    return leaf
