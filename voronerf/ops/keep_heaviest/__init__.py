"""The heaviest samples of a batch. b batches, q samples kept of each, m samples of the batch, r rays, d coordinates."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import PLAIN, Implementation
from voronerf.ops._core.declare import declare


def _prepare(given: Any) -> Any:
    if given.kept_importance.numel() < 1:
        shape = list(given.kept_importance.shape)
        raise ValueError(f"keep_heaviest: kept_importance must have at least one place, got {shape}")
    if (given.error is None) != (given.ray_index is None):
        missing = "error" if given.error is None else "ray_index"
        raise ValueError(f"keep_heaviest: error and ray_index must be given together, got no {missing}")
    return given


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
    """Keeps the heaviest samples of a batch in place of those of the oldest, in place.

    The importance of a sample is its weight, times the error of its ray where that is given (Elsner et al. 2023,
    section 3.1). Samples whose importance is not finite and above 0 are left out. The q heaviest of the others, or all,
    become batch ``added % b``, from the heaviest on; of equal ones the first come first. Where the point of one is not
    finite, its place stays empty; empty places have importance 0, at 0. Then 1 is added to ``added``. The same on any
    number of threads. Not differentiable.

    Args:
        kept_points: contiguous.
        kept_importance: contiguous; at least one place.
        added: batches that were added so far.
        points: of the batch.
        weights: of the samples.
        error: of the rays; None to leave weights as they are.
        ray_index: the ray of each sample, 0 to r - 1; None where ``error`` is.

    Raises:
        ValueError: what is kept is not contiguous; one of ``error`` and ``ray_index`` alone; on the CPU a ray that is
            not there.

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
