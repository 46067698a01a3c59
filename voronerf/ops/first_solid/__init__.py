"""The first of some solids on rays. r rays, m solids."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import Implementation
from voronerf.ops._core.checks import INDEX, LIKE_FIRST, Checked, check_range
from voronerf.ops.first_solid.reference import KINDS, Solids

_OP = backends.declare("first_solid", native=Implementation(("cpu",), (torch.float32,)))


def first_solid(origins: Tensor, directions: Tensor, solids: Solids, *, backend: str = "auto") -> tuple[Tensor, Tensor]:
    """The first solid on each ray; of several at one distance, the one with the lowest number.

    Rays start outside of all solids; one that starts inside of the box around a torus does not see it. Not
    differentiable.

    Args:
        origins: float32 or float64 [r, 3], or [1, 3] where all rays start from the same point.
        directions: [r, 3] unit, or [1, 3] where all rays are parallel.
        solids: m of them; it is faster where those that stand together follow each other.
        backend: "auto", "reference" or "native".

    Returns:
        Distance [r], infinite for a miss; number of the solid, int32 [r], 0 for a miss.

    Raises:
        ValueError: numbers of origins and directions that differ where neither is 1; on the CPU other kinds.

    Examples:
        >>> import torch
        >>> from voronerf.ops import Solids, first_solid
        >>> ball = Solids(torch.tensor([1]).int(), torch.zeros(1, 3), torch.eye(3)[None], torch.tensor([[4.0, 0, 0]]))
        >>> first_solid(torch.tensor([[5.0, 0, 0]]), torch.tensor([[-1.0, 0, 0], [1.0, 0, 0]]), ball)
        (tensor([3., inf]), tensor([0, 0], dtype=torch.int32))
    """
    if not isinstance(solids, Solids):
        raise TypeError(f"{_OP}: solids must be Solids, got {type(solids).__name__}")
    given = Checked(_OP)
    given.tensor("origins", origins, (torch.float32, torch.float64), "o", 3)
    given.tensor("directions", directions, LIKE_FIRST, "d", 3)
    given.tensor("kinds", solids.kinds, INDEX, "m")
    given.tensor("centres", solids.centres, LIKE_FIRST, "m", 3)
    given.tensor("turns", solids.turns, LIKE_FIRST, "m", 3, 3)
    given.tensor("measures", solids.measures, LIKE_FIRST, "m", 3)
    o, d = given.sizes["o"], given.sizes["d"]
    if o != d and o != 1 and d != 1:
        raise ValueError(f"{_OP}: directions must be as many as the {o} origins, or one, got {d}")
    check_range(_OP, "kinds", solids.kinds, len(KINDS))
    run = backends.resolve(_OP, backend=backend, device=origins.device, dtype=origins.dtype)
    depth, number = run(origins.detach(), directions.detach(), Solids(*(each.detach() for each in solids)))
    return depth, number
