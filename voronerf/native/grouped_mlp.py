"""Whole per-cell networks of the compiled module: ``grouped_mlp``, and ``grouped_linear`` on CUDA.

n samples, r rays, k cells, p and q features of a raw position and direction, i inputs and o outputs of a layer. Tensors
are cast to float32 on the way in and back on the way out, a cell having few weights. With bfloat16 storage, or under
autocast to it, products take bfloat16 operands where the processor multiplies them faster (AVX512-BF16), and float32
ones elsewhere; sums are float32 always. Gradients that will be differentiated again are taken layer by layer
(``layerwise.py``).
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from voronerf import native
from voronerf.derivatives import asked_for
from voronerf.layers import ACTIVATIONS, MLP, POSITIONS, Layer
from voronerf.native.custom_op import custom_op, on_huge_pages
from voronerf.native.layer_table import Table, compiled_table, in_float32, network
from voronerf.reference.grouped_mlp import cells_of

# Of one layer, whose width does not matter here.
_LINEAR = {activation: MLP((Layer((POSITIONS,), 1, activation),), (0,)).text for activation in ACTIVATIONS}
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
    own = features is not None and features.dim() == 3
    cells = cells_of(offsets, positions) if own else None
    given = network(positions, weights, biases, layers, directions, features, cells)
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
    given = in_float32(x, [weight], [bias], _LINEAR[activation], None, "grouped_linear")
    out: Tensor = _forward(given.positions, offsets, given.weights, given.biases, given.table, None, None)
    return out.to(given.dtype)


@custom_op("grouped_mlp_native")
def _forward(
    positions: Tensor,
    offsets: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    table: str,
    directions: Tensor | None,
    direction_index: Tensor | None,
) -> Iterator[Tensor]:
    out = new_output(positions, table, weights)
    yield out
    run(out, positions, offsets, weights, biases, table, directions, direction_index, None)


def new_output(positions: Tensor, table: str, weights: Sequence[Tensor]) -> Tensor:
    """[n, features of all outputs]."""
    features = sum(weights[output].shape[1] for output in Table.parse(table).layers.outputs)
    return positions.new_empty(positions.shape[0], features)


def run(
    out: Tensor,
    positions: Tensor,
    offsets: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    table: str,
    directions: Tensor | None,
    direction_index: Tensor | None,
    order: Tensor | None,
) -> None:
    """Fills the output of sorted rows, or of those that ``order`` int32 [n] sorts."""
    on_huge_pages(out)
    given = compiled_table(table, positions, weights, directions)
    inputs = _inputs(positions, offsets, weights, biases, directions, direction_index, order)
    compiled, machine = native.compiled, native.machine(positions)
    if isinstance(machine, compiled.Cuda):
        rest = _on_cuda(table, given, inputs, machine, backward=False, parameters=False)
        compiled.grouped_mlp(given, inputs, out, *rest, machine)
    else:
        compiled.grouped_mlp(given, inputs, out, machine)


@custom_op("grouped_mlp_native_backward")
def backward(
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
) -> Iterator[list[Tensor]]:
    """Gradients of weights, biases, positions, directions; empty unless wanted: (parameters, positions, directions)."""
    count = len(weights)
    chosen = [wanted[0]] * (2 * count) + [wanted[1], wanted[2]]
    results = [
        tensor.new_empty(tensor.shape) if tensor is not None and want else positions.new_empty(0)
        for tensor, want in zip((*weights, *biases, positions, directions), chosen)
    ]
    yield results
    for result in results:
        on_huge_pages(result)
    compiled, machine = native.compiled, native.machine(positions)
    given = compiled_table(table, positions, weights, directions)
    inputs = _inputs(positions, offsets, weights, biases, directions, direction_index, order)
    to_directions = results[-1] if wanted[2] else None
    of_samples = None
    if isinstance(machine, compiled.Cuda) and wanted[2] and direction_index is not None and directions is not None:
        to_directions = of_samples = positions.new_empty(positions.shape[0], directions.shape[1])
    gradients = compiled.MlpGradients(
        output=gradient,
        weights=results[:count] if wanted[0] else None,
        biases=_present(results[count : 2 * count]) if wanted[0] else None,
        positions=results[-2] if wanted[1] else None,
        directions=to_directions,
    )
    if isinstance(machine, compiled.Cuda):
        rest = _on_cuda(table, given, inputs, machine, backward=True, parameters=wanted[0])
        compiled.grouped_mlp_backward(given, inputs, gradients, *rest, machine)
    else:
        compiled.grouped_mlp_backward(given, inputs, gradients, machine)
    if of_samples is not None and direction_index is not None:
        # torch adds in a fixed order where deterministic algorithms are asked for.
        results[-1].zero_().index_add_(0, direction_index, of_samples)


def _inputs(
    positions: Tensor,
    offsets: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    directions: Tensor | None,
    direction_index: Tensor | None,
    order: Tensor | None,
) -> native.compiled.MlpInputs:
    return native.compiled.MlpInputs(
        positions=positions,
        directions=directions,
        direction_index=direction_index,
        offsets=offsets,
        weights=weights,
        biases=_present(biases),
        n=positions.shape[0],
        r=0 if directions is None else directions.shape[0],
        k=offsets.shape[0] - 1,
        order=order,
    )


def _present(biases: Sequence[Tensor]) -> list[Tensor | None]:
    """Biases with None for the empty tensors of layers that have none."""
    return [bias if bias.numel() else None for bias in biases]


def _on_cuda(
    table: str,
    given: native.compiled.MlpTable,
    inputs: native.compiled.MlpInputs,
    machine: native.compiled.Cuda,
    *,
    backward: bool,
    parameters: bool,
) -> tuple[str, str, Tensor]:
    """What a call takes besides its tensors: the type of the products, the way, a workspace."""
    precision, positions = Table.parse(table).operands, inputs.positions
    if precision == "float32" and torch.backends.cuda.matmul.fp32_precision == "tf32":
        precision = "tf32"
    size = native.compiled.grouped_mlp_workspace(
        given, inputs.n, inputs.k, backward, parameters, precision, _way, machine
    )
    assert positions is not None
    return precision, _way, positions.new_empty(size, dtype=torch.uint8)


def _forward_setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    positions, offsets, weights, biases, ctx.table, directions, direction_index = inputs
    ctx.count = len(weights)
    ctx.save_for_backward(positions, offsets, *weights, *biases, directions, direction_index)


def _forward_backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:
    saved = positions, offsets, *parameters, directions, direction_index = ctx.saved_tensors
    to_positions, _, *to_parameters, to_directions, _ = asked_for(ctx, saved)
    network = positions, offsets, parameters[: ctx.count], parameters[ctx.count :], ctx.table, directions
    found = gradients(gradient, *network, direction_index, None, asked=(*to_parameters, to_positions, to_directions))
    *of_parameters, of_positions, of_directions = found
    of_weights, of_biases = of_parameters[: ctx.count], of_parameters[ctx.count :]
    return of_positions, None, of_weights, of_biases, None, of_directions, None


def gradients(
    gradient: Tensor,
    positions: Tensor,
    offsets: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    table: str,
    directions: Tensor | None,
    direction_index: Tensor | None,
    order: Tensor | None,
    *,
    asked: Sequence[bool],
) -> list[Tensor | None]:
    """Gradients of weights, biases, positions and directions, None for those that are not asked for."""
    if torch.is_grad_enabled():
        # Late: that module takes grouped_linear, which takes this one for CUDA.
        from voronerf.native.layerwise import gradients as differentiable

        layers = Table.parse(table).with_widths(weights)
        given = gradient, positions, offsets, weights, biases, layers, directions, direction_index, order
        return differentiable(*given, asked=asked)
    *parameters, to_positions, to_directions = asked
    wanted = [any(parameters), to_positions, to_directions]
    results = backward(gradient, positions, offsets, weights, biases, table, directions, direction_index, order, wanted)
    return [result if want else None for result, want in zip(results, asked)]


_forward.register_autograd(_forward_backward, setup_context=_forward_setup)
