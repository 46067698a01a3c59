from __future__ import annotations

import pytest

from voronerf.ops._core.grids import HashGrid
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS, Layer

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
    # As it was written before there was a choice.
    assert points.text == '[[[["positions"], 4, "relu"], [[0, "positions"], 2, "none"]], [1], 16, null]'
    for octaves in (None, 0):
        with pytest.raises(ValueError, match=r"^MLP: position_octaves must be at least 1 with the integrated encoding"):
            MLP(layers, (1,), octaves, position_encoding="integrated")
    with pytest.raises(
        ValueError, match=r"^MLP: position_encoding must be one of frequency, integrated, hash, got 'wave'"
    ):
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
        ({"direction_encoding": "sh"}, "direction_encoding must be one of frequency, spherical, got 'sh'"),
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
