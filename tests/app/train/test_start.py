"""Tests of the first steps: the grid does not become empty, and training restarts if it learns nothing."""

import itertools
from dataclasses import replace

import pytest
import torch
from tiny_runs import Each, small, steps_of

from voronerf.app.evaluate.scores import evaluate, mean_scores
from voronerf.app.scenes import builtin_scene
from voronerf.app.train import TrainConfig, build
from voronerf.app.train.start import JUDGED, judged_at, why_nothing_is_learnt
from voronerf.nerf import Batch, Rays, RenderOutput
from voronerf.nerf.volume import Samples


@pytest.mark.slow
@pytest.mark.native
def test_steps_of_many_rays_do_not_empty_the_grid_before_the_field_is_dense():
    """Regression: this seed's training lost all its samples and stayed at 9 dB."""
    scene = builtin_scene(32, train_views=30, test_views=2)
    config = TrainConfig(steps=6000, split_at=(0.9,), rays=4096, samples=(128,), seed=3)
    state = steps_of(build(config, scene), 115)
    with state.averaged():
        assert state.sampler.grid.share < 0.9
        assert mean_scores(evaluate(state.renderer, scene, views=2))["psnr"] > 20


def test_a_start_that_failed_begins_again_and_learns(scene, monkeypatch):
    monkeypatch.setattr("voronerf.nerf.samplers.WARMUP_STEPS", 20)
    monkeypatch.setattr("voronerf.app.train.start.JUDGED", 30)
    said = []
    state = build(small(field="hashgrid", depth=1, occupancy=True, steps=400, split_at=(0.9,)), scene)
    state = replace(state, on_event=said.append)
    with torch.no_grad():
        state.router.module.density.bias.fill_(-30.0)
    steps_of(state, 20)
    state.sampler.grid.occupied.fill_(False)
    steps_of(state, 30)
    assert said == ["nothing is learnt by step 50: the field is empty everywhere; restart 1 of 3 with another seed"]
    assert state.began == 50 and state.sampler.grid.share == 1 and state.rays == 64 and not state.optimizer.state
    assert len(state.strategy.reservoir) == 0 and state.learning_rate() < 0.1 * state.config.lr
    steps_of(state, 100)
    assert len(said) == 1 and state.sampler.grid.share == 1 and state.loss < 0.03


def test_a_start_is_judged_after_its_grid_has_settled(scene):
    state = build(small(occupancy=True), scene)
    assert judged_at(state) == state.sampler.settling_steps + JUDGED
    state.sampler.grid.settled = 512
    assert judged_at(state) == 512 + JUDGED


def weight(state):
    return state.router.module.trunk[0].weight.detach().clone()


def test_every_new_start_is_another_draw(scene, monkeypatch):
    monkeypatch.setattr("voronerf.nerf.samplers.WARMUP_STEPS", 1)
    monkeypatch.setattr("voronerf.app.train.start.JUDGED", 1)
    monkeypatch.setattr("voronerf.app.train.start.why_nothing_is_learnt", lambda batch, output: "planted")
    said = []
    state = replace(build(small(occupancy=True, cells=(), lr=1.0), scene), on_event=said.append)
    drawn = [weight(state)]
    steps_of(state, 8, Each(lambda s: s.step in (2, 4, 6) and drawn.append(weight(s))))
    assert [stage.started_at_step for stage in state.stages] == [0, 2, 4, 6]
    assert not any(torch.equal(a, b) for a, b in itertools.combinations(drawn, 2))
    advice = "the learning rate is probably too high, try --lr 0.02, the default"
    assert said[2] == f"nothing is learnt by step 6: planted; restart 3 of 3 with another seed; {advice}"


def test_a_start_of_one_colour_has_failed():
    """A start has failed if its samples have one colour, unless the rays' target is that colour."""
    generator = torch.Generator().manual_seed(0)
    background, target = torch.rand(2, 50, 3, generator=generator)
    light = torch.linspace(0, 1, 50)[:, None]
    for sampled, wanted, failed in ((0.4, target, True), (0.4, 0.4 + 0 * target, False), (target, target, False)):
        colour = light * sampled + (1 - light) * background
        nothing, places = torch.zeros(50), torch.zeros(50, 3)
        batch = Batch(Rays(places, places), nothing, nothing, wanted, background)
        samples = Samples(places, torch.arange(50), torch.arange(51), nothing, nothing)
        output = RenderOutput(torch.zeros(()), nothing, light[:, 0], nothing, samples, colour)
        assert why_nothing_is_learnt(batch, output) == ("all rays have the same colour" if failed else None)
