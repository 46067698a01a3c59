"""Gradients of samples near the camera, made smaller. m samples, c outputs of the networks."""

from __future__ import annotations

from typing import Annotated

import torch
from torch import Tensor

from voronerf.ops._core.backends import EVERYWHERE, PLAIN, Implementation
from voronerf.ops._core.declare import declare


@declare(native=Implementation(EVERYWHERE, (torch.float32,)), warp=PLAIN, small=["gradient"], writes=["gradient"])
def scale_gradient(
    gradient: Annotated[Tensor, "float32|float64 [m, c]"],
    depths: Annotated[Tensor, "same [m]"],
    full: Annotated[float, "positive"],
    *,
    backend: str = "auto",
) -> None:
    """Multiplies the gradients of samples by the square of their distance from the camera, up to 1, in place.

    A camera sees the space before it with more rays, and more samples, than others do: without this, fog that only one
    view shows is learnt there first. Source: Philip and Deschaintre 2023, "Floaters No More: Radiance Field Gradient
    Scaling for Improved Near-Camera Training". Not differentiable.

    Args:
        gradient: contiguous.
        depths: of the samples.
        full: The distance from which gradients are whole.

    Raises:
        ValueError: a gradient that is not contiguous.

    Examples:
        >>> import torch
        >>> from voronerf.ops import scale_gradient
        >>> gradient = torch.ones(3, 2)
        >>> scale_gradient(gradient, torch.tensor([1.0, 4.0, 9.0]), 4.0)
        >>> gradient[:, 0]
        tensor([0.0625, 1.0000, 1.0000])
    """
