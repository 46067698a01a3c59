"""A table that finds the nearest of many centres in a few steps, for centres that stay where they are. k centres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import COORDINATES, Implementation
from voronerf.ops._core.checks import FLOATING, Checked
from voronerf.ops.centre_grid.reference import BRICK_BITS, CELL_BITS, GridTables, centre_table, root_bits

_OP = backends.declare("centre_grid", native=Implementation(("cpu",), COORDINATES))


@dataclass(frozen=True, eq=False)
class CentreGrid:
    """A grid over all of space with a list of candidate centres in each cell: made by `centre_grid`, for
    `nearest_centre`.

    Tables that lead outside of themselves are refused where a grid is made or unpickled, since no query looks at them
    again.

    Attributes:
        centres: float32 or float64 [k, 3], a copy of the centres that the grid was made from.
        tables: the lists and their index; csrc/geometry/centre_grid.h describes them.

    Raises:
        ValueError: tables that are not those of a grid of these centres.

    Examples:
        >>> import torch
        >>> from voronerf import centre_grid
        >>> centres = torch.eye(3)
        >>> grid = centre_grid(centres)
        >>> grid.belongs_to(centres), grid.belongs_to(centres + 1)
        (True, False)
    """

    centres: Tensor
    tables: GridTables

    def __post_init__(self) -> None:
        _check_tables(self.centres, self.tables)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.__post_init__()

    @property
    def nbytes(self) -> int:
        """Memory of the tables."""
        return sum(tensor.nbytes for tensor in self.tables[:4])

    def fits(self, centres: Tensor) -> bool:
        """Whether as many centres have a place in the tables; reads shapes alone."""
        return centres.shape == self.centres.shape

    def belongs_to(self, centres: Tensor) -> bool:
        """Whether the grid was made from these very centres. Reads them, on CUDA from the host."""
        # In float64, which holds all of them: centres that were rounded since have other borders.
        return self.fits(centres) and torch.equal(centres.double(), self.centres.double())


def _check_tables(centres: Tensor, tables: GridTables) -> None:
    """Raises unless every walk through the tables ends at a list of centres that are there."""
    kind = "CentreGrid"
    given = Checked(kind)
    given.tensor("centres", centres, (torch.float32, torch.float64), "k", 3)
    frame, entries, lists, table, bits = tables
    given.tensor("tables.frame", frame, (torch.float32,), 2, 3)
    given.tensor("tables.entries", entries, (torch.int32,), "e")
    given.tensor("tables.lists", lists, (torch.int32,), "l")
    given.tensor("tables.table", table, (torch.float32,), "k", 4)
    k, root, brick = len(centres), 8 ** root_bits(len(centres)), 8**BRICK_BITS
    if bits != root_bits(k):
        raise ValueError(f"{kind}: tables.bits must be {root_bits(k)} for {k} centres, got {bits}")
    if not torch.equal(table, centre_table(centres)):
        raise ValueError(f"{kind}: tables.table must hold the centres, got others")
    if entries.numel() < root or (entries.numel() - root) % brick:
        raise ValueError(f"{kind}: tables.entries must be {root} and bricks of {brick}, got {entries.numel()}")
    # From the root down: a place of a list ends the walk; another number is a brick, which belongs to one cell.
    bricks = entries[root:].reshape(-1, brick)
    found, places = entries[:root], []
    for left in reversed(range((CELL_BITS - bits) // BRICK_BITS + 1)):
        places.append(found[found >= 0])
        starts = -1 - found[found < 0]
        inside = (starts >= root) & (starts < entries.numel()) & ((starts - root) % brick == 0)
        if not bool(inside.all()):
            raise ValueError(f"{kind}: tables.entries must name the start of a brick, got {int(starts[~inside][0])}")
        if starts.numel() > (len(bricks) if left else 0):
            raise ValueError(f"{kind}: tables.entries must name each brick once, and none below {CELL_BITS} bits")
        found = bricks[(starts - root) // brick].flatten()
    place = torch.cat(places).long()
    # The zero is the length of a list that would start behind the end.
    ends = place + torch.cat([lists, lists.new_zeros(1)])[place.clamp(max=lists.numel())]
    if bool(((ends <= place) | (ends >= lists.numel())).any()):
        raise ValueError(
            f"{kind}: tables.lists must have a list of at least one centre at each place that entries name"
        )
    strangers = ((lists < 0) | (lists >= k)).cumsum(0)
    if not torch.equal(strangers[ends], strangers[place]):
        raise ValueError(f"{kind}: tables.lists must hold centres 0 to {k - 1}, got others")


def centre_grid(centres: Tensor, *, backend: str = "auto") -> CentreGrid:
    """A grid that makes ``nearest_centre(points, centres, grid=grid)`` fast for many fixed centres.

    Space is cut into grid cells, small among the centres and larger outside. Each has a list of all centres that are
    nearest to some point in it, so a query compares only a few centres. The result is exactly the one without a grid.
    On two threads of an AVX-512 machine, a query took 4 to 9 ns for any k, and a search of all centres 0.025 ns times
    k. For 4,096 centres, making the grid took 30 ms and 6 MB. So it pays from about 300 centres on, if they stay fixed
    for 100,000 queries. The worst case is thousands of centres on one sphere, all equally near to its middle: 44 MB,
    and several times the time to make it.

    `VoronoiDiagram.locate` makes and keeps a grid by itself where it pays.

    Args:
        centres: [k, 3] floating point, finite, k >= 1.
        backend: "auto", "native" (CPU) or "reference" (slow, for comparison).

    Raises:
        ValueError: a value that is not finite.

    Examples:
        >>> import torch
        >>> from voronerf import centre_grid, nearest_centre
        >>> centres = torch.rand(1000, 3, generator=torch.Generator().manual_seed(0))
        >>> grid = centre_grid(centres)
        >>> nearest_centre(centres[:4] + 1e-4, centres, grid=grid)
        tensor([0, 1, 2, 3], dtype=torch.int32)
    """
    given = Checked(_OP)
    given.tensor("centres", centres, FLOATING, "k", 3)
    if centres.is_meta:
        raise ValueError(f"{_OP}: centres must have values, got a tensor on the device meta")
    if len(centres) < 1:
        raise ValueError(f"{_OP}: centres must hold at least one centre, got none")
    dtype = torch.promote_types(centres.dtype, torch.float32)
    centres = centres.detach().to(dtype, copy=True).contiguous()
    if not bool(torch.isfinite(centres).all()):
        raise ValueError(f"{_OP}: centres must be finite, got NaN or infinity")
    run = backends.resolve(_OP, backend=backend, device=centres.device, dtype=dtype)
    return CentreGrid(centres, run(centres))
