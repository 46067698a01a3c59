"""Networks whose parameters learn from the gradient of a loss to what they put out. n samples."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import EVERYWHERE, FLOATS, Implementation
from voronerf.ops._core.checks import check_flag, check_shape, detached
from voronerf.ops.forward_with_tape.reference import Tape
from voronerf.ops.routed_mlp import check_routed, routed_mlp

_OP = backends.declare("forward_with_tape", native=Implementation(EVERYWHERE, FLOATS))


class Outputs(NamedTuple):
    """What networks put out, to learn from.

    Attributes:
        raw: float32 [n, out], without gradients.
        tape: What it was computed from.

    Examples:
        >>> import torch
        >>> from voronerf import MLP, Layer
        >>> from voronerf.ops import forward_with_tape
        >>> weight = torch.tensor([[[2.0]]], requires_grad=True)
        >>> table = MLP((Layer(("positions",), 1),), outputs=(0,))
        >>> network = {"positions": torch.ones(4, 1), "weights": [weight], "biases": [None], "layers": table}
        >>> outputs = forward_with_tape(network)
        >>> loss = outputs.learn(outputs.raw.square().mean(), outputs.raw * (2 / 4), backward=True)
        >>> float(loss), float(weight.grad)
        (4.0, 4.0)
    """

    raw: Tensor
    tape: Tape

    def learn(self, loss: Tensor, gradient: Tensor, *, backward: bool = False) -> Tensor:
        """Gives the parameters the gradients that follow from that of a loss to ``raw``. To be called once.

        Args:
            loss: [].
            gradient: [n, out], of the loss to ``raw``.
            backward: Whether the gradients are added to ``.grad`` of the parameters at once, as ``loss.backward()``
                does.

        Returns:
            The loss [], whose ``backward`` hands the gradients over; with ``backward`` without gradients.

        Raises:
            ValueError: a loss or gradient of another shape.
        """
        check_shape(_OP, "loss", loss, ())
        check_shape(_OP, "gradient", gradient, self.raw.shape)
        check_flag(_OP, "backward", backward)
        return self.tape.learn(detached(loss), detached(gradient), backward)


def forward_with_tape(network: Mapping[str, Any], *, backend: str = "auto") -> Outputs:
    """Evaluates networks that learn from the gradient of a loss to their outputs.

    ``outputs.learn(loss, gradient)`` is equivalent to the backward pass of a loss of ``routed_mlp(**network)[0]``, for
    a loss that knows its own gradient. The native CPU implementation has all gradients of the parameters before
    ``backward`` is called. Only once differentiable.

    Args:
        network: The arguments of `routed_mlp` by name, but for ``backend``, as ``VoronoiRouter.table_arguments`` gives
            them. Gradients go to weights, biases and features, and to positions and directions that ask
            for them.
        backend: "auto", "reference" or "native".

    Returns:
        :class:`Outputs`, with an example.

    Examples:
        >>> import torch
        >>> from voronerf import MLP, Layer
        >>> from voronerf.ops import forward_with_tape
        >>> table = MLP((Layer(("positions",), 1),), outputs=(0,))
        >>> weights = [torch.tensor([[[2.0]]])]
        >>> network = {"positions": torch.ones(1, 1), "weights": weights, "biases": [None], "layers": table}
        >>> forward_with_tape(network).raw
        tensor([[2.]])
    """
    if not isinstance(network, Mapping) or not {"positions", "weights", "biases", "layers"} <= network.keys():
        raise ValueError(f"{_OP}: network must hold positions, weights, biases and layers, got {network!r:.60}")
    network = check_routed(_OP, **network)
    device, dtype = network["positions"].device, network["weights"][0].dtype
    run = backends.resolve(_OP, backend=backend, device=device, dtype=dtype)
    if backend == "auto" and backends.chosen(_OP, device, dtype) == "reference":
        run = functools.partial(run, evaluate=routed_mlp)  # whose operations have backends of their own
    return Outputs(*run(network))
