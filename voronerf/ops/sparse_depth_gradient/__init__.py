"""How little of a ray's light comes from near a known point, with its gradient. s rays, m samples (packed)."""

from __future__ import annotations

from typing import Annotated

import torch
from torch import Tensor

from voronerf.ops._core.backends import PLAIN, Implementation
from voronerf.ops._core.declare import declare


@declare(native=Implementation(("cpu",), (torch.float32,)), warp=PLAIN)
def sparse_depth_gradient(
    density: Annotated[Tensor, "float32|float64 [m]"],
    depths: Annotated[Tensor, "same [m]"],
    deltas: Annotated[Tensor, "same [m]"],
    weights: Annotated[Tensor, "same [m]"],
    ray_offsets: Annotated[Tensor, "int32 [s+1]"],
    distances: Annotated[Tensor, "same [s]"],
    *,
    backend: str = "auto",
) -> tuple[Annotated[Tensor, "same []"], Annotated[Tensor, "same [m]"]]:
    """The sum of the loss of rays that end at known points, and its gradient to the densities of their samples.

    A sample is near the point if it lies within 0.03 of the distance of the point and its own length of it. The loss of
    a ray is ``-log`` of the sum of the weights of these samples, from 0.001 to 1: the likelihood of Deng et al. 2022,
    "Depth-supervised NeRF", with a box in the place of their Gaussian. Fog before the point takes from them. With the
    transmittance T behind a sample and the light S from points that lie behind it, the derivative of the sum by its
    density is ``delta (T near - S)``. Nothing is differentiable further.

    Args:
        density: float32 or float64 [m], of the samples.
        depths: [m], their distances along the rays; of the type of ``density``, like the next two.
        deltas: [m], their lengths.
        weights: [m], their contributions to the rays.
        ray_offsets: int32 [s + 1]: ray i owns samples ``ray_offsets[i]`` to ``ray_offsets[i + 1]``, counted from the
            first of all, which may be beyond 0; together all m.
        distances: [s], of the point that each ray ends at; NaN for none.
        backend: "auto", "reference", "native" or "warp".

    Returns:
        (loss [], gradient [m]).

    Raises:
        ValueError: on the CPU offsets that fall, or of more or fewer samples than m.

    Examples:
        >>> import torch
        >>> from voronerf.ops import sparse_depth_gradient
        >>> depths, deltas = torch.tensor([1.0, 2.0]), torch.full((2,), 0.1)  # fog, and a wall with a point
        >>> weights, offsets = torch.tensor([0.5, 0.5]), torch.tensor([0, 2], dtype=torch.int32)
        >>> given = torch.tensor([6.93, 1e3]), depths, deltas, weights, offsets, torch.tensor([2.0])
        >>> loss, gradient = sparse_depth_gradient(*given)
        >>> loss, gradient.abs().round(decimals=3)  # less fog is better
        (tensor(0.6931), tensor([0.1000, 0.0000]))
    """
