"""``grouped_mlp`` of the compiled module, and ``grouped_linear`` on CUDA, which is a network of one layer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from torch import Tensor

from voronerf.ops._core.custom_op import custom_op
from voronerf.ops._core.layers import ACTIVATIONS, MLP, POSITIONS, Layer
from voronerf.ops.grouped_mlp.gradients import gradients_of_network, keep_network, kept_network
from voronerf.ops.grouped_mlp.network import Given, Network, as_network, hashes_before, in_float32, new_results, run
from voronerf.ops.grouped_mlp.reference import cells_of

# Of one layer, whose width does not matter here.
_LINEAR = {activation: MLP((Layer((POSITIONS,), 1, activation),), (0,)) for activation in ACTIVATIONS}


def grouped_mlp(
    positions: Tensor,
    offsets: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    *,
    layers: MLP,
    directions: Tensor | None = None,
    direction_index: Tensor | None = None,
    features: Tensor | None = None,
) -> Tensor:
    """Every sample through the network of its cell; see ``voronerf.ops.grouped_mlp``.

    Under ``torch.autocast`` to bfloat16, products take bfloat16 operands where the processor has them.
    """
    given = Given(positions, weights, biases, layers, directions, direction_index, features)
    own, before = features is not None and features.dim() == 3, hashes_before(given)
    cells = cells_of(offsets, positions) if own and before else None
    taken, dtype = as_network(given, cells, hashed_before=before)
    out: Tensor
    out, _ = _forward(taken, offsets)
    return out.to(dtype)


def grouped_linear(
    x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None = None, activation: str = "none"
) -> Tensor:
    """Every sample through the layer of its cell; see ``voronerf.ops.grouped_linear``. A network of one layer.

    For CUDA; the CPU has kernels of one layer (``voronerf/ops/grouped_linear/cpu.py``).
    """
    layers = _LINEAR[activation]
    taken, dtype = in_float32(Given(x, [weight], [bias], layers), layers.text, "grouped_linear")
    out: Tensor
    out, _ = _forward(taken, offsets)
    return out.to(dtype)


@custom_op("grouped_mlp_native")
def _forward(network: Network, offsets: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """See `new_results`."""
    out, encoded = new_results(network)
    yield out, encoded
    run(out, encoded, network, offsets, None)


def _forward_setup(ctx: Any, inputs: tuple[Network, Tensor], output: tuple[Tensor, Tensor]) -> None:
    network, offsets = inputs
    ctx.mark_non_differentiable(output[1])
    ctx.set_materialize_grads(False)
    keep_network(ctx, network, offsets, output[1])


def _forward_backward(ctx: Any, gradient: Tensor | None, _of_encoded: None) -> tuple[Any, ...]:
    network, (offsets, encoded) = kept_network(ctx)
    return gradients_of_network(ctx, gradient, network, offsets, None, encoded), None


_forward.register_autograd(_forward_backward, setup_context=_forward_setup)
