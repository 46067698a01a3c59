"""Runs that are stopped, loaded and resumed: bit for bit, and refused where they are another's."""

import json
import os
import threading
from dataclasses import replace
from types import SimpleNamespace

import pytest
from helpers import refuses, same
from tiny_runs import assert_resumes, scores, small, stopping, tensors

import voronerf.app.evaluate.scores as scores_module
import voronerf.app.train.trainer as trainer_module
from voronerf import open_run
from voronerf.app.evaluate.scores import evaluate
from voronerf.app.train.checkpoint import (
    CheckpointError,
    checkpoint_path,
    checkpoint_paths,
    load_checkpoint,
    save_checkpoint,
)
from voronerf.app.train.config import ConfigError
from voronerf.app.train.networks import make_routers, restore_routers
from voronerf.app.train.run_directory import held
from voronerf.app.train.trainer import Trainer


@pytest.fixture(scope="module")
def stopped(tmp_path_factory, scene):
    """The settings of a run that was stopped after 14 steps."""
    config = small(tmp_path_factory.mktemp("stopped"))
    stopping(config, scene, 14).run()
    return config


@pytest.mark.parametrize("stop_at", [5, 11, 17])
def test_resume_is_bit_for_bit(tmp_path, scene, stop_at):
    assert_resumes(tmp_path, scene, stop_at, assignment="stochastic")


def test_resume_drops_evaluations_made_after_the_checkpoint(tmp_path, scene):
    config = small(tmp_path)
    stopping(config, scene, 14).run()
    with open(tmp_path / "metrics.jsonl", "a") as file:
        file.write(json.dumps({"step": 20, "psnr": 99.0}) + "\n")
    Trainer(replace(config, resume=True), scene).run()
    assert [step for step, _ in scores(tmp_path)] == [12, 24]


def test_an_evaluation_that_was_stopped_is_made_again(tmp_path, scene, monkeypatch):
    whole, part = (small(tmp_path / name) for name in ("whole", "part"))
    Trainer(whole, scene).run()
    rendered = scores_module.render_view

    def stopping_view(*args, **options):
        if trainer.step == stop_at:
            trainer.request_stop()
        return rendered(*args, **options)

    monkeypatch.setattr(scores_module, "render_view", stopping_view)
    for stop_at, steps, evaluated in ((12, 12, []), (24, 24, [12]), (None, 24, [12, 24])):
        trainer = Trainer(replace(part, resume=stop_at != 12), scene)
        summary = trainer.run()
        assert (summary["steps"], summary["complete"]) == (steps, stop_at is None)
        assert [step for step, _ in scores(part.out)] == evaluated
    assert scores(whole.out) == scores(part.out) and same(tensors(whole.out), tensors(part.out))


def test_longer_resumed_runs_are_evaluated(tmp_path, scene):
    config = small(tmp_path, steps=8, cells=(), evaluations=4)
    Trainer(config, scene).run()
    summary = Trainer(replace(config, steps=16, resume=True), scene).run()
    assert [step for step, _ in scores(tmp_path)] == [2, 4, 6, 8, 12, 16]
    assert scores(tmp_path)[-1][1] == summary["psnr"]


def test_seeds_decide_everything(tmp_path, scene):
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        Trainer(small(tmp_path / name, seed=seed), scene).run()
    a, b, c = (tensors(tmp_path / name) for name in "abc")
    assert same(a, b) and not same(a, c)


def test_a_loaded_run_renders_the_same(tmp_path, scene):
    trainer = Trainer(small(tmp_path, cells=(3, 2)), scene)
    trainer.run()
    run = open_run(tmp_path, scene=scene)
    config = run.config
    assert config == trainer.config
    with trainer.averaged():
        assert evaluate(run.renderer, scene, views=2) == evaluate(trainer.renderer, scene, views=2)
    coarser = open_run(tmp_path, scene=scene, samples=3, backend="reference").renderer
    assert (coarser.sampler.samples, coarser.backend) == (3, "reference")
    # Another configuration, another architecture.
    with pytest.raises(CheckpointError, match=r"a checkpoint of another configuration: --width 8 -> 16; --lr"):
        Trainer(replace(config, width=16, lr=1e-4, resume=True), scene)
    checkpoint = load_checkpoint(checkpoint_path(tmp_path))
    del checkpoint.tensors["router.module.density.weight"]
    refuses("another architecture", restore_routers, make_routers(config, "cpu"), checkpoint, error=CheckpointError)


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
        ("SampleReservoir: state must hold points", without("reservoir.")),
        ("'draws'", without("generator.draws")),
        ("another architecture", without("router.module.density")),
        ("step must be an integer, got 'x'", lambda c: c.values.update(step="x")),
        ("step, times and stages must be counts, got -1", lambda c: c.values.update(step=-1)),
        ("stage 1: cells must be an integer, got 4.5", lambda c: c.values["stages"][1].update(cells=4.5)),
        ("stage 0: split_cells missing", lambda c: c.values["stages"][0].pop("split_cells")),
        ("rays must lie in 64 to 64 by its settings, got 65", lambda c: c.values.update(rays=65)),
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
        Trainer(replace(stopped, out=tmp_path, resume=True), scene)
    assert str(caught.value).startswith(f"{path}: ") and message in str(caught.value)


def test_a_run_goes_on_from_an_older_checkpoint(tmp_path, scene):
    config = small(tmp_path / "part", checkpoint_every=1e-9)
    stopping(config, scene, 14).run()
    (partial := config.out / "checkpoints" / ".1-1.partial").write_bytes(b"of a process that died")
    path = checkpoint_path(config.out)
    path.write_bytes(path.read_bytes()[:-1] + b"\x7f")
    with held(config.out), pytest.warns(UserWarning, match="takes its place"):
        trainer = Trainer(replace(config, resume=True, checkpoint_every=60), scene)
    assert trainer.step in (13, 14) and not partial.exists()
    trainer.run()
    Trainer(small(tmp_path / "whole"), scene).run()
    assert same(tensors(config.out), tensors(tmp_path / "whole"))


@pytest.mark.parametrize("contraction", ["none", "sphere"])
def test_a_run_with_a_grid_resumes_bit_for_bit(tmp_path, scene, monkeypatch, contraction):
    monkeypatch.setattr("voronerf.nerf.cells.REVISIT_EVERY", 2)
    monkeypatch.setattr("voronerf.nerf.cells.SETTLING_STEPS", 5)
    monkeypatch.setattr("voronerf.app.train.rates.FILL", 1.5)  # other numbers of rays in every step
    settings = {"contraction": contraction, "precision": "fp32" if contraction == "none" else "bf16"}
    found = assert_resumes(tmp_path, scene, 15, occupancy=True, occupancy_resolution=8, ray_growth=8, **settings)
    assert len(found["occupancy.density"].unique()) > 1


def test_training_goes_on_while_a_checkpoint_is_written(tmp_path, scene, monkeypatch):
    written, whole = threading.Event(), os.fsync

    def slow(descriptor):
        assert threading.current_thread() is threading.main_thread() or written.wait(600)
        whole(descriptor)

    monkeypatch.setattr(os, "fsync", slow)
    trainer = Trainer(small(tmp_path, checkpoint_every=1e-9), scene)

    def on_step(progress):
        if progress.step == 20:
            assert checkpoint_paths(tmp_path) == []
            written.set()

    trainer.on_step = on_step
    trainer.advance()
    assert load_checkpoint(checkpoint_path(tmp_path)).values["step"] >= 1


def test_a_thread_that_cannot_begin_leaves_no_silence(tmp_path, scene, monkeypatch):
    trainer = Trainer(small(tmp_path, steps=3), scene)
    monkeypatch.setattr(threading.Thread, "run", lambda thread: None)
    with pytest.raises(MemoryError, match="no memory for the thread that writes a checkpoint"):
        trainer.run()


def test_turns_leave_checkpoints(tmp_path, scene, monkeypatch):
    ticks = iter(range(1000))
    monkeypatch.setattr(trainer_module, "time", SimpleNamespace(perf_counter=lambda: 0.01 * next(ticks)))
    trainer = Trainer(small(tmp_path, steps=100_000, checkpoint_every=0.05), scene)
    while trainer.seconds < 0.15:
        assert trainer.seconds >= 0.05 or not checkpoint_path(tmp_path).exists()
        trainer.advance(trainer.seconds + 1e-4)  # a step
    assert checkpoint_path(tmp_path).exists()
