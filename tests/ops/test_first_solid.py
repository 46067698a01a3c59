"""The first of some solids on rays: the compiled tree against each solid in turn."""

import pytest
import torch

from voronerf.ops import Solids, first_solid
from voronerf.ops._core.cases import Draw
from voronerf.ops.first_solid.case import CASE

pytestmark = pytest.mark.native


@pytest.mark.parametrize("kind", CASE.kinds)
@pytest.mark.parametrize("solids", [0, 1, 7, 8, 9, 65, 513])
def test_a_tree_leaves_out_nothing(solids, kind):
    given = CASE.make(Draw(solids, solids=solids, **CASE.kinds[kind]), 257)
    depth, number = first_solid(**given, backend="native")
    expected, which = first_solid(**given, backend="reference")
    assert torch.equal(number, which)
    torch.testing.assert_close(depth, expected, rtol=1e-5, atol=1e-5)
    assert solids < 7 or float(depth.isfinite().float().mean()) > 0.1, "some rays hit"


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_of_two_at_one_distance_the_first_is_found(backend):
    twice = Solids(torch.zeros(3).int(), torch.tensor([[9.0, 0, 0], [2, 0, 0], [2, 0, 0]]), *twins())
    ahead = torch.tensor([[1.0, 0, 0], [-1.0, 0, 0]])
    depth, number = first_solid(torch.zeros(1, 3), ahead, twice, backend=backend)
    assert depth.tolist() == [1.0, torch.inf] and number.tolist() == [1, 0]


def twins():
    return torch.eye(3).repeat(3, 1, 1), torch.ones(3, 3)
