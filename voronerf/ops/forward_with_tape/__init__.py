"""Networks whose parameters learn from the gradient of a loss to what they put out. n samples."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from voronerf.ops._core import backends
from voronerf.ops._core.backends import EVERYWHERE, FLOATS, PLAIN, Implementation
from voronerf.ops.forward_with_tape.reference import Tape
from voronerf.ops.grouped_mlp.checks import check_routed
from voronerf.ops.routed_program import check_routed_program

_OP = backends.declare("forward_with_tape", native=Implementation(EVERYWHERE, FLOATS), warp=PLAIN)
_NEEDED = ("positions", "weights", "biases", "layers")
_OF_PROGRAM = ("program", "inputs", "parameters")


def forward_with_tape(network: Mapping[str, Any], *, backend: str = "auto") -> Tape:
    """Evaluates networks that learn from the gradient of a loss to their outputs.

    ``tape.backward(loss, gradient)`` is equivalent to the backward pass of a loss of ``routed_mlp(**network)[0]``, for
    a loss that knows its own gradient. The native CPU implementation has all gradients of the parameters before
    ``backward`` is called. Only once differentiable.

    Args:
        network: The arguments of `routed_mlp` by name, but for ``backend``. Gradients go to weights, biases and
            features, and to positions and directions that ask for them. Or, for networks that are no layer table,
            ``program``, with one output, ``inputs``, of which the first begins with the positions, ``parameters`` and
            ``ray_index`` as `grouped_program` takes them, parameters that all cells share also without the dimension of
            cells, in the place of positions, weights, biases, layers,
            directions, direction_index and features. Gradients go to parameters, and to inputs that ask for them.
        backend: "auto", "reference", "native" or "warp".

    Returns:
        :class:`Tape`, with an example.

    Raises:
        ValueError: a network without positions, weights, biases or layers, or without inputs or parameters.

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
    by_program = isinstance(network, Mapping) and "program" in network
    needed = _OF_PROGRAM if by_program else _NEEDED
    missing = [name for name in needed if name not in network] if isinstance(network, Mapping) else None
    if missing != []:
        came = f"no {', '.join(missing)}" if missing else f"{network!r:.60}"
        raise ValueError(f"{_OP}: network must hold {', '.join(needed[:-1])} and {needed[-1]}, got {came}")
    if not all(isinstance(name, str) for name in network):
        raise TypeError(f"{_OP}: network must hold arguments by name, got {list(network)!r:.100}")
    network = check_routed_program(_OP, True, **network) if by_program else check_routed(_OP, **network)
    first = network["inputs" if by_program else "weights"][0]
    tape: Tape = backends.resolve_composed(_OP, backend=backend, device=first.device, dtype=first.dtype)(network)
    return tape
