"""Two regularisers, a distortion loss and an orientation loss, with their gradient. r rays, m samples (packed)."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import PLAIN, Implementation
from voronerf.ops._core.declare import declare
from voronerf.ops.render_loss.reference import scaled


def _prepare(arguments: Any) -> Any:
    return scaled("surface_gradient", arguments)


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
    """Adds two regularisers, a distortion loss and an orientation loss, and their gradient, in place.

    The means of these losses over the r rays, times ``distortion`` and ``orientation``, are added to ``loss``, and
    their gradient to the last column of ``gradient``. For samples with weights w and opacities a:

    - The distortion ``sum over i, j of w_i w_j |s_i - s_j| + sum of w_i^2 l_i / 3`` (Barron et al. 2022, "Mip-NeRF
      360", equation 15) is smallest if all light comes from one depth. Normalised depths go from 0 at ``near`` to 1 at
      ``far`` in equal steps of disparity, ``s = (1 / near - 1 / depth) / (1 / near - 1 / far)``, and a sample has the
      length ``l = delta / depth^2 / (1 / near - 1 / far)``. The background does not count.
    - The orientation loss ``sum of w_i max(0, a_i - a_{i+1})^2`` (after Verbin et al. 2022, "Ref-NeRF", equation 11,
      with the decrease of the opacity along the ray in place of the normal) is 0 if the opacity does not decrease from
      a visible sample to the next. The next sample must be adjacent: nearer than the sum of both lengths.

    Let T be the transmittance behind sample i, and v_i the derivative of a loss with respect to the weight w_i. The
    weights contribute ``delta (T v_i - sum over j > i of w_j v_j)`` to the derivative of the loss with respect to the
    density of sample i. Not differentiable.

    Args:
        loss: the loss, updated in place.
        gradient: the gradient of the loss with respect to the networks' outputs, contiguous, updated in place.
        density: the densities of the samples.
        depths: the distances of the samples along the rays, > 0 and ascending.
        deltas: the lengths of the samples' ray segments.
        weights: the rendering weights of the samples.
        ray_offsets: ray i owns samples ``ray_offsets[i]`` to ``ray_offsets[i + 1]``.
        near: the near ends of the rays, > 0.
        far: the far ends of the rays, beyond ``near``.
        distortion: the factor on the mean of the distortion.
        orientation: the factor on the mean of the orientation loss.
        hidden: the transmittance up to which a sample counts as hidden. Both losses ignore hidden samples, which have
            no gradient.
        density_scale: the factor on the density after its softplus, as for `render_loss`; None with ``activated``.
        activated: whether the gradient is with respect to the density itself.

    Raises:
        ValueError: a gradient that is not contiguous; both or neither of ``density_scale`` and ``activated``; offsets
            that decrease or exceed m (checked on the CPU only).

    Examples:
        >>> import torch
        >>> from voronerf.ops import surface_gradient
        >>> depths, deltas, offsets = torch.tensor([1.25, 2.5]), torch.full((2,), 0.1), torch.tensor([0, 2]).int()
        >>> ends = torch.tensor([1.0]), torch.tensor([5.0])
        >>> for light in (0.0, 0.5, 1.0):  # from a veil in front of a wall
        ...     weights = torch.tensor([light, 1 - light])
        ...     given = torch.tensor([6.93, 1e3]), depths, deltas, weights, offsets, *ends
        ...     loss, gradient = torch.tensor(0.0), torch.zeros(2, 4)
        ...     surface_gradient(loss, gradient, *given, distortion=1.0, orientation=0.0, activated=True)
        ...     print(f"{float(loss):.3f}")
        0.007
        0.258
        0.027
    """
