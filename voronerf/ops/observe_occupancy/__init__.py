"""What rendered samples teach an occupancy grid. x, y, z cells along each axis, m samples."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf import backends
from voronerf.backends import EVERYWHERE, Implementation
from voronerf.checks import LIKE_FIRST, Checked, check_count, check_number, check_range, check_writable, detached
from voronerf.ops.observe_occupancy.reference import Observed

_OP = backends.declare(
    "observe_occupancy",
    native=Implementation(EVERYWHERE, (torch.float32,)),
    warp=Implementation(EVERYWHERE, (torch.float32,)),
)
_TOLD, _TELL = (
    backends.declare(
        op,
        native=Implementation(("cpu",), (torch.float32,), file="observe_occupancy"),
        reference=Implementation(file="observe_occupancy"),
    )
    for op in ("observe_told", "tell_observed")
)
#: Density, occupied and box.
Grid = tuple[Tensor, Tensor, Tensor]
#: Positions, sigma, deltas and weights.
Samples = tuple[Tensor, Tensor, Tensor, Tensor]


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
        ValueError: shapes, devices, a grid that is not contiguous, a decay out of range, an unknown backend.
        TypeError: dtypes.
        BackendUnavailable: the named backend cannot run here.

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
    samples = positions, sigma, deltas, weights
    _, given = _checked(_OP, (density, occupied, box), samples, decay=decay, threshold=threshold, hidden=hidden)
    backends.resolve(_OP, backend=backend, device=density.device, dtype=density.dtype)(given)


def observe_told(
    grid: Grid,
    samples: Samples,
    told: Tensor,
    *,
    reached: Tensor | None = None,
    decay: float,
    threshold: float,
    hidden: float,
    backend: str = "auto",
) -> None:
    """`observe_occupancy` with the samples that other ranks have told, in place.

    Args:
        grid: density, occupied and box, as there.
        samples: positions, sigma, deltas and weights, as there, of this rank.
        told: float32 [c, 2], what `tell_observed` gave on other ranks.
        reached: bool [x y z], the cells of the grid that this rank has: others stay as they are. None for all.
        decay: 0 to 1.
        threshold: density from which a cell counts as occupied.
        hidden: share of the light, 0 to 1.
        backend: "auto", "reference" or "native".

    Raises:
        ValueError: as `observe_occupancy`; on the CPU also cells out of range.
        TypeError: dtypes.
        BackendUnavailable: the named backend cannot run here.

    Examples:
        >>> import torch
        >>> from voronerf.ops import observe_told
        >>> box = torch.tensor([[0.0, 0, 0], [2, 1, 1]])
        >>> grid = torch.full((2, 1, 1), 4.0), torch.ones(2, 1, 1, dtype=torch.bool), box
        >>> none = torch.zeros(0, 3), *torch.zeros(3, 0)
        >>> told = torch.tensor([[1, 0]], dtype=torch.int32).view(torch.float32)  # the second cell was found empty
        >>> observe_told(grid, none, told, decay=0.5, threshold=3.0, hidden=1e-3)
        >>> grid[0].flatten(), grid[1].flatten()
        (tensor([4., 2.]), tensor([ True, False]))
    """
    tensors, given = _checked(_TOLD, grid, samples, decay=decay, threshold=threshold, hidden=hidden)
    density = given.density
    tensors.tensor("told", told, LIKE_FIRST, "c", 2)
    tensors.optional("reached", reached, (torch.bool,), density.numel())
    check_range(_TOLD, "told", told[:, 0].contiguous().view(torch.int32), density.numel())
    run = backends.resolve(_TOLD, backend=backend, device=density.device, dtype=density.dtype)
    run(given, told.detach(), reached)


def tell_observed(
    grid: Grid,
    samples: Samples,
    *,
    several: Tensor | None = None,
    hidden: float,
    backend: str = "auto",
) -> Tensor:
    """What other ranks should know of samples, for `observe_told`.

    Args:
        grid: density, occupied and box, as in `observe_occupancy`.
        samples: positions, sigma, deltas and weights, as there.
        several: bool [x y z], the cells of the grid that several ranks have: samples in others are left out. None for
            all.
        hidden: share of the light, 0 to 1: samples that no more than it reaches count as density 0.
        backend: "auto", "reference" or "native".

    Returns:
        float32 [c, 2]: the cell of each sample, as bits of an int32, and its density.

    Raises:
        ValueError: as `observe_occupancy`.
        TypeError: dtypes.
        BackendUnavailable: the named backend cannot run here.

    Examples:
        >>> import torch
        >>> from voronerf.ops import tell_observed
        >>> box = torch.tensor([[0.0, 0, 0], [2, 1, 1]])
        >>> grid = torch.full((2, 1, 1), 4.0), torch.ones(2, 1, 1, dtype=torch.bool), box
        >>> samples = torch.tensor([[1.5, 0.5, 0.5]]), torch.tensor([9.0]), torch.ones(1), torch.ones(1)
        >>> told = tell_observed(grid, samples, hidden=1e-3)
        >>> told[:, 0].view(torch.int32), told[:, 1]
        (tensor([1], dtype=torch.int32), tensor([9.]))
    """
    tensors, given = _checked(_TELL, grid, samples, hidden=hidden)
    density = given.density
    tensors.optional("several", several, (torch.bool,), density.numel())
    run = backends.resolve(_TELL, backend=backend, device=density.device, dtype=density.dtype)
    told: Tensor = run(given, several)
    return told


def _checked(
    op: str, grid: Grid, samples: Samples, *, hidden: float, decay: float = 1.0, threshold: float = 1.0
) -> tuple[Checked, Observed]:
    """The arguments of an implementation, which are no part of a graph."""
    if not isinstance(grid, tuple) or len(grid) != 3:
        raise ValueError(f"{op}: grid must be density, occupied and box, got {grid!r:.60}")
    if not isinstance(samples, tuple) or len(samples) != 4:
        raise ValueError(f"{op}: samples must be positions, sigma, deltas and weights, got {samples!r:.60}")
    (density, occupied, box), (positions, sigma, deltas, weights) = grid, samples
    given = Checked(op)
    given.tensor("density", density, (torch.float32,), "x", "y", "z")
    given.tensor("occupied", occupied, (torch.bool,), "x", "y", "z")
    given.tensor("box", box, LIKE_FIRST, 2, 3)
    given.tensor("positions", positions, LIKE_FIRST, "m", 3)
    for name, value in (("sigma", sigma), ("deltas", deltas), ("weights", weights)):
        given.tensor(name, value, LIKE_FIRST, "m")
    check_count(op, "density", density.numel())
    check_writable(op, "density", density)
    check_writable(op, "occupied", occupied)
    if density.numel() < 1:
        raise ValueError(f"{op}: density must have at least one cell, got {list(density.shape)}")
    for name, number in (("decay", decay), ("threshold", threshold), ("hidden", hidden)):
        check_number(op, name, number)
    if not 0 <= decay <= 1:
        raise ValueError(f"{op}: decay must lie in 0 to 1, got {decay}")
    tensors = [detached(tensor) for tensor in (*grid, *samples)]
    return given, Observed._make([*tensors, float(decay), float(threshold), float(hidden)])
