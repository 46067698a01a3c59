"""Tests of training in territories: equal runs on any number of ranks, killed ranks, damaged files, and refusals."""

import os
import shutil
import signal
from dataclasses import replace
from unittest import mock

import pytest
import torch
from ranks import complaints, network_files, new_store, on_ranks, town_tensors

from voronerf.app.cli import main
from voronerf.app.scenes import builtin_scene
from voronerf.app.scenes.scene import SparseDepth
from voronerf.app.train import Callback, TrainConfig, build
from voronerf.app.train import train as train_alone
from voronerf.app.train.checkpoint import checkpoint_path, load_checkpoint
from voronerf.app.train.resume import snapshot
from voronerf.nerf import OccupancyGrid, TrainingStep
from voronerf.town import group, open_run, rays, train

ARGUMENTS = """
train-territories --data builtin --downscale 8 --width 8 --field-options levels=4 log2_entries=10 --rays 16 --cells 2
--split-at 6 --steps 24 --panels 0 --territories 3 --lpips off --eval-views 1
"""


def slow(*row):
    return pytest.param(*row, marks=pytest.mark.slow)


def command(out, *more):
    return [*ARGUMENTS.split(), "--out", str(out), *more]


def in_step(number, harm):
    """Returns a context in which rank 1 calls `harm` before step `number`."""
    real, steps = rays.step_together, iter(range(10_000))

    def step_together(group, *arguments):
        if next(steps) == number and group.rank == 1:
            harm()
        return real(group, *arguments)

    return mock.patch.object(train, "step_together", step_together)


def dies(args, step):
    with in_step(step, lambda: os.kill(os.getpid(), signal.SIGKILL)):
        return main(args)


def dies_at_the_start(args):
    """Kills rank 1 before the rendezvous; the other ranks wait 3 s for it."""
    if os.environ["RANK"] == "1":
        os.kill(os.getpid(), signal.SIGKILL)
    with mock.patch.object(group, "PATIENCE", 3):
        return main(args)


def is_asked_to_stop(args, step):
    with in_step(step, lambda: os.kill(os.getpid(), signal.SIGTERM)):
        return main(args)


def has_no_room(args):
    full = OSError(28, "No space left on device")
    with mock.patch.object(train, "save_checkpoint", side_effect=full):
        return main(args)


def same(first, second):
    first, second = town_tensors(first), town_tensors(second)
    return first.keys() == second.keys() and all(first[name].equal(second[name]) for name in first)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of an undisturbed run of one process."""
    out = tmp_path_factory.mktemp("whole") / "run"
    assert on_ranks(main, command(out), folder=out.parent, size=1)[0] == [0]
    return out


@pytest.fixture(scope="module")
def resumed(tmp_path_factory):
    """The folder of a run of two ranks, which was stopped and resumed, and has two checkpoints."""
    folder = tmp_path_factory.mktemp("resumed")
    assert on_ranks(is_asked_to_stop, command(folder / "run"), 12, folder=folder)[0] == [130, 130]
    assert on_ranks(main, command(folder / "run", "--resume"), folder=folder)[0] == [0, 0]
    return folder / "run"


def test_a_run_of_territories_is_opened_as_one_field(whole):
    scene = builtin_scene(12, train_views=8, test_views=1)
    opened = open_run(whole, scene=scene)
    assert opened.router.num_cells == 6 and len(opened.router[0].networks) == 3
    assert opened.render(0).colour.isfinite().all()
    assert opened.renderer.occupancy is not None


@pytest.mark.parametrize("size", [2, slow(3)])
def test_any_number_of_ranks_trains_the_same_run(tmp_path, whole, size):
    assert on_ranks(main, command(tmp_path / "run"), folder=tmp_path, size=size)[0] == [0] * size
    assert same(whole, tmp_path / "run")


def test_a_run_that_was_stopped_and_continued_is_the_same(whole, resumed):
    last = checkpoint_path(resumed)
    assert last.with_name("last-1.safetensors").is_file() and same(whole, resumed)


@pytest.mark.slow
def test_a_run_continues_on_another_number_of_ranks_that_need_not_name_its_territories(tmp_path, whole):
    run = tmp_path / "run"
    assert on_ranks(is_asked_to_stop, command(run), 12, folder=tmp_path)[0] == [130, 130]
    args = ["train-territories", "--resume", "--out", str(run), "--panels", "0"]
    assert on_ranks(main, args, folder=tmp_path, size=1)[0] == [0]
    assert same(whole, run)


@pytest.mark.slow
def test_a_rank_that_is_killed(tmp_path, whole):
    """The other rank reports the killed rank; after a restart as by torchrun, the run equals `whole` bit for bit."""
    args = command(tmp_path / "run", "--checkpoint-every", "1e-6")
    codes, texts = on_ranks(dies, args, 19, folder=tmp_path)
    assert codes == [1, -signal.SIGKILL] and len(complaints(texts)) == 1
    assert "another rank has ended" in complaints(texts)[0]
    assert on_ranks(main, args, folder=tmp_path, restarts=1)[0] == [0, 0]
    assert same(whole, tmp_path / "run")


@pytest.mark.slow
def test_a_rank_that_is_killed_before_the_others_meet_it(tmp_path):
    codes, texts = on_ranks(dies_at_the_start, command(tmp_path / "run"), folder=tmp_path, size=3)
    assert codes == [1, -signal.SIGKILL, 1] and len(complaints(texts)) == 1
    assert "another rank has ended" in complaints(texts)[0]


@pytest.mark.parametrize("harm", ["changed", slow("cut short"), slow("missing")])
def test_a_damaged_part(tmp_path, whole, resumed, harm):
    """All ranks load the previous checkpoint, and name the damaged file."""
    shutil.copytree(resumed, tmp_path / "run")
    part = network_files(tmp_path / "run")[1]
    data = bytearray(part.read_bytes())
    if harm == "missing":
        part.unlink()
    else:
        data[-5] ^= 1
        part.write_bytes(data[: len(data) // (1 if harm == "changed" else 2)])
    codes, texts = on_ranks(main, command(tmp_path / "run", "--resume"), folder=tmp_path)
    assert codes == [0, 0] and "; using last-" in texts[0] and same(whole, tmp_path / "run")


def test_no_checkpoint_is_left(tmp_path, resumed):
    shutil.copytree(resumed, tmp_path / "run")
    for file in checkpoint_path(tmp_path / "run").parent.glob("*"):
        file.write_bytes(b"")
    codes, texts = on_ranks(main, command(tmp_path / "run", "--resume"), folder=tmp_path)
    assert codes == [1, 1] and len(complaints(texts)) == 1 and "not a readable checkpoint" in complaints(texts)[0]


def test_files_of_checkpoints_that_are_gone_are_removed(whole, resumed):
    assert len(list(checkpoint_path(whole).parent.glob("networks-*"))) == 3
    assert len(list(checkpoint_path(resumed).parent.glob("networks-*"))) == 6


def test_a_full_disk(tmp_path):
    codes, texts = on_ranks(has_no_room, command(tmp_path / "run"), folder=tmp_path)
    assert codes == [1, 1]
    assert len(complaints(texts)) == 1 and "No space left on device" in complaints(texts)[0]
    assert not (tmp_path / "run").exists() or not list((tmp_path / "run").rglob("last*"))


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--sampling", "hierarchical"], "--sampling must be stratified with --territories: a ray is split"),
        (["--territories", "1"], "--territories must be at least the 2 ranks, got 1"),
        slow(["--no-occupancy"], "--occupancy must be on with --territories, got False"),
        slow(["--territories", "999"], "--territories must be at most the"),
    ],
)
def test_settings_that_territories_do_not_support(tmp_path, more, said):
    """Exactly one rank reports the error at every start, also if torchrun's store has entries of an earlier start."""
    store = new_store()
    for restarts in range(1 + (more[0] == "--sampling")):
        args = command(tmp_path / "run", *more)
        codes, texts = on_ranks(main, args, folder=tmp_path, restarts=restarts, store=store)
        assert codes == [1, 1] and not (tmp_path / "run").exists()
        assert len(complaints(texts)) == 1 and said in complaints(texts)[0]


def test_ranks_that_differ(tmp_path):
    arguments = [(command(tmp_path / "run"),), (command(tmp_path / "run", "--seed", "1"),)]
    codes, texts = on_ranks(main, folder=tmp_path, arguments=arguments)
    assert codes == [1, 1] and not (tmp_path / "run").exists()
    assert complaints(texts) == ["voronerf: error: --seed must be the same on all ranks, got 0 on 0 and 1 on 1"]


def test_a_training_learns(whole):
    index = load_checkpoint(checkpoint_path(whole))
    assert index.values["parts"][0]["networks"] and index.tensors["bounds"].shape == (3, 2, 3)
    for path in network_files(whole):
        checkpoint = load_checkpoint(path)
        assert checkpoint.values["step"] == 24 and checkpoint.values["skipped"] == 0
        assert any(bool(t.any()) for name, t in checkpoint.tensors.items() if name.endswith("exp_avg"))
        assert torch.isfinite(checkpoint.tensors["router.module.features"]).all()


def build_some(out, steps, count=3, **more):
    """Builds small territories in this process."""
    options = ("levels=4", "log2_entries=10")
    settings = {"width": 8, "rays": 24, "cells": (2,), "split_at": (0.85,), "field_options": options, **more}
    config = TrainConfig(steps=steps, out=out, lpips=False, **settings)
    scene = builtin_scene(16, train_views=9, test_views=1)
    return train.build_town(config, scene, count, group.Group(torch.device("cpu")))


@pytest.mark.slow
def test_parts_of_steps_are_replayed(tmp_path, monkeypatch):
    """Replayed parts of steps give the same bits as eager steps, also after a split and occupancy updates."""
    results = []
    monkeypatch.setattr("voronerf.nerf.samplers.WARMUP_STEPS", 20)
    monkeypatch.setattr(OccupancyGrid, "can_learn_from", lambda *_, **__: True)
    for expected in ("recorded and replayed", "a test"):
        if results:
            monkeypatch.setattr(TrainingStep, "_standing_obstacle", lambda *of, **how: "a test")
        town = build_some(tmp_path / expected, 60)
        train.train(town)
        results.append([v for state in town.states.values() for v in snapshot(state).tensors.values()])
        for state in town.states.values():
            assert expected in state.training_step.explain()
            assert "another segment" not in state.training_step.explain()
            replayed = {name for name, segment in state.training_step._segments.items() if segment.replayed}
            assert replayed >= ({"own rays: networks", "own rays: gradients beside 0"} if len(results) == 1 else set())
    assert all(one.equal(other) for one, other in zip(*results, strict=True))


def test_a_start_that_failed_begins_again(tmp_path, monkeypatch):
    """A territory restarts if its rays, with the light of all territories, show nothing; here all fields are empty."""
    monkeypatch.setattr("voronerf.nerf.samplers.WARMUP_STEPS", 20)
    monkeypatch.setattr("voronerf.app.train.start.JUDGED", 30)
    town, said = build_some(tmp_path, 70), []
    for state in town.states.values():
        state.on_event = said.append
        with torch.no_grad():
            state.router.module.density.bias.fill_(-30.0)
    train.train(town)
    assert len(said) == 3 and "nothing is learnt by step 50: the field is empty everywhere" in said[0]
    for number, state in town.states.items():
        assert state.began == 50 and state.strategy.splits == 1
        outside = town.members[number].place.outside(state.sampler.grid)
        assert state.sampler.grid.occupied.view(-1).equal(~outside)


def test_photographs_have_a_robust_loss(tmp_path):
    losses = []
    for robust in (0.0, 0.05):
        town = build_some(tmp_path / str(robust), 1)
        for state in town.states.values():
            assert state.ray_loss.robust == 0  # the pictures are computed, not photographs
            state.ray_loss.robust = robust
        train.train(town)
        losses.append([state.loss for state in town.states.values()])
    assert all(0 < robust < 0.7 * squared for squared, robust in zip(*losses, strict=True)), losses


def test_one_territory_is_an_ordinary_training(tmp_path):
    """A single territory records whole steps; a stopped and resumed training gives the same bits."""
    results = []
    for stops in (False, True):
        town = build_some(tmp_path / str(stops), 30, count=1)
        if stops:
            train.train(town, [Stops(town)])
            assert town.first.step == 12
            town = build_some(tmp_path / str(stops), 30, count=1)
            train.resume(town)
        train.train(town)
        assert "recorded and replayed" in town.first.training_step.explain()
        results.append(snapshot(town.first))
    assert results[1].values["step"] == 30
    assert all(results[0].tensors[name].equal(tensor) for name, tensor in results[1].tensors.items())


def test_one_territory_of_photographs_is_an_ordinary_training(tmp_path):
    """A single territory equals a training without territories, bit for bit, with sparse points and unseen rays."""
    computed, points = builtin_scene(16, train_views=9, test_views=1), SparseDepth(torch.arange(60), torch.ones(60))
    views = replace(computed.train, images=computed.train.images[..., :3].contiguous(), sparse_depth=points)
    scene = replace(computed, train=views, box=None, background=None, kind="unbounded")
    more = {"rays": 32, "samples": (16,), "cells": (2,), "field_options": ("levels=4", "log2_entries=10")}
    config = TrainConfig(steps=30, out=tmp_path / "run", **more)
    town, alone = train.build_town(config, scene, 1, group.Group(torch.device("cpu"))), build(config, scene)
    kinds = [type(term).__name__ for term in alone.ray_loss.terms]
    assert alone.batches.unseen > 0 and kinds == ["SparseDepth", "SmoothDepth", "Surface"]
    train.train(town)
    train_alone(alone)
    result, expected = snapshot(town.first).tensors, snapshot(alone).tensors
    assert result.keys() == expected.keys() and all(result[name].equal(expected[name]) for name in expected)


class Stops(Callback):
    def __init__(self, town):
        self.town = town

    def after_step(self, state):
        if state.step == 12:
            self.town.stop()
