"""Splits cells of a diagram by weighted samples; cells made by a split can be split again.

Letters: m samples, k children of one cell.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from voronerf.diagram.balance import CENTRES, Balance, balance, cell_weights, check_samples, first_distinct
from voronerf.diagram.voronoi import VoronoiDiagram


@dataclass(frozen=True)
class Split:
    """The result of `split_diagram`.

    Attributes:
        diagram: the refined diagram; the original diagram if no cell could be split.
        parents: int64 [num_cells], the original cell in which each cell of `diagram` lies.
        balances: the result of `balance` for each original cell that was split.

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
    centres: str = "centroidal",
    generator: torch.Generator | None = None,
    backend: str = "auto",
    steps: int = 500,
) -> Split:
    """Splits cells into k children each, whose centres are placed by the samples in the cell.

    A cell with fewer than `max(k, min_samples)` distinct samples is not split; for k = 1, no cell is split. If the
    diagram has a single cell, the diagram of its children becomes the root.

    Args:
        diagram: a diagram of any depth.
        points: floating [m, d], the samples, finite; d as in the diagram.
        importance: floating [m], finite, >= 0; samples of importance 0 do not count.
        k: the number of children of a split cell, >= 1.
        cells: "all"; "worst", the cell with the largest total importance among the cells with enough samples; or the
            numbers of the cells to split.
        min_samples: the number of distinct samples that a cell needs to be split.
        centres: "centroidal", "balanced", "random" or "uniform", see `balance`. Uniform centres may lie outside of
            their cell and have no samples. "random" and "uniform" are ablations of the paper.
        generator: the CPU generator for all random draws; None for torch's global generator. Draws are made cell by
            cell, in ascending order.
        backend: the backend of the cell queries, see `voronerf.ops._core.backends`.
        steps: the number of steps of `balance`.

    Returns:
        The split. Cells with too few samples stay leaves; `balances` has an entry for each split cell.

    Raises:
        ValueError: samples that `balance` does not accept, an unknown choice, a cell number out of range or twice, or k
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
        VoronoiDiagram(cells=4, depth=1)
        >>> split.parents
        tensor([0, 0, 0, 0])
        >>> nested = split_diagram(split.diagram, points, importance, 4, generator=generator)
        >>> nested.diagram
        VoronoiDiagram(cells=16, depth=2)
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
    least = max(k, min_samples)
    numbers = _cell_numbers(cells, diagram.num_cells)
    chosen = [cell for cell in numbers if len(first_distinct(points[leaves == cell], least)) == least]
    if cells == "worst" and chosen:
        accumulated = cell_weights(leaves, importance, diagram.num_cells)
        chosen = [max(chosen, key=lambda cell: float(accumulated[cell]))]

    balances: dict[int, Balance] = {}
    for cell in chosen if k > 1 else []:
        inside = leaves == cell
        arguments = points[inside], importance[inside], k
        balances[cell] = balance(*arguments, centres=centres, steps=steps, generator=generator, backend=backend)
    refined, parents = diagram.refine({cell: result.centres for cell, result in balances.items()})
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


def finer_diagram(
    present: VoronoiDiagram,
    finer: VoronoiDiagram | int,
    parents: Tensor | None,
    points: Tensor | None,
    weights: Tensor | None,
    split: dict[str, Any],
) -> tuple[VoronoiDiagram, Tensor]:
    """Returns the new diagram of ``VoronoiRouter.subdivide``, and the parents of its cells.

    Args:
        present: The diagram that is refined.
        finer: The new diagram, or a number of children for each cell.
        parents: If ``finer`` is a diagram, the parent of each new cell, int64 [new cells]; None for the cells that hold
            the new centres.
        points: If ``finer`` is a number, samples [m, d].
        weights: If ``finer`` is a number, the weights of the samples, [m]; None if all are 1.
        split: Options of :func:`split_diagram`.

    Raises:
        ValueError: If ``parents`` do not fit, or ``points`` are missing or not allowed.
        TypeError: If ``finer`` is neither a diagram nor a number, or ``parents`` are not int64.
    """
    if not isinstance(finer, VoronoiDiagram):
        if isinstance(finer, bool) or not isinstance(finer, int):
            raise TypeError(
                "VoronoiRouter.subdivide: diagram must be a VoronoiDiagram or a number of children, got "
                f"{type(finer).__name__}"
            )
        if points is None or parents is not None:
            raise ValueError("VoronoiRouter.subdivide: a number of children needs points, and no parents")
        if finer < 1:
            raise ValueError(f"VoronoiRouter.subdivide: diagram must be at least 1 child for a cell, got {finer}")
        if points.shape[-1:] != present.centres.shape[1:]:
            rule = f"VoronoiRouter.subdivide: points must have shape [m, {present.centres.shape[1]}]"
            raise ValueError(f"{rule}, got {list(points.shape)}")
        weights = points.new_ones(points.shape[:-1]) if weights is None else weights
        if weights.shape != points.shape[:-1]:
            rule = f"VoronoiRouter.subdivide: weights must have shape {list(points.shape[:-1])}"
            raise ValueError(f"{rule}, got {list(weights.shape)}")
        generator = split["generator"]
        if generator is not None and generator.device.type != "cpu":
            seed = torch.randint(2**62, (), generator=generator, device=generator.device)
            split = {**split, "generator": torch.Generator().manual_seed(int(seed))}
        result = split_diagram(present, points, weights, finer, **split)
        finer, parents = result.diagram, result.parents
    elif points is not None or weights is not None or split.keys() - {"generator", "backend"}:
        extra = [n for n, v in (("points", points), ("weights", weights)) if v is not None]
        extra += [name for name in split if name not in ("generator", "backend")]
        raise ValueError(
            f"VoronoiRouter.subdivide: {extra[0]} must come with a number of children, got a VoronoiDiagram"
        )
    if parents is None:
        parents = present.locate(finer.leaf_centres.to(present.centres.device)).long()
    if parents.ndim != 1 or parents.shape[0] != finer.num_cells:
        raise ValueError(
            f"VoronoiRouter.subdivide: parents must have shape [{finer.num_cells}], got {list(parents.shape)}"
        )
    if parents.dtype != torch.int64:
        raise TypeError(f"VoronoiRouter.subdivide: parents must be int64, got {parents.dtype}")
    if int(parents.min()) < 0 or int(parents.max()) >= present.num_cells:
        raise ValueError(
            f"VoronoiRouter.subdivide: parents must lie in 0..{present.num_cells - 1}, got "
            f"{int(parents.min())}..{int(parents.max())}"
        )
    return finer, parents
