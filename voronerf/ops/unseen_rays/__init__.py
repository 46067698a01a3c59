"""Triples of neighbouring rays from positions without a camera. r rays."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import PLAIN, Implementation
from voronerf.ops._core.declare import declare


def check_triples(op: str, arguments: Any) -> None:
    """Raises ValueError for more triples than fit in r rays."""
    if 3 * arguments.triples > arguments.r:
        raise ValueError(f"{op}: triples must be at most a third of the {arguments.r} rays, got {arguments.triples}")


def _prepare(arguments: Any) -> Any:
    check_triples("unseen_rays", arguments)
    return arguments


@declare(
    native=Implementation(("cpu",), (torch.float32,)),
    warp=PLAIN,
    writes=["origins", "directions"],
    prepare=_prepare,
)
def unseen_rays(
    origins: Annotated[Tensor, "float32|float64 [r, 3]"],
    directions: Annotated[Tensor, "same [r, 3]"],
    seed: Annotated[Tensor, "int32 [1]"],
    *,
    triples: Annotated[int, "0.."],
    move: Annotated[float, "positive"],
    tilt: Annotated[float, "positive"],
    backend: str = "auto",
) -> None:
    """Replaces the last rays of a batch by triples of neighbouring rays from positions without a camera, in place.

    Ray ``r - 3 triples + i`` keeps its direction d, and its origin moves randomly, by at most ``move`` along each axis.
    Rays ``r - 2 triples + i`` and ``r - triples + i`` get the same origin and the directions ``d + t`` and ``d - t``,
    normalised. t is a random vector whose coordinates are at most ``tilt`` times ``2 ** -4u``, projected to be
    orthogonal to d. u is a random number in 0 to 1, so that the angles to the neighbours are distributed evenly over
    four octaves. Not differentiable.

    Args:
        origins: the origins of the rays, contiguous.
        directions: the directions of the rays, contiguous unit vectors.
        seed: the seed; each random number is a hash of the seed and of the ray.
        triples: the number of triples, at most r / 3.
        move: the largest move of an origin along an axis.
        tilt: the largest coordinate of t before the projection.

    Raises:
        ValueError: more triples than a third of the rays; tensors that are not contiguous.

    Examples:
        >>> import torch
        >>> from voronerf.ops import unseen_rays
        >>> origins, directions = torch.ones(5, 3), torch.eye(3)[[0, 1, 2, 0, 0]]
        >>> unseen_rays(origins, directions, torch.tensor([7], dtype=torch.int32), triples=1, move=0.1, tilt=0.1)
        >>> (origins[:2] == 1).all(), torch.equal(origins[2], origins[4])
        (tensor(True), True)
        >>> torch.allclose(directions[3] + directions[4], 2 * directions[2], atol=0.05)
        True
    """
