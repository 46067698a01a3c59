"""One linear layer for each cell. n samples, k cells, i inputs, o outputs."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import EVERYWHERE, FLOATS, Implementation
from voronerf.ops._core.checks import check_same_dtype
from voronerf.ops._core.declare import declare
from voronerf.ops._core.layers import ACTIVATIONS


def _prepare(given: Any) -> Any:
    if 0 in given.weight.shape:
        raise ValueError(f"grouped_linear: weight must have no empty dimension, got {list(given.weight.shape)}")
    if not torch.is_autocast_enabled(given.x.device.type):
        check_same_dtype("grouped_linear", x=given.x, weight=given.weight, bias=given.bias)
    return given


@declare(
    native=Implementation(EVERYWHERE, FLOATS),
    warp=Implementation(EVERYWHERE, FLOATS, "grouped_mlp"),
    smooth=["x", "weight", "bias"],
    prepare=_prepare,
)
def grouped_linear(
    x: Annotated[Tensor, "floating [n, i]"],
    offsets: Annotated[Tensor, "int32 [k+1]"],
    weight: Annotated[Tensor, "floating [k, o, i]"],
    bias: Annotated[Tensor | None, "floating [k, o]"] = None,
    *,
    activation: Annotated[str, "|".join(ACTIVATIONS)] = "none",
    backend: str = "auto",
) -> Annotated[Tensor, "floating [n, o]"]:
    """A linear layer for each cell: ``activation(W_c x + b_c)``, where c is the cell of the sample.

    Gradients of every order to x, weight and bias. Products are accumulated in float32 at least. Under
    ``torch.autocast`` the arguments are cast to its dtype, float64 excepted, as for ``torch.nn.functional.linear``.

    Args:
        x: samples, sorted by cell, n < 2**31, i >= 1.
        offsets: rising; cell c owns rows ``offsets[c]`` to ``offsets[c + 1]``. Rows outside all cells (before
            ``offsets[0]``, from ``offsets[k]`` on) give 0. Cells may be empty.
        weight: of each cell, o >= 1.
        bias: of each cell.
        activation: "none", "relu", "softplus", "sigmoid" or "sine".

    Returns:
        [n, o] in the dtype of x (of autocast, where it is on).

    Raises:
        ValueError: on the CPU offsets that fall or exceed n.

    Examples:
        >>> import torch
        >>> from voronerf import grouped_linear
        >>> x = torch.tensor([[1.0], [2.0], [3.0]])
        >>> offsets = torch.tensor([0, 2, 3], dtype=torch.int32)  # rows 0 and 1 belong to cell 0, row 2 to cell 1
        >>> weight = torch.tensor([[[10.0]], [[-1.0]]])  # [k, o, i] = [2, 1, 1]
        >>> grouped_linear(x, offsets, weight).flatten()
        tensor([10., 20., -3.])
        >>> grouped_linear(x, offsets, weight, activation="relu").flatten()
        tensor([10., 20.,  0.])
    """
