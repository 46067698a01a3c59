"""What rendered samples teach an occupancy grid. x, y, z cells along each axis, m samples."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import EVERYWHERE, Implementation
from voronerf.ops._core.declare import declare


def _prepare(given: Any) -> Any:
    if given.density.numel() < 1:
        raise ValueError(f"observe_occupancy: density must have at least one cell, got {list(given.density.shape)}")
    if (given.deltas is None) != (given.weights is None):
        missing = "deltas" if given.deltas is None else "weights"
        raise ValueError(f"observe_occupancy: deltas and weights must be given together, got no {missing}")
    return given


@declare(
    native=Implementation(EVERYWHERE, (torch.float32,)),
    warp=Implementation(EVERYWHERE, (torch.float32,)),
    small=["density"],
    writes=["density", "occupied"],
    prepare=_prepare,
)
def observe_occupancy(
    density: Annotated[Tensor, "float32 [x, y, z]"],
    occupied: Annotated[Tensor, "bool [x, y, z]"],
    box: Annotated[Tensor, "same [2, 3]"],
    positions: Annotated[Tensor, "same [m, 3]"],
    sigma: Annotated[Tensor, "same [m]"],
    deltas: Annotated[Tensor | None, "same [m]"] = None,
    weights: Annotated[Tensor | None, "same [m]"] = None,
    *,
    decay: Annotated[float, "0 to 1"],
    threshold: float,
    hidden: float,
    contraction: Annotated[Tensor | None, "same [4] or [5, 3]"] = None,
    fixed: Annotated[Tensor | None, "bool [x, y, z]"] = None,
    backend: str = "auto",
) -> None:
    """Updates the cells of an occupancy grid that rendered samples lie in, in place.

    A cell with samples gets the largest of their densities and ``decay`` times its old density (Mueller et al. 2022,
    appendix C). A sample that receives less than the share ``hidden`` of the light counts as density 0:
    ``weights <= hidden * (1 - exp(-sigma * deltas))``. The other cells keep theirs. Not differentiable.

    With a ``contraction`` the grid, its box and the positions are of the contracted space, ``sigma`` and ``deltas`` of
    the world. A cell then gets densities per unit of contracted length along rays from the centre.

    Args:
        density: >= 0, contiguous.
        occupied: contiguous: density >= threshold.
        box: lowest and highest corner.
        positions: a position outside the box counts for the nearest cell at its border.
        sigma: densities of the samples; NaN counts as infinite.
        deltas: lengths of their strata; a sample of length 0 says nothing. None where all light reaches every sample.
        weights: their contributions to their rays; None where ``deltas`` is.
        decay: 0 to 1.
        threshold: density from which a cell counts as occupied.
        hidden: share of the light, 0 to 1.
        contraction: of the space of the grid, as for ``march_rays``.
        fixed: cells that stay as they are; None for none.

    Raises:
        ValueError: a grid that is not contiguous; one of ``deltas`` and ``weights`` alone.

    Examples:
        >>> import torch
        >>> from voronerf.ops import observe_occupancy
        >>> density, occupied = torch.full((3, 1, 1), 4.0), torch.ones(3, 1, 1, dtype=torch.bool)
        >>> box = torch.tensor([[0.0, 0, 0], [3.0, 1, 1]])
        >>> positions = torch.tensor([[0.5, 0.5, 0.5], [1.5, 0.5, 0.5]])  # in the first two cells
        >>> samples = positions, torch.tensor([0.0, 9.0]), torch.ones(2), torch.tensor([0.0, 1.0])
        >>> observe_occupancy(density, occupied, box, *samples, decay=0.5, threshold=3.0, hidden=1e-3)
        >>> density.flatten(), occupied.flatten()
        (tensor([2., 9., 4.]), tensor([False,  True,  True]))
    """
