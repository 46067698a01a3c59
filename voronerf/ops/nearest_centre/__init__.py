"""Which cell of a Voronoi diagram a point lies in. n points, k centres."""

from __future__ import annotations

from typing import Annotated

from torch import Tensor

from voronerf.ops._core.backends import COORDINATES, EVERYWHERE, Implementation
from voronerf.ops._core.declare import declare


@declare(
    native=Implementation(EVERYWHERE, COORDINATES),
    warp=Implementation(EVERYWHERE, COORDINATES),
    filled={"k": "centres must hold at least one centre, got none"},
    compared=["points", "centres"],
)
def nearest_centre(
    points: Annotated[Tensor, "floating [n, 3]"],
    centres: Annotated[Tensor, "floating [k, 3]"],
    *,
    backend: str = "auto",
) -> Annotated[Tensor, "int32 [n]"]:
    """Index of the nearest centre of every point: ``argmin_c |x - v_c|``.

    Exact: the direct form of the distance is used, and ties go to the lowest index. A point that is not finite goes to
    cell 0. Not differentiable.

    Args:
        points: n < 2**31. float16 and bfloat16 are compared in float32.
        centres: finite, k >= 1.

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
