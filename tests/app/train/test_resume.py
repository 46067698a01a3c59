"""Tests of resumed runs: they equal unstopped runs bit for bit, and refuse the checkpoints of other runs."""

import json
import math
import os
import threading
from dataclasses import replace

import pytest
import torch
from helpers import read_json, refuses, same, trained
from tiny_runs import HIERARCHICAL, Each, assert_resumes, scores, small, steps_of, tensors

import voronerf.app.evaluate.scores as scores_module
from voronerf.app import open_run
from voronerf.app.train import Checkpoints, ConfigError, build, load, run, snapshot, train
from voronerf.app.train.build import make_routers
from voronerf.app.train.checkpoint import (
    CheckpointError,
    checkpoint_path,
    checkpoint_paths,
    load_checkpoint,
    save_checkpoint,
)
from voronerf.app.train.resume import restore_routers
from voronerf.app.train.run_directory import held
from voronerf.ops._core import backends


@pytest.fixture(scope="module")
def stopped(tmp_path_factory, scene):
    """The settings of a run that stopped after 14 steps."""
    config = small(tmp_path_factory.mktemp("stopped"))
    trained(config, scene, stop_at=14)
    return config


@pytest.mark.parametrize("stop_at", [11, 17])
def test_resume_is_bit_for_bit(tmp_path, scene, stop_at):
    assert_resumes(tmp_path, scene, stop_at, assignment="stochastic")


def test_resume_drops_evaluations_made_after_the_checkpoint(tmp_path, scene):
    config = small(tmp_path)
    trained(config, scene, stop_at=14)
    with open(tmp_path / "metrics.jsonl", "a") as file:
        file.write(json.dumps({"step": 20, "psnr": 99.0}) + "\n")
    trained(config, scene, resume=True)
    assert [step for step, _ in scores(tmp_path)] == [12, 24]


def test_an_evaluation_that_was_stopped_is_made_again(tmp_path, scene, monkeypatch):
    whole, part = (small(tmp_path / name) for name in ("whole", "part"))
    trained(whole, scene)
    rendered = scores_module.render_camera

    for stop_at, steps, evaluated in ((12, 12, []), (24, 24, [12]), (None, 24, [12, 24])):
        states = []

        def stopping_view(*args, stop_at=stop_at, states=states, **options):
            if states and states[0].step == stop_at:
                states[0].stop()
            return rendered(*args, **options)

        class Keep(Each):
            def on_start(self, state, states=states):
                states.append(state)

        monkeypatch.setattr(scores_module, "render_camera", stopping_view)
        keep = Keep(lambda state: None)
        summary = trained(part, scene, resume=stop_at != 12, callbacks=[keep])
        assert (summary["steps"], summary["complete"]) == (steps, stop_at is None)
        assert [step for step, _ in scores(part.out)] == evaluated
    assert scores(whole.out) == scores(part.out) and same(tensors(whole.out), tensors(part.out))


def test_longer_resumed_runs_are_evaluated(tmp_path, scene):
    config = small(tmp_path, steps=8, cells=(), evaluations=4)
    trained(config, scene)
    summary = trained(replace(config, steps=16), scene, resume=True)
    assert [step for step, _ in scores(tmp_path)] == [2, 4, 6, 8, 12, 16]
    assert scores(tmp_path)[-1][1] == summary["psnr"]


def test_seeds_decide_everything(tmp_path, scene):
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        trained(small(tmp_path / name, seed=seed), scene)
    a, b, c = (tensors(tmp_path / name) for name in "abc")
    assert same(a, b) and not same(a, c)


def test_a_loaded_run_may_be_rendered_otherwise_and_has_its_architecture(tmp_path, scene):
    state = build(small(tmp_path, cells=(3, 2), **HIERARCHICAL), scene)
    run(state, [Checkpoints(tmp_path)])
    opened = open_run(tmp_path, scene=scene)
    config = opened.config
    assert config == state.config
    coarser = open_run(tmp_path, scene=scene, samples=(3, 2), backend="reference").renderer
    assert (coarser.sampler.samples, coarser.sampler.fine_samples, coarser.backend) == (3, 2, "reference")
    # Checkpoints of another configuration or architecture are refused.
    checkpoint = load_checkpoint(checkpoint_path(tmp_path))
    with pytest.raises(CheckpointError, match=r"a checkpoint of another configuration: --width 8 -> 16; --lr"):
        load(build(replace(config, width=16, lr=1e-4), scene), checkpoint)
    del checkpoint.tensors["router.module.density.weight"]
    refuses("another architecture", restore_routers, make_routers(config), checkpoint, error=CheckpointError)


def without(prefix):
    return lambda c: [c.tensors.pop(name) for name in list(c.tensors) if name.startswith(prefix)]


@pytest.mark.parametrize(
    ("message", "damage"),
    [
        ("no moments of the optimiser after 14 steps", without("optimizer.")),
        ("optimizer.0.exp_avg_sq must have shape [", without("optimizer.0.exp_avg_sq")),
        (
            "optimizer.99.step must be of one of",
            lambda c: c.tensors.update({"optimizer.99.step": c.tensors["optimizer.0.step"].clone()}),
        ),
        ("SplitStrategy: splits must lie in 0..1, got -1", without("strategy.")),
        ("'draws'", without("generator.draws")),
        ("another architecture", without("router.module.density")),
        (
            "density.bias must be float32 [4, 1], got float64 [4, 1]",
            lambda c: c.tensors.update({(n := "router.module.density.bias"): c.tensors[n].double()}),
        ),
        ("step must be an integer, got 'x'", lambda c: c.values.update(step="x")),
        ("step, times and stages must be counts, got -1", lambda c: c.values.update(step=-1)),
        ("stage 1: cells must be an integer, got 4.5", lambda c: c.values["stages"][1].update(cells=4.5)),
        ("stage 0: split_cells missing", lambda c: c.values["stages"][0].pop("split_cells")),
        ("step, times and stages must be counts, got 14, [inf", lambda c: c.values.update(seconds=math.inf)),
        ("rays must lie in 64 to 4096 by its settings, got 4097", lambda c: c.values.update(rays=4097)),
        ("seconds missing", lambda c: c.values.pop("seconds")),
        ("settings: width must be an integer or null, got '8'", lambda c: c.values["config"].update(width="8")),
        ("settings: cells must be a list, each entry an integer", lambda c: c.values["config"].update(cells=[True])),
    ],
)
def test_what_a_checkpoint_lacks_is_named(tmp_path, scene, stopped, message, damage):
    path = checkpoint_path(tmp_path)
    checkpoint = load_checkpoint(checkpoint_path(stopped.out))
    damage(checkpoint)
    save_checkpoint(path, checkpoint)
    with pytest.raises((CheckpointError, ConfigError)) as caught:
        load(build(stopped, scene), load_checkpoint(path))
    assert str(caught.value).startswith(f"{path}: ") and message in str(caught.value)


def test_steps_that_were_left_out_are_counted_on(scene, stopped):
    checkpoint = load_checkpoint(checkpoint_path(stopped.out))
    checkpoint.values["skipped"] = 3
    load(state := build(stopped, scene), checkpoint)
    state.training_step.guard.skipped.add_(1)
    assert state.skipped == snapshot(state).values["skipped"] == 4


def test_a_training_leaves_its_checkpoint_as_it_was(scene, stopped):
    """Several trainings may start from one checkpoint; an optimiser updates its moments in place."""
    checkpoint = load_checkpoint(checkpoint_path(stopped.out))
    before = {name: tensor.clone() for name, tensor in checkpoint.tensors.items()}
    load(state := build(stopped, scene), checkpoint)
    steps_of(state, 2)
    assert same(before, checkpoint.tensors)


def test_a_run_goes_on_from_an_older_checkpoint(tmp_path, scene):
    config = small(tmp_path / "part")
    checkpoints = Checkpoints(config.out, interval=1e-9)
    run(state := build(config, scene), [checkpoints, Each(lambda s: s.step == 14 and s.stop())])
    (partial := config.out / "checkpoints" / ".1-1.partial").write_bytes(b"of a process that died")
    path = checkpoint_path(config.out)
    path.write_bytes(path.read_bytes()[:-1] + b"\x7f")
    with held(config.out), pytest.warns(UserWarning, match="; using last-.* instead"):
        assert trained(config, scene, resume=True)["complete"] and state.step == 14
    assert not partial.exists()
    trained(small(tmp_path / "whole"), scene)
    assert same(tensors(config.out), tensors(tmp_path / "whole"))


@pytest.mark.parametrize(("contraction", "stop_at"), [("none", 7), ("sphere", 15)])  # before, after the grid settles
def test_a_run_with_a_grid_resumes_bit_for_bit(tmp_path, scene, monkeypatch, contraction, stop_at):
    monkeypatch.setattr("voronerf.nerf.occupancy.CONTRAST", 0.022)
    monkeypatch.setattr("voronerf.nerf.schedule.GROUP", 2)
    for name in ("SETTLING_STEPS", "WARMUP_STEPS"):
        monkeypatch.setattr(f"voronerf.nerf.samplers.{name}", 5)
    monkeypatch.setattr("voronerf.nerf.schedule.FILL", 1.5)  # the number of rays varies
    settings = {"contraction": contraction, "precision": "fp32" if contraction == "none" else "bf16"}
    saved = assert_resumes(tmp_path, scene, stop_at, occupancy=True, field="hashgrid", depth=1, **settings)
    assert saved["occupancy.settled"] == (8 if contraction == "none" else 10)
    assert len(saved["occupancy.density"].unique()) > 1


@pytest.mark.parametrize("stop_at", [4, 7])  # before and after the restart
def test_a_start_that_failed_is_begun_again_and_resumed(tmp_path, scene, monkeypatch, stop_at):
    monkeypatch.setattr("voronerf.nerf.samplers.WARMUP_STEPS", 2)
    monkeypatch.setattr("voronerf.app.train.start.JUDGED", 3)
    monkeypatch.setattr("voronerf.app.train.start.why_nothing_is_learnt", lambda batch, output: "planted")
    assert_resumes(tmp_path, scene, stop_at, occupancy=True, field="hashgrid", depth=1, split_at=(0.9,))
    stages = read_json(tmp_path / "part" / "summary.json")["stages"]
    assert [(stage["cells"], stage["started_at_step"]) for stage in stages] == [
        (1, 0),
        (1, 5),
        (1, 10),
        (1, 15),
        (4, 22),
    ]


def test_averages_are_resumed_and_shown(tmp_path, scene):
    saved = assert_resumes(tmp_path, scene, 40, steps=50, split_at=(0.7,), **HIERARCHICAL)
    assert any(name.endswith(".average") for name in saved)
    opened = open_run(tmp_path / "part", scene=scene)
    assert any(not torch.equal(p, saved[f"router.{name}"]) for name, p in opened.router.named_parameters())


def test_training_goes_on_while_a_checkpoint_is_written(tmp_path, scene, monkeypatch):
    written, whole = threading.Event(), os.fsync

    def slow(descriptor):
        assert threading.current_thread() is threading.main_thread() or written.wait(600)
        whole(descriptor)

    def look(state):
        if state.step == 20:
            assert checkpoint_paths(tmp_path) == []
            written.set()

    monkeypatch.setattr(os, "fsync", slow)
    checkpoints = Checkpoints(tmp_path, interval=1e-9)
    train(build(small(tmp_path), scene), [checkpoints, Each(look)])
    checkpoints.writer.wait()
    assert load_checkpoint(checkpoint_path(tmp_path)).values["step"] >= 1


def test_a_thread_that_cannot_begin_leaves_no_silence(tmp_path, scene, monkeypatch):
    monkeypatch.setattr(threading.Thread, "run", lambda thread: None)
    with pytest.raises(MemoryError, match="no memory for the thread that writes a checkpoint"):
        trained(small(tmp_path, steps=3), scene)


def test_turns_leave_checkpoints(tmp_path, scene):
    ticks = iter(range(100_000))
    state = build(small(tmp_path, steps=100_000), scene)
    checkpoints = Checkpoints(tmp_path, interval=0.05)
    while state.seconds < 0.15:
        assert state.seconds >= 0.05 or not checkpoint_path(tmp_path).exists()
        train(state, [checkpoints], until=state.seconds + 1e-4, clock=lambda: 0.01 * next(ticks))  # takes one step
    checkpoints.writer.wait()
    assert checkpoint_path(tmp_path).exists()


def test_the_checkpoint_after_the_last_step_has_the_cleaned_grid(tmp_path, scene, monkeypatch):
    """A process that ends before the cleaning leaves an earlier checkpoint, from which a resume cleans the grid."""
    done = []
    monkeypatch.setattr(Checkpoints, "save", lambda self, state: done.append(state.step))
    monkeypatch.setattr("voronerf.nerf.Stratified.finish", lambda *_: done.append("cleaned"))
    run(build(small(tmp_path, steps=3), scene), [Checkpoints(tmp_path, interval=0)])
    assert done[-2:] == ["cleaned", 3] and done.count(3) == 1 and len(done) > 2


def test_a_change_of_threads_is_said_where_torch_computes(scene, tmp_path):
    before = torch.get_num_threads()
    changed = f"by torch on {before} thread{'s' * (before > 1)}, later steps by torch on {before + 1} threads"
    for backend, expected in (("auto", []), ("reference", [changed])):
        said = []
        config = small(tmp_path / backend, backend=backend, steps=2, cells=())
        trained(config, scene)
        torch.set_num_threads(before + 1)
        try:
            load(build(config, scene, on_event=said.append), load_checkpoint(checkpoint_path(config.out)))
        finally:
            torch.set_num_threads(before)
        assert len(said) == len(expected) and all(part in line for part, line in zip(expected, said))


def test_a_resume_without_the_compiled_module_is_said(scene, tmp_path, monkeypatch):
    config, said = small(tmp_path, steps=2, cells=()), []
    trained(config, scene)
    monkeypatch.setitem(backends.ORDER, "cpu", ("reference",))
    backends._choose_once.cache_clear()
    try:
        load(build(config, scene, on_event=said.append), load_checkpoint(checkpoint_path(tmp_path)))
    finally:
        backends._choose_once.cache_clear()
    assert "was computed by native operations, later steps by torch on" in "".join(said)
