"""A loss on the curvature of unseen rays' disparities, with its gradient. r rays, m samples."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import PLAIN, Implementation
from voronerf.ops._core.declare import declare
from voronerf.ops.render_loss.reference import scaled
from voronerf.ops.unseen_rays import check_triples


def _prepare(arguments: Any) -> Any:
    check_triples("smooth_depth_gradient", arguments)
    return scaled("smooth_depth_gradient", arguments)


@declare(
    native=Implementation(("cpu",), (torch.float32,)),
    warp=PLAIN,
    small=["gradient"],
    writes=["loss", "gradient"],
    prepare=_prepare,
)
def smooth_depth_gradient(
    loss: Annotated[Tensor, "float32|float64 []"],
    gradient: Annotated[Tensor, "same [m, 4]"],
    density: Annotated[Tensor, "same [m]"],
    depths: Annotated[Tensor, "same [m]"],
    deltas: Annotated[Tensor, "same [m]"],
    weights: Annotated[Tensor, "same [m]"],
    ray_offsets: Annotated[Tensor, "int32 [r+1]"],
    far: Annotated[Tensor, "same [r]"],
    *,
    triples: Annotated[int, "0.."],
    factor: float,
    hidden: Annotated[float, "[0, 1)"] = 0.0,
    density_scale: Annotated[float | None, "positive"] = None,
    activated: bool = False,
    backend: str = "auto",
) -> None:
    """Adds a loss on the curvature of unseen rays' disparities, and its gradient, in place.

    The last rays are the triples of `unseen_rays`: ray ``r - 3 triples + i`` lies between rays ``r - 2 triples + i``
    and ``r - triples + i``. The disparity D of a ray is the sum of ``weight / depth`` over its samples, plus the
    remaining transmittance divided by ``far``. The loss is ``factor`` times the mean over the triples of the robust
    error of ``log((D' + D'') / (2 D))``, where D is the disparity of the middle ray and D', D'' are its neighbours'
    disparities. The robust error is as in `render_loss`, with scale 0.05, so that edges of surfaces count less.

    The loss is almost 0 on a plane, since the disparity of a plane is linear along a line of an image. (Distances along
    rays differ from depths by the cosine of the angle between rays: by 0.5 % for 0.1 radians.) The loss favours smooth
    surfaces over fog that only fits single views (after Niemeyer et al. 2022, "RegNeRF", section 4.1, whose loss
    favours equal depths of neighbours).

    The gradient is added to the last column of ``gradient``. The derivative of D with respect to the density of a
    sample is ``delta (T / depth - S)``, where T is the transmittance behind the sample, and S the part of D that is due
    to everything behind the sample. Not differentiable.

    Args:
        loss: the loss, updated in place.
        gradient: the gradient of the loss with respect to the networks' outputs, contiguous, updated in place.
        density: the densities of the samples.
        depths: the distances of the samples along the rays, > 0.
        deltas: the lengths of the samples' ray segments.
        weights: the rendering weights of the samples.
        ray_offsets: ray i owns samples ``ray_offsets[i]`` to ``ray_offsets[i + 1]``.
        far: the far ends of the rays, > 0.
        triples: the number of triples, at most r / 3.
        factor: the factor on the mean of the robust errors.
        hidden: the transmittance up to which a sample counts as hidden. Hidden samples have no gradient, as for
            `render_loss`.
        density_scale: the factor on the density after its softplus, as for `render_loss`; None with ``activated``.
        activated: whether the gradient is with respect to the density itself.

    Raises:
        ValueError: tensors that are not contiguous; more triples than a third of the rays; both or neither of
            ``density_scale`` and ``activated``; offsets that decrease or exceed m (checked on the CPU only).

    Examples:
        >>> import torch
        >>> from voronerf.ops import smooth_depth_gradient
        >>> walls, deltas, offsets = torch.ones(3), torch.full((3,), 0.1), torch.arange(4, dtype=torch.int32)
        >>> for depths in ([1.0, 1.25, 1 / 1.2], [1.0, 2.0, 2.0]):  # a tilted wall; a wall in front of another
        ...     given = torch.full((3,), 1e3), torch.tensor(depths), deltas, walls, offsets, torch.full((3,), 4.0)
        ...     loss, gradient = torch.tensor(0.0), torch.zeros(3, 4)
        ...     smooth_depth_gradient(loss, gradient, *given, triples=1, factor=1.0, activated=True)
        ...     print(f"{float(loss):.3f}")  # the second loss is about 0.1 log(2)
        0.000
        0.064
    """
