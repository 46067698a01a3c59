"""Networks with an autograd tape: the caller computes a loss and the gradient of their outputs. n samples."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from voronerf.ops._core import backends
from voronerf.ops._core.backends import EVERYWHERE, FLOATS, PLAIN, Implementation
from voronerf.ops.forward_with_tape.reference import Tape
from voronerf.ops.routed_program import check_network

_OP = backends.declare("forward_with_tape", native=Implementation(EVERYWHERE, FLOATS), warp=PLAIN)
_NEEDED = ("program", "inputs", "parameters")


def forward_with_tape(network: Mapping[str, Any], *, backend: str = "auto") -> Tape:
    """Evaluates networks and returns a tape; its ``backward`` takes a loss and the gradient of the outputs.

    If a loss is a function of the outputs of ``routed_program(**network)``, and ``gradient`` its gradient with respect
    to the outputs, ``tape.backward(loss, gradient)`` equals ``loss.backward()``. Only first derivatives exist.

    Args:
        network: the arguments of `routed_program` by name, except ``backend``. ``program`` (with one output),
            ``inputs`` and ``parameters`` are required; ``ray_index`` and the arguments that locate the samples are
            optional. Gradients go to all parameters and inputs with ``requires_grad``.
        backend: "auto", "reference", "native" or "warp".

    Returns:
        :class:`Tape`, with the outputs and ``backward``.

    Raises:
        ValueError: ``network`` has no program, inputs or parameters.

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
    routed = check_network(_OP, network)
    arguments, leaves = routed.arguments(_OP), [*routed.inputs, *routed.parameters]
    device = leaves[0].device
    run = backends.resolve_composed(_OP, backend=backend, device=device, dtype=arguments.dtype)
    tape: Tape = run(arguments, routed.routing, leaves)
    return tape
