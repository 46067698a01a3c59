"""What rendered samples teach an occupancy grid. x, y, z cells along each axis, m samples."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf import backends
from voronerf.backends import EVERYWHERE, Implementation
from voronerf.checks import (
    check_count,
    check_dtype,
    check_number,
    check_range,
    check_same_device,
    check_same_dtype,
    check_shape,
    check_writable,
    detached,
)

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
        deltas: float32 [m], lengths of their strata.
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
    _check(_OP, density, occupied, box, samples, decay=decay, threshold=threshold, hidden=hidden)
    run = backends.resolve(_OP, backend=backend, device=density.device, dtype=density.dtype)
    constant = (detached(tensor) for tensor in (box, *samples))
    run(detached(density), occupied, *constant, float(decay), float(threshold), float(hidden))


def observe_told(
    grid: tuple[Tensor, Tensor, Tensor],
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
    density, occupied, box = _grid(_TOLD, grid)
    _check(_TOLD, density, occupied, box, samples, decay=decay, threshold=threshold, hidden=hidden)
    check_shape(_TOLD, "told", told, ("c", 2))
    _check_cells(_TOLD, "reached", reached, density)
    check_same_dtype(_TOLD, density=density, told=told)
    check_same_device(_TOLD, density=density, told=told, reached=reached)
    check_range(_TOLD, "told", told[:, 0].contiguous().view(torch.int32), density.numel())
    run = backends.resolve(_TOLD, backend=backend, device=density.device, dtype=density.dtype)
    run(detached(density), occupied, box, told, reached, samples, float(decay), float(threshold), float(hidden))


def tell_observed(
    grid: tuple[Tensor, Tensor, Tensor],
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
    density, occupied, box = _grid(_TELL, grid)
    _check(_TELL, density, occupied, box, samples, decay=1.0, threshold=1.0, hidden=hidden)
    _check_cells(_TELL, "several", several, density)
    run = backends.resolve(_TELL, backend=backend, device=density.device, dtype=density.dtype)
    told: Tensor = run(density, box, several, samples, float(hidden))
    return told


def _grid(op: str, grid: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    if not isinstance(grid, tuple) or len(grid) != 3:
        raise ValueError(f"{op}: grid must be density, occupied and box, got {grid!r:.60}")
    return grid


def _check_cells(op: str, name: str, chosen: Tensor | None, density: Tensor) -> None:
    if chosen is not None:
        check_shape(op, name, chosen, (density.numel(),))
        check_dtype(op, name, chosen, (torch.bool,))
        check_same_device(op, density=density, **{name: chosen})


def _check(op: str, density: Tensor, occupied: Tensor, box: Tensor, samples: Samples, **numbers: float) -> None:
    if not isinstance(samples, tuple) or len(samples) != 4:
        raise ValueError(f"{op}: samples must be positions, sigma, deltas and weights, got {samples!r:.60}")
    positions, sigma, deltas, weights = samples
    sizes: dict[str, int] = {}
    check_shape(op, "density", density, ("x", "y", "z"), sizes)
    check_shape(op, "occupied", occupied, ("x", "y", "z"), sizes)
    check_shape(op, "box", box, (2, 3))
    check_shape(op, "positions", positions, ("m", 3), sizes)
    floats = {"density": density, "box": box, "positions": positions}
    for name, value in (("sigma", sigma), ("deltas", deltas), ("weights", weights)):
        check_shape(op, name, value, ("m",), sizes)
        floats[name] = value
    check_dtype(op, "density", density, (torch.float32,))
    check_dtype(op, "occupied", occupied, (torch.bool,))
    check_same_dtype(op, **floats)
    check_same_device(op, **floats, occupied=occupied)
    check_count(op, "density", density.numel())
    check_count(op, "positions", sizes["m"])
    for name, grid in (("density", density), ("occupied", occupied)):
        check_writable(op, name, grid)
    if density.numel() < 1:
        raise ValueError(f"{op}: density must have at least one cell, got {list(density.shape)}")
    for name, number in numbers.items():
        check_number(op, name, number)
    if not 0 <= numbers["decay"] <= 1:
        raise ValueError(f"{op}: decay must lie in 0 to 1, got {numbers['decay']}")
