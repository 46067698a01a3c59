"""How far the depths of neighbours are from a plane where no picture says, with its gradient. r rays, m samples."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import PLAIN, Implementation
from voronerf.ops._core.declare import declare
from voronerf.ops.render_loss.reference import scaled
from voronerf.ops.unseen_rays import check_triples


def _prepare(given: Any) -> Any:
    check_triples("smooth_depth_gradient", given)
    return scaled("smooth_depth_gradient", given)


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
    """Adds the loss of bent depths of unseen rays, and its gradient, to those of ``render_loss_gradient``, in place.

    The last rays are triples of `unseen_rays`, ``r - 3 triples + i`` between ``r - 2 triples + i`` and
    ``r - triples + i``. The disparity D of a ray is the sum of its weights over their depths, and light that is left
    comes from ``far``. Along a line of a picture, the disparity of a plane is linear. To the loss, ``factor`` times the
    mean over the triples of the robust error of ``log((D' + D'') / 2 D)`` is added, where D is that of the ray in the
    middle: squares, which count less beyond 0.05, at the edges of surfaces, as ``robust`` ones of `render_loss` do.
    (Distances along rays make a plane bend by the cosine of the angle between them, 0.005 for 0.1.) Its gradient is
    added to the last column. With the transmittance T behind a sample and the disparity S from what lies behind it, the
    derivative of D by its density is ``delta (T / depth - S)``. Surfaces are mostly smooth, fog that explains one view
    each is not seen from the side (after Niemeyer et al. 2022, "RegNeRF", section 4.1, where neighbours should have one
    depth). Nothing is differentiable further.

    Args:
        loss: to which the loss is added.
        gradient: contiguous, to the outputs of the networks.
        density: of the samples.
        depths: their distances along the rays, > 0.
        deltas: their lengths.
        weights: their contributions to the rays.
        ray_offsets: ray i owns samples ``ray_offsets[i]`` to ``ray_offsets[i + 1]``.
        far: > 0, where the rays end.
        triples: how many, at most r / 3.
        factor: on the mean.
        hidden: share of the light; samples that no more than it reaches have no gradient, as for `render_loss`.
        density_scale: factor on the density behind its softplus, as for `render_loss`; None with ``activated``.
        activated: whether the gradient is to the density itself.

    Raises:
        ValueError: tensors that are not contiguous; more triples than a third of the rays; ``density_scale`` with
            ``activated``, or neither; on the CPU offsets that fall or exceed m.

    Examples:
        >>> import torch
        >>> from voronerf.ops import smooth_depth_gradient
        >>> walls, deltas, offsets = torch.ones(3), torch.full((3,), 0.1), torch.arange(4, dtype=torch.int32)
        >>> for depths in ([1.0, 1.25, 1 / 1.2], [1.0, 2.0, 2.0]):  # a tilted wall; one before another
        ...     given = torch.full((3,), 1e3), torch.tensor(depths), deltas, walls, offsets, torch.full((3,), 4.0)
        ...     loss, gradient = torch.tensor(0.0), torch.zeros(3, 4)
        ...     smooth_depth_gradient(loss, gradient, *given, triples=1, factor=1.0, activated=True)
        ...     print(f"{float(loss):.3f}")  # the second about 0.1 log(2)
        0.000
        0.064
    """
