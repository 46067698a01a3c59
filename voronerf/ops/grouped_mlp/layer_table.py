"""Layer tables as the ops of whole networks take them. n samples, k cells, p and q features of a position and a
direction.

An op takes a table as a string, since a list of numbers costs a call of ``torch.library`` 15 us, and since a graph
that ``torch.compile`` keeps may be read by another process. It is JSON with names, read once.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS
from voronerf.ops.grouped_mlp.reference import encode_directions, encode_positions
from voronerf.ops.hash_encode.native import compiled_grid, hash_encode

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
    """

    positions: Tensor
    weights: Sequence[Tensor]
    biases: Sequence[Tensor]
    table: str
    directions: Tensor | None
    direction_index: Tensor | None
    features: Tensor | None


def network(
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
    positions, weights, directions = given.positions, given.weights, given.directions
    dtype = storage(positions, weights)
    found = Network(
        positions.float(),
        [weight.float() for weight in weights],
        [positions.new_empty(0, dtype=torch.float32) if bias is None else bias.float() for bias in given.biases],
        table_text(text, caller, operands(positions, dtype), encoded),
        None if directions is None else directions.float(),
        given.direction_index,
        given.features,
    )
    return found, dtype


def table_text(layers: str, caller: str, multiplied: str, encoded: str) -> str:
    """A table as the ops take it; see `Table`."""
    return f'{{"caller": "{caller}", "operands": "{multiplied}", "encoded": "{encoded}", "layers": {layers}}}'


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
        said = json.loads(text)
        layers = MLP.parse(json.dumps(said["layers"]))
        return Table(said["caller"], said["operands"], encoded_already(layers, said["encoded"]))

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
