"""Losses along rays, with their gradients with respect to weights and densities. r rays, m samples of all rays.

`rendered_gradient` carries these gradients on to the outputs of the networks, for all losses at once.
"""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import PLAIN, Implementation
from voronerf.ops._core.declare import declare
from voronerf.ops.unseen_rays import check_triples

_HERE: Any = {
    "native": Implementation(("cpu",), (torch.float32,), file="ray_losses"),
    "warp": PLAIN,
    "reference": Implementation(file="ray_losses"),
    "small": ["depths"],
}


def _check_distances(arguments: Any) -> Any:
    if arguments.s > arguments.r:
        raise ValueError(
            f"sparse_depth_loss: distances must have at most {arguments.r} entries (the number of rays), "
            f"got {arguments.s}"
        )
    return arguments


def _check_triples(arguments: Any) -> Any:
    check_triples("smooth_depth_loss", arguments)
    return arguments


@declare(**_HERE, writes=["loss", "of_weights"], prepare=_check_distances)
def sparse_depth_loss(
    loss: Annotated[Tensor, "float32|float64 []"],
    of_weights: Annotated[Tensor, "same [m]"],
    depths: Annotated[Tensor, "same [m]"],
    deltas: Annotated[Tensor, "same [m]"],
    weights: Annotated[Tensor, "same [m]"],
    ray_offsets: Annotated[Tensor, "int32 [r+1]"],
    distances: Annotated[Tensor, "same [s]"],
    *,
    factor: float,
    backend: str = "auto",
) -> None:
    """Adds a loss on rays that end at known points, and its gradient with respect to the weights, in place.

    A sample of length ``delta`` at depth d is near the point at distance p on its ray if ``|d - p| <= 0.03 p + delta``.
    The loss of a ray is ``-log`` of the sum of the weights of its samples near the point; the sum is clamped to at
    least 0.001. This loss is the likelihood of Deng et al. 2022, "Depth-supervised NeRF", with a box in place of their
    Gaussian. Fog in front of the point reduces the sum. The mean of the s losses times ``factor`` is added to ``loss``.
    If the weight of a sample near the point is NaN, the loss is NaN, and the ray has no gradient. Not differentiable.

    Args:
        loss: the loss, updated in place.
        of_weights: the gradient of the loss with respect to the weights, updated in place.
        depths: the distances of the samples along the rays.
        deltas: the lengths of the samples' ray segments.
        weights: the rendering weights of the samples.
        ray_offsets: ray i owns samples ``ray_offsets[i]`` to ``ray_offsets[i + 1]``.
        distances: the distance of the point on each of the first s rays, s <= r. The loss of a ray whose distance is
            NaN is ``-log(0.001)``, without a gradient.
        factor: the factor on the mean of the losses.

    Raises:
        ValueError: a gradient that is not contiguous; more distances than rays; offsets that decrease or exceed m
            (checked on the CPU only).

    Examples:
        >>> import torch
        >>> from voronerf.ops import sparse_depth_loss
        >>> depths, deltas = torch.tensor([1.0, 2.0]), torch.full((2,), 0.1)  # fog, and a wall with a point
        >>> weights, offsets = torch.tensor([0.5, 0.5]), torch.tensor([0, 2], dtype=torch.int32)
        >>> loss, of_weights = torch.tensor(0.0), torch.zeros(2)
        >>> sparse_depth_loss(loss, of_weights, depths, deltas, weights, offsets, torch.tensor([2.0]), factor=1.0)
        >>> loss, of_weights  # more light from the point reduces the loss
        (tensor(0.6931), tensor([ 0., -2.]))
    """


@declare(**_HERE, writes=["loss", "of_weights"], prepare=_check_triples)
def smooth_depth_loss(
    loss: Annotated[Tensor, "float32|float64 []"],
    of_weights: Annotated[Tensor, "same [m]"],
    depths: Annotated[Tensor, "same [m]"],
    weights: Annotated[Tensor, "same [m]"],
    ray_offsets: Annotated[Tensor, "int32 [r+1]"],
    far: Annotated[Tensor, "same [r]"],
    *,
    triples: Annotated[int, "0.."],
    factor: float,
    backend: str = "auto",
) -> None:
    """Adds a loss on the curvature of unseen rays' disparities, and its gradient with respect to the weights, in place.

    The last rays are the triples of `unseen_rays`: ray ``r - 3 triples + i`` lies between rays ``r - 2 triples + i``
    and ``r - triples + i``. The disparity D of a ray is the sum of ``weight / depth`` over its samples, plus the
    remaining transmittance divided by ``far``. The loss is ``factor`` times the mean over the triples of the robust
    error of ``log((D' + D'') / (2 D))``, where D is the disparity of the middle ray and D', D'' are its neighbours'
    disparities. The robust error is as in `render_loss`, with scale 0.05, so that edges of surfaces count less.

    The loss is almost 0 on a plane, since the disparity of a plane is linear along a line of an image. (Distances along
    rays differ from depths by the cosine of the angle between rays: by 0.5 % for 0.1 radians.) The loss favours smooth
    surfaces over fog that only fits single views (after Niemeyer et al. 2022, "RegNeRF", section 4.1, whose loss
    favours equal depths of neighbours). Not differentiable.

    Args:
        loss: the loss, updated in place.
        of_weights: the gradient of the loss with respect to the weights, updated in place.
        depths: the distances of the samples along the rays, > 0.
        weights: the rendering weights of the samples.
        ray_offsets: ray i owns samples ``ray_offsets[i]`` to ``ray_offsets[i + 1]``.
        far: the far ends of the rays, > 0.
        triples: the number of triples, at most r / 3.
        factor: the factor on the mean of the robust errors.

    Raises:
        ValueError: a gradient that is not contiguous; more triples than a third of the rays; offsets that decrease or
            exceed m (checked on the CPU only).

    Examples:
        >>> import torch
        >>> from voronerf.ops import smooth_depth_loss
        >>> walls, offsets, far = torch.ones(3), torch.arange(4, dtype=torch.int32), torch.full((3,), 4.0)
        >>> for depths in ([1.0, 1.25, 1 / 1.2], [1.0, 2.0, 2.0]):  # a tilted wall; a wall in front of another
        ...     loss, of_weights = torch.tensor(0.0), torch.zeros(3)
        ...     smooth_depth_loss(loss, of_weights, torch.tensor(depths), walls, offsets, far, triples=1, factor=1.0)
        ...     print(f"{float(loss):.3f}")  # the second loss is about 0.1 log(2)
        0.000
        0.064
    """


@declare(**_HERE, writes=["loss", "of_weights", "of_density"])
def surface_loss(
    loss: Annotated[Tensor, "float32|float64 []"],
    of_weights: Annotated[Tensor, "same [m]"],
    of_density: Annotated[Tensor, "same [m]"],
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
    backend: str = "auto",
) -> None:
    """Adds two regularisers, a distortion loss and an orientation loss, and their gradients, in place.

    The means of these losses over the r rays, times ``distortion`` and ``orientation``, are added to ``loss``. For
    samples with weights w and opacities a, where ``a_i = w_i / (1 - sum over j < i of w_j)``:

    - The distortion ``sum over i, j of w_i w_j |s_i - s_j| + sum of w_i^2 l_i / 3`` (Barron et al. 2022, "Mip-NeRF
      360", equation 15) is smallest if all light comes from one depth. Normalised depths go from 0 at ``near`` to 1 at
      ``far`` in equal steps of disparity, ``s = (1 / near - 1 / depth) / (1 / near - 1 / far)``, and a sample has the
      length ``l = delta / depth^2 / (1 / near - 1 / far)``. The background does not count.
    - The orientation loss ``sum of w_i max(0, a_i - a_{i+1})^2`` (after Verbin et al. 2022, "Ref-NeRF", equation 11,
      with the decrease of the opacity along the ray in place of the normal) is 0 if the opacity does not decrease from
      a visible sample to the next. The next sample must be adjacent: nearer than the sum of both lengths.

    The derivative with respect to a_i is added to ``of_density`` as ``delta_i (1 - a_i)`` times this derivative, since
    ``a_i = 1 - exp(-density_i delta_i)``. Not differentiable.

    Args:
        loss: the loss, updated in place.
        of_weights: the gradient of the loss with respect to the weights, updated in place.
        of_density: the gradient of the loss with respect to the densities, except through the weights, updated in
            place.
        depths: the distances of the samples along the rays, > 0 and ascending.
        deltas: the lengths of the samples' ray segments.
        weights: the rendering weights of the samples.
        ray_offsets: ray i owns samples ``ray_offsets[i]`` to ``ray_offsets[i + 1]``.
        near: the near ends of the rays, > 0.
        far: the far ends of the rays, beyond ``near``.
        distortion: the factor on the mean of the distortion.
        orientation: the factor on the mean of the orientation loss.
        hidden: the transmittance up to which a sample counts as hidden. Both losses ignore hidden samples.

    Raises:
        ValueError: a gradient that is not contiguous; offsets that decrease or exceed m (checked on the CPU only).

    Examples:
        >>> import torch
        >>> from voronerf.ops import surface_loss
        >>> depths, deltas, offsets = torch.tensor([1.25, 2.5]), torch.full((2,), 0.1), torch.tensor([0, 2]).int()
        >>> ends = torch.tensor([1.0]), torch.tensor([5.0])
        >>> for light in (0.0, 0.5, 1.0):  # from a veil in front of a wall
        ...     given = depths, deltas, torch.tensor([light, 1 - light]), offsets, *ends
        ...     loss, *slopes = torch.tensor(0.0), torch.zeros(2), torch.zeros(2)
        ...     surface_loss(loss, *slopes, *given, distortion=1.0, orientation=0.0)
        ...     print(f"{float(loss):.3f}")
        0.007
        0.258
        0.027
    """
