"""Which cell of a Voronoi diagram a point lies in. n points, k centres."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import COORDINATES, EVERYWHERE, Implementation
from voronerf.ops._core.checks import FLOATING, Checked

_OP = backends.declare(
    "nearest_centre", native=Implementation(EVERYWHERE, COORDINATES), warp=Implementation(EVERYWHERE, COORDINATES)
)


def nearest_centre(points: Tensor, centres: Tensor, *, backend: str = "auto") -> Tensor:
    """Index of the nearest centre of every point: ``argmin_c |x - v_c|``.

    Exact: the direct form of the distance is used, and ties go to the lowest index. A point that is not finite goes to
    cell 0. Not differentiable.

    Args:
        points: [n, 3] floating point, n < 2**31. float16 and bfloat16 are compared in float32.
        centres: [k, 3] floating point, finite, k >= 1.
        backend: "auto", "reference", "native" or "warp".

    Returns:
        cells int32 [n], in 0 to k - 1.

    Examples:
        >>> import torch
        >>> from voronerf import nearest_centre
        >>> points = torch.tensor([[0.1, 0.0, 0.0], [0.9, 0.0, 0.0], [0.4, 0.0, 0.0]])
        >>> centres = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
        >>> nearest_centre(points, centres)
        tensor([0, 1, 0], dtype=torch.int32)
    """
    given = Checked(_OP)
    given.tensor("points", points, FLOATING, "n", 3)
    given.tensor("centres", centres, FLOATING, "k", 3)
    if given.sizes["k"] < 1:
        raise ValueError(f"{_OP}: centres must hold at least one centre, got none")
    points, centres = of_one_dtype(points, centres)
    run = backends.resolve(_OP, backend=backend, device=points.device, dtype=points.dtype)
    cells: Tensor = run(points, centres)
    return cells


def of_one_dtype(points: Tensor, centres: Tensor) -> tuple[Tensor, Tensor]:
    """What is compared, in one type for all backends: float64 where either is, float32 otherwise."""
    if points.dtype is centres.dtype is torch.float32 and not (points.requires_grad or centres.requires_grad):
        return points, centres
    dtype = torch.promote_types(torch.promote_types(points.dtype, centres.dtype), torch.float32)
    return points.detach().to(dtype), centres.detach().to(dtype)
