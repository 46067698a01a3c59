"""Hierarchical sampling. r rays, s bins of a ray."""

from __future__ import annotations

from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import EVERYWHERE, FLOATS, Implementation
from voronerf.ops._core.checks import FLOATING, LIKE_FIRST, Checked, check_count, check_integer

_OP = backends.declare("resample", native=Implementation(EVERYWHERE, FLOATS), warp=Implementation(EVERYWHERE, FLOATS))


def resample(
    weights: Tensor, edges: Tensor, count: int, *, uniforms: Tensor | None = None, backend: str = "auto"
) -> Tensor:
    """Inverse-CDF sampling: depths from the piecewise constant density with mass ``weights[:, i]`` in bin i of a ray.

    Mildenhall et al. 2020, section 5.2. Weights that are negative or not finite count as 0. If all weights of a ray are
    0, every bin counts the same. Not differentiable: depths carry no gradient to the weights, the edges or the
    uniforms.

    Args:
        weights: [r, s] floating point, s >= 1; need not sum to 1.
        edges: [r, s + 1], rising along a ray, the dtype of the weights.
        count: depths of a ray, at least 1.
        uniforms: [r, count] in 0 to 1, in any order, the dtype of the weights; None for the midpoints of ``count``
            equal strata, which is deterministic.
        backend: "auto", "reference", "native" or "warp".

    Returns:
        depths [r, count], rising along a ray, in the dtype of the edges.

    Examples:
        >>> import torch
        >>> from voronerf import resample
        >>> weights = torch.tensor([[0.0, 1.0, 0.0]])  # all of the mass lies between 2 and 3
        >>> edges = torch.tensor([[1.0, 2.0, 3.0, 4.0]])
        >>> resample(weights, edges, 4)
        tensor([[2.1250, 2.3750, 2.6250, 2.8750]])
    """
    given = Checked(_OP)
    given.tensor("weights", weights, FLOATING, "r", "s")
    given.tensor("edges", edges, LIKE_FIRST, "r", "s+1")
    check_integer(_OP, "count", count, 1)
    given.sizes["count"] = count
    given.optional("uniforms", uniforms, LIKE_FIRST, "r", "count")
    check_count(_OP, "weights", weights.numel())
    check_count(_OP, "depths", given.sizes["r"] * count)
    if given.sizes["s"] < 1:
        raise ValueError(f"{_OP}: weights must have at least one bin, got none")
    run = backends.resolve(_OP, backend=backend, device=weights.device, dtype=weights.dtype)
    uniforms = None if uniforms is None else uniforms.detach()
    depths: Tensor = run(weights.detach(), edges.detach(), count, uniforms)
    return depths
