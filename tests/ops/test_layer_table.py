from __future__ import annotations

import pytest
from op_cases import refused

from voronerf.ops._core.grids import HashGrid
from voronerf.ops._core.layers import DIRECTION_ENCODINGS, DIRECTIONS, MLP, POSITION_ENCODINGS, POSITIONS, Layer

SOURCES = "layer 0 must read 'positions', 'directions' or an earlier layer"

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
    assert NERF.program(3, 3, None, (True,) * 5, True) is NERF.program(3, 3, None, (True,) * 5, True)
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


ONE = {"layers": (Layer((DIRECTIONS, POSITIONS), 4),), "outputs": (0,)}
ACTIVATIONS = "an activation of none, relu, softplus, sigmoid, sine"
SPHERICAL = {"direction_encoding": "spherical"}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"layers": ()}, "layers must be a tuple of at least one layer, got ()"),
        ({"outputs": ()}, "outputs must be a tuple of at least one layer, got ()"),
        ({"outputs": (1,)}, "outputs must be layer indices 0 to 0, got 1"),
        ({"outputs": (-1,)}, "outputs must be layer indices 0 to 0, got -1"),
        ({"layers": (Layer((), 4),)}, "layer 0 must have a tuple of at least one input, got ()"),
        ({"layers": (Layer((0,), 4),)}, f"{SOURCES}, got 0"),
        ({"layers": (Layer(("x",), 4),)}, f"{SOURCES}, got 'x'"),
        ({"layers": (Layer((POSITIONS,), 0),)}, "layer 0 must have a width of 1 to 1048576, got 0"),
        ({"layers": (Layer((POSITIONS,), 1, "tanh"),)}, f"layer 0 must have {ACTIVATIONS}, got 'tanh'"),
        ({"position_octaves": -1}, "position_octaves must be None or 0 to 127, got -1"),
        *(
            (
                {"position_encoding": "integrated", "position_octaves": octaves},
                "position_octaves must be at least 1 with the integrated encoding...",
            )
            for octaves in (None, 0)
        ),
        (
            {"position_encoding": "wave", "position_octaves": 4},
            f"position_encoding must be one of {', '.join(POSITION_ENCODINGS)}, got 'wave'",
        ),
        ({"direction_encoding": "sh"}, f"direction_encoding must be one of {', '.join(DIRECTION_ENCODINGS)}, got 'sh'"),
        (SPHERICAL, "direction_degree must be 1 to 4 with spherical harmonics, got None"),
        ({**SPHERICAL, "direction_degree": 5}, "direction_degree must be 1 to 4 with spherical harmonics, got 5"),
        ({"direction_degree": 2}, "direction_degree must be None without spherical harmonics, got 2"),
        (
            {**SPHERICAL, "direction_degree": 2, "direction_octaves": 1},
            "direction_octaves must be None with spherical harmonics, got 1",
        ),
    ],
)
def test_errors(changed, message):
    with refused(ValueError, f"MLP: {message}"):
        MLP(**{**ONE, **changed})


GRID = HashGrid(levels=3, features=2, log2_entries=10, base=3, finest=12)


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
