from __future__ import annotations

import functools
import os
import sys
import threading

import pytest
import torch
from op_cases import refusals

from voronerf.ops import locate_cell

pytestmark = pytest.mark.op("locate_cell")

# Diagram 0 has three centres: the first is a leaf, diagram 1 refines the second, and diagram 2 refines the third.
# Diagram 3 refines the second centre of diagram 2. Leaves are numbered depth first.
CHILD_OFFSETS = torch.tensor([0, 3, 5, 7, 10], dtype=torch.int32)
CHILD = torch.tensor([-1, 1, 2, -2, -3, -4, 3, -5, -6, -7], dtype=torch.int32)
DEPTH = 3


def slow(points, centres):
    """Descends the tree for one point at a time."""
    leaves = []
    for point in points:
        diagram = 0
        while diagram >= 0:
            rows = slice(int(CHILD_OFFSETS[diagram]), int(CHILD_OFFSETS[diagram + 1]))
            distance = (point.double() - centres[rows].double()).square().sum(-1)
            diagram = int(CHILD[rows][int(distance.argmin())])
        leaves.append(-diagram - 1)
    return torch.tensor(leaves, dtype=torch.int32)


@pytest.mark.parametrize("n", [0, 1, 257])
def test_uneven_tree_matches_a_slow_descent(device, backend, n):
    points, centres = torch.randint(-3, 4, (n, 3)).float(), torch.randint(-3, 4, (10, 3)).float()
    tables = (tensor.to(device) for tensor in (points, centres, CHILD_OFFSETS, CHILD))
    leaf = locate_cell(*tables, depth=DEPTH, backend=backend)
    assert leaf.dtype == torch.int32
    assert torch.equal(leaf.cpu(), slow(points, centres))


def test_many_points_cross_the_pieces(device, backend):
    centres = torch.rand(10, 3)
    points = centres[torch.randint(0, 10, (30000,))] + 0.2 * torch.rand(30000, 3)
    tables = (CHILD_OFFSETS.to(device), CHILD.to(device))
    leaf = locate_cell(points.to(device), centres.to(device), *tables, depth=DEPTH, backend=backend)
    assert torch.equal(leaf[::97].cpu(), slow(points[::97], centres))


def test_points_that_are_not_finite_take_the_first_centre_at_every_level(device, backend):
    points = torch.tensor([[float("nan"), 0, 0], [0, float("inf"), 0]], device=device)
    centres = torch.rand(10, 3, device=device)
    # In this tree the first centre of the root is refined too.
    child = torch.tensor([1, -1, 2, -6, -3, -4, 3, -5, -2, -7], dtype=torch.int32, device=device)
    leaf = locate_cell(points, centres, CHILD_OFFSETS.to(device), child, depth=DEPTH, backend=backend)
    assert leaf.tolist() == [5, 5]


def test_errors():
    points, centres = torch.rand(4, 3), torch.rand(10, 3)
    refuses = refusals(locate_cell, points=points, centres=centres, child_offsets=CHILD_OFFSETS, child=CHILD, depth=3)
    refuses("depth must be at least 1, got 0", depth=0)
    refuses("centres must hold ... got 0 centres in 4 diagrams", centres=centres[:0], child=CHILD[:0], depth=1)
    refuses("depth must be an integer, got float", depth=1.0)


@pytest.mark.parametrize("wrong", ["first", "falls", "child", "shallow"])
def test_every_backend_refuses_what_is_no_tree(wrong, device, backend, request):
    if device.type != "cpu" or request.config.getoption("--emulate-cuda") is not None:
        pytest.skip("the values are not read")
    offsets, child, depth = CHILD_OFFSETS.clone(), CHILD.clone(), DEPTH
    if wrong == "shallow":
        depth = 1
    else:
        target, place, value = {"first": (offsets, 0, 1), "falls": (offsets, 1, 9), "child": (child, 1, 4)}[wrong]
        target[place] = value
    with pytest.raises(ValueError, match=r"locate_cell: (child|depth).* must"):
        locate_cell(torch.rand(40, 3), torch.rand(10, 3), offsets, child, depth=depth, backend=backend)


@pytest.mark.native
@pytest.mark.skipif(sys.platform == "win32", reason="needs fork")
def test_threads_may_have_small_stacks():
    """The call runs in a fork, since a stack overflow ends the process."""
    points, centres, done = torch.rand(3000, 3, dtype=torch.float64), torch.rand(4, 3, dtype=torch.float64), []
    tree = torch.tensor([0, 2, 4], dtype=torch.int32), torch.tensor([1, -1, -2, -3], dtype=torch.int32)
    child = os.fork()
    if child == 0:
        torch.set_num_threads(1)  # a forked child can run only with one thread
        threading.stack_size(128 * 1024)
        run = functools.partial(locate_cell, points, centres, *tree, depth=2, backend="native")
        thread = threading.Thread(target=lambda: done.append(run()))
        thread.start()
        thread.join()
        os._exit(0 if done else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_more_levels_than_a_tree_can_have_cost_no_time(backend):
    tree = torch.tensor([0, 2], dtype=torch.int32), torch.tensor([-1, -2], dtype=torch.int32)
    points = torch.eye(3)[:2]
    assert locate_cell(points, points, *tree, depth=2**31 - 1, backend=backend).tolist() == [0, 1]
