"""Centres that are spread evenly over a box."""

import torch
from torch import Tensor


def uniform_centres(box: Tensor, k: int) -> Tensor:
    """k centres spread evenly over a box, as close to a regular grid as k allows (the paper's "uniform" ablation).

    The box is cut across its longest side: into 2 equal parts if k is even, into 3 if k is divisible by 3, otherwise
    into 2 parts in proportion to their numbers of centres. Each part is cut in the same way, until it holds one centre,
    in its middle. All final parts have the same volume. In a cube, 8, 27, 64 ... give cubic grids, 12 gives 2 x 2 x 3,
    and 16 gives 4 x 2 x 2.

    Args:
        box: floating [2, 3], lowest and highest corner; flat boxes are allowed.
        k: number of centres, >= 1.

    Returns:
        [k, 3] in the dtype and on the device of `box`.

    Raises:
        ValueError: k < 1, a wrong shape, a value that is not finite, or a highest corner below the lowest.

    Examples:
        >>> import torch
        >>> from voronerf import uniform_centres
        >>> box = torch.tensor([[0.0, 0, 0], [2.0, 1, 1]])
        >>> uniform_centres(box, 2)
        tensor([[0.5000, 0.5000, 0.5000],
                [1.5000, 0.5000, 0.5000]])
    """
    if k < 1:
        raise ValueError(f"uniform_centres: k must be at least 1, got {k}")
    if tuple(box.shape) != (2, 3):
        raise ValueError(f"uniform_centres: box must have shape [2, 3], got {list(box.shape)}")
    low, high = box.tolist()
    if not bool(torch.isfinite(box).all()) or any(a > b for a, b in zip(low, high, strict=True)):
        raise ValueError(f"uniform_centres: box must be finite with box[0] <= box[1], got {box.tolist()}")

    def place(low: list[float], high: list[float], k: int) -> list[list[float]]:
        if k == 1:
            return [[(a + b) / 2 for a, b in zip(low, high, strict=True)]]
        if k % 2 == 0:
            shares = [k // 2] * 2
        elif k % 3 == 0:
            shares = [k // 3] * 3
        else:
            shares = [k // 2, k - k // 2]
        sides = [b - a for a, b in zip(low, high, strict=True)]
        # Rounding must not decide between equal sides: they count as equal up to one part in a million.
        axis = next(i for i, side in enumerate(sides) if side >= max(sides) * (1 - 1e-6))
        centres: list[list[float]] = []
        start, done = low[axis], 0
        for share in shares:
            done += share
            end = low[axis] + sides[axis] * done / k
            centres += place([*low[:axis], start, *low[axis + 1 :]], [*high[:axis], end, *high[axis + 1 :]], share)
            start = end
        return centres

    return torch.tensor(place(low, high, k), dtype=box.dtype, device=box.device)
