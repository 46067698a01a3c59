"""Hierarchical sampling. r rays, s bins of a ray."""

from __future__ import annotations

from typing import Annotated, Any

from torch import Tensor

from voronerf.ops._core.backends import EVERYWHERE, FLOATS, PLAIN, Implementation
from voronerf.ops._core.checks import check_count
from voronerf.ops._core.declare import declare


def _prepare(arguments: Any) -> Any:
    check_count("resample", "count times the rays", arguments.weights.shape[0] * arguments.count)
    if arguments.weights.shape[1] < 1:
        raise ValueError("resample: weights must have at least one bin, got none")
    return arguments


@declare(
    native=Implementation(EVERYWHERE, FLOATS),
    warp=PLAIN,
    small=["weights"],
    prepare=_prepare,
)
def resample(
    weights: Annotated[Tensor, "floating [r, s]"],
    edges: Annotated[Tensor, "same [r, s+1]"],
    count: Annotated[int, "1.."],
    *,
    uniforms: Annotated[Tensor | None, "same [r, count]"] = None,
    backend: str = "auto",
) -> Annotated[Tensor, "same [r, count]"]:
    """Draws depths by inverse-CDF sampling; the mass ``weights[:, i]`` is uniform within bin i of a ray.

    See Mildenhall et al. 2020, section 5.2. Weights that are negative or not finite count as 0. If all weights of a ray
    are 0, its bins have equal masses. Not differentiable: depths carry no gradient to the weights, the edges or the
    uniforms.

    Args:
        weights: the masses of the bins, s >= 1; they need not sum to 1.
        edges: the edges of the bins, ascending along a ray.
        count: the number of depths of a ray, at least 1.
        uniforms: random numbers, 0 to 1, in any order; None for the midpoints of ``count`` equal strata.

    Returns:
        [r, count], depths in ascending order along a ray, in the dtype of the edges.

    Examples:
        >>> import torch
        >>> from voronerf import resample
        >>> weights = torch.tensor([[0.0, 1.0, 0.0]])  # all of the mass lies between 2 and 3
        >>> edges = torch.tensor([[1.0, 2.0, 3.0, 4.0]])
        >>> resample(weights, edges, 4)
        tensor([[2.1250, 2.3750, 2.6250, 2.8750]])
    """
