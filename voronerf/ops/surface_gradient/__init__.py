"""How far the light of rays is from that of one surface, with its gradient. r rays, m samples of all rays (packed)."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import PLAIN, Implementation
from voronerf.ops._core.declare import declare
from voronerf.ops.render_loss.reference import scaled


def _prepare(given: Any) -> Any:
    return scaled("surface_gradient", given)


@declare(
    native=Implementation(("cpu",), (torch.float32,)),
    warp=PLAIN,
    small=["gradient"],
    writes=["loss", "gradient"],
    prepare=_prepare,
)
def surface_gradient(
    loss: Annotated[Tensor, "float32|float64 []"],
    gradient: Annotated[Tensor, "same [m, 4]"],
    density: Annotated[Tensor, "same [m]"],
    depths: Annotated[Tensor, "same [m]"],
    deltas: Annotated[Tensor, "same [m]"],
    weights: Annotated[Tensor, "same [m]"],
    ray_offsets: Annotated[Tensor, "int32 [r+1]"],
    near: Annotated[Tensor, "same [r]"],
    far: Annotated[Tensor, "same [r]"],
    *,
    distortion: float,
    orientation: float,
    hidden: Annotated[float, "[0, 1)"] = 0.0,
    density_scale: Annotated[float | None, "positive"] = None,
    activated: bool = False,
    backend: str = "auto",
) -> None:
    """Adds two losses of rays whose light does not come from one surface, and their gradient, in place.

    To the loss of ``render_loss_gradient``, ``distortion`` and ``orientation`` times the means over the r rays of these
    are added, and to the last column of the gradient that of both, for samples with weights w and opacities a:

    - The distortion ``sum over i, j of w_i w_j |s_i - s_j| + sum of w_i^2 l_i / 3`` (Barron et al. 2022, "Mip-NeRF
      360", equation 15) is least if all light comes from one place. Places go from 0 at ``near`` to 1 at ``far`` in
      equal steps of disparity, ``s = (1 / near - 1 / depth) / (1 / near - 1 / far)``, and a sample has the length
      ``l = delta / depth^2 / (1 / near - 1 / far)``. Light that is left counts nowhere.
    - The orientation loss ``sum of w_i max(0, a_i - a_{i+1})^2`` (after Verbin et al. 2022, "Ref-NeRF", equation 11,
      with the fall of the opacity along the ray for the normal) is 0 if what is seen gets no thinner from a sample to
      the next. That has to lie right behind it: nearer than both are long.

    With the transmittance T behind a sample and the slopes v to the weights, the derivative of a loss through them is
    ``delta (T v_i - sum over j > i of w_j v_j)``. Nothing is differentiable further.

    Args:
        loss: to which the loss is added.
        gradient: contiguous, to the outputs of the networks.
        density: of the samples.
        depths: their distances along the rays, > 0 and rising.
        deltas: their lengths.
        weights: their contributions to the rays.
        ray_offsets: ray i owns samples ``ray_offsets[i]`` to ``ray_offsets[i + 1]``.
        near: > 0, where the rays begin.
        far: where they end, beyond ``near``.
        distortion: factor on the mean of the first loss.
        orientation: factor on that of the second.
        hidden: share of the light; samples that no more than it reaches count nowhere, and have no gradient.
        density_scale: factor on the density behind its softplus, as for `render_loss`; None with ``activated``.
        activated: whether the gradient is to the density itself.

    Raises:
        ValueError: a gradient that is not contiguous; ``density_scale`` with ``activated``, or neither; on the CPU
            offsets that fall or exceed m.

    Examples:
        >>> import torch
        >>> from voronerf.ops import surface_gradient
        >>> depths, deltas, offsets = torch.tensor([1.25, 2.5]), torch.full((2,), 0.1), torch.tensor([0, 2]).int()
        >>> ends = torch.tensor([1.0]), torch.tensor([5.0])
        >>> for light in (0.0, 0.5, 1.0):  # of a veil before a wall
        ...     weights = torch.tensor([light, 1 - light])
        ...     given = torch.tensor([6.93, 1e3]), depths, deltas, weights, offsets, *ends
        ...     loss, gradient = torch.tensor(0.0), torch.zeros(2, 4)
        ...     surface_gradient(loss, gradient, *given, distortion=1.0, orientation=0.0, activated=True)
        ...     print(f"{float(loss):.3f}")
        0.007
        0.258
        0.027
    """
