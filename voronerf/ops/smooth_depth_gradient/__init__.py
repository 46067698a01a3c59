"""How much the depths of neighbouring rays differ where no picture says, with its gradient. r rays, m samples."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import PLAIN, Implementation
from voronerf.ops._core.declare import declare
from voronerf.ops.render_loss.reference import scaled
from voronerf.ops.unseen_rays import check_pairs


def _prepare(given: Any) -> Any:
    check_pairs("smooth_depth_gradient", given)
    return scaled("smooth_depth_gradient", given)


@declare(
    native=Implementation(("cpu",), (torch.float32,)),
    warp=PLAIN,
    small=["gradient"],
    writes=["loss", "error", "gradient"],
    prepare=_prepare,
)
def smooth_depth_gradient(
    loss: Annotated[Tensor, "float32|float64 []"],
    error: Annotated[Tensor, "same [r]"],
    gradient: Annotated[Tensor, "same [m, 4]"],
    density: Annotated[Tensor, "same [m]"],
    depths: Annotated[Tensor, "same [m]"],
    deltas: Annotated[Tensor, "same [m]"],
    weights: Annotated[Tensor, "same [m]"],
    ray_offsets: Annotated[Tensor, "int32 [r+1]"],
    far: Annotated[Tensor, "same [r]"],
    *,
    pairs: Annotated[int, "0.."],
    factor: float,
    robust: Annotated[float, "[0, 1)"] = 0.0,
    hidden: Annotated[float, "[0, 1)"] = 0.0,
    density_scale: Annotated[float | None, "positive"] = None,
    activated: bool = False,
    backend: str = "auto",
) -> None:
    """Puts smooth depths in the place of the colours of `unseen_rays`, in the results of ``render_loss_gradient``.

    The last rays are pairs, ``r - 2 pairs + i`` and ``r - pairs + i``, of which no picture shows the colour: it leaves
    the loss, and its error and gradient become 0. The disparity D of a ray is the sum of its weights over their depths,
    and light that is left comes from ``far``. To the loss, ``factor`` times the mean over the pairs of the robust error
    of ``log(D / D')`` is added, where D' is that of the other ray: squares, which count less beyond 0.05, at the edges
    of surfaces, as ``robust`` ones of `render_loss` do. Its gradient goes to the last column. With the transmittance T
    behind a sample and the disparity S from what lies behind it, the derivative of D by its density is
    ``delta (T / depth - S)``. Surfaces are mostly smooth, fog that explains one view each is not seen from the side
    (Niemeyer et al. 2022, "RegNeRF", section 4.1). Nothing is differentiable further.

    Args:
        loss: which changes.
        error: of the colours, contiguous.
        gradient: contiguous; to the outputs of the networks.
        density: of the samples.
        depths: their distances along the rays, > 0.
        deltas: their lengths.
        weights: their contributions to the rays.
        ray_offsets: ray i owns samples ``ray_offsets[i]`` to ``ray_offsets[i + 1]``.
        far: > 0, where the rays end.
        pairs: how many, at most r / 2.
        factor: on the mean.
        robust: of the loss of the colours, as for `render_loss`.
        hidden: share of the light; samples that no more than it reaches have no gradient, as for `render_loss`.
        density_scale: factor on the density behind its softplus, as for `render_loss`; None with ``activated``.
        activated: whether the gradient is to the density itself.

    Raises:
        ValueError: tensors that are not contiguous; more pairs than half of the rays; ``density_scale`` with
            ``activated``, or neither; on the CPU offsets that fall or exceed m.

    Examples:
        >>> import torch
        >>> from voronerf.ops import smooth_depth_gradient
        >>> depths, deltas = torch.tensor([1.0, 2.0]), torch.full((2,), 0.1)  # two walls, one behind the other
        >>> walls, offsets = torch.tensor([1.0, 1.0]), torch.tensor([0, 1, 2], dtype=torch.int32)
        >>> given = torch.full((2,), 1e3), depths, deltas, walls, offsets, torch.full((2,), 4.0)
        >>> loss, error, gradient = torch.tensor(0.0), torch.zeros(2), torch.zeros(2, 4)
        >>> smooth_depth_gradient(loss, error, gradient, *given, pairs=1, factor=1.0, activated=True)
        >>> loss  # about 0.1 log(2)
        tensor(0.0645)
    """
