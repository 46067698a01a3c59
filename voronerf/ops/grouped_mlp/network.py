"""Whole networks as compiled functions take them, for the ops that run them.

n samples, r rays, k cells, p and q features of a raw position and direction. Tensors are cast to float32 on the way in
and back on the way out, a cell having few weights. With bfloat16 storage, or under autocast to it, products take
bfloat16 operands where the processor multiplies them faster (AVX512-BF16), and float32 ones elsewhere; sums are float32
always.

An op takes its layers as a string, since a list of numbers costs a call of ``torch.library`` 15 us, and since a graph
that ``torch.compile`` keeps may be read by another process. A string is parsed once.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import custom_op
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS
from voronerf.ops.grouped_mlp.reference import encode_directions, encode_positions
from voronerf.ops.hash_encode.native import compiled_grid, hash_encode

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


_OUTSIDE = {POSITIONS: -1, DIRECTIONS: -2}


class Given(NamedTuple):
    """Samples and parameters as the public functions take them."""

    positions: Tensor
    weights: Sequence[Tensor]
    biases: Sequence[Tensor | None]
    layers: MLP
    directions: Tensor | None = None
    direction_index: Tensor | None = None
    features: Tensor | None = None


class Network(NamedTuple):
    """Samples and parameters as the ops take them, in float32.

    Attributes:
        positions: [n, p].
        weights: one [k, o, i] for each layer.
        biases: one [k, o] for each layer. Autograd takes no list of optional tensors; an empty one stands for no bias.
        table: the layers; see `Table`.
        directions: [n, q] or [r, q], or None.
        direction_index: int32 [n] or None.
        features: of a hash grid, unless positions are encoded already; not in float32. Or None.
        keep: whether the forward pass keeps hashed positions for the backward pass. To look 16 features of 8 levels up
            again takes some 70 ns a sample, to write them 9 (Zen 4, one thread).
    """

    positions: Tensor
    weights: Sequence[Tensor]
    biases: Sequence[Tensor]
    table: str
    directions: Tensor | None
    direction_index: Tensor | None
    features: Tensor | None
    keep: bool


def as_network(
    given: Given, cells: Tensor | None, caller: str = "grouped_mlp", *, hashed_before: bool
) -> tuple[Network, torch.dtype]:
    """What the ops take for a layer table, and the storage type of their result (autocast's, where it is on).

    Octaves and harmonics of float64 are computed in float64, beforehand. So are positions that are hashed, where
    ``hashed_before`` says so; ``cells`` says their tables where each cell has one.
    """
    encoded = ""
    positions, weights, biases, layers, directions, index, features = given
    if features is not None and features.dtype == torch.float64:
        features = features.float()
    if hashed_before:
        assert features is not None and layers.grid is not None
        positions = hash_encode(positions, features, layers.grid, cells=cells if features.dim() == 3 else None)
        features = None
        encoded += POSITIONS
    elif positions.dtype == torch.float64 and layers.position_octaves is not None:
        positions = encode_positions(positions, layers)
        encoded += POSITIONS
    if directions is not None:
        wide = directions.dtype == torch.float64
        if wide and (layers.direction_octaves is not None or layers.direction_degree is not None):
            directions = encode_directions(directions, layers)
            encoded += DIRECTIONS
    now = Given(positions, weights, biases, layers, directions, index, features)
    return in_float32(now, layers.text, caller, encoded)


def in_float32(given: Given, text: str, caller: str, encoded: str = "") -> tuple[Network, torch.dtype]:
    """Everything in float32, with a table of which the layers are ``text`` (``MLP.text``), whatever those given are.

    No number is written into it, since it may be symbolic under ``torch.compile``; widths are those of the weights.
    ``encoded``: what is encoded already, whatever ``text`` says.
    """
    dtype = storage(given.positions, given.weights)
    text = table_text(text, caller, operands(given.positions, dtype), encoded)
    positions, directions, features = given.positions.float(), given.directions, given.features
    weights = [weight.float() for weight in given.weights]
    biases = [positions.new_empty(0) if bias is None else bias.float() for bias in given.biases]
    directions = None if directions is None else directions.float()
    keep = False
    if features is not None and torch.is_grad_enabled():
        inputs = (positions, directions, features, *weights, *biases)
        keep = any(tensor is not None and tensor.requires_grad for tensor in inputs)
    return Network(positions, weights, biases, text, directions, given.direction_index, features, keep), dtype


def table_text(layers: str, caller: str, multiplied: str, encoded: str) -> str:
    """A table as the ops take it; see `Table`."""
    return f"{caller} {multiplied} {encoded} {layers}"


def storage(positions: Tensor, weights: Sequence[Tensor]) -> torch.dtype:
    """Type of the weights, or autocast's where that is on."""
    kind = positions.device.type
    return torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else weights[0].dtype


def operands(positions: Tensor, dtype: torch.dtype) -> str:
    """Type of what is multiplied, of a storage type; CUDA alone has float16."""
    if dtype == torch.float16 and native.on_cuda(positions):
        return "float16"
    return "bfloat16" if dtype == torch.bfloat16 else "float32"


@dataclass(frozen=True)
class Table:
    """What the string of an op says.

    Attributes:
        caller: the operation that errors name.
        operands: type of what is multiplied, one of ``compiled.MlpPrecision``.
        layers: the layer table, without the encodings of what is encoded already. Its widths are not those of the
            weights.
    """

    caller: str
    operands: str
    layers: MLP

    @staticmethod
    @functools.lru_cache(maxsize=256)
    def parse(text: str) -> Table:
        """The table of a string."""
        caller, multiplied, encoded, layers = text.split(" ", 3)
        return Table(caller, multiplied, encoded_already(MLP.parse(layers), encoded))

    def with_widths(self, weights: Sequence[Tensor]) -> MLP:
        """The layer table, with the widths of the weights."""
        given = zip(self.layers.layers, weights)
        layers = tuple(replace(layer, width=int(weight.shape[1])) for layer, weight in given)
        return replace(self.layers, layers=layers)


def encoded_already(layers: MLP, sources: str) -> MLP:
    """The table without the encodings of these sources."""
    if POSITIONS in sources:
        layers = replace(layers, position_octaves=None, position_encoding="frequency", grid=None)
    if DIRECTIONS in sources:
        layers = replace(layers, direction_octaves=None, direction_encoding="frequency", direction_degree=None)
    return layers


Key = tuple[str, int, int, tuple[int, ...]]
"""Of a table: its string, p, q, and the widths of the weights."""


def table_key(text: str, positions: Tensor, weights: Sequence[Tensor], directions: Tensor | None) -> Key:
    """What a compiled table depends on, to be looked up by."""
    q = 0 if directions is None else directions.shape[1]
    return text, positions.shape[1], q, tuple([weight.shape[1] for weight in weights])


@functools.lru_cache(maxsize=256)
def table_of(text: str, p: int, q: int, widths: tuple[int, ...]) -> native.compiled.MlpTable:
    """The compiled table of a key."""
    table, compiled = Table.parse(text), native.compiled
    layers = table.layers
    return compiled.MlpTable(
        layers=tuple(
            compiled.MlpLayer(
                width=width,
                activation=layer.activation,
                inputs=tuple(_OUTSIDE[source] if isinstance(source, str) else source for source in layer.inputs),
            )
            for layer, width in zip(layers.layers, widths)
        ),
        outputs=layers.outputs,
        positions=p,
        directions=q,
        position=_encoding(
            layers.position_encoding, layers.position_octaves, layers.grid.out_features if layers.grid else None
        ),
        direction=_encoding(layers.direction_encoding, layers.direction_octaves, layers.direction_degree),
        grid=compiled.HashGrid([], [], [], 0, False) if layers.grid is None else compiled_grid(layers.grid.text),
        half=table.operands != "float32",
        caller=table.caller,
    )


def _encoding(kind: str, octaves: int | None, size: int | None) -> native.compiled.MlpEncoding:
    """An encoding of octaves, or of another ``size``; neither: none."""
    size = octaves if size is None else size
    return native.compiled.MlpEncoding("none", 0) if size is None else native.compiled.MlpEncoding(kind, size)


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


def new_results(network: Network) -> tuple[Tensor, Tensor]:
    """Outputs [n, features of all of them], and hashed positions in the order of their cells.

    These are [n, features rounded up to 16], empty if they are not kept.
    """
    layers, (n, _), new = Table.parse(network.table).layers, network.positions.shape, network.positions.new_empty
    out = new(n, sum(network.weights[output].shape[1] for output in layers.outputs))
    if layers.grid is None or not network.keep:
        return out, new(0)
    return out, new(n, -(-layers.grid.out_features // 16) * 16)


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
    positions, weights, biases, _, directions, direction_index, features, _ = network
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
