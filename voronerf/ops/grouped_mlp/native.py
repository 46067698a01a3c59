"""Whole per-cell networks of the compiled module: ``grouped_mlp``, and ``grouped_linear`` on CUDA.

n samples, r rays, k cells, p and q features of a raw position and direction, i inputs and o outputs of a layer. Tensors
are cast to float32 on the way in and back on the way out, a cell having few weights. With bfloat16 storage, or under
autocast to it, products take bfloat16 operands where the processor multiplies them faster (AVX512-BF16), and float32
ones elsewhere; sums are float32 always. Gradients that will be differentiated
again are taken layer by layer (``layerwise.py``).
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, cast

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import custom_op
from voronerf.ops._core.derivatives import asked_for
from voronerf.ops._core.layers import ACTIVATIONS, MLP, POSITIONS, Layer
from voronerf.ops.grouped_mlp.layer_table import (
    Given,
    Key,
    Network,
    Table,
    in_float32,
    network,
    operands,
    storage,
    table_key,
    table_of,
    table_text,
)
from voronerf.ops.grouped_mlp.layerwise import gradients as differentiable
from voronerf.ops.grouped_mlp.reference import cells_of

# Of one layer, whose width does not matter here.
_LINEAR = {activation: MLP((Layer((POSITIONS,), 1, activation),), (0,)) for activation in ACTIVATIONS}
WAYS = native.compiled.MlpCudaWay
"""Through a network on CUDA (csrc/network/grouped_mlp.h)."""


def _choose_way() -> str:
    """The way of VORONERF_CUDA_MLP, with which gpu-check and benchmarks compare what the kernels reach."""
    wanted = os.environ.get("VORONERF_CUDA_MLP") or WAYS[0]
    if wanted not in WAYS:
        raise ValueError(f"VORONERF_CUDA_MLP must be one of {', '.join(WAYS)}, got {wanted!r}")
    return wanted


_way = _choose_way()


@contextmanager
def using_way(way: str) -> Iterator[None]:
    """Every network on CUDA goes this way, one of ``WAYS``, or is refused, while the context lasts."""
    global _way
    if way not in WAYS:
        raise ValueError(f"using_way: way must be one of {', '.join(WAYS)}, got {way!r}")
    before, _way = _way, way
    try:
        yield
    finally:
        _way = before


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
    taken, dtype = network(given, cells, hashed_before=before)
    out: Tensor
    out, _ = _forward(taken, offsets, keeps_encoded(taken))
    return out.to(dtype)


def grouped_linear(
    x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None = None, *, activation: str = "none"
) -> Tensor:
    """Every sample through the layer of its cell; see ``voronerf.ops.grouped_linear``. A network of one layer.

    For CUDA; the CPU has kernels of one layer (``voronerf/ops/grouped_linear/cpu.py``).
    """
    layers = _LINEAR[activation]
    taken, dtype = in_float32(Given(x, [weight], [bias], layers), layers.text, "grouped_linear")
    out: Tensor
    out, _ = _forward(taken, offsets, False)
    return out.to(dtype)


@custom_op("grouped_mlp_native")
def _forward(network: Network, offsets: Tensor, keep: bool) -> Iterator[tuple[Tensor, Tensor]]:
    """Output, and for the backward pass what `new_encoded` says."""
    out, encoded = new_output(network), new_encoded(network, keep)
    yield out, encoded
    run(out, encoded, network, offsets, None)


def hashes_before(given: Given) -> bool:
    """Whether a hash grid is looked up before the network: on CUDA, where its kernels do not do it themselves."""
    positions, weights, layers = given.positions, given.weights, given.layers
    if layers.grid is None or not native.on_cuda(positions):
        return False
    if torch.compiler.is_compiling():  # which cannot ask the compiled module
        return True
    multiplied = operands(positions, storage(positions, weights))
    text = table_text(layers.text, "grouped_mlp", multiplied, "")
    machine = native.machine(positions)
    assert isinstance(machine, native.compiled.Cuda)
    return not _hashes(table_key(text, positions, weights, given.directions), _precision(multiplied), _way, machine)


@functools.lru_cache(maxsize=256)
def _hashes(key: Key, precision: str, way: str, machine: native.compiled.Cuda) -> bool:
    return native.compiled.grouped_mlp_hashes(table_of(*key), precision, way, machine)


def keeps_encoded(given: Network) -> bool:
    """Whether the forward pass of a network keeps hashed positions for the backward pass.

    To look 16 features of 8 levels up again takes some 70 ns a sample, to write them 9 (Zen 4, one thread).
    """
    inputs = (given.positions, given.directions, given.features, *given.weights, *given.biases)
    differentiable = any(tensor is not None and tensor.requires_grad for tensor in inputs)
    return given.features is not None and torch.is_grad_enabled() and differentiable


def new_encoded(network: Network, keep: bool) -> Tensor:
    """For hashed positions in the order of their cells, [n, features rounded up to 16]; empty if they are not kept."""
    grid, positions = Table.parse(network.table).layers.grid, network.positions
    if grid is None or not keep:
        return positions.new_empty(0)
    return positions.new_empty(positions.shape[0], -(-grid.out_features // 16) * 16)


def new_output(network: Network) -> Tensor:
    """[n, features of all outputs]."""
    outputs = Table.parse(network.table).layers.outputs
    features = sum(network.weights[output].shape[1] for output in outputs)
    return network.positions.new_empty(network.positions.shape[0], features)


def run(out: Tensor, encoded: Tensor, network: Network, offsets: Tensor, order: Tensor | None) -> None:
    """Fills the output of sorted rows, or of those that ``order`` int32 [n] sorts."""
    native.on_huge_pages(out)
    native.on_huge_pages(encoded)
    inputs, key = inputs_of(network, offsets, order, encoded), key_of(network)
    compiled, machine = native.compiled, native.machine(network.positions)
    if isinstance(machine, compiled.Cuda):
        call, workspace = _on_cuda(key, inputs, machine, backward=False, parameters=False)
        compiled.grouped_mlp(call, inputs, out, workspace, machine)
    else:
        compiled.grouped_mlp(table_of(*key), inputs, out, machine)


@custom_op("grouped_mlp_native_backward")
def backward(
    gradient: Tensor, network: Network, offsets: Tensor, order: Tensor | None, encoded: Tensor, wanted: Sequence[bool]
) -> Iterator[list[Tensor]]:
    """Gradients of weights, biases, positions, directions and features, in float32.

    They are empty unless wanted: (parameters, positions, directions, features).
    """
    positions, weights, biases, _, directions, direction_index, features = network
    count = len(weights)
    chosen = [wanted[0]] * (2 * count) + list(wanted[1:])
    results = [
        positions.new_empty(tensor.shape if tensor is not None and want else 0)
        for tensor, want in zip((*weights, *biases, positions, directions, features), chosen)
    ]
    yield results
    if positions.shape[0] == 0:  # where nothing of a hash grid could be kept
        for result in results:
            result.zero_()
        return
    for result in results:
        native.on_huge_pages(result)
    compiled, machine = native.compiled, native.machine(positions)
    inputs, key = inputs_of(network, offsets, order, encoded), key_of(network)
    to_directions = results[-2] if wanted[2] else None
    of_samples = None
    if isinstance(machine, compiled.Cuda) and wanted[2] and direction_index is not None and directions is not None:
        to_directions = of_samples = positions.new_empty(positions.shape[0], directions.shape[1])
    gradients = compiled.MlpGradients(
        output=gradient,
        weights=results[:count] if wanted[0] else None,
        biases=_present(results[count : 2 * count]) if wanted[0] else None,
        positions=results[-3] if wanted[1] else None,
        directions=to_directions,
        features=results[-1] if wanted[3] else None,
    )
    if isinstance(machine, compiled.Cuda):
        if wanted[3]:
            native.refuse_where_deterministic(Table.parse(network.table).caller, positions)
        call, workspace = _on_cuda(key, inputs, machine, backward=True, parameters=wanted[0])
        compiled.grouped_mlp_backward(call, inputs, gradients, workspace, machine)
    else:
        compiled.grouped_mlp_backward(table_of(*key), inputs, gradients, machine)
    if of_samples is not None and direction_index is not None:
        # torch adds in a fixed order where deterministic algorithms are asked for.
        results[-2].zero_().index_add_(0, direction_index, of_samples)


def key_of(network: Network) -> Key:
    """What the compiled table of a network is looked up by."""
    return table_key(network.table, network.positions, network.weights, network.directions)


def inputs_of(network: Network, offsets: Tensor, order: Tensor | None, encoded: Tensor) -> native.compiled.MlpInputs:
    """What compiled functions read of a network, with rows of its cells by offsets [k + 1] and an order."""
    directions, features = network.directions, network.features
    return native.compiled.MlpInputs(
        positions=network.positions,
        directions=directions,
        direction_index=network.direction_index,
        offsets=offsets,
        weights=network.weights,
        biases=_present(network.biases),
        n=network.positions.shape[0],
        r=0 if directions is None else directions.shape[0],
        k=offsets.shape[0] - 1,
        order=order,
        features=None if features is None else native.aligned(features),
        features_type="float32" if features is None else str(features.dtype).removeprefix("torch."),
        tables=1 if features is None or features.dim() == 2 else features.shape[0],
        encoded=encoded if encoded.numel() else None,
    )


def _present(biases: Sequence[Tensor]) -> list[Tensor | None]:
    """Biases with None for the empty tensors of layers that have none."""
    return [bias if bias.numel() else None for bias in biases]


def _on_cuda(
    key: Key, inputs: native.compiled.MlpInputs, machine: native.compiled.Cuda, *, backward: bool, parameters: bool
) -> tuple[native.compiled.MlpCudaCall, Tensor]:
    """What a call takes besides its tensors: its plan and a workspace."""
    assert inputs.positions is not None
    precision = _precision(Table.parse(key[0]).operands)
    call, size = _plan(key, inputs.n, inputs.k, backward, parameters, precision, _way, machine)
    return call, inputs.positions.new_empty(size, dtype=torch.uint8)


@functools.lru_cache(maxsize=256)
def _plan(
    key: Key, n: int, k: int, backward: bool, parameters: bool, precision: str, way: str, machine: native.compiled.Cuda
) -> tuple[native.compiled.MlpCudaCall, int]:
    """The plan of a call, which takes tens of microseconds, and the bytes of its workspace."""
    call = native.compiled.grouped_mlp_call(table_of(*key), n, k, backward, parameters, precision, way, machine)
    return call, native.compiled.grouped_mlp_workspace(call)


def _precision(multiplied: str) -> str:
    """What products take on CUDA."""
    tf32 = multiplied == "float32" and torch.backends.cuda.matmul.fp32_precision == "tf32"
    return "tf32" if tf32 else multiplied


def _forward_setup(ctx: Any, inputs: tuple[Network, Tensor, bool], output: tuple[Tensor, Tensor]) -> None:
    network, offsets, _ = inputs
    ctx.mark_non_differentiable(output[1])
    ctx.set_materialize_grads(False)
    keep_network(ctx, network, offsets, output[1])


def _forward_backward(ctx: Any, gradient: Tensor | None, _of_encoded: None) -> tuple[Any, ...]:
    network, (offsets, encoded) = kept_network(ctx)
    return gradients_of_network(ctx, gradient, network, offsets, None, encoded), None, None


def keep_network(ctx: Any, network: Network, *others: Tensor) -> None:
    """Saves a network and other tensors for the backward pass."""
    ctx.table, ctx.count = network.table, len(network.weights)
    positions, weights, biases, _, *rest = network
    ctx.save_for_backward(positions, *weights, *biases, *rest, *others)


def kept_network(ctx: Any) -> tuple[Network, Sequence[Tensor]]:
    """What `keep_network` saved."""
    saved, count = ctx.saved_tensors, ctx.count
    weights, biases = saved[1 : 1 + count], saved[1 + count : 1 + 2 * count]
    directions, index, features, *others = saved[1 + 2 * count :]
    return Network(saved[0], weights, biases, ctx.table, directions, index, features), others


def gradients_of_network(
    ctx: Any, gradient: Tensor | None, network: Network, offsets: Tensor, order: Tensor | None, encoded: Tensor
) -> Network:
    """Gradients in the place of what they are of, None where there is none; ``ctx``: whom the engine asks for them."""
    count = ctx.count
    if gradient is None:
        return Network(*cast(Any, (None, [None] * count, [None] * count, None, None, None, None)))
    positions, weights, biases, _, directions, index, features = network
    asked = asked_for(ctx, (positions, *weights, *biases, directions, index, features))
    to_positions, *to_parameters, to_directions, _, to_features = asked
    wanted = *to_parameters, to_positions, to_directions, to_features
    *found, of_positions, of_directions, of_features = gradients(
        gradient, network, offsets, order, encoded, asked=wanted
    )
    return Network(*cast(Any, (of_positions, found[:count], found[count:], None, of_directions, None, of_features)))


def gradients(
    gradient: Tensor, network: Network, offsets: Tensor, order: Tensor | None, encoded: Tensor, *, asked: Sequence[bool]
) -> list[Tensor | None]:
    """Gradients of weights, biases, positions, directions and features, None for those that are not asked for."""
    if torch.is_grad_enabled():
        return differentiable(gradient, network, offsets, order, asked=asked)
    *parameters, to_positions, to_directions, to_features = asked
    wanted = [any(parameters), to_positions, to_directions, to_features]
    *results, of_features = backward(gradient, network, offsets, order, encoded, wanted)
    if network.features is not None and to_features:
        of_features = of_features.to(network.features.dtype)
    return [result if want else None for result, want in zip((*results, of_features), asked)]


_forward.register_autograd(_forward_backward, setup_context=_forward_setup)
