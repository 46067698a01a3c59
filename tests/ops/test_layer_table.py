from __future__ import annotations

import pytest
import torch
from op_cases import offsets_of
from programs import ByPrograms, derivatives
from test_grouped_mlp import TABLES

from voronerf.ops import grouped_mlp, grouped_program
from voronerf.ops._core.grids import HashGrid
from voronerf.ops._core.layers import DIRECTION_ENCODINGS, DIRECTIONS, MLP, POSITION_ENCODINGS, POSITIONS, Layer

SOURCES = "MLP: layer 0 must read 'positions', 'directions' or an earlier layer"

NERF = MLP(
    (
        Layer((POSITIONS,), 64, "relu"),
        Layer((POSITIONS, 0), 64, "relu"),
        Layer((1,), 1, "softplus"),
        Layer((1, DIRECTIONS), 32, "relu"),
        Layer((3,), 3, "sigmoid"),
    ),
    outputs=(4, 2),
    position_octaves=10,
    direction_octaves=4,
)


def test_widths():
    assert NERF.out_features == 4
    assert NERF.uses_directions
    assert NERF.weight_shapes(3, 3) == [(64, 63), (64, 127), (1, 64), (32, 91), (3, 32)]
    assert NERF.input_width(3, 3, 3) == 64 + 27
    plain = MLP((Layer((POSITIONS,), 2), Layer((0, POSITIONS, 0), 5)), (1, 1))
    assert plain.weight_shapes(7) == [(2, 7), (5, 11)]
    assert plain.out_features == 10
    assert not plain.uses_directions


def test_text_round_trip():
    assert MLP.parse(NERF.text) == NERF
    assert MLP.parse(NERF.text) is MLP.parse(NERF.text)
    assert hash(MLP.parse(NERF.text)) == hash(NERF)
    encoded = MLP((Layer((POSITIONS,), 1),), (0,), None, 0)
    assert MLP.parse(encoded.text) == encoded


def test_text_of_integrated_positions():
    layers = (Layer((POSITIONS,), 4, "relu"), Layer((0, POSITIONS), 2))
    gaussians = MLP(layers, (1,), 16, position_encoding="integrated")
    assert gaussians.weight_shapes(6) == [(4, 96), (2, 100)]
    assert MLP.parse(gaussians.text) == gaussians
    points = MLP(layers, (1,), 16)
    assert points != gaussians and points.text != gaussians.text
    # The text does not name the default encoding.
    assert points.text == '[[[["positions"], 4, "relu"], [[0, "positions"], 2, "none"]], [1], 16, null]'
    for octaves in (None, 0):
        with pytest.raises(ValueError, match=r"^MLP: position_octaves must be at least 1 with the integrated encoding"):
            MLP(layers, (1,), octaves, position_encoding="integrated")
    known = ", ".join(POSITION_ENCODINGS)
    with pytest.raises(ValueError, match=rf"^MLP: position_encoding must be one of {known}, got 'wave'"):
        MLP(layers, (1,), 4, position_encoding="wave")


def test_text_of_spherical_directions():
    layers = (Layer((POSITIONS, DIRECTIONS), 4, "relu"),)
    for degree in (1, 2, 3, 4):
        table = MLP(layers, (0,), 2, direction_encoding="spherical", direction_degree=degree)
        assert table.weight_shapes(3, 3) == [(4, 15 + degree**2)]
        assert MLP.parse(table.text) == table
    gaussians = MLP(layers, (0,), 2, None, "integrated", None, "spherical", 4)
    assert gaussians.weight_shapes(6, 3) == [(4, 28)] and MLP.parse(gaussians.text) == gaussians
    grid = MLP(layers, (0,), None, None, "hash", HashGrid(), "spherical", 3)
    assert MLP.parse(grid.text) == grid


def test_errors_of_directions():
    layers = (Layer((DIRECTIONS,), 4),)
    for options, message in (
        (
            {"direction_encoding": "sh"},
            f"direction_encoding must be one of {', '.join(DIRECTION_ENCODINGS)}, got 'sh'",
        ),
        ({"direction_encoding": "spherical"}, "direction_degree must be 1 to 4 with spherical harmonics, got None"),
        (
            {"direction_encoding": "spherical", "direction_degree": 5},
            "direction_degree must be 1 to 4 with spherical harmonics, got 5",
        ),
        ({"direction_degree": 2}, "direction_degree must be None without spherical harmonics, got 2"),
        (
            {"direction_encoding": "spherical", "direction_degree": 2, "direction_octaves": 1},
            "direction_octaves must be None with spherical harmonics, got 1",
        ),
    ):
        with pytest.raises(ValueError) as caught:
            MLP(layers, (0,), **options)
        assert str(caught.value) == f"MLP: {message}"


@pytest.mark.parametrize(
    ("layers", "outputs", "octaves", "message"),
    [
        ((), (0,), None, "MLP: layers must be a tuple of at least one layer, got ()"),
        ((Layer((POSITIONS,), 4),), (), None, "MLP: outputs must be a tuple of at least one layer, got ()"),
        ((Layer((POSITIONS,), 4),), (1,), None, "MLP: outputs must be layer indices 0 to 0, got 1"),
        ((Layer((POSITIONS,), 4),), (-1,), None, "MLP: outputs must be layer indices 0 to 0, got -1"),
        ((Layer((POSITIONS,), 4),), (0,), -1, "MLP: position_octaves must be None or 0 to 127, got -1"),
        ((Layer((), 4),), (0,), None, "MLP: layer 0 must have a tuple of at least one input, got ()"),
        ((Layer((0,), 4),), (0,), None, f"{SOURCES}, got 0"),
        ((Layer(("x",), 4),), (0,), None, f"{SOURCES}, got 'x'"),
        ((Layer((POSITIONS,), 0),), (0,), None, "MLP: layer 0 must have a width of 1 to 1048576, got 0"),
        (
            (Layer((POSITIONS,), 1, "tanh"),),
            (0,),
            None,
            "MLP: layer 0 must have an activation of none, relu, softplus, sigmoid, sine, got 'tanh'",
        ),
    ],
)
def test_errors(layers, outputs, octaves, message):
    with pytest.raises(ValueError) as caught:
        MLP(layers, outputs, octaves)
    assert str(caught.value) == message


GRID = HashGrid(levels=3, features=2, log2_entries=10, base=3, finest=12)
HASHED = MLP(TABLES["tangled"].layers, (3, 1), None, 1, "hash", GRID)
PROGRAMS = {
    **TABLES,
    "hashed": HASHED,
    "hashed, a table for each cell": HASHED,
    "unread": MLP((Layer((DIRECTIONS,), 4), Layer((POSITIONS, 0), 3, "sigmoid"), Layer((POSITIONS,), 2)), (2,), 2, 1),
    "relu": MLP((Layer((POSITIONS,), 9, "relu"), Layer((0, POSITIONS), 5, "relu"), Layer((1,), 3)), (2, 1), 3),
    "no octaves": MLP((Layer((POSITIONS, DIRECTIONS), 9, "sine"), Layer((0,), 5)), (1,), 0, 0),
}


@pytest.mark.parametrize("ray", [False, True], ids=["of samples", "of rays"])
@pytest.mark.parametrize("name", PROGRAMS)
def test_program_is_the_network(name, ray):
    """Values and two orders of gradients of the program equal `grouped_mlp`."""
    table, generator = PROGRAMS[name], torch.Generator().manual_seed(0)
    counts, rays, p, q = [4, 0, 6], 5, 6 if PROGRAMS[name].integrated else 3, 3
    n, k, offsets = sum(counts) + 3, len(counts), offsets_of(counts) + 1
    shapes = table.weight_shapes(p, q if table.uses_directions else 0)
    biased = tuple(index != 1 for index in range(len(shapes)))
    program = table.program(p, q if table.uses_directions else 0, None, biased, ray)
    assert program is table.program(p, q if table.uses_directions else 0, None, biased, ray)

    def normal(*shape):
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    inputs = [torch.rand(n, p, generator=generator, dtype=torch.float64)]
    if table.uses_directions:
        inputs.append(torch.nn.functional.normalize(normal(rays if ray else n, q), dim=1))
    weights = [normal(k, o, i) / i**0.5 for o, i in shapes]
    biases = [normal(k, o) for (o, _), has in zip(shapes, biased) if has]
    features = [normal(k if "each" in name else 1, *table.grid.table_shape)] if table.grid else []
    tensors = [*inputs, *weights, *biases, *features]
    index = torch.randint(0, rays, (n,), generator=generator, dtype=torch.int32)
    index = index if ray and table.uses_directions else None

    def by_layers(*leaves):
        following = iter(leaves)
        x, directions = next(following), next(following) if table.uses_directions else None
        own = [next(following) for _ in weights]
        bent = [next(following) if has else None for has in biased]
        grid = next(following, None)
        return [
            grouped_mlp(
                x,
                offsets,
                own,
                bent,
                layers=table,
                directions=directions,
                direction_index=index,
                features=grid if grid is None or len(grid) > 1 else grid[0],
                backend="reference",
            )
        ]

    def by_the_op(*leaves):
        count = len(inputs)
        arguments = leaves[:count], leaves[count:], offsets
        return grouped_program(*arguments, program=program, ray_index=index, backend="reference")

    def by_programs(*leaves):
        return ByPrograms.apply(program.text, offsets, None, index, *leaves)

    expected = derivatives(by_layers, tensors, 2)
    for run in (by_the_op, by_programs):
        for actual, exact in zip(derivatives(run, tensors, 2), expected, strict=True):
            torch.testing.assert_close(actual, exact, rtol=1e-9, atol=1e-9)


def test_program_of_other_widths_and_without_what_is_not_read():
    """Weights may have more rows than the table says; inputs and parameters keep their indices, even unread ones."""
    table = MLP((Layer((POSITIONS,), 8, "relu"), Layer((0, DIRECTIONS), 4), Layer((0,), 2)), (2,), 2)
    program = table.program(3, 3, (5, 6, 7), (True, True, False), True)
    assert program.inputs == (3, 3) and program.rays == (1,)
    assert program.parameters == ((5, 15), (6, 8), (7, 5), (5,), (6,))
    assert [step.op for step in program.steps] == ["input", "encode", "linear", "function", "linear"]
    assert [columns.width for columns in program.outputs] == [7]
    both = MLP(table.layers, (2, 1, 2), 2).program(3, 3, None, (False, True, True))
    assert [columns.width for columns in both.outputs] == [8] and both.steps[-1].op == "move" and both.rays == ()
    grid = MLP((Layer((POSITIONS, DIRECTIONS), 4),), (0,), None, 2, "hash", GRID)
    hashed = grid.program(3, 3, None, (True,), True)
    assert hashed.parameters == ((4, 21), (4,), GRID.table_shape)
    assert hashed.tables == (2,) and hashed.grids == (GRID.text,)
