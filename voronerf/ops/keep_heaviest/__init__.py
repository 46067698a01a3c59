"""The heaviest samples of each batch. b kept batches of q samples, m samples of a new batch, r rays, d coordinates."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import PLAIN, Implementation
from voronerf.ops._core.declare import declare


def _prepare(arguments: Any) -> Any:
    if arguments.kept_importance.numel() < 1:
        shape = list(arguments.kept_importance.shape)
        raise ValueError(f"keep_heaviest: kept_importance must have at least one place, got {shape}")
    if (arguments.error is None) != (arguments.ray_index is None):
        missing = "error" if arguments.error is None else "ray_index"
        raise ValueError(f"keep_heaviest: error and ray_index must be given together, got no {missing}")
    return arguments


@declare(
    native=Implementation(("cpu",), (torch.float32,)),
    warp=PLAIN,
    small=["weights"],
    writes=["kept_points", "kept_importance", "added"],
    prepare=_prepare,
)
def keep_heaviest(
    kept_points: Annotated[Tensor, "float32 [b, q, d]"],
    kept_importance: Annotated[Tensor, "float32 [b, q]"],
    added: Annotated[Tensor, "int64 [1]"],
    points: Annotated[Tensor, "float32 [m, d]"],
    weights: Annotated[Tensor, "float32 [m]"],
    *,
    error: Annotated[Tensor | None, "float32 [r]"] = None,
    ray_index: Annotated[Tensor | None, "int32 [m]"] = None,
    backend: str = "auto",
) -> None:
    """Replaces the oldest kept batch by the heaviest samples of a new batch, in place.

    The importance of a sample is its weight, multiplied by the error of its ray if ``error`` is given (Elsner et al.
    2023, section 3.1). Samples with an importance that is not finite and positive are ignored. The q most important
    samples become batch ``added % b``, in descending order; equal importances keep the order of the batch. The
    remaining slots, and the slots of samples whose point is not finite, get importance 0 and point 0. Then ``added`` is
    incremented. The result does not depend on the number of threads. Not differentiable.

    Args:
        kept_points: the points of the kept samples, contiguous.
        kept_importance: the importances of the kept samples, contiguous; b >= 1 and q >= 1.
        added: the number of batches that were added so far.
        points: the points of the batch.
        weights: the weights of the samples.
        error: the errors of the rays; None to use the weights alone.
        ray_index: the ray of each sample, 0 to r - 1; None if ``error`` is None.

    Raises:
        ValueError: ``kept_points`` or ``kept_importance`` that are not contiguous; ``error`` without ``ray_index``, or
            the reverse; a ray out of range (checked on the CPU only).

    Examples:
        >>> import torch
        >>> from voronerf.ops import keep_heaviest
        >>> kept, importance = torch.zeros(3, 2, 1), torch.zeros(3, 2)
        >>> added = torch.tensor([4])
        >>> points, weights = torch.tensor([[7.0], [8.0], [9.0]]), torch.tensor([0.5, 0.5, 0.25])
        >>> rays = {"error": torch.tensor([2.0, 8.0]), "ray_index": torch.tensor([0, 0, 1], dtype=torch.int32)}
        >>> keep_heaviest(kept, importance, added, points, weights, **rays)
        >>> kept[1, :, 0], importance[1], added
        (tensor([9., 7.]), tensor([2., 1.]), tensor([5]))
    """
