"""Volume rendering. r rays, s samples of a ray, m samples of all rays (packed), c channels."""

from __future__ import annotations

from typing import Annotated

from torch import Tensor

from voronerf.ops._core.backends import EVERYWHERE, FLOATS, PLAIN, Implementation
from voronerf.ops._core.declare import declare
from voronerf.ops.composite.reference import Composite


@declare(
    native=Implementation(EVERYWHERE, FLOATS),
    warp=PLAIN,
    smooth=["sigma", "rgb", "depths", "deltas", "background"],
    small=["sigma"],
)
def composite(
    sigma: Annotated[Tensor, "floating [m] if ray_offsets else [r, s]"],
    rgb: Annotated[Tensor, "same [m, c] if ray_offsets else [r, s, c]"],
    depths: Annotated[Tensor, "same [m] if ray_offsets else [r, s]"],
    deltas: Annotated[Tensor, "same [m] if ray_offsets else [r, s]"],
    *,
    ray_offsets: Annotated[Tensor | None, "int32 [r+1]"] = None,
    background: Annotated[Tensor | None, "same [c] or [r, c]"] = None,
    backend: str = "auto",
) -> Composite:
    """Renders the colour, opacity and depth of rays from the density and colour of their samples (volume rendering).

    ``weight_i = T_i (1 - exp(-sigma_i delta_i))`` with ``T_i = exp(-sum over j < i of sigma_j delta_j)``: Max 1995, and
    Mildenhall et al. 2020, equation 3. The samples of a ray are in order of depth. Infinite density is opaque, unless
    its delta is 0. A NaN sample affects only its own ray.

    Args:
        sigma: the density per unit of length, at least 0.
        rgb: the colours, or other channels.
        depths: the distance of each sample along its ray.
        deltas: the length of the ray segment of each sample, at least 0.
        ray_offsets: the offsets of packed samples: ray i owns samples ``ray_offsets[i]`` to ``ray_offsets[i + 1]``,
            possibly none. None for the dense form.
        background: a colour added with weight 1 - opacity. A ray without samples shows only the background.

    All floating-point arguments share one dtype, float16 to float64, and all are differentiable. Sums have at least
    float32 precision.

    Returns:
        Composite(colour [r, c], opacity [r], depth [r], weights in the shape of sigma). ``depth`` is the sum of weight
        times depth and is not divided by the opacity.

    Raises:
        ValueError: the offsets decrease or exceed m (checked on the CPU only).

    Examples:
        >>> import torch
        >>> from voronerf import composite
        >>> sigma = torch.tensor([[0.0, float("inf"), 1.0]])  # one ray: air, a wall, a sample behind it
        >>> rgb = torch.tensor([[[0.0, 0, 0], [1.0, 0, 0], [0.0, 1, 0]]])
        >>> depths, deltas = torch.tensor([[1.0, 2.0, 3.0]]), torch.ones(1, 3)
        >>> result = composite(sigma, rgb, depths, deltas)
        >>> result.colour, result.depth, result.weights
        (tensor([[1., 0., 0.]]), tensor([2.]), tensor([[0., 1., 0.]]))
    """
