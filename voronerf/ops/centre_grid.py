"""A table that finds the nearest of many centres in a few steps, for centres that stay where they are. k centres."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from voronerf import backends
from voronerf.backends import COORDINATES, Implementation
from voronerf.checks import check_dtype, check_same_device, check_shape
from voronerf.reference.centre_grid import GridTables

_OP = backends.declare(
    "centre_grid",
    native=Implementation(("cpu",), COORDINATES),
)


@dataclass(frozen=True, eq=False)
class CentreGrid:
    """A grid over all of space with a list of candidate centres in each cell: made by `centre_grid`, for
    `nearest_centre`.

    Attributes:
        centres: float32 or float64 [k, 3], a copy of the centres that the grid was made from.
        weights: [k] in the same dtype, or None.
        tables: the lists and their index; csrc/geometry/centre_grid.h describes them.

    Examples:
        >>> import torch
        >>> from voronerf import centre_grid
        >>> centres = torch.eye(3)
        >>> grid = centre_grid(centres)
        >>> grid.belongs_to(centres, None), grid.belongs_to(centres + 1, None)
        (True, False)
    """

    centres: Tensor
    weights: Tensor | None
    tables: GridTables

    @property
    def nbytes(self) -> int:
        """Memory of the tables."""
        return sum(tensor.nbytes for tensor in self.tables[:4])

    def fits(self, centres: Tensor, weights: Tensor | None) -> bool:
        """Whether as many centres have a place in the tables, and weights as well; reads shapes alone."""
        return centres.shape == self.centres.shape and (weights is None) == (self.weights is None)

    def belongs_to(self, centres: Tensor, weights: Tensor | None) -> bool:
        """Whether the grid was made from these very centres and weights. Reads them, on CUDA from the host."""
        if not self.fits(centres, weights):
            return False
        # In float64, which holds all of them: centres that were rounded since have other borders.
        if not torch.equal(centres.double(), self.centres.double()):
            return False
        return weights is None or self.weights is None or torch.equal(weights.double(), self.weights.double())


def centre_grid(centres: Tensor, *, weights: Tensor | None = None, backend: str = "auto") -> CentreGrid:
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
        weights: [k] floating point, finite, or None: a power diagram (squared scene units).
        backend: "auto", "native" (CPU) or "reference" (slow, for comparison).

    Raises:
        ValueError: shapes, devices, an unknown backend, or a value that is not finite.
        TypeError: dtypes.
        BackendUnavailable: the named backend cannot run here.

    Examples:
        >>> import torch
        >>> from voronerf import centre_grid, nearest_centre
        >>> centres = torch.rand(1000, 3, generator=torch.Generator().manual_seed(0))
        >>> grid = centre_grid(centres)
        >>> nearest_centre(centres[:4] + 1e-4, centres, grid=grid)
        tensor([0, 1, 2, 3], dtype=torch.int32)
    """
    sizes: dict[str, int] = {}
    check_shape(_OP, "centres", centres, ("k", 3), sizes)
    check_dtype(_OP, "centres", centres)
    if weights is not None:
        check_shape(_OP, "weights", weights, ("k",), sizes)
        check_dtype(_OP, "weights", weights)
    check_same_device(_OP, centres=centres, weights=weights)
    if sizes["k"] < 1:
        raise ValueError(f"{_OP}: centres must hold at least one centre, got none")
    dtype = torch.promote_types(centres.dtype, torch.float32)
    if weights is not None:
        dtype = torch.promote_types(dtype, weights.dtype)
        weights = weights.detach().to(dtype, copy=True).contiguous()
    centres = centres.detach().to(dtype, copy=True).contiguous()
    for name, tensor in (("centres", centres), ("weights", weights)):
        if tensor is not None and not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"{_OP}: {name} must be finite, got NaN or infinity")
    run = backends.resolve(_OP, backend=backend, device=centres.device, dtype=dtype)
    return CentreGrid(centres, weights, run(centres, weights=weights))
