"""Tests of the optimiser: tables with few gradients, and moments that are inherited and saved."""

import functools

import pytest
import torch

from voronerf import HashGridField, VoronoiDiagram, VoronoiRouter
from voronerf.nerf.adam import Adam
from voronerf.nerf.schedule import GROUP


def test_dense_groups_are_torchs():
    results = []
    for make in (Adam, functools.partial(torch.optim.Adam, fused=True)):
        torch.manual_seed(0)
        parameters = [torch.nn.Parameter(torch.randn(5, 3)), torch.nn.Parameter(torch.randn(7))]
        optimizer = make(parameters, lr=0.1, betas=(0.9, 0.99))
        for _ in range(3):
            optimizer.zero_grad()
            sum((p.square() * torch.randn_like(p)).sum() for p in parameters).backward()
            optimizer.step()
        results.append([*parameters, *(t for p in parameters for t in optimizer.state[p].values())])
    for actual, expected in zip(*results, strict=True):
        torch.testing.assert_close(actual, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("option", ["weight_decay", "amsgrad", "maximize", "differentiable"])
def test_options_that_are_not_there_are_refused(option):
    """Unsupported options are refused in a new group; if set later, they are refused at the start of a step."""
    weight = torch.nn.Parameter(torch.ones(3))
    value = 0.1 if option == "weight_decay" else True
    with pytest.raises(ValueError, match=f"Adam: {option} of a group must be 0 or False, got {value}"):
        Adam([{"params": [weight], option: value}], lr=0.1)
    optimizer = Adam([weight], lr=0.1)
    optimizer.param_groups[0][option] = value
    weight.grad = torch.ones(3)
    with pytest.raises(ValueError, match=f"Adam: {option} of a group must be"):
        optimizer.step()
    assert bool((weight == 1).all()) and not optimizer.state[weight]
    optimizer.param_groups[0][option] = False
    optimizer.step()
    assert bool((weight < 1).all())


def test_cells_without_samples_keep_their_bits():
    """Cells with samples take the first step of ``torch.optim.Adam``; other cells keep parameters and moments."""
    generator, options = torch.Generator().manual_seed(0), {"lr": 0.01, "betas": (0.9, 0.999), "eps": 1e-8}
    routers = [VoronoiRouter(torch.nn.Linear(8, 3), 50, fuse=True) for _ in range(2)]
    routers[1].load_state_dict(routers[0].state_dict())
    optimizers = [
        Adam([{"params": routers[0].parameters(), "sparse": True}], **options),
        torch.optim.Adam(routers[1].parameters(), **options),
    ]
    for step in range(4):
        present = torch.tensor([0, 7, 8, 49] if step == 0 else [7, 30])
        absent = torch.ones(50, dtype=torch.bool).index_fill(0, present, False)
        x = torch.rand(32, 8, generator=generator)
        cells = present[torch.randint(len(present), (32,), generator=generator)]
        moments = [state[name].clone() for state in optimizers[0].state.values() for name in ("exp_avg", "exp_avg_sq")]
        before = [parameter.detach().clone() for parameter in routers[0].parameters()]
        for router, optimizer in zip(routers, optimizers):
            optimizer.zero_grad()
            router(x, cells=cells).square().mean().backward()
            optimizer.step()
        for old, new, torchs in zip(before, *(router.parameters() for router in routers), strict=True):
            assert torch.equal(new[absent], old[absent]) and not torch.equal(new, old)
            if step == 0:
                torch.testing.assert_close(new, torchs)
        states = [state[name] for state in optimizers[0].state.values() for name in ("exp_avg", "exp_avg_sq")]
        assert all(torch.equal(new[absent], old[absent]) for new, old in zip(states, moments))


def test_tables_shrink_by_the_rate_of_their_group_where_they_learn():
    table, asleep, other = (torch.nn.Parameter(torch.ones(6, 2)) for _ in range(3))
    groups = [{"params": [other]}, {"params": [table, asleep], "sparse": True, "shrink": 0.01}]
    optimizer = Adam(groups, lr=0.5)
    table.grad, other.grad = torch.zeros(6, 2), torch.zeros(6, 2)
    optimizer.after_step(1)
    assert bool((table == 1).all())
    optimizer.after_step(16)
    assert torch.equal(table, torch.full((6, 2), 1 - 16 * 0.5 * 0.01))
    assert bool((asleep == 1).all()) and bool((other == 1).all())
    optimizer.set_learning_rate(0.25, decay=4.0)
    optimizer.after_step(32)
    assert torch.equal(table, torch.full((6, 2), (1 - 16 * 0.5 * 0.01) * (1 - 16 * 0.25 * 4 * 0.01)))


def test_frozen_cells_do_not_shrink():
    router = VoronoiRouter(torch.nn.Linear(3, 2), torch.rand(4, 3))
    weight = router.module.weight
    optimizer = Adam([{"params": [weight], "sparse": True, "shrink": 0.01}], lr=0.5)
    router.freeze([0, 2])
    weight.grad, before = torch.zeros_like(weight), weight.detach().clone()
    optimizer.after_step(0)
    assert torch.equal(weight[[0, 2]], before[[0, 2]])
    assert torch.equal(weight[[1, 3]], before[[1, 3]] * (1 - 16 * 0.5 * 0.01))


def test_steps_count_once_for_a_parameter_whose_cells_are_partly_frozen():
    torch.manual_seed(0)
    results, centres, gradients = [], torch.rand(5, 3), torch.randn(3, 5, 2, 3)
    for frozen in ([], [1, 3]):  # the two frozen cells leave three ranges of cells
        torch.manual_seed(1)
        router = VoronoiRouter(torch.nn.Linear(3, 2), centres)
        weight = router.module.weight
        optimizer = Adam([weight], lr=0.1)
        router.freeze(frozen)
        for gradient in gradients:
            weight.grad = gradient.clone()
            optimizer.step()
        assert float(optimizer.state[weight]["step"]) == 3
        results.append(weight.detach()[[0, 2, 4]])
    assert torch.equal(*results)


def test_a_scaled_gradient_is_unscaled_and_an_overflow_skipped():
    results = []
    for enabled in (False, True):
        table = torch.nn.Parameter(torch.ones(40, 2))
        optimizer = Adam([{"params": [table], "sparse": True}], lr=0.5, eps=1e-3)
        scaler = torch.amp.GradScaler("cpu", enabled=enabled)
        for factor in (1.0, 2.0) if not enabled else (1.0, torch.inf, 2.0):
            optimizer.zero_grad()
            scaler.scale(table[3].sum() * factor).backward()
            scaler.step(optimizer)
            scaler.update()
        results.append(table.detach())
    assert torch.equal(*results)


def test_a_field_names_its_tables_which_shrink_less_with_many_views():
    router = VoronoiRouter(HashGridField(width=8, levels=2, log2_entries=10), torch.rand(2, 3), share=["features"])
    for views, shrink in ((1, 0.1), (300, 0.1), (3000, 0.01)):
        optimizer = Adam.of({"field": router}, lr=0.1, views=views, sparse=["feat*"])
        dense, tables = optimizer.param_groups
        assert tables["sparse"] and not dense["sparse"] and tables["params"] == [router.module.features]
        assert tables["shrink"] == pytest.approx(shrink)


@pytest.mark.parametrize("decay", [0.5, 0.98])
def test_averages_are_exponential_over_a_growing_window(decay):
    weight, expected, passed = torch.nn.Parameter(torch.randn(5)), None, []
    optimizer = Adam([weight], lr=0.1, average=decay)
    for step in range(130):
        weight.grad = torch.randn(5)
        optimizer.update()
        optimizer.after_step(step)
        now = weight.detach().clone()
        if step % GROUP == 0:
            window = min(1 / (1 - decay), max(1, step / 30))
            new = 1 - (1 - 1 / window) ** GROUP
            expected = now if expected is None else expected + (now - expected) * new
        if step % 10 == 9:
            with optimizer.averaged():
                torch.testing.assert_close(weight.detach(), expected, rtol=1e-4, atol=1e-6)
            assert torch.equal(weight.detach(), now)
            passed.append(not torch.equal(expected, now))
    assert len(passed) == 13 and any(passed)


@pytest.mark.parametrize("inherit", [True, False])
def test_children_have_the_average_of_their_parent(inherit):
    router = VoronoiRouter(torch.nn.Linear(3, 2), torch.zeros(1, 3), coords="first3")
    optimizer = Adam(router.parameters(), lr=0.1, average=0.9)
    for step in range(60):
        router(torch.rand(8, 3)).square().sum().backward()
        optimizer.update()
        optimizer.after_step(step)
    with optimizer.averaged():
        before = router.module.weight.detach().clone()
    router.subdivide(
        VoronoiDiagram(torch.rand(4, 3)), torch.zeros(4, dtype=torch.int64), optimizer=optimizer, inherit=inherit
    )
    wanted = before.expand(4, 2, 3) if inherit else router.module.weight.detach().clone()
    with optimizer.averaged():
        assert torch.equal(router.module.weight, wanted)
