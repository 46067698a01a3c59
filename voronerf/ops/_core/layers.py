"""The layer table of a per-cell network, which ``grouped_mlp`` runs.

A network is a list of linear layers with elementwise activations. Each layer names the sources of its inputs. Skip
connections and a branch that reads the view direction are thus table entries rather than code, and one kernel runs all
networks. The original NeRF (Mildenhall et al. 2020, figure 7) and the networks of KiloNeRF are both such tables.

Letters: d features of a raw position (3) or direction (3), L octaves of the frequency encoding, i inputs and o outputs
of a layer, k cells.
"""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass, field, replace

from voronerf.ops._core.encodings import ENCODINGS
from voronerf.ops._core.grids import HashGrid
from voronerf.ops._core.program import HASH, PARAMETER, Builder, Columns, Program, encoded_columns, pruned

ACTIVATIONS = ("none", "relu", "softplus", "sigmoid", "sine")
POSITION_ENCODINGS = (*(name for name, encoding in ENCODINGS.items() if encoding.positions), HASH)
DIRECTION_ENCODINGS = tuple(name for name, encoding in ENCODINGS.items() if encoding.directions)
POSITIONS = "positions"
DIRECTIONS = "directions"
NUMBERS = {"softplus": (1.0, 20.0), "sine": (1.0, 0.0)}
"""The numbers a and b of the activations that need them, see :data:`~voronerf.ops._core.program.FUNCTIONS`."""
MOST_FEATURES = 2**20
"""The largest width of a layer."""


@dataclass(frozen=True)
class Layer:
    """One linear layer and its activation.

    Attributes:
        inputs: the sources, concatenated in order: "positions", "directions", or the index of an earlier layer.
        width: the number of output features.
        activation: one of ``ACTIVATIONS``, applied after the bias.

    Examples:
        >>> from voronerf import Layer
        >>> Layer(("positions",), 64, "relu")  # reads the (encoded) position
        Layer(inputs=('positions',), width=64, activation='relu')
        >>> Layer((0, "directions"), 32, "relu").width  # reads layer 0 and the view direction
        32
    """

    inputs: tuple[int | str, ...]
    width: int
    activation: str = "none"


@dataclass(frozen=True)
class MLP:
    """A network as a table of layers.

    Attributes:
        layers: the layers in order of evaluation.
        outputs: the indices of the layers whose results are concatenated into the network's output.
        position_octaves: the octaves of the positions' encoding; None for raw positions.
        direction_octaves: the octaves of the view directions' encoding; None for raw directions.
        position_encoding: "frequency", ``frequency_encode`` with the input included (d -> d + 2dL); or "integrated",
            ``integrated_encode`` of Gaussians: positions are [n, 6], the mean and then the diagonal variance (6 -> 6L);
            or "hash", ``hash_encode`` (3 -> levels * features), whose table of features is a separate argument.
        grid: the grid of the "hash" encoding, else None.
        direction_encoding: "frequency", or "spherical", ``spherical_harmonics`` of unit vectors (3 -> degree^2).
        direction_degree: the degree of the spherical harmonics, 1 to 4; None for other encodings.
        text: the table as JSON, the argument of ``torch.library`` operators; ``parse`` reads it.

    Raises:
        ValueError: the table is invalid: no layers or outputs, a source that is not an earlier layer, a width below 1,
            an unknown activation or encoding, negative octaves, the integrated encoding without octaves, the hash
            encoding without a grid or with octaves, spherical harmonics without a degree or with octaves, or a degree
            without spherical harmonics.

    Examples:
        >>> from voronerf import MLP, Layer
        >>> table = MLP((Layer(("positions",), 64, "relu"), Layer((0,), 4)), outputs=(1,), position_octaves=10)
        >>> table.weight_shapes(3)  # [o, i] of each layer, for positions of three features
        [(64, 63), (4, 64)]
        >>> table.out_features
        4
    """

    layers: tuple[Layer, ...]
    outputs: tuple[int, ...]
    position_octaves: int | None = None
    direction_octaves: int | None = None
    position_encoding: str = "frequency"
    grid: HashGrid | None = None
    direction_encoding: str = "frequency"
    direction_degree: int | None = None
    text: str = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name, value in (("layers", self.layers), ("outputs", self.outputs)):
            if not isinstance(value, tuple) or not value:
                raise ValueError(f"MLP: {name} must be a tuple of at least one layer, got {value!r:.60}")
        for index, layer in enumerate(self.layers):
            _check_layer(index, layer)
        for output in self.outputs:
            if type(output) is not int or not 0 <= output < len(self.layers):
                raise ValueError(f"MLP: outputs must be layer indices 0 to {len(self.layers) - 1}, got {output!r:.60}")
        for name, octaves in (
            ("position_octaves", self.position_octaves),
            ("direction_octaves", self.direction_octaves),
        ):
            if octaves is not None and (type(octaves) is not int or not 0 <= octaves <= 127):
                raise ValueError(f"MLP: {name} must be None or 0 to 127, got {octaves!r:.60}")
        for name, encoding, names in (
            ("position_encoding", self.position_encoding, POSITION_ENCODINGS),
            ("direction_encoding", self.direction_encoding, DIRECTION_ENCODINGS),
        ):
            if encoding not in names:
                raise ValueError(f"MLP: {name} must be one of {', '.join(names)}, got {encoding!r:.60}")
        for name, encoding, octaves in (
            ("position_octaves", self.position_encoding, self.position_octaves),
            ("direction_octaves", self.direction_encoding, self.direction_octaves),
        ):
            if encoding not in ("frequency", "spherical", HASH) and not octaves:
                raise ValueError(f"MLP: {name} must be at least 1 with the {encoding} encoding, got {octaves}")
        if self.grid is not None and not isinstance(self.grid, HashGrid):
            raise ValueError(f"MLP: grid must be a HashGrid or None, got {type(self.grid).__name__}")
        hashed = self.position_encoding == "hash"
        if hashed != (self.grid is not None) or (hashed and self.position_octaves is not None):
            raise ValueError(
                'MLP: grid must be set if and only if position_encoding is "hash", without position_octaves, got '
                f"{self.position_encoding} with {self.position_octaves} octaves and the grid {self.grid}"
            )
        self._check_degree()
        rows = [[list(layer.inputs), layer.width, layer.activation] for layer in self.layers]
        table = [rows, list(self.outputs), self.position_octaves, self.direction_octaves]
        # Trailing defaults are not written, so a table with default encodings has four entries, as in old saved runs.
        choices: list[object] = [self.position_encoding, self.grid and self.grid.text]
        choices += [self.direction_encoding, self.direction_degree]
        while choices and choices[-1] in (None, "frequency"):
            choices.pop()
        table += choices
        object.__setattr__(self, "text", json.dumps(table))

    def _check_degree(self) -> None:
        degree, octaves = self.direction_degree, self.direction_octaves
        if self.direction_encoding != "spherical":
            if degree is not None:
                raise ValueError(f"MLP: direction_degree must be None without spherical harmonics, got {degree!r:.60}")
        elif type(degree) is not int or not 1 <= degree <= 4:
            raise ValueError(f"MLP: direction_degree must be 1 to 4 with spherical harmonics, got {degree!r:.60}")
        elif octaves is not None:
            raise ValueError(f"MLP: direction_octaves must be None with spherical harmonics, got {octaves}")

    def __hash__(self) -> int:
        return hash(self.text)  # Python caches the hash of a str

    @staticmethod
    @functools.lru_cache(maxsize=256)
    def parse(text: str) -> MLP:
        """Parses a table from its ``text``."""
        rows, outputs, *encodings = json.loads(text)
        if len(encodings) > 3 and encodings[3] is not None:
            encodings[3] = HashGrid.parse(encodings[3])
        layers = tuple(Layer(tuple(inputs), width, activation) for inputs, width, activation in rows)
        return MLP(layers, tuple(outputs), *encodings)

    @property
    def integrated(self) -> bool:
        """Returns whether positions are Gaussians, [n, 6], for the integrated encoding."""
        return self.position_encoding == "integrated"

    @property
    def out_features(self) -> int:
        """The number of features of the network's output."""
        return sum(self.layers[index].width for index in self.outputs)

    @property
    def uses_directions(self) -> bool:
        """Returns whether any layer reads the view directions."""
        return any(DIRECTIONS in layer.inputs for layer in self.layers)

    def encoding(self, source: str) -> tuple[str, int] | None:
        """Returns the name and size of the encoding of "positions" or "directions"; None if they are raw."""
        if source == POSITIONS:
            name, size = self.position_encoding, self.position_octaves
        else:
            name, size = self.direction_encoding, self.direction_degree or self.direction_octaves
        return (name, size) if size else None

    def source_width(self, source: int | str, positions_d: int, directions_d: int = 0) -> int:
        """Returns the number of features of a layer's input: of an earlier layer, or of an input after encoding."""
        if isinstance(source, int):
            return self.layers[source].width
        if source == POSITIONS and self.grid is not None:
            return self.grid.out_features
        width, encoding = positions_d if source == POSITIONS else directions_d, self.encoding(source)
        return width if encoding is None else encoded_columns(encoding[0], width, encoding[1])

    def input_width(self, layer: int, positions_d: int, directions_d: int = 0) -> int:
        """Returns the input features i of a layer, for raw positions and directions of these widths."""
        return sum(self.source_width(source, positions_d, directions_d) for source in self.layers[layer].inputs)

    def weight_shapes(self, positions_d: int, directions_d: int = 0) -> list[tuple[int, int]]:
        """Returns the shape [o, i] of every layer's weight, without the leading k cells."""
        return [
            (layer.width, self.input_width(index, positions_d, directions_d)) for index, layer in enumerate(self.layers)
        ]

    def program(
        self, p: int, q: int, widths: tuple[int, ...] | None, biased: tuple[bool, ...], ray: bool = False
    ) -> Program:
        """Builds the network's program, which ``grouped_program`` runs.

        Its inputs, before encoding, are the positions and, if a layer reads directions, the directions. Its parameters
        are the weight (o, i) of each layer, the bias (o,) of each biased layer, and the grid's table (e, f) if there is
        a grid, in this order. The program keeps parameters that no output depends on. It has one output,
        [n, out_features].

        Args:
            p: the number of columns of the positions.
            q: the number of columns of the directions; 0 if no layer reads them.
            widths: the output features o of each layer's weight; None for the widths in the table.
            biased: for each layer, whether it has a bias.
            ray: whether directions have one row for each ray, [r, q].

        Returns:
            The program; it is cached, so equal arguments give the same object.

        Examples:
            >>> from voronerf import MLP, Layer
            >>> table = MLP((Layer(("positions",), 16, "relu"), Layer((0,), 4)), outputs=(1,), position_octaves=6)
            >>> program = table.program(3, 0, None, (True, False))
            >>> program.inputs, program.parameters
            ((3,), ((16, 39), (4, 16), (16,)))
            >>> [step.name or step.op for step in program.steps]
            ['input', 'frequency', 'linear', 'relu', 'linear']
        """
        return _program(self.text, p, q, widths, biased, ray)


@functools.lru_cache(maxsize=256)
def _program(text: str, p: int, q: int, widths: tuple[int, ...] | None, biased: tuple[bool, ...], ray: bool) -> Program:
    """Builds the result of :meth:`MLP.program` for the table in ``text``."""
    table, builder = MLP.parse(text), Builder()
    if widths is not None:
        layers = zip(table.layers, widths, strict=True)
        table = replace(table, layers=tuple(replace(layer, width=width) for layer, width in layers))
    raw = {POSITIONS: builder.input(p)}
    if table.uses_directions:
        raw[DIRECTIONS] = builder.input(q, ray)
    weights = [builder.parameter(*shape) for shape in table.weight_shapes(p, q)]
    biases = [
        Columns(PARAMETER, builder.parameter(layer.width), 0, layer.width) if has else None
        for layer, has in zip(table.layers, biased, strict=True)
    ]
    features = None if table.grid is None else builder.parameter(*table.grid.table_shape)
    values: dict[int | str, Columns] = {}

    def source(name: int | str) -> Columns:
        if name not in values:
            x, encoding = raw[str(name)], table.encoding(str(name))
            if name == POSITIONS and table.grid is not None and features is not None:
                x = builder.encode(HASH, x, builder.grid(table.grid.text), features)
            elif encoding is not None:
                x = builder.encode(encoding[0], x, encoding[1])
            values[name] = x
        return values[name]

    for index, layer in enumerate(table.layers):
        total, start = biases[index], 0
        for name in layer.inputs:
            x = source(name)
            total = builder.linear(x, weights[index], layer.width, start, add=total)
            start += x.width
        assert total is not None
        if layer.activation != "none":
            total = builder.apply(layer.activation, total, *NUMBERS.get(layer.activation, (0.0, 0.0)))
        values[index] = total
    parts, at = [], 0
    for output in table.outputs:
        parts.append((values[output], at))
        at += values[output].width
    return pruned(builder.program([builder.move(at, parts)]))


def _check_layer(index: int, layer: Layer) -> None:
    if not isinstance(layer, Layer):
        raise ValueError(f"MLP: layer {index} must be a Layer, got {layer!r:.60}")
    if not isinstance(layer.inputs, tuple) or not layer.inputs:
        raise ValueError(f"MLP: layer {index} must have a tuple of at least one input, got {layer.inputs!r:.60}")
    for source in layer.inputs:
        earlier = type(source) is int and 0 <= source < index
        if not earlier and not (isinstance(source, str) and source in (POSITIONS, DIRECTIONS)):
            raise ValueError(
                f"MLP: layer {index} must read 'positions', 'directions' or an earlier layer, got {source!r:.60}"
            )
    if type(layer.width) is not int or not 1 <= layer.width <= MOST_FEATURES:
        raise ValueError(f"MLP: layer {index} must have a width of 1 to {MOST_FEATURES}, got {layer.width!r:.60}")
    if not isinstance(layer.activation, str) or layer.activation not in ACTIVATIONS:
        raise ValueError(
            f"MLP: layer {index} must have an activation of {', '.join(ACTIVATIONS)}, got {layer.activation!r:.60}"
        )
