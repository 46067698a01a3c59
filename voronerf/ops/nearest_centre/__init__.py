"""Which cell of a Voronoi diagram a point lies in. n points, k centres."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf import backends
from voronerf.backends import COORDINATES, EVERYWHERE, Implementation
from voronerf.checks import check_count, check_dtype, check_same_device, check_shape
from voronerf.ops.centre_grid import CentreGrid
from voronerf.ops.nearest_centre_grid import nearest_centre_grid

_OP = backends.declare(
    "nearest_centre",
    native=Implementation(EVERYWHERE, COORDINATES),
    warp=Implementation(EVERYWHERE, COORDINATES),
)


def nearest_centre(
    points: Tensor,
    centres: Tensor,
    *,
    weights: Tensor | None = None,
    grid: CentreGrid | None = None,
    backend: str = "auto",
) -> Tensor:
    """Index of the nearest centre of every point: ``argmin_c |x - v_c|^2 - w_c``.

    Exact: the direct form of the distance is used, and ties go to the lowest index. A point that is not finite goes to
    cell 0. Not differentiable.

    Args:
        points: [n, 3] floating point, n < 2**31. float16 and bfloat16 are compared in float32.
        centres: [k, 3] floating point, finite, k >= 1.
        weights: [k] floating point or None: a power diagram, in which larger weights give larger cells (squared scene
            units).
        grid: made by ``centre_grid`` from these centres and weights, or None. The result is the same, and faster for
            hundreds of centres. With a grid, "native" runs on the CPU only.
        backend: "auto", "reference", "native" or "warp".

    Returns:
        cells int32 [n], in 0 to k - 1.

    Raises:
        ValueError: shapes, devices, an unknown backend, or a grid of other centres or weights.
        TypeError: dtypes.
        BackendUnavailable: the named backend cannot run here.

    Examples:
        >>> import torch
        >>> from voronerf import nearest_centre
        >>> points = torch.tensor([[0.1, 0.0, 0.0], [0.9, 0.0, 0.0], [0.4, 0.0, 0.0]])
        >>> centres = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
        >>> nearest_centre(points, centres)
        tensor([0, 1, 0], dtype=torch.int32)
        >>> nearest_centre(points, centres, weights=torch.tensor([0.0, 0.5]))  # the second cell is larger
        tensor([0, 1, 1], dtype=torch.int32)
    """
    sizes: dict[str, int] = {}
    check_shape(_OP, "points", points, ("n", 3), sizes)
    check_shape(_OP, "centres", centres, ("k", 3), sizes)
    check_dtype(_OP, "points", points)
    check_dtype(_OP, "centres", centres)
    if weights is not None:
        check_shape(_OP, "weights", weights, ("k",), sizes)
        check_dtype(_OP, "weights", weights)
    check_same_device(_OP, points=points, centres=centres, weights=weights)
    check_count(_OP, "points", sizes["n"])
    if sizes["k"] < 1:
        raise ValueError(f"{_OP}: centres must hold at least one centre, got none")
    # One type for all backends: float64 when any argument is, float32 otherwise.
    dtype = torch.promote_types(torch.promote_types(points.dtype, centres.dtype), torch.float32)
    if weights is not None:
        dtype = torch.promote_types(dtype, weights.dtype)
        weights = weights.detach().to(dtype)
    points, centres = points.detach().to(dtype), centres.detach().to(dtype)
    if grid is not None:
        return nearest_centre_grid(points, centres, weights, grid, backend)
    run = backends.resolve(_OP, backend=backend, device=points.device, dtype=dtype)
    cells: Tensor = run(points, centres, weights=weights)
    return cells
