"""Frozen cells have no gradient and no optimiser step, and cost no backward time; other cells keep the same bits."""

import copy
import pickle

import pytest
import torch
from helpers import refuses

from voronerf import NeRF, VoronoiRouter
from voronerf.nerf.adam import Adam
from voronerf.nerf.fields import HashGridField
from voronerf.nerf.radiance import radiance_of

FROZEN, LEARNING = [1, 3], [0, 2]
OPTIMIZERS = {
    "Adam": lambda p: torch.optim.Adam(p, lr=0.1, weight_decay=0.1),
    "AdamW": lambda p: torch.optim.AdamW(p, lr=0.1, amsgrad=True),
    "SGD": lambda p: torch.optim.SGD(p, lr=0.1, momentum=0.9, weight_decay=0.1),
    "voronerf": lambda p: Adam([{"params": list(p)}], lr=0.1),
    "voronerf, reference": lambda p: Adam([{"params": list(p)}], lr=0.1, backend="reference"),
}


def make(kind, **options):
    centres = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    if kind == "table":
        return VoronoiRouter(NeRF(width=16, depth=2), centres, **options)
    net = torch.nn.Sequential(torch.nn.Linear(3, 16), torch.nn.ReLU(), torch.nn.Linear(16, 2))
    return VoronoiRouter(net, centres, coords="first3", way=kind, fuse=kind == "fused", **options)


def loss_of(router, points):
    if hasattr(router.module, "layers"):
        colour, density = router(points, torch.nn.functional.normalize(points + 0.1, dim=-1))
        return colour.square().mean() + density.mean()
    return router(points).square().mean()


def gradients(router, points):
    router.zero_grad()
    loss_of(router, points).backward()
    return [p.grad for p in router.parameters()]


@pytest.mark.parametrize(
    ("kind", "backend"),
    [("table", "native"), ("table", "reference"), ("fused", "auto"), ("grouped", "auto"), ("loop", "auto")],
)
def test_frozen_cells_have_no_gradient_and_others_the_same(kind, backend):
    router, points = make(kind, backend=backend), torch.rand(200, 3, requires_grad=True)
    expected = [g.clone() for g in gradients(router, points)]
    values = loss_of(router, points)
    router.freeze(FROZEN)
    torch.testing.assert_close(loss_of(router, points), values)
    points.grad, inside = None, torch.isin(router.assign(points), torch.tensor(FROZEN))
    actual = gradients(router, points)
    assert not points.grad[inside].any() and points.grad[~inside].any()
    for own, full in zip(actual, expected, strict=True):
        assert not own[FROZEN].any() and own[LEARNING].any()
        torch.testing.assert_close(own[LEARNING], full[LEARNING])


@pytest.mark.parametrize("name", OPTIMIZERS)
@pytest.mark.parametrize("before", [0, 2])
def test_steps_leave_frozen_cells_bit_for_bit(name, before):
    router, points = make("grouped"), torch.rand(200, 3)
    optimizer = OPTIMIZERS[name](router.parameters())
    for _ in range(before):
        gradients(router, points)
        optimizer.step()
    router.freeze(FROZEN, optimizer=optimizer)

    def bits():
        state = [v for p in router.parameters() for v in optimizer.state[p].values() if torch.is_tensor(v) and v.dim()]
        return [t.detach().clone() for t in (*router.parameters(), *state)]

    held = bits()
    for _ in range(3):
        gradients(router, points)
        optimizer.step()
    now = bits()
    for own, old in zip(now, held if before else now, strict=True):
        assert torch.equal(own[FROZEN], old[FROZEN])
        assert not before or not torch.equal(own[LEARNING], old[LEARNING])
    if not before:
        parameters = len(list(router.parameters()))
        assert all(torch.equal(a[FROZEN], b[FROZEN]) for a, b in zip(now[:parameters], held))
        assert not any(state[FROZEN].any() for state in now[parameters:])


@pytest.mark.parametrize("kind", ["table", "fused", "loop"])
def test_an_optimiser_that_was_not_given_is_found_out(kind):
    router, points = make(kind), torch.rand(200, 3)
    optimizer = torch.optim.AdamW(router.parameters(), lr=0.1)
    router.freeze(FROZEN)
    gradients(router, points)
    optimizer.step()
    refuses("not given has changed frozen cells; write router.freeze(cells, optimizer=", gradients, router, points)
    refuses("has changed frozen cells", gradients, router, points)
    router.freeze(optimizer=optimizer)
    gradients(router, points)
    with pytest.raises(ValueError, match="freeze: optimizer must hold the router's parameters"):
        router.freeze(optimizer=torch.optim.SGD([torch.nn.Parameter(torch.ones(1))], 0.1))
    own, other = make(kind), make(kind)
    own.freeze(FROZEN)
    optimizer = Adam([{"params": list(own.parameters())}], lr=0.1)
    for _ in range(3):
        gradients(own, points)
        optimizer.step()
    own.load_cell(1, other.cell(0))  # the router itself may change frozen cells
    gradients(own, points)


def test_optimisers_get_no_hooks_of_others():
    router, other = make("grouped"), make("grouped")
    optimizer, bystander = (torch.optim.SGD(r.parameters(), 0.1) for r in (router, other))
    router.freeze(FROZEN, optimizer=optimizer)
    router.freeze(LEARNING, optimizer=optimizer)
    assert len(optimizer._optimizer_step_pre_hooks) == len(optimizer._optimizer_step_post_hooks) == 1
    assert not bystander._optimizer_step_pre_hooks and not bystander._optimizer_step_post_hooks


def test_cells_learn_again_with_their_moments():
    router, points = make("grouped"), torch.rand(200, 3)
    optimizer = Adam([{"params": list(router.parameters())}], lr=0.1)
    gradients(router, points)
    optimizer.step()
    router.freeze()
    assert router.frozen.all()
    router.unfreeze([0])
    assert router.frozen.tolist() == [False, True, True, True]
    router.unfreeze()
    weight = next(router.parameters())
    old = weight.detach().clone()
    gradients(router, points)
    optimizer.step()
    assert (weight != old).flatten(1).any(1).all()


def test_a_batch_in_frozen_cells_alone_is_no_error():
    for kind in ("table", "fused", "grouped", "loop"):
        router = make(kind)
        router.freeze(FROZEN)
        points = torch.tensor([1.0, 0.5, 0]) + 0.01 * torch.rand(20, 3)
        loss_of(router, points).backward()
        assert not any(p.grad is not None and p.grad.any() for p in router.parameters())
        router(points[:0], points[:0]) if kind == "table" else router(points[:0])


@pytest.mark.parametrize("own", [True, False])
def test_tables_learn_from_other_cells_alone(own):
    field, centres = HashGridField(box=((0.0, 0, 0), (1.0, 1, 1))), torch.tensor([[0.0, 0, 0], [1, 1, 1]])
    router = VoronoiRouter(field, centres, **({} if own else {"share": ["features"]}))
    points = torch.rand(300, 3)
    near = router.assign(points) == 0
    (expected,) = (g.clone() for g in gradients_of_table(router, points[near], len(points)))
    router.freeze([1])
    (actual,) = gradients_of_table(router, points, len(points))
    torch.testing.assert_close(actual, expected)
    assert actual.any() and (not own or not actual[1].any())


def gradients_of_table(router, points, count):
    router.zero_grad()
    colour, density = router(points, points.new_ones(len(points), 3))
    ((colour.sum() + density.sum()) / count).backward()
    return [router.module.features.grad]


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_a_tape_leaves_frozen_cells_out(backend):
    router, points = make("table"), torch.rand(100, 3)
    router.freeze(FROZEN)
    radiance, rays = radiance_of(router), torch.arange(100, dtype=torch.int32)
    rows, network = radiance.rows(points, torch.ones(100, 3), rays), radiance.network(radiance.networks.raw)
    (raw,), tape = network.fwd(**rows, backend=backend)
    tape.learn(raw.square().sum(), [2 * raw])
    for p in router.parameters():
        assert not p.grad[FROZEN].any() and p.grad[LEARNING].any()
    for frozen, error, message in (
        (torch.zeros(3, dtype=torch.bool), ValueError, r"frozen must have shape \[k\] with k = 4, got \[3\]"),
        (torch.zeros(4), TypeError, "frozen must have dtype bool, got float32"),
    ):
        with pytest.raises(error, match=message):
            network.fwd(**{**rows, "cells": rows["cells"]._replace(frozen=frozen)})


def test_averages_of_frozen_cells_stay():
    router, points = make("grouped"), torch.rand(200, 3)
    optimizer = Adam([{"params": list(router.parameters())}], lr=0.1, average=0.98)
    for step in (0, 4):
        gradients(router, points)
        optimizer.step()
        optimizer.after_step(step)
    router.freeze(FROZEN)
    old = [optimizer.state[p]["average"].clone() for p in router.parameters()]
    gradients(router, points)
    optimizer.step()
    optimizer.after_step(16)
    for p, before in zip(router.parameters(), old, strict=True):
        now = optimizer.state[p]["average"]
        assert torch.equal(now[FROZEN], before[FROZEN]) and not torch.equal(now[LEARNING], before[LEARNING])


def test_copies_children_and_states():
    router = make("table")
    router.freeze(FROZEN)
    for again in (copy.deepcopy(router), pickle.loads(pickle.dumps(router)), router.double().float()):
        assert again.frozen.tolist() == [False, True, False, True]
        optimizer = torch.optim.AdamW(again.parameters())
        again.freeze([], optimizer=optimizer)
        old = [p.detach().clone() for p in again.parameters()]
        gradients(again, torch.rand(50, 3))
        optimizer.step()
        assert all(torch.equal(p[FROZEN], o[FROZEN]) for p, o in zip(again.parameters(), old, strict=True))
    assert not any("frozen" in name for name in router.state_dict())
    other = make("table")
    other.load_state_dict(router.state_dict())
    assert not other.frozen.any()
    centres = torch.cat([router.diagram.centres, router.diagram.centres + 0.01])
    router.subdivide(type(router.diagram)(centres), torch.tensor([0, 1, 2, 3] * 2))
    assert router.frozen.tolist() == [False, True, False, True] * 2
    router.load_state_dict(other.state_dict())
    assert not router.frozen.any() and len(router.frozen) == 4


def test_refuses_cells_that_are_none():
    router = make("table")
    for cells, error, message in (
        ([4], ValueError, "numbers below 4, got 4"),
        ([-1], ValueError, "numbers below 4, got -1"),
        (torch.zeros(3, dtype=torch.bool), ValueError, "cells must be bool [4], got [3]"),
        ([0.5], TypeError, "numbers of cells or bool [4], got torch.float32 [1]"),
        ([[0]], TypeError, "got torch.int64 [1, 1]"),
    ):
        refuses(message, router.freeze, cells, error=error)
        refuses(message, router.unfreeze, cells, error=error)
    router.freeze([])
    assert not router.frozen.any()
