"""Balancing a diagram's cells. m samples, k centres."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import PLAIN, Implementation
from voronerf.ops._core.declare import declare


def _prepare(arguments: Any) -> Any:
    if arguments.k < 1:
        raise ValueError("balance_centres: centres must hold at least one centre, got none")
    return arguments


@declare(native=Implementation(("cpu",), (torch.float32,)), warp=PLAIN, prepare=_prepare)
def balance_centres(
    samples: Annotated[Tensor, "float32 [m, 3]"],
    masses: Annotated[Tensor, "float64 [m]"],
    centres: Annotated[Tensor, "float32 [k, 3]"],
    *,
    steps: Annotated[int, "0.."] = 500,
    alpha: float = 0.05,
    neighbours: Annotated[int, "1.."] = 8,
    backend: str = "auto",
) -> tuple[Annotated[Tensor, "float32 [k, 3]"], Annotated[Tensor, "float64 [k]"]]:
    """Moves all centres `steps` times, towards cells of equal mass; see ``voronerf.diagram.balance``.

    ``v_i <- v_i + alpha * mean_{j in N(i)} (v_j - v_i) * (W_j - W_i) / norm_i`` (Elsner et al. 2023, section 3.2). N(i)
    are the `neighbours` closest centres, or all others if there are fewer; ties go to the lowest index. W_i is the mass
    of the samples in cell i, and norm_i the largest mass among cell i and its neighbours N(i). Updates are computed in
    float64 and stored in float32. The result is deterministic. Not differentiable.

    Args:
        samples: the positions of the samples, finite.
        masses: the masses of the samples, >= 0 and finite.
        centres: the centres to start from, finite, k >= 1.
        steps: the number of updates, >= 0.
        alpha: the step size, no unit.
        neighbours: the size of N(i), >= 1.

    Returns:
        Centres float32 [k, 3]; weights float64 [k], the mass in each cell of the returned centres.

    Examples:
        >>> import torch
        >>> from voronerf.ops import balance_centres
        >>> samples = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0], [9.0, 0, 0]])
        >>> masses = torch.ones(4, dtype=torch.float64)
        >>> centres = torch.tensor([[0.0, 0, 0], [9.0, 0, 0]])
        >>> moved, weights = balance_centres(samples, masses, centres, steps=100)
        >>> weights  # they were 3 and 1
        tensor([2., 2.], dtype=torch.float64)
    """
