"""One linear layer for each cell. n samples, k cells, i inputs, o outputs."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from voronerf.ops._core.backends import EVERYWHERE, FLOATS, Implementation
from voronerf.ops._core.checks import FLOATING, LIKE_FIRST, TensorRule, check_rules
from voronerf.ops._core.declare import declare
from voronerf.ops._core.layers import ACTIVATIONS


def _like_x(count: int) -> list[TensorRule]:
    shapes = {"x": ("n", "i"), "weight": ("k", "o", "i"), "bias": ("k", "o")}
    return [TensorRule(name, FLOATING if name == "x" else LIKE_FIRST, shapes[name]) for name in [*shapes][:count]]


def _prepare(arguments: Any) -> Any:
    if 0 in arguments.weight.shape:
        raise ValueError(f"grouped_linear: weight must have no empty dimension, got {list(arguments.weight.shape)}")
    if not torch.is_autocast_enabled(arguments.x.device.type):
        tensors = [arguments.x, arguments.weight, *([] if arguments.bias is None else [arguments.bias])]
        check_rules("grouped_linear", _like_x, tensors, len(tensors))
    return arguments


@declare(
    native=Implementation(EVERYWHERE, FLOATS),
    warp=Implementation(EVERYWHERE, FLOATS, "network"),
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
    """Applies the linear layer of each sample's cell c: ``activation(W_c x + b_c)``.

    x, weight and bias have gradients of every order. Products are accumulated in float32 at least. Under
    ``torch.autocast`` the arguments are cast to its dtype, except float64, as for ``torch.nn.functional.linear``.

    Args:
        x: the samples, sorted by cell, n < 2**31, i >= 1.
        offsets: ascending; cell c owns rows ``offsets[c]`` to ``offsets[c + 1]``. Rows outside all cells (before
            ``offsets[0]`` or from ``offsets[k]`` on) give 0. Cells may be empty.
        weight: the weights of each cell, o >= 1.
        bias: the biases of each cell, or None.
        activation: "none", "relu", "softplus", "sigmoid" or "sine".

    Returns:
        [n, o] in the dtype of x (or of autocast, if it is enabled).

    Raises:
        ValueError: offsets decrease or exceed n (checked on the CPU only).

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
