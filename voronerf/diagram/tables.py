"""Checks of the tables that a diagram is made of, see `voronerf.diagram.voronoi`."""

import itertools

import torch
from torch import Tensor


def check_table(name: str, table: Tensor, k: int | None = None) -> None:
    """Checks a table of centres [any number, 3] or, where ``k`` is given, one of weights [k].

    Raises:
        ValueError: a wrong shape, or a value that is not finite.
        TypeError: not a floating-point tensor.
    """
    if not isinstance(table, Tensor) or not table.is_floating_point():
        got = table.dtype if isinstance(table, Tensor) else type(table).__name__
        raise TypeError(f"VoronoiDiagram: {name} must be a floating-point tensor, got {got}")
    if k is None and (table.dim() != 2 or table.shape[1] != 3):
        raise ValueError(f"VoronoiDiagram: {name} must have shape [k, 3], got {list(table.shape)}")
    if k is not None and table.shape != (k,):
        raise ValueError(f"VoronoiDiagram: {name} must have shape [{k}], got {list(table.shape)}")
    if not bool(torch.isfinite(table).all()):
        raise ValueError(f"VoronoiDiagram: {name} must be finite, got NaN or infinity")


def check_tree(centres: Tensor, child_offsets: Tensor, child: Tensor, power: Tensor | None) -> tuple[int, int]:
    """Checks the tables of a tree, which may come from a damaged file; returns its depth and number of leaves."""

    def refuse(rule: str) -> ValueError:
        return ValueError(f"VoronoiDiagram: tables of a tree must {rule}")

    check_table("centres", centres)
    m = centres.shape[0]
    if power is not None:
        check_table("power", power, m)
    if any(table.dtype != torch.int32 or table.dim() != 1 for table in (child_offsets, child)):
        raise refuse("hold child_offsets and child as int32 vectors")
    offsets, links = child_offsets.tolist(), child.tolist()
    if len(links) != m or len(offsets) < 2 or offsets[0] != 0 or offsets[-1] != m:
        raise refuse(f"cover all {m} centres, got {len(links)} links and offsets {offsets[:1]}..{offsets[-1:]}")
    if any(a >= b for a, b in itertools.pairwise(offsets)):
        raise refuse("give every diagram at least one centre")

    depth, leaf = 0, 0
    seen = [False] * (len(offsets) - 1)
    # Depth-first, first child first, as the leaves are numbered: rows are stacked in reverse.
    stack = [(row, 1) for row in reversed(range(offsets[0], offsets[1]))]
    seen[0] = True
    while stack:
        row, level = stack.pop()
        depth = max(depth, level)
        link = links[row]
        if link < 0:
            if link != -1 - leaf:
                raise refuse(f"number the leaves depth-first, got {-1 - link} where {leaf} was due")
            leaf += 1
            continue
        if link >= len(seen) or seen[link]:
            raise refuse(f"refer to each diagram once, got diagram {link} of {len(seen)} again or out of range")
        seen[link] = True
        stack += [(inner, level + 1) for inner in reversed(range(offsets[link], offsets[link + 1]))]
    if not all(seen):
        raise refuse("reach every diagram from the root")
    return depth, leaf
