"""How little of a ray's light comes from near a known point, with its gradient. s of r rays, m samples (packed)."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import PLAIN, Implementation
from voronerf.ops._core.declare import declare
from voronerf.ops.render_loss.reference import scaled


def _prepare(given: Any) -> Any:
    if given.s > given.r:
        raise ValueError(f"sparse_depth_gradient: distances must be of at most the {given.r} rays, got {given.s}")
    return scaled("sparse_depth_gradient", given)


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
    """Adds the loss of rays that end at known points, and its gradient, to those of ``render_loss_gradient``, in place.

    A sample is near the point if it lies within 0.03 of the distance of the point and its own length of it. The loss of
    a ray is ``-log`` of the sum of the weights of these samples, at least 0.001: the likelihood of Deng et al. 2022,
    "Depth-supervised NeRF", with a box in the place of their Gaussian. Fog before the point takes from them. With the
    transmittance T behind a sample and the light S from points that lie behind it, the derivative of the sum by its
    density is ``delta (T near - S)``. What is added is ``factor`` times the mean of the s losses, and to the last
    column of the gradient that of it. A weight that is NaN makes the loss NaN if it is near the point, and its ray has
    no gradient. Nothing is differentiable further.

    Args:
        loss: to which the loss is added.
        gradient: contiguous, to the outputs of the networks.
        density: of the samples.
        depths: their distances along the rays.
        deltas: their lengths.
        weights: their contributions to the rays.
        ray_offsets: ray i owns samples ``ray_offsets[i]`` to ``ray_offsets[i + 1]``.
        distances: of the point that each of the first s rays ends at, s <= r; NaN for none.
        factor: on the mean of the losses.
        density_scale: factor on the density behind its softplus, as for `render_loss`; None with ``activated``.
        activated: whether the gradient is to the density itself.

    Raises:
        ValueError: a gradient that is not contiguous; more distances than rays; ``density_scale`` with ``activated``,
            or neither; on the CPU offsets that fall or exceed m.

    Examples:
        >>> import torch
        >>> from voronerf.ops import sparse_depth_gradient
        >>> depths, deltas = torch.tensor([1.0, 2.0]), torch.full((2,), 0.1)  # fog, and a wall with a point
        >>> weights, offsets = torch.tensor([0.5, 0.5]), torch.tensor([0, 2], dtype=torch.int32)
        >>> given = torch.tensor([6.93, 1e3]), depths, deltas, weights, offsets, torch.tensor([2.0])
        >>> loss, gradient = torch.tensor(0.0), torch.zeros(2, 4)
        >>> sparse_depth_gradient(loss, gradient, *given, factor=1.0, activated=True)
        >>> loss, gradient[:, 3].abs().round(decimals=3)  # less fog is better
        (tensor(0.6931), tensor([0.1000, 0.0000]))
    """
