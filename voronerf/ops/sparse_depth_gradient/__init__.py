"""A loss on rays that end at known points (sparse depth) and its gradient. r rays, s of them with points, m samples."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import PLAIN, Implementation
from voronerf.ops._core.declare import declare
from voronerf.ops.render_loss.reference import scaled


def _prepare(arguments: Any) -> Any:
    if arguments.s > arguments.r:
        raise ValueError(
            f"sparse_depth_gradient: distances must have at most {arguments.r} entries (the number of rays), "
            f"got {arguments.s}"
        )
    return scaled("sparse_depth_gradient", arguments)


@declare(
    native=Implementation(("cpu",), (torch.float32,)),
    warp=PLAIN,
    small=["gradient"],
    writes=["loss", "gradient"],
    prepare=_prepare,
)
def sparse_depth_gradient(
    loss: Annotated[Tensor, "float32|float64 []"],
    gradient: Annotated[Tensor, "same [m, 4]"],
    density: Annotated[Tensor, "same [m]"],
    depths: Annotated[Tensor, "same [m]"],
    deltas: Annotated[Tensor, "same [m]"],
    weights: Annotated[Tensor, "same [m]"],
    ray_offsets: Annotated[Tensor, "int32 [r+1]"],
    distances: Annotated[Tensor, "same [s]"],
    *,
    factor: float,
    density_scale: Annotated[float | None, "positive"] = None,
    activated: bool = False,
    backend: str = "auto",
) -> None:
    """Adds a loss on rays that end at known points, and its gradient, in place.

    A sample of length ``delta`` at depth d is near the point at distance p on its ray if ``|d - p| <= 0.03 p + delta``.
    The loss of a ray is ``-log`` of the sum of the weights of its samples near the point; the sum is clamped to at
    least 0.001. This loss is the likelihood of Deng et al. 2022, "Depth-supervised NeRF", with a box in place of their
    Gaussian. Fog in front of the point reduces the sum. The derivative of the sum with respect to the density of a
    sample is ``delta (T near - S)``, where T is the transmittance behind the sample, S the part of the sum that is due
    to samples behind it, and ``near`` is 1 if the sample is near the point, otherwise 0. The mean of the s losses times
    ``factor`` is added to ``loss``, and its gradient to the last column of ``gradient``. If the weight of a sample near
    the point is NaN, the loss is NaN, and the ray has no gradient. Not differentiable.

    Args:
        loss: the loss, updated in place.
        gradient: the gradient of the loss with respect to the networks' outputs, contiguous, updated in place.
        density: the densities of the samples.
        depths: the distances of the samples along the rays.
        deltas: the lengths of the samples' ray segments.
        weights: the rendering weights of the samples.
        ray_offsets: ray i owns samples ``ray_offsets[i]`` to ``ray_offsets[i + 1]``.
        distances: the distance of the point on each of the first s rays, s <= r; NaN for no point.
        factor: the factor on the mean of the losses.
        density_scale: the factor on the density after its softplus, as for `render_loss`; None with ``activated``.
        activated: whether the gradient is with respect to the density itself.

    Raises:
        ValueError: a gradient that is not contiguous; more distances than rays; both or neither of ``density_scale``
            and ``activated``; offsets that decrease or exceed m (checked on the CPU only).

    Examples:
        >>> import torch
        >>> from voronerf.ops import sparse_depth_gradient
        >>> depths, deltas = torch.tensor([1.0, 2.0]), torch.full((2,), 0.1)  # fog, and a wall with a point
        >>> weights, offsets = torch.tensor([0.5, 0.5]), torch.tensor([0, 2], dtype=torch.int32)
        >>> given = torch.tensor([6.93, 1e3]), depths, deltas, weights, offsets, torch.tensor([2.0])
        >>> loss, gradient = torch.tensor(0.0), torch.zeros(2, 4)
        >>> sparse_depth_gradient(loss, gradient, *given, factor=1.0, activated=True)
        >>> loss, gradient[:, 3].abs().round(decimals=3)  # less fog reduces the loss
        (tensor(0.6931), tensor([0.1000, 0.0000]))
    """
