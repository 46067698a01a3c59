"""Triples of rays from where no camera was. r rays."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import PLAIN, Implementation
from voronerf.ops._core.declare import declare


def check_triples(op: str, given: Any) -> None:
    """ValueError for more triples than r rays have."""
    if 3 * given.triples > given.r:
        raise ValueError(f"{op}: triples must be at most a third of the {given.r} rays, got {given.triples}")


def _prepare(given: Any) -> Any:
    check_triples("unseen_rays", given)
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
    triples: Annotated[int, "0.."],
    move: Annotated[float, "positive"],
    tilt: Annotated[float, "positive"],
    backend: str = "auto",
) -> None:
    """Makes the last rays of a batch triples of neighbours from where no camera was, in place.

    Ray ``r - 3 triples + i`` keeps its direction d, and its origin moves at random, along each axis by at most
    ``move``. Rays ``r - 2 triples + i`` and ``r - triples + i`` begin there too, on both sides of it: in the directions
    ``d + t`` and ``d - t``, normalised, with t across d. Along each axis t is at most ``tilt`` times ``2 ** -4u``, with
    a random number u in 0..1, so that neighbours are as often close as far. Not differentiable.

    Args:
        origins: contiguous.
        directions: contiguous unit vectors.
        seed: each number is a hash of it and of the ray.
        triples: how many, at most r / 3.
        move: of an origin along an axis, at most.
        tilt: of a direction along an axis, at most.

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
