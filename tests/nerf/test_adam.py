"""The optimiser of tables: few entries have a gradient, moments are inherited and saved."""

import functools
from typing import ClassVar

import pytest
import torch
from tiny_runs import assert_resumes, small

from voronerf import VoronoiRouter
from voronerf.app.train.networks import make_optimizer
from voronerf.app.train.trainer import Trainer
from voronerf.nerf.adam import Adam
from voronerf.nerf.fields import FIELDS, register_field


@pytest.fixture
def embedded():
    @register_field("embedded")
    class Embedded(torch.nn.Module):
        """A feature for each slab of the box; a step meets few of the slabs."""

        router_options: ClassVar = {"share": ["table"]}
        sparse_parameters = ("tab*",)

        def __init__(self, width: int = 8):
            super().__init__()
            self.table = torch.nn.Parameter(torch.randn(5000, 4))
            self.out = torch.nn.Linear(4, 4)

        def forward(self, positions, directions):
            slab = (positions[:, 0] * 800 + 2500).long().clamp(0, 4999)
            raw = self.out(torch.nn.functional.embedding(slab, self.table))
            return torch.sigmoid(raw[:, :3]), torch.nn.functional.softplus(raw[:, 3])

    yield "embedded"
    del FIELDS["embedded"]


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
    for found, expected in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


def test_tables_move_where_they_have_a_gradient_and_keep_it():
    table, other = torch.nn.Parameter(torch.ones(6, 2)), torch.nn.Parameter(torch.ones(2))
    optimizer = Adam([{"params": [other]}, {"params": [table], "sparse": True}], lr=0.5)
    for row in (1, 4):
        optimizer.zero_grad()
        (table[row].sum() + other.sum()).backward()
        before, moments = table.detach().clone(), optimizer.state[table].get("exp_avg", torch.zeros(6, 2)).clone()
        optimizer.step()
        rest = torch.arange(6) != row
        assert torch.equal(table[rest], before[rest]) and bool((table[row] < before[row]).all())
        assert torch.equal(optimizer.state[table]["exp_avg"][rest], moments[rest])
        assert table.grad is not None and bool((table.grad[row] == 1).all())
    assert float(optimizer.state[table]["step"]) == 2 and bool((other < 1).all())


def test_weights_shrink_by_the_rate_of_their_group_where_they_learn():
    table, asleep, other = (torch.nn.Parameter(torch.ones(6, 2)) for _ in range(3))
    groups = [{"params": [other]}, {"params": [table, asleep], "sparse": True, "shrink": 0.1}]
    optimizer = Adam(groups, lr=0.5)
    table.grad, other.grad = torch.zeros(6, 2), torch.zeros(6, 2)
    optimizer.shrink(4)
    assert torch.equal(table, torch.full((6, 2), 1 - 4 * 0.5 * 0.1))
    assert bool((asleep == 1).all()) and bool((other == 1).all())


def test_frozen_cells_do_not_shrink():
    router = VoronoiRouter(torch.nn.Linear(3, 2), torch.rand(4, 3))
    weight = router.module.weight
    optimizer = Adam([{"params": [weight], "sparse": True, "shrink": 0.1}], lr=0.5)
    router.freeze([0, 2])
    weight.grad, before = torch.zeros_like(weight), weight.detach().clone()
    optimizer.shrink(1)
    assert torch.equal(weight[[0, 2]], before[[0, 2]])
    assert torch.equal(weight[[1, 3]], before[[1, 3]] * (1 - 0.5 * 0.1))


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


def test_a_field_names_its_tables(tmp_path, scene, embedded):
    trainer = Trainer(small(tmp_path, field=embedded, depth=None), scene)
    dense, tables = trainer.optimizer.param_groups
    assert tables["sparse"] and not dense["sparse"] and len(dense["params"]) == 2
    (table,) = tables["params"]
    before = table.detach().clone()
    trainer.on_step = lambda progress: trainer.request_stop() if progress.step == 2 else None
    trainer.advance()
    met = (trainer.optimizer.state[table]["exp_avg"] != 0).any(1)
    assert bool(met.any()) and not bool(met.all())
    shrunk = table[~met].detach() / before[~met]  # the others have the decay of the first step alone
    assert float(shrunk.max()) < 1 and torch.allclose(shrunk, shrunk[0, 0])
    assert bool((table[met] != before[met] * shrunk[0, 0]).any(1).all())


def test_tables_of_many_views_shrink_less(tmp_path, scene, embedded):
    trainer = Trainer(small(tmp_path, field=embedded, depth=None), scene)
    made = (make_optimizer(trainer.routers, trainer.config, views=views) for views in (1, 300, 3000))
    assert [optimizer.param_groups[1]["shrink"] for optimizer in made] == pytest.approx([0.1, 0.1, 0.01])


def test_tables_resume_bit_for_bit(tmp_path, scene, embedded):
    assert_resumes(tmp_path, scene, 15, field=embedded, depth=None)
