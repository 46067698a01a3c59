"""The memory of an occupancy grid. x, y, z cells along each axis, q cells looked at."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf import backends
from voronerf.backends import EVERYWHERE, Implementation
from voronerf.checks import INDEX, Checked, check_count, check_number

_OP = backends.declare(
    "update_occupancy",
    native=Implementation(EVERYWHERE, (torch.float32,)),
    warp=Implementation(EVERYWHERE, (torch.float32,)),
)


def update_occupancy(
    density: Tensor, cells: Tensor, values: Tensor, *, decay: float, threshold: float, backend: str = "auto"
) -> tuple[Tensor, Tensor]:
    """Updates the densities of some cells of an occupancy grid, and says which cells are occupied.

    An updated cell gets the largest of the values found in it and ``decay`` times its old density (Mueller et al. 2022,
    appendix C). The other cells keep theirs. Not differentiable.

    Args:
        density: float32 [x, y, z], >= 0.
        cells: int32 [q], flat numbers of the cells to update, 0 to x * y * z - 1; a cell may occur more than once.
            Other numbers are an error on the CPU, and undefined on CUDA, where they are not checked.
        values: float32 [q], the densities found, not NaN.
        decay: 0 to 1.
        threshold: density from which a cell counts as occupied.
        backend: "auto", "reference", "native" or "warp".

    Returns:
        (density float32 [x, y, z], occupied bool [x, y, z]).

    Raises:
        ValueError: on the CPU cells out of range.

    Examples:
        >>> import torch
        >>> from voronerf import update_occupancy
        >>> density = torch.tensor([4.0, 4.0, 4.0]).reshape(3, 1, 1)
        >>> cells = torch.tensor([0, 1], dtype=torch.int32)  # cells that were looked at
        >>> density, occupied = update_occupancy(density, cells, torch.tensor([9.0, 0.0]), decay=0.5, threshold=3.0)
        >>> density.flatten(), occupied.flatten()
        (tensor([9., 2., 4.]), tensor([ True, False,  True]))
    """
    given = Checked(_OP)
    given.tensor("density", density, (torch.float32,), "x", "y", "z")
    given.tensor("cells", cells, INDEX, "q")
    given.tensor("values", values, (torch.float32,), "q")
    check_count(_OP, "density", density.numel())
    check_number(_OP, "decay", decay)
    check_number(_OP, "threshold", threshold)
    if not 0 <= decay <= 1:
        raise ValueError(f"{_OP}: decay must lie in 0 to 1, got {decay}")
    run = backends.resolve(_OP, backend=backend, device=density.device, dtype=density.dtype)
    remembered, occupied = run(density.detach(), cells, values.detach(), float(decay), float(threshold))
    return remembered, occupied
