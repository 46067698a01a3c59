"""Pairs of rays from where no camera was. r rays."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import PLAIN, Implementation
from voronerf.ops._core.declare import declare


def check_pairs(op: str, given: Any) -> None:
    """ValueError for more pairs than r rays have."""
    if 2 * given.pairs > given.r:
        raise ValueError(f"{op}: pairs must be at most half of the {given.r} rays, got {given.pairs}")


def _prepare(given: Any) -> Any:
    check_pairs("unseen_rays", given)
    return given


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
    pairs: Annotated[int, "0.."],
    move: Annotated[float, "positive"],
    tilt: Annotated[float, "positive"],
    backend: str = "auto",
) -> None:
    """Makes the last rays of a batch pairs of neighbours from where no camera was, in place.

    Ray ``r - 2 pairs + i`` keeps its direction, and its origin moves at random, along each axis by at most ``move``.
    Ray ``r - pairs + i`` begins there too, in a direction that differs at random by at most ``tilt`` along each axis
    before it is normalised. Not differentiable.

    Args:
        origins: contiguous.
        directions: contiguous unit vectors.
        seed: each number is a hash of it and of the ray.
        pairs: how many, at most r / 2.
        move: of an origin along an axis, at most.
        tilt: of a direction along an axis, at most.

    Raises:
        ValueError: more pairs than half of the rays; tensors that are not contiguous.

    Examples:
        >>> import torch
        >>> from voronerf.ops import unseen_rays
        >>> origins, directions = torch.ones(4, 3), torch.eye(3)[[0, 1, 2, 0]]
        >>> unseen_rays(origins, directions, torch.tensor([7], dtype=torch.int32), pairs=1, move=0.1, tilt=0.01)
        >>> (origins[:2] == 1).all(), torch.equal(origins[2], origins[3]), (directions[2] - directions[3]).norm() < 0.02
        (tensor(True), True, tensor(True))
    """
