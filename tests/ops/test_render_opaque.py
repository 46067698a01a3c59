"""Tests of `render_opaque`: one operation for the rays of an image, against separate operations in waves."""

import pytest
import torch
from cases import Draw
from cases.render_opaque import CASE
from helpers import all_pairs, on_any_number_of_threads
from op_cases import refused

from voronerf import MLP, Layer
from voronerf.ops import Cells, Network, render_opaque

pytestmark = pytest.mark.op("render_opaque")
MOVED = ("origins", "directions", "near", "far")
PLAIN = MLP((Layer(("positions",), 4),), outputs=(0,)).program(3, 0, None, (True,))
GRID = torch.ones(2, 2, 2, dtype=torch.bool), torch.tensor([[-1.0] * 3, [1.0] * 3])  # occupied everywhere in a box
CHOICES = {
    "n": [700, 33, 1, 0],
    "positions": ["hashed", "as they are"],
    "cells": [1, 3],
    "spacing": ["linear", "disparity"],
    "density": ["softplus", "relu"],
}


@pytest.mark.native
@pytest.mark.parametrize(*all_pairs(CHOICES))
def test_native_sees_what_the_reference_sees(n, positions, cells, spacing, density):
    pins = {"positions": positions, "cells": cells, "spacing": spacing, "density": density}
    arguments = CASE.make(Draw(n, **pins), n)
    actual, expected = (render_opaque(**arguments, backend=backend) for backend in ("native", "reference"))
    for name, part, other in zip(actual._fields, actual, expected, strict=True):
        torch.testing.assert_close(part, other, rtol=1e-4, atol=1e-5, msg=name)
    assert n < 33 or 0.1 < float(actual.opacity.mean()) < 1.1


@pytest.mark.parametrize("backend", ["reference", pytest.param("native", marks=pytest.mark.native)])
def test_values_are_seen_as_they_are(backend):
    """Colours and densities are rendered unchanged, even values that no activation returns."""
    origins, directions = torch.tensor([[0.0, 0, -2]]), torch.tensor([[0.0, 0, 1]])
    ray = origins, directions, torch.zeros(1), torch.full((1,), 4.0)
    network = Network(PLAIN, [torch.zeros(1, 4, 3), torch.tensor([[3.0, -2, 0.5, -0.25]])])
    seen = render_opaque(*ray, *GRID, 64, network, opaque=0.0, backend=backend)
    opacity = -torch.tensor([0.5]).expm1()  # the density is -0.25 over a length of 2
    torch.testing.assert_close(seen.opacity, opacity)
    torch.testing.assert_close(seen.colour, opacity * torch.tensor([[3.0, -2, 0.5]]))
    torch.testing.assert_close(seen.light, 1 - opacity)


@pytest.mark.native
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16, "autocast"], ids=str)
def test_networks_of_other_dtypes_are_seen(dtype):
    """With a table of another dtype, or under autocast, separate operations run and give the same results."""
    arguments = CASE.make(Draw(1), 300)
    network = arguments["network"]
    if isinstance(dtype, torch.dtype):
        *others, table = network.parameters
        network = Network(network.program, [*others, table.to(dtype)])
    with torch.autocast("cpu", torch.bfloat16, enabled=dtype == "autocast"):
        result = render_opaque(**{**arguments, "network": network}, backend="native")
    for part, other in zip(result[:4], render_opaque(**arguments, backend="reference")[:4], strict=True):
        assert part.dtype == torch.float32
        torch.testing.assert_close(part, other, rtol=0.03, atol=0.03)


@pytest.mark.native
@pytest.mark.parametrize("kind", [{}, {"cells": 9, "wave": 1}, {"contraction": torch.tensor([0.1, 0, 0, 0.4])}])
def test_a_ray_sees_the_same_bits_beside_any_others(kind):
    """A ray has the same bits for any threads and any order of rays, which decide which rays share a wave."""
    arguments = CASE.make(Draw(7, **kind), 5000)
    result = on_any_number_of_threads(lambda: render_opaque(**arguments, backend="native"))
    order = torch.randperm(5000, generator=torch.Generator().manual_seed(0))
    moved = {name: arguments[name][order] for name in MOVED}
    for part, other in zip(result, render_opaque(**{**arguments, **moved}, backend="native"), strict=True):
        assert torch.equal(part[order], other)


def test_leaps_over_empty_cells_find_the_same():
    """The native backend lets rays leap over empty grid cells only if there are at least four strata per grid cell.

    Strata are the sampling intervals of all rays. Only the larger batch has enough strata to leap.
    """
    arguments = CASE.make(Draw(3, samples=130, side=4), 40)
    arguments["occupied"] = torch.zeros(12, 12, 12, dtype=torch.bool)
    arguments["occupied"][5:7, 4:8, 3:9] = True
    few, many = (
        {**arguments, **{name: arguments[name].repeat_interleave(copies, 0) for name in MOVED}} for copies in (1, 8)
    )
    assert len(few["near"]) * 130 < 4 * 12**3 <= len(many["near"]) * 130
    for part, other in zip(render_opaque(**few), render_opaque(**many), strict=True):
        assert torch.equal(part, other[::8])


def test_a_tree_of_diagrams_tells_the_cells():
    """Space is split in halves and one half again; each of the three networks has one colour."""
    colours = torch.tensor([[1.0, 0, 0, 9], [0, 1, 0, 9], [0, 0, 1, 9]])
    network = Network(PLAIN, [torch.zeros(3, 4, 3), colours])
    centres = torch.tensor([[-0.5, 0, 0], [0.5, 0, 0], [0.5, -0.5, 0], [0.5, 0.5, 0]])
    child_offsets, child = torch.tensor([0, 2, 4], dtype=torch.int32), torch.tensor([-1, 1, -2, -3], dtype=torch.int32)
    cells = Cells(centres=centres, child_offsets=child_offsets, child=child, depth=2)
    origins = torch.tensor([[-0.5, -0.5, -2], [0.5, -0.5, -2], [0.5, 0.5, -2]])
    ray = origins, torch.tensor([[0.0, 0, 1]]).expand(3, 3), torch.zeros(3), torch.full((3,), 4.0)
    for backend in ("auto", "reference"):
        seen = render_opaque(*ray, *GRID, 64, network, cells=cells, backend=backend)
        assert torch.equal(seen.colour.round(decimals=1), torch.eye(3)), backend
    with refused(ValueError, "render_opaque: depth must be the number of levels of the tree, got 1, which is too few"):
        render_opaque(*ray, *GRID, 64, network, cells=cells._replace(depth=1), backend="native")


def test_other_networks_are_refused():
    arguments = CASE.make(Draw(0), 3)
    network = Network(
        MLP((Layer(("positions",), 3),), outputs=(0,)).program(3, 0, None, (False,)), [torch.zeros(1, 3, 3)]
    )
    with refused(ValueError, "render_opaque: program must have one output of 4 numbers, colour and density, got [3]"):
        render_opaque(**{**arguments, "network": network, "cells": None})
    wide = Network(arguments["network"].program, [p.double() for p in arguments["network"].parameters])
    with refused(TypeError, "render_opaque: parameters must have dtype float32 or one of 16 bits, got float64"):
        render_opaque(**{**arguments, "network": wide})
