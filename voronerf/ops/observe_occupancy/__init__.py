"""What rendered samples teach an occupancy grid. x, y, z cells along each axis, m samples."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import EVERYWHERE, Implementation
from voronerf.ops._core.checks import LIKE_FIRST, Checked, check_count, check_number, check_writable, detached
from voronerf.ops.observe_occupancy.reference import Observed

_OP = backends.declare(
    "observe_occupancy",
    native=Implementation(EVERYWHERE, (torch.float32,)),
    warp=Implementation(EVERYWHERE, (torch.float32,)),
)


def observe_occupancy(
    density: Tensor,
    occupied: Tensor,
    box: Tensor,
    positions: Tensor,
    sigma: Tensor,
    deltas: Tensor,
    weights: Tensor,
    *,
    decay: float,
    threshold: float,
    hidden: float,
    backend: str = "auto",
) -> None:
    """Updates the cells of an occupancy grid that rendered samples lie in, in place.

    A cell with samples gets the largest of their densities and ``decay`` times its old density (Mueller et al. 2022,
    appendix C). A sample that receives less than the share ``hidden`` of the light counts as density 0:
    ``weights <= hidden * (1 - exp(-sigma * deltas))``. The other cells keep theirs. Not differentiable.

    Args:
        density: float32 [x, y, z], >= 0, contiguous.
        occupied: bool [x, y, z], contiguous: density >= threshold.
        box: float32 [2, 3], lowest and highest corner.
        positions: float32 [m, 3]; a position outside the box counts for the nearest cell at its border.
        sigma: float32 [m], densities of the samples; NaN counts as infinite.
        deltas: float32 [m], lengths of their strata; a sample of length 0 says nothing.
        weights: float32 [m], their contributions to their rays.
        decay: 0 to 1.
        threshold: density from which a cell counts as occupied.
        hidden: share of the light, 0 to 1.
        backend: "auto", "reference", "native" or "warp".

    Raises:
        ValueError: a grid that is not contiguous.

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
    given = Checked(_OP)
    given.tensor("density", density, (torch.float32,), "x", "y", "z")
    given.tensor("occupied", occupied, (torch.bool,), "x", "y", "z")
    given.tensor("box", box, LIKE_FIRST, 2, 3)
    given.tensor("positions", positions, LIKE_FIRST, "m", 3)
    for name, value in (("sigma", sigma), ("deltas", deltas), ("weights", weights)):
        given.tensor(name, value, LIKE_FIRST, "m")
    check_count(_OP, "density", density.numel())
    check_writable(_OP, "density", density)
    check_writable(_OP, "occupied", occupied)
    if density.numel() < 1:
        raise ValueError(f"{_OP}: density must have at least one cell, got {list(density.shape)}")
    for name, number in (("decay", decay), ("threshold", threshold), ("hidden", hidden)):
        check_number(_OP, name, number)
    if not 0 <= decay <= 1:
        raise ValueError(f"{_OP}: decay must lie in 0 to 1, got {decay}")
    tensors = [detached(tensor) for tensor in (density, occupied, box, positions, sigma, deltas, weights)]
    observed = Observed._make([*tensors, float(decay), float(threshold), float(hidden)])
    backends.resolve(_OP, backend=backend, device=density.device, dtype=density.dtype)(observed)
