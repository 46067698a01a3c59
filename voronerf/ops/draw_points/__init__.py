"""Random points in a box. n points."""

from __future__ import annotations

from typing import Annotated

import torch
from torch import Tensor

from voronerf.ops._core.backends import EVERYWHERE, PLAIN, Implementation
from voronerf.ops._core.declare import declare


@declare(native=Implementation(EVERYWHERE, (torch.int32,)), warp=PLAIN)
def draw_points(
    seed: Annotated[Tensor, "int32 [1]"],
    count: Annotated[int, "1..134217728"],
    box: Annotated[Tensor, "float32 [2, 3]"],
    *,
    backend: str = "auto",
) -> Annotated[Tensor, "float32 [count, 3]"]:
    """Draws points uniformly from a box.

    This equals drawing a random voxel of a regular grid in the box, then a random point in it. Points are hashes of the
    seed and of their indices, the same on every backend and on any number of threads. Not differentiable.

    Args:
        seed: the seed of the hashes.
        count: the number of points, n, 1 to 2**27.
        box: the lowest and the highest corner.

    Returns:
        float32 [n, 3], the points.

    Examples:
        >>> import torch
        >>> from voronerf.ops import draw_points
        >>> box = torch.tensor([[0.0, 0, 5], [1.0, 2, 6]])
        >>> points = draw_points(torch.tensor([7], dtype=torch.int32), 1000, box)
        >>> bool(((points >= box[0]) & (points <= box[1])).all()), points.shape
        (True, torch.Size([1000, 3]))
    """
