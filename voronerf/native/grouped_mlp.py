"""Whole per-cell networks of the compiled module as PyTorch ops: ``grouped_mlp``, and ``grouped_linear`` on CUDA.

n samples, r rays, k cells, p and q features of a raw position and direction, i inputs and o outputs of a layer. Two
custom ops, forward and backward, functional both: they make inputs contiguous, allocate outputs, and pass addresses.
Tensors are cast to float32 on the way in and back on the way out, a cell having few weights. With bfloat16 storage, or
under autocast to it, products take bfloat16 operands where the processor multiplies them faster (AVX512-BF16), and
float32 ones elsewhere; sums are float32 always. Second derivatives come from the reference formula. Shapes and dtypes
have been validated by ``voronerf.ops``.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf import native as _native
from voronerf.derivatives import aliases, second_derivatives
from voronerf.layers import ACTIVATIONS, DIRECTIONS, MLP, POSITIONS, Layer
from voronerf.reference.frequency_encode import frequency_encode
from voronerf.reference.grouped_mlp import grouped_mlp as _reference
from voronerf.reference.specification import encode_positions

_OUTSIDE = {POSITIONS: -1, DIRECTIONS: -2}
# Of one layer, whose width does not matter here.
_LINEAR = {activation: MLP((Layer((POSITIONS,), 1, activation),), (0,)).text for activation in ACTIVATIONS}
# Operations by the numbers of MlpCaller in csrc/network/grouped_mlp.h.
CALLERS = ("grouped_mlp", "grouped_linear", "routed_mlp")
# Types of products by the numbers of MlpPrecision in grouped_mlp_cuda_plan.h; the CPU has the first two.
_OPERANDS = ("float32", "bfloat16", "float16", "tf32")
# Ways through a network on CUDA, by the numbers of MlpCudaWay in csrc/network/cuda/grouped_mlp_cuda_layers.h.
WAYS = ("auto", "chain", "tiles", "layers", "wgmma")


def _choose_way() -> int:
    """The way of VORONERF_CUDA_MLP, with which gpu-check and benchmarks compare what the kernels reach."""
    wanted = os.environ.get("VORONERF_CUDA_MLP") or WAYS[0]
    if wanted not in WAYS:
        raise ValueError(f"VORONERF_CUDA_MLP must be one of {', '.join(WAYS)}, got {wanted!r}")
    return WAYS.index(wanted)


_WAY = _choose_way()


@contextmanager
def taking(way: str) -> Iterator[None]:
    """For a while every network on CUDA goes this way, one of ``WAYS``, or is refused."""
    global _WAY
    before, _WAY = _WAY, WAYS.index(way)
    try:
        yield
    finally:
        _WAY = before


def grouped_mlp(
    positions: Tensor,
    offsets: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    *,
    layers: MLP,
    directions: Tensor | None = None,
    direction_index: Tensor | None = None,
) -> Tensor:
    """Every sample through the network of its cell; see ``voronerf.ops.grouped_mlp``.

    Under ``torch.autocast`` to bfloat16, products take bfloat16 operands where the processor has them.
    """
    given = network(positions, weights, biases, layers, directions)
    out: Tensor = _forward(
        given.positions, offsets, given.weights, given.biases, given.table, given.directions, direction_index
    )
    return out.to(given.dtype)


def grouped_linear(
    x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor | None = None, *, activation: str = "none"
) -> Tensor:
    """Every sample through the layer of its cell; see ``voronerf.ops.grouped_linear``. A network of one layer.

    For CUDA; the CPU has kernels of one layer (``voronerf/native/grouped_linear.py``).
    """
    given = _cast(x, [weight], [bias], "grouped_linear", [], _LINEAR[activation], None)
    out: Tensor = _forward(given.positions, offsets, given.weights, given.biases, given.table, None, None)
    return out.to(given.dtype)


class Network(NamedTuple):
    """Arguments of the ops, in float32, and the storage type of their result (autocast's, where it is on)."""

    positions: Tensor
    weights: list[Tensor]
    biases: list[Tensor]
    table: str
    directions: Tensor | None
    dtype: torch.dtype


def network(
    positions: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    layers: MLP,
    directions: Tensor | None,
    caller: str = "grouped_mlp",
) -> Network:
    """What the ops take for a layer table. Positions and directions in float64 are encoded in float64, beforehand."""
    encoded = []
    if positions.dtype == torch.float64 and layers.position_octaves is not None:
        positions = encode_positions(positions, layers)
        encoded.append(POSITIONS)
    if directions is not None and directions.dtype == torch.float64 and layers.direction_octaves is not None:
        directions = frequency_encode(directions, layers.direction_octaves)
        encoded.append(DIRECTIONS)
    return _cast(positions, weights, biases, caller, encoded, layers.text, directions)


def _cast(
    positions: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    caller: str,
    encoded: Sequence[str],
    text: str,
    directions: Tensor | None,
) -> Network:
    """Everything in float32, and the table for the ops: a string, since a list of numbers costs them 15 us a call.

    No number is written into it here, since it may be symbolic under ``torch.compile``; widths are those of the
    weights. ``encoded``: what is encoded already, whatever ``text`` says.
    """
    dtype, kind = weights[0].dtype, positions.device.type
    if torch.is_autocast_enabled(kind):
        dtype = torch.get_autocast_dtype(kind)
    return Network(
        positions.float(),
        [weight.float() for weight in weights],
        # Autograd takes no list of optional tensors; an empty one stands for no bias.
        [positions.new_empty(0, dtype=torch.float32) if bias is None else bias.float() for bias in biases],
        " ".join((caller, _operands(positions, dtype), "+".join(encoded), text)),
        None if directions is None else directions.float(),
        dtype,
    )


def _operands(positions: Tensor, dtype: torch.dtype) -> str:
    """Type of what is multiplied; CUDA alone has float16."""
    if dtype == torch.float16 and _native.on_cuda(positions):
        return "float16"
    return "bfloat16" if dtype == torch.bfloat16 else "float32"


class _Table(NamedTuple):
    """What the string of ``_cast`` says."""

    layers: MLP  # with the widths of ``text``, not of the weights
    numbers: list[int]  # as csrc/bindings/bindings_mlp.cpp reads them, but for p, q and the widths
    widths: list[int]  # where in ``numbers`` the width of each layer belongs


@functools.lru_cache(maxsize=256)
def _read(table: str) -> _Table:
    caller, operands, encoded, text = table.split(" ", 3)
    layers = MLP.parse(text)
    if POSITIONS in encoded:
        layers = replace(layers, position_octaves=None, position_encoding="frequency")
    if DIRECTIONS in encoded:
        layers = replace(layers, direction_octaves=None)
    octaves = [-1 if count is None else count for count in (layers.position_octaves, layers.direction_octaves)]
    numbers = [0, 0, *octaves, _OPERANDS.index(operands), CALLERS.index(caller), int(layers.integrated)]
    numbers += [len(layers.layers), len(layers.outputs)]
    widths = []
    for layer in layers.layers:
        widths.append(len(numbers))
        sources = [_OUTSIDE[source] if isinstance(source, str) else source for source in layer.inputs]
        numbers += [0, ACTIVATIONS.index(layer.activation), len(sources), *sources]
    return _Table(layers, [*numbers, *layers.outputs], widths)


def _numbers(table: str, positions: Tensor, weights: Sequence[Tensor], directions: Tensor | None) -> list[int]:
    """The table for csrc/bindings/bindings_mlp.cpp."""
    given = _read(table)
    numbers = given.numbers.copy()
    numbers[0], numbers[1] = positions.shape[1], 0 if directions is None else directions.shape[1]
    for at, weight in zip(given.widths, weights):
        numbers[at] = weight.shape[1]
    return numbers


def _layers(table: str, weights: Sequence[Tensor]) -> MLP:
    """The layer table, with the widths of the weights."""
    given = _read(table).layers
    layers = tuple(replace(layer, width=int(weight.shape[1])) for layer, weight in zip(given.layers, weights))
    return replace(given, layers=layers)


@torch.library.custom_op("voronerf::grouped_mlp_native", mutates_args=(), device_types=("cpu", "cuda"))
def _forward(
    positions: Tensor,
    offsets: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    table: str,
    directions: Tensor | None,
    direction_index: Tensor | None,
) -> Tensor:
    return run(positions, offsets, weights, biases, table, directions, direction_index, None)


def run(
    positions: Tensor,
    offsets: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    table: str,
    directions: Tensor | None,
    direction_index: Tensor | None,
    order: Tensor | None,
) -> Tensor:
    """The forward pass on sorted rows, or on those that ``order`` int32 [n] sorts."""
    kept = _Arguments(positions, offsets, weights, biases, directions, direction_index, order)
    out = _native.fresh(_allocate(positions, table, weights))
    numbers = _numbers(table, positions, weights, directions)
    given = numbers, kept.inputs, kept.weights, kept.biases, out.data_ptr()
    if _native.on_cuda(positions):
        device = _Device(kept, numbers, backward=False, parameters=False)
        _native._C.grouped_mlp_cuda(*given, *device.arguments)
    else:
        _native._C.grouped_mlp(*given, _native._ISA, torch.get_num_threads())
    return out


@torch.library.custom_op("voronerf::grouped_mlp_native_backward", mutates_args=(), device_types=("cpu", "cuda"))
def _backward(
    gradient: Tensor,
    positions: Tensor,
    offsets: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    table: str,
    directions: Tensor | None,
    direction_index: Tensor | None,
    order: Tensor | None,
    wanted: Sequence[bool],
) -> list[Tensor]:
    kept = _Arguments(positions, offsets, weights, biases, directions, direction_index, order)
    results = [_native.fresh(each) for each in _allocate_gradients(positions, weights, biases, directions, wanted)]
    count, gradient = len(weights), gradient.contiguous()
    addresses = [_address(result) for result in results]
    numbers = _numbers(table, positions, weights, directions)
    given = (
        numbers,
        kept.inputs,
        kept.weights,
        kept.biases,
        gradient.data_ptr(),
        addresses[:count] if wanted[0] else [],
        addresses[count : 2 * count] if wanted[0] else [],
        addresses[-2] if wanted[1] else 0,
    )
    if not _native.on_cuda(positions):
        to_directions = addresses[-1] if wanted[2] else 0
        _native._C.grouped_mlp_backward(*given, to_directions, _native._ISA, torch.get_num_threads())
        return results
    device = _Device(kept, numbers, backward=True, parameters=wanted[0])
    of_samples = results[-1]
    if wanted[2] and direction_index is not None and directions is not None:
        of_samples = positions.new_empty(positions.shape[0], directions.shape[1])
    _native._C.grouped_mlp_backward_cuda(*given, _address(of_samples) if wanted[2] else 0, *device.arguments)
    if of_samples is not results[-1] and direction_index is not None:
        # torch adds in a fixed order where deterministic algorithms are asked for.
        results[-1].zero_().index_add_(0, direction_index, of_samples)
    return results


class _Device:
    """What a CUDA call takes besides its tensors: the type of the products, a workspace, the device and its stream."""

    def __init__(self, kept: _Arguments, numbers: list[int], *, backward: bool, parameters: bool) -> None:
        positions = kept.tensors[0]
        assert positions is not None
        device, stream = _native.stream(positions)
        precision = numbers[4]
        if precision == 0 and torch.backends.cuda.matmul.fp32_precision == "tf32":
            precision = _OPERANDS.index("tf32")
        sizes = kept.inputs[5], kept.inputs[7]
        size = _native._C.grouped_mlp_workspace_cuda(numbers, precision, *sizes, backward, parameters, device, _WAY)
        if isinstance(size, str):
            raise ValueError(f"{CALLERS[numbers[5]]}: {size} on CUDA; use backend='reference'")
        self.workspace = positions.new_empty(size, dtype=torch.uint8)
        self.arguments = precision, self.workspace.data_ptr(), device, stream, _WAY


class _Arguments:
    """Contiguous inputs of a call, kept alive, and their addresses in the order of csrc/bindings/bindings_mlp.cpp."""

    def __init__(
        self,
        positions: Tensor,
        offsets: Tensor,
        weights: Sequence[Tensor],
        biases: Sequence[Tensor],
        directions: Tensor | None,
        direction_index: Tensor | None,
        order: Tensor | None,
    ) -> None:
        given = (positions, directions, direction_index, offsets, order, *weights, *biases)
        self.tensors = [None if tensor is None else tensor.contiguous() for tensor in given]
        addresses = [_address(tensor) for tensor in self.tensors]
        if direction_index is not None and not addresses[2]:
            addresses[2] = addresses[3]  # an index of no samples has no address, but it is there
        rays = 0 if directions is None else directions.shape[0]
        self.inputs = [*addresses[:5], positions.shape[0], rays, offsets.shape[0] - 1]
        self.weights, self.biases = addresses[5 : 5 + len(weights)], addresses[5 + len(weights) :]


def _address(tensor: Tensor | None) -> int:
    return 0 if tensor is None or tensor.numel() == 0 else tensor.data_ptr()


def _allocate(positions: Tensor, table: str, weights: Sequence[Tensor]) -> Tensor:
    features = sum(weights[output].shape[1] for output in _read(table).layers.outputs)
    return positions.new_empty(positions.shape[0], features)


def _allocate_gradients(
    positions: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    directions: Tensor | None,
    wanted: Sequence[bool],
) -> list[Tensor]:
    """Gradients of weights, biases, positions, directions; empty unless wanted: (parameters, positions, directions)."""
    chosen = [wanted[0]] * (len(weights) + len(biases)) + [wanted[1], wanted[2]]
    return [
        torch.empty_like(tensor, memory_format=torch.contiguous_format)
        if tensor is not None and want
        else positions.new_empty(0)
        for tensor, want in zip((*weights, *biases, positions, directions), chosen)
    ]


@_forward.register_fake
def _(
    positions: Tensor,
    offsets: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    table: str,
    directions: Tensor | None,
    direction_index: Tensor | None,
) -> Tensor:
    return _allocate(positions, table, weights)


@_backward.register_fake
def _(
    gradient: Tensor,
    positions: Tensor,
    offsets: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    table: str,
    directions: Tensor | None,
    direction_index: Tensor | None,
    order: Tensor | None,
    wanted: Sequence[bool],
) -> list[Tensor]:
    return _allocate_gradients(positions, weights, biases, directions, wanted)


def _forward_setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    positions, offsets, weights, biases, ctx.table, directions, direction_index = inputs
    ctx.count = len(weights)
    ctx.save_for_backward(positions, offsets, directions, direction_index, *weights, *biases)


def _forward_backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:
    positions, offsets, directions, direction_index, *parameters = ctx.saved_tensors
    weights, biases = parameters[: ctx.count], parameters[ctx.count :]
    needs = ctx.needs_input_grad
    wanted = [any(needs[2]) or any(needs[3]), needs[0], needs[5]]
    results = _backward(
        gradient, positions, offsets, weights, biases, ctx.table, directions, direction_index, None, wanted
    )
    return (
        results[-2] if needs[0] else None,
        None,
        [result if need else None for result, need in zip(results, needs[2])],
        [result if need else None for result, need in zip(results[ctx.count :], needs[3])],
        None,
        results[-1] if needs[5] else None,
        None,
    )


def _backward_setup(ctx: Any, inputs: tuple[Any, ...], output: list[Tensor]) -> None:
    gradient, positions, offsets, weights, biases, ctx.table, directions, direction_index, order, ctx.wanted = inputs
    ctx.count = len(weights)
    ctx.save_for_backward(gradient, positions, offsets, directions, direction_index, order, *weights, *biases)


def _backward_backward(ctx: Any, cotangents: list[Tensor]) -> tuple[Any, ...]:
    """Derivative of the gradients, through the reference formula."""
    gradient, positions, offsets, directions, direction_index, order, *parameters = ctx.saved_tensors
    count = ctx.count
    leaves, graph = aliases((*parameters, positions, directions, gradient))
    with torch.enable_grad():
        *inputs, gradient = leaves
        rows, seen = _given(leaves[-3]), leaves[-2]
        if order is not None:
            rows, gradient = rows[order], _given(gradient)[order]
            if direction_index is not None:
                direction_index = direction_index[order]
            elif seen is not None:
                seen = seen[order]
        out = _reference(
            rows,
            offsets,
            [_given(weight) for weight in leaves[:count]],
            [bias if _given(bias).numel() else None for bias in leaves[count : 2 * count]],
            layers=_layers(ctx.table, parameters[:count]),
            directions=seen,
            direction_index=direction_index,
        )
        chosen = [ctx.wanted[0]] * (2 * count) + [ctx.wanted[1], ctx.wanted[2]]
        pairs = [
            (tensor, cotangent)
            for tensor, cotangent, want in zip(inputs, cotangents, chosen)
            if want and tensor is not None and tensor.numel() and cotangent is not None
        ]
        results = second_derivatives([(out, gradient)], pairs, leaves, graph)
    return (
        results[-1],
        results[-3],
        None,
        results[:count],
        results[count : 2 * count],
        None,
        results[-2],
        None,
        None,
        None,
    )


def _given(tensor: Tensor | None) -> Tensor:
    assert tensor is not None
    return tensor


_forward.register_autograd(_forward_backward, setup_context=_forward_setup)
_backward.register_autograd(_backward_backward, setup_context=_backward_setup)
