"""Networks whose parameters learn from the gradient of a loss to what they put out. n samples."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from voronerf.ops._core import backends
from voronerf.ops._core.backends import EVERYWHERE, FLOATS, PLAIN, Implementation
from voronerf.ops.forward_with_tape.reference import Tape
from voronerf.ops.routed_program import routed_of

_OP = backends.declare("forward_with_tape", native=Implementation(EVERYWHERE, FLOATS), warp=PLAIN)
_NEEDED = ("program", "inputs", "parameters")


def forward_with_tape(network: Mapping[str, Any], *, backend: str = "auto") -> Tape:
    """Evaluates networks that learn from the gradient of a loss to their outputs.

    ``tape.backward(loss, gradient)`` is equivalent to the backward pass of a loss of ``routed_program(**network)``, for
    a loss that knows its own gradient. The native CPU implementation has all gradients of the parameters before
    ``backward`` is called. Only once differentiable.

    Args:
        network: The arguments of `routed_program` by name, but for ``backend``: ``program``, with one output,
            ``inputs`` and ``parameters``, and where there are any, ``ray_index`` and what tells the cells. Gradients go
            to the parameters, and to inputs that ask for them.
        backend: "auto", "reference", "native" or "warp".

    Returns:
        :class:`Tape`, with an example.

    Raises:
        ValueError: a network without a program, inputs or parameters.

    Examples:
        >>> import torch
        >>> from voronerf import MLP, Layer
        >>> from voronerf.ops import forward_with_tape
        >>> table = MLP((Layer(("positions",), 1),), outputs=(0,))
        >>> program = table.program(1, 0, None, (False,))  # of positions [n, 1], without a bias
        >>> network = {"program": program, "inputs": [torch.ones(1, 1)], "parameters": [torch.tensor([[[2.0]]])]}
        >>> forward_with_tape(network).raw
        tensor([[2.]])
    """
    missing = [name for name in _NEEDED if name not in network] if isinstance(network, Mapping) else None
    if missing != []:
        came = f"no {', '.join(missing)}" if missing else f"{network!r:.60}"
        raise ValueError(f"{_OP}: network must hold program, inputs and parameters, got {came}")
    if not all(isinstance(name, str) for name in network):
        raise TypeError(f"{_OP}: network must hold arguments by name, got {list(network)!r:.100}")
    routed = routed_of(_OP, network)
    given, leaves = routed.given(_OP), [*routed.inputs, *routed.parameters]
    device = leaves[0].device
    run = backends.resolve_composed(_OP, backend=backend, device=device, dtype=given.dtype)
    tape: Tape = run(given, routed.where, leaves)
    return tape
