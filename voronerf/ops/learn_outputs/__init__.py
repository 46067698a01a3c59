"""Networks, a loss of their outputs and the gradients of their parameters, in one operation. n samples."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

from torch import Tensor

from voronerf import backends
from voronerf.backends import EVERYWHERE, FLOATS, Implementation
from voronerf.checks import check_flag
from voronerf.ops.learn_outputs.reference import Loss
from voronerf.ops.routed_mlp import check_routed, routed_mlp

_OP = backends.declare("learn_outputs", native=Implementation(EVERYWHERE, FLOATS))


def learn_outputs(network: Mapping[str, Any], loss: Loss, *, backward: bool = False, backend: str = "auto") -> Tensor:
    """Evaluates networks, and computes a loss of their outputs together with the gradients of their parameters.

    Equivalent to ``loss(routed_mlp(**network)[0])`` and its backward pass, for a loss that knows its own gradient. The
    native CPU implementation is one node of autograd, which has all gradients before ``backward`` is called; or none,
    if these go to the parameters at once. A whole training step is this operation. Only once differentiable.

    Args:
        network: The arguments of `routed_mlp` by name, but for ``backend``, as ``VoronoiRouter.table_arguments`` gives
            them. Gradients go to weights, biases and features, and to positions and directions that ask
            for them.
        loss: Called once with the outputs, float32 [n, out], without gradients; returns the loss [] and its gradient to
            the outputs, [n, out].
        backward: Whether the gradients are added to ``.grad`` of the parameters at once, as ``loss.backward()`` does.
        backend: "auto", "reference" or "native".

    Returns:
        The loss []; with ``backward`` without gradients.

    Raises:
        ValueError: a loss or gradient of another shape.

    Examples:
        >>> import torch
        >>> from voronerf import MLP, Layer
        >>> from voronerf.ops import learn_outputs
        >>> weight = torch.tensor([[[2.0]]], requires_grad=True)
        >>> table = MLP((Layer(("positions",), 1),), outputs=(0,))
        >>> network = {"positions": torch.ones(4, 1), "weights": [weight], "biases": [None], "layers": table}
        >>> def squares(out):
        ...     return out.square().mean(), out * (2 / len(out))
        >>> loss = learn_outputs(network, squares)
        >>> loss.backward()
        >>> float(loss), float(weight.grad)
        (4.0, 4.0)
    """
    if not isinstance(network, Mapping) or not {"positions", "weights", "biases", "layers"} <= network.keys():
        raise ValueError(f"{_OP}: network must hold positions, weights, biases and layers, got {network!r:.60}")
    if not callable(loss):
        raise TypeError(f"{_OP}: loss must be a function, got {type(loss).__name__}")
    check_flag(_OP, "backward", backward)
    network = check_routed(_OP, **network)
    positions, weights = network["positions"], network["weights"]

    def checked(out: Tensor) -> tuple[Tensor, Tensor]:
        total, gradient = loss(out)
        if total.dim() or gradient.shape != out.shape:
            wanted = f"a loss [] and a gradient {list(out.shape)}"
            raise ValueError(f"{_OP}: loss must return {wanted}, got {list(total.shape)} and {list(gradient.shape)}")
        return total, gradient

    device, dtype = positions.device, weights[0].dtype
    run = backends.resolve(_OP, backend=backend, device=device, dtype=dtype)
    if backend == "auto" and backends.chosen(_OP, device, dtype) == "reference":
        run = functools.partial(run, evaluate=routed_mlp)  # whose operations have backends of their own
    total: Tensor = run(network, checked, backward)
    return total
