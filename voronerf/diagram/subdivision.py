"""Splits cells of a diagram by the samples that are still wrong: the first split and every nested one.

Letters: m samples, k children of one cell.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from voronerf.diagram.balance import Balance, balance, cell_weights, check_samples
from voronerf.diagram.voronoi import VoronoiDiagram

CENTRES = ("balanced", "random", "uniform")


@dataclass(frozen=True)
class Split:
    """The result of `split_diagram`.

    Attributes:
        diagram: the refined diagram; the given one if no cell could be split.
        parents: int64 [num_cells], for each cell of `diagram` the cell of the given diagram that it lies in.
        balances: for each cell of the given diagram that was split, how its centres were balanced.

    Examples:
        >>> import torch
        >>> from voronerf import VoronoiDiagram, split_diagram
        >>> points = torch.rand(100, 3)
        >>> split = split_diagram(VoronoiDiagram(torch.zeros(1, 3)), points, torch.ones(100), 2)
        >>> split.diagram.num_cells, list(split.balances)  # cell 0 was split
        (2, [0])
    """

    diagram: VoronoiDiagram
    parents: Tensor
    balances: dict[int, Balance]


def split_diagram(
    diagram: VoronoiDiagram,
    points: Tensor,
    importance: Tensor,
    k: int,
    *,
    cells: str | Sequence[int] = "all",
    min_samples: int = 0,
    centres: str = "balanced",
    uniform_scale: float = 1.0,
    generator: torch.Generator | None = None,
    backend: str = "auto",
    **options: Any,
) -> Split:
    """Splits cells into k each, every cell by the samples that lie in it.

    A cell with fewer than `max(k, min_samples)` distinct samples stays as it is, and so do all cells for k = 1. The
    first split starts from a diagram of one cell; its child becomes the root.

    Args:
        diagram: a diagram of any depth.
        points: floating [m, 3], the kept samples, finite.
        importance: floating [m], finite, >= 0; samples of importance 0 do not count.
        k: children of each cell that is split, >= 1.
        cells: "all"; "worst", the one cell with the largest accumulated importance among those that hold enough
            samples; or the numbers of the cells to split.
        min_samples: number of distinct samples that a cell needs to be split.
        centres: "balanced": moved by `balance`; "random": samples drawn at random and not moved; "uniform":
            `uniform_centres` over the bounding box of the samples in the cell, not moved (some may lie outside the cell
            and have no samples). The last two are ablations of the paper.
        uniform_scale: factor > 0 on the size of the box of "uniform", or of init="uniform", about its middle.
        generator: CPU generator of all draws; None for torch's global one. Cells draw from it in ascending order.
        backend: of the cell queries, see `voronerf.backends`.
        **options: arguments of `balance` for "balanced": method, steps, alpha, neighbours, normalise, init.

    Returns:
        The split. Cells that are too small stay leaves; `balances` has the cells that were split.

    Raises:
        ValueError: samples that `balance` does not accept, an unknown choice, a cell out of range or given twice, or k
            larger than the number of samples.
        TypeError: points or importance are not floating.

    Examples:
        >>> import torch
        >>> from voronerf import VoronoiDiagram, split_diagram
        >>> generator = torch.Generator().manual_seed(0)
        >>> points, importance = torch.rand(1000, 3, generator=generator), torch.rand(1000, generator=generator)
        >>> coarse = VoronoiDiagram(torch.zeros(1, 3))
        >>> split = split_diagram(coarse, points, importance, 4, generator=generator)
        >>> split.diagram
        VoronoiDiagram(Voronoi, cells=4, depth=1)
        >>> split.parents
        tensor([0, 0, 0, 0])
        >>> nested = split_diagram(split.diagram, points, importance, 4, generator=generator)
        >>> nested.diagram
        VoronoiDiagram(Voronoi, cells=16, depth=2)
    """
    check_samples("split_diagram", points, importance)
    if k < 1:
        raise ValueError(f"split_diagram: k must be at least 1, got {k}")
    if centres not in CENTRES:
        raise ValueError(f"split_diagram: centres must be one of {', '.join(CENTRES)}, got {centres!r}")
    points = points.detach().to("cpu", torch.float32)[importance.cpu() > 0]
    importance = importance.detach().cpu()[importance.cpu() > 0]
    if k > points.shape[0]:
        raise ValueError(
            f"split_diagram: k must be at most the number of samples with importance, {points.shape[0]}, got {k}: "
            "more cells than samples"
        )
    leaves = diagram.locate(points.to(diagram.centres.device), backend=backend).cpu()
    distinct = torch.unique(torch.cat([leaves[:, None].to(points.dtype), points], 1), dim=0)
    counts = torch.bincount(distinct[:, 0].long(), minlength=diagram.num_cells).tolist()

    chosen = [cell for cell in _cell_numbers(cells, diagram.num_cells) if counts[cell] >= max(k, min_samples)]
    if cells == "worst" and chosen:
        accumulated = cell_weights(leaves, importance, diagram.num_cells)
        chosen = [max(chosen, key=lambda cell: float(accumulated[cell]))]

    if centres != "balanced":
        options = {"method": "published", "steps": 0, "init": centres}
    balances: dict[int, Balance] = {}
    for cell in chosen if k > 1 else []:
        inside = leaves == cell
        balances[cell] = balance(
            points[inside],
            importance[inside],
            k,
            generator=generator,
            uniform_scale=uniform_scale,
            backend=backend,
            **options,
        )
    refined, parents = diagram.refine({cell: result.diagram() for cell, result in balances.items()})
    return Split(refined if balances else diagram, parents, balances)


def _cell_numbers(cells: str | Sequence[int], num_cells: int) -> list[int]:
    if isinstance(cells, str):
        if cells not in ("all", "worst"):
            raise ValueError(f"split_diagram: cells must be 'all', 'worst' or cell numbers, got {cells!r}")
        return list(range(num_cells))
    numbers = sorted(int(cell) for cell in cells)
    if any(not 0 <= cell < num_cells for cell in numbers) or len(set(numbers)) < len(numbers):
        raise ValueError(f"split_diagram: cells must name cells 0..{num_cells - 1}, each once, got {list(cells)}")
    return numbers
