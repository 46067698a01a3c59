"""Intersection of rays with the scene's box. r rays; distances are along the unit direction, in world units."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops.formulas import meet_box


def intersect_box(
    origins: Tensor, directions: Tensor, box: Tensor | None, near: float, far: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the part of each ray between `near` and `far` that lies in an axis-aligned box (slab method).

    Args:
        origins: [r, 3], the origins of the rays.
        directions: [r, 3], unit directions; components may be zero.
        box: [2, 3], lowest and highest corner, or None for all of space.
        near: The nearest distance of interest, >= 0.
        far: The farthest distance of interest.

    Returns:
        (near [r], far [r], hit bool [r]). A ray that misses the box has hit False and far == near, so its samples
        have no extent. A ray that only touches the box misses it.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import intersect_box
        >>> origins = torch.tensor([[-3.0, 0.5, 0.5], [-3.0, 2.0, 0.5]])
        >>> directions = torch.tensor([[1.0, 0, 0], [1.0, 0, 0]])
        >>> box = torch.tensor([[0.0, 0, 0], [1.0, 1, 1]])
        >>> near, far, hit = intersect_box(origins, directions, box, 0.0, 10.0)
        >>> near[hit], far[hit], hit
        (tensor([3.]), tensor([4.]), tensor([ True, False]))
    """
    if directions.shape != origins.shape or origins.dim() != 2 or origins.shape[1] != 3:
        raise ValueError(
            "intersect_box: origins and directions must have the same shape [r, 3], "
            f"got {list(origins.shape)} and {list(directions.shape)}"
        )
    if not 0 <= near < far:
        raise ValueError(f"intersect_box: near and far must satisfy 0 <= near < far, got {near} and {far}")
    if box is None:
        first = torch.full_like(origins[:, 0], near)
        return first, torch.full_like(first, far), torch.ones_like(first, dtype=torch.bool)
    if box.shape != (2, 3):
        raise ValueError(f"intersect_box: box must have shape [2, 3], got {list(box.shape)}")
    enter, leave = meet_box(origins, directions, box, near, far)
    return enter, leave, leave > enter
