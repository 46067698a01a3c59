"""One linear layer for each cell. n samples, k cells, i inputs, o outputs."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import EVERYWHERE, FLOATS, Implementation
from voronerf.ops._core.checks import FLOATING, INDEX, Checked, check_choice, check_same_dtype
from voronerf.ops._core.layers import ACTIVATIONS

_OP = backends.declare("grouped_linear", native=Implementation(EVERYWHERE, FLOATS))


def grouped_linear(
    x: Tensor,
    offsets: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    *,
    activation: str = "none",
    backend: str = "auto",
) -> Tensor:
    """A linear layer for each cell: ``activation(W_c x + b_c)``, where c is the cell of the sample.

    Gradients of every order to x, weight and bias. Products are accumulated in float32 at least. Under
    ``torch.autocast`` the arguments are cast to its dtype, float64 excepted, as for ``torch.nn.functional.linear``.

    Args:
        x: [n, i] floating point, sorted by cell, n < 2**31, i >= 1.
        offsets: int32 [k + 1], rising; cell c owns rows ``offsets[c]`` to ``offsets[c + 1]``. Rows outside all cells
            (before ``offsets[0]``, from ``offsets[k]`` on) give 0. Cells may be empty.
        weight: [k, o, i], o >= 1, the dtype of x.
        bias: [k, o] or None.
        activation: "none", "relu", "softplus", "sigmoid" or "sine".
        backend: "auto", "reference" or "native".

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
    given = Checked(_OP)
    given.tensor("x", x, FLOATING, "n", "i")
    given.tensor("weight", weight, FLOATING, "k", "o", "i")
    given.tensor("offsets", offsets, INDEX, "k+1")
    given.optional("bias", bias, FLOATING, "k", "o")
    given.no_inference()
    check_choice(_OP, "activation", activation, ACTIVATIONS)
    if 0 in weight.shape:
        raise ValueError(f"{_OP}: weight must have no empty dimension, got {list(weight.shape)}")
    if not torch.is_autocast_enabled(x.device.type):
        check_same_dtype(_OP, x=x, weight=weight, bias=bias)
    run = backends.resolve(_OP, backend=backend, device=x.device, dtype=x.dtype)
    y: Tensor = run(x, offsets, weight, bias, activation=activation)
    return y
