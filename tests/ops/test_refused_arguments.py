"""Arguments of a wrong kind: each error names the operation, the argument, the rule and what came."""

from __future__ import annotations

import pytest
import torch
from helpers import refuses

from voronerf import MLP, Layer, ops
from voronerf.layers import POSITIONS

POINTS, TREE = torch.rand(4, 3), (torch.tensor([0, 2], dtype=torch.int32), torch.tensor([-1, -2], dtype=torch.int32))
GRID = torch.rand(2, 2, 2)
ONE_LAYER = {"weights": [torch.rand(1, 1, 3)], "biases": [None]}
CELLS = torch.zeros(4, dtype=torch.int32)


def draw(**given):
    options = {"temperature": 0.1, "depth": 1, **given}
    return ops.draw_cell(POINTS, POINTS[:2], *TREE, torch.rand(4, 1), **options)


def composite(**given):
    return ops.composite(torch.rand(2, 3), torch.rand(2, 3, 3), torch.rand(2, 3), torch.rand(2, 3), **given)


def balance(**given):
    return ops.balance_centres(POINTS, torch.rand(4).double(), POINTS, steps=1, **given)


def network(**given):
    options = {"weights": [], "biases": [], "layers": MLP((Layer((POSITIONS,), 1),), (0,)), **given}
    return ops.grouped_mlp(POINTS, torch.tensor([0, 4], dtype=torch.int32), **options)


@pytest.mark.parametrize(
    ("error", "message", "call"),
    [
        (TypeError, "draw_cell: temperature must be a number, got str", lambda: draw(temperature="warm")),
        (TypeError, "draw_cell: temperature must be a number, got Tensor", lambda: draw(temperature=torch.ones(2))),
        (ValueError, "draw_cell: depth must be at most 2147483647, got 1099511627776", lambda: draw(depth=2**40)),
        (TypeError, "balance_centres: alpha must be a number, got NoneType", lambda: balance(alpha=None)),
        (
            TypeError,
            "update_occupancy: threshold must be a number, got str",
            lambda: ops.update_occupancy(GRID, CELLS, torch.rand(4), decay=0.5, threshold="x"),
        ),
        (TypeError, "composite: background must be a tensor, got str", lambda: composite(background="x")),
        (TypeError, "grouped_mlp: layers must be an MLP, got NoneType", lambda: network(layers=None)),
        (TypeError, "grouped_mlp: features must be a tensor, got list", lambda: network(**ONE_LAYER, features=[1.0])),
        (
            ValueError,
            "frequency_encode: octaves must be at most 127, got 3000",
            lambda: ops.frequency_encode(POINTS, octaves=3000),
        ),
        (
            ValueError,
            "cast_solids: kinds must be 0 (sphere) to 3 (torus), got -5",
            lambda: ops.cast_solids(CELLS[:1] - 5, torch.rand(1, 4, 3), torch.rand(1, 3), POINTS, POINTS),
        ),
        (
            ValueError,
            "update_occupancy: threshold must be at most 1.8e+308, got an integer of more digits",
            lambda: ops.update_occupancy(GRID, CELLS, torch.rand(4), decay=0.5, threshold=10**400),
        ),
        (TypeError, "balance_centres: global_norm must be True or False, got str", lambda: balance(global_norm="x")),
        (
            TypeError,
            "frequency_encode: include_input must be True or False, got list",
            lambda: ops.frequency_encode(POINTS, octaves=3, include_input=[1]),
        ),
        (
            TypeError,
            "hash_encode: grid must be a HashGrid, got dict",
            lambda: ops.hash_encode(POINTS, torch.rand(8, 2), {}),
        ),
        (
            TypeError,
            "pixel_rays: far must be a number, got NoneType",
            lambda: ops.pixel_rays(
                torch.eye(4)[None],
                torch.ones(1, 4),
                torch.zeros(1, 2, 2, 3, dtype=torch.uint8),
                CELLS.long(),
                near=0,
                far=None,
            ),
        ),
        (
            TypeError,
            "sparse_adam: learning_rate must be a number, got str",
            lambda: ops.sparse_adam(*torch.zeros(4, 2), step=1, learning_rate="x"),
        ),
        (TypeError, "grouped_mlp: weights must be a list, got NoneType", lambda: network(weights=None)),
        (ValueError, "cell_sort: k must be at most 2147483647", lambda: ops.cell_sort(CELLS, 2**31)),
    ],
)
def test_the_argument_is_named(error, message, call):
    refuses(message, call, error=error)


@pytest.mark.parametrize(
    ("kind", "make"),
    [
        ("sparse_coo", lambda: POINTS.to_sparse()),
        ("sparse_csr", lambda: POINTS.to_sparse_csr()),
        ("_mkldnn", lambda: POINTS.to_mkldnn()),
        ("nested", lambda: torch.nested.nested_tensor([POINTS, POINTS])),
        ("quantized", lambda: torch.quantize_per_tensor(POINTS, 0.1, 0, torch.qint8)),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_tensors_that_are_not_dense(kind, make):
    message = f"nearest_centre: points must be a dense tensor, got a {kind} one"
    refuses(message, ops.nearest_centre, make(), POINTS, error=TypeError)


@pytest.mark.op("grouped_linear")
def test_inference_tensors(backend):
    """They are taken unless autograd would have to keep them."""
    with torch.inference_mode():
        weight, background = torch.rand(1, 2, 3), torch.ones(3)
        offsets = torch.tensor([0, 4], dtype=torch.int32)
        inside = composite(background=background, backend=backend)
    assert inside.colour.isfinite().all() and composite(background=background).colour.isfinite().all()
    points = POINTS.clone().requires_grad_()
    message = "grouped_linear: offsets must be a copy where gradients are recorded, got an inference tensor"
    refuses(message, ops.grouped_linear, points, offsets, weight.clone(), backend=backend, error=TypeError)
    with torch.no_grad():
        ops.grouped_linear(points, offsets, weight, backend=backend)
