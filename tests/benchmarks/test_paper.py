"""Tests of benchmarks/paper.py: trainings in turns, and the files of tiny experiments."""

import contextlib
import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import turns
from helpers import read_json, refuses
from paper import balance, figures, runs, slices
from paper import main as paper
from paper.experiments import EXPERIMENTS
from paper.report import ABOUT
from PIL import Image

from voronerf.app.scenes import builtin_scene
from voronerf.app.train import ConfigError, TrainConfig
from voronerf.app.train.build import count_parameters, solve_width
from voronerf.app.train.defaults import resolve

TINY = {"scene": ("builtin",), "downscale": 20, "budget": 0.25, "seeds": 1, "rays": 48, "samples": 8}
TINY |= {"evaluations": 2, "eval_views": 1, "final_views": 1, "turn": 0.1, "cells": 4}


@pytest.fixture(autouse=True)
def steady_clock(monkeypatch):
    """Sets a clock on which a step always takes ten milliseconds, so that splits and ends are deterministic."""
    ticks = itertools.count()
    monkeypatch.setitem(turns.CLOCKS, "wall", lambda: 0.0101 * next(ticks))


@pytest.fixture
def settings(tmp_path):
    return runs.Settings(**TINY, out=tmp_path)


class Fake:
    """A fake training with steps of equal length."""

    def __init__(self, name, seconds, step, log=None):
        self.name, self.seconds, self.step, self.log = name, seconds, step, log

    def advance(self, until):
        while self.seconds < until:
            self.seconds += self.step
        if self.log is not None:
            self.log.append((self.name, round(until, 3)))


def test_turns():
    log = []
    fakes = [Fake("a", 0.0, 0.5, log=log), Fake("b", 2.0, 0.5, log=log), Fake("c", 0.0, 2.5, log=log)]
    turns.take_turns(
        fakes,
        budget=3.0,
        turn=1.0,
        stops=lambda fake: (0.5, 2.0) if fake.name == "a" else (),
        on_stop=lambda fake, second: log.append(("look", second, fake.seconds)),
        after_turn=lambda fake: log.append(("after", fake.name)),
    )
    first = [("a", 0.5), ("look", 0.5, 0.5), ("a", 1.0), ("after", "a"), ("c", 1.0), ("after", "c")]
    assert log[:6] == first  # b is ahead and waits
    assert log[6:9] == [("a", 2.0), ("look", 2.0, 2.0), ("a", 2.0)]
    assert log[-5:] == [("after", "a"), ("b", 3.0), ("after", "b"), ("c", 3.0), ("after", "c")]
    assert all(fake.seconds >= 3.0 for fake in fakes)
    refuses("--turn must be positive, got 0", turns.take_turns, fakes, budget=1, turn=0, error=ConfigError)

    # A training that resumes within a turn repeats the whole turn: `on_stop` is also called for the turn's stop at
    # 4.5 s, which the training has already passed.
    looks = []
    stops, on_stop = lambda fake: (3.0, 4.5, 5.0), lambda fake, second: looks.append(second)
    turns.take_turns([Fake("a", 4.7, 0.5)], budget=6.0, turn=2.0, stops=stops, on_stop=on_stop)
    assert looks == [4.5, 5.0]


def test_experiments_write_their_files_and_are_not_run_again(settings, capsys, monkeypatch):
    paper.repeat(settings, ("initialisation", "title"))
    stored = read_json(settings.out / "initialisation.json")
    assert stored["metadata"]["experiment"] == "initialisation" and stored["metadata"]["machine"]
    assert stored["metadata"]["size"] == [20, 20]
    assert [row["variant"] for row in stored["results"]] == ["inherited", "random parameters"]
    for row in stored["results"]:
        assert row["cells"] == 4 and row["seconds"] >= 0.25 and row["psnr"] == row["curve"][-1]["psnr"]
        assert row["looks"][0]["look"] == "before" and row["looks"][-1]["look"] == "end"
        assert [e["num_cells"] for e in row["looks"] if e["look"] in ("before", "after", "end")] == [1, 4, 4]
        assert row["looks"][-1]["psnr"] > 0
    page = (settings.out / "report.md").read_text()
    assert "| builtin | inherited |" in page and f"{stored['results'][0]['psnr']:.2f}" in page
    assert "![title-pictures](title-pictures.png)" in page
    with Image.open(settings.out / "initialisation.png") as picture:
        assert picture.width > 400 and len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 10

    # The first variant of the experiment stores the samples for the balance experiment.
    trained = [run for run in EXPERIMENTS["initialisation"].runs(settings) if run.variant.name == "inherited"]
    rows = balance.measure(trained, "auto", diagrams=3)
    assert [row["variant"] for row in rows] == ["kept by a training, builtin", "separate objects"]
    for row in rows:
        assert len(row["after_all"]) == 3 and row["after"] == sorted(row["after_all"])[1] < row["before"]

    def refuse(*_, **__):
        raise AssertionError("must not be trained again")

    monkeypatch.setattr(runs, "Training", refuse)
    paper.repeat(settings, ("initialisation", "density", "ghosting"))  # these experiments reuse the trainings
    assert read_json(settings.out / "initialisation.json")["results"] == stored["results"]
    assert read_json(settings.out / "ghosting.json")["results"] == stored["results"]
    assert (settings.out / "density-pictures.png").is_file()
    refuses("trained again", paper.repeat, replace(settings, budget=0.3), ("density",), error=AssertionError)
    refuses("experiments are convergence, ", paper.repeat, settings, ("nothing",), error=ConfigError)


def test_defaults_at_size(settings):
    run = EXPERIMENTS["at-size"].runs(settings)[0]
    changed = {"data", "out", "budget", "downscale", "evaluations", "eval_views", "backend"}
    given, default = run.config.to_values(), TrainConfig().to_values()
    assert {name for name in given if given[name] != default[name]} <= changed
    assert EXPERIMENTS["at-size"].published(run.variant.name, "ship").psnr == 29.007


def one(settings, seed=0, scene="builtin", **changes):
    """Creates the training of one network."""
    return runs.make_run(runs.Variant("one", {"cells": (), **changes}), scene, seed, settings)


def test_an_interrupted_training_goes_on(settings, monkeypatch):
    training, save, saved = one(settings), turns.Training.save, []

    def write(self):
        save(self)
        saved.append(self.state.step)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched, contextlib.suppress(KeyboardInterrupt):
        patched.setattr(turns.Training, "save", write)
        runs.train_missing([training], settings)
    assert not training.result.exists() and not runs.results([training])
    began, advance = [], turns.Training.advance

    def note(self, *until):
        began.append(self.state.step)
        advance(self, *until)

    monkeypatch.setattr(turns.Training, "advance", note)
    runs.train_missing([training, training], settings)
    assert began[0] == saved[0] > 0
    (row,) = runs.results([training])
    assert row["seconds"] >= settings.budget and row["steps"] > saved[0]


def test_a_curve_is_of_the_same_views_throughout(settings):
    settings = replace(settings, final_views=3)
    training = one(settings, width=8)
    runs.train_missing([training], settings)
    (row,) = runs.results([training])
    assert row["views"] == 3 and [entry["views"] for entry in row["curve"]] == [1, 1]
    assert row["psnr"] != row["curve"][-1]["psnr"] and row["curve"][-1]["seconds"] >= settings.budget


def test_failures_of_a_training_are_told(settings):
    variant = runs.Variant("too many", {"cells": (5000,), "split_at": (2,)})
    failing, other, said = runs.make_run(variant, "builtin", 0, settings), one(settings), []
    runs.train_missing([other, failing], settings, said.append)
    assert any("too many" in line and "failed: 5000 cells need at least 5000 samples" in line for line in said)
    (row,) = runs.results([other, failing])
    assert row["variant"] == "one" and row["seconds"] >= settings.budget
    assert runs.failure(failing).startswith("too many on builtin, seed 0: 5000 cells need at least 5000 samples")
    runs.train_missing([other, failing], settings, said.append)
    assert said[-1].startswith("2 trainings, 2 of them finished")


def test_runs_are_known_by_what_they_learn(settings):
    same = runs.make_run(runs.Variant("another name", {"cells": ()}), "builtin", 0, replace(settings, turn=3.0))
    others = [one(replace(settings, **change)) for change in ({"budget": 1.0}, {"samples": 9}, {"final_views": 2})]
    others += [one(settings, 1), one(settings, scene="builtin-city"), one(settings, width=8)]
    folders = {str(run.folder) for run in (one(settings), *others)}
    assert same.folder == one(settings).folder and len(folders) == 1 + len(others)


def test_sizes_and_scenes(tmp_path, monkeypatch):
    assert [runs.factor("builtin", runs.Settings(downscale=n)) for n in (1, 4, 8, 20)] == [1, 1, 2, 5]
    assert runs.factor("lego", runs.Settings(downscale=8)) == 8
    monkeypatch.setenv("VORONERF_DATA", str(tmp_path))
    assert runs.default_scenes(2) == ("builtin",)
    (tmp_path / "ship").mkdir()
    assert runs.default_scenes(2) == ("ship",) and runs.scene_source("ship") == str(tmp_path / "ship")
    with pytest.raises(ConfigError, match=r"--scene must be a folder, a name in .* got 'nowhere'"):
        runs.scene_source("nowhere")
    for wrong in ({"seeds": 0}, {"budget": 0.0}, {"samples": 1}, {"cells": 1}, {"turn": -1.0}):
        with pytest.raises(ConfigError, match=f"--{next(iter(wrong))} must be"):
            runs.Settings(**wrong)


def test_both_sides_have_the_same_settings(settings):
    """Checks that variants differ only in the compared settings, not in rays, samples, learning rate or schedule."""
    compared = {"cells", "width", "parameters", "centres", "init"}
    compared |= {"assignment", "split_at"}
    for name, experiment in EXPERIMENTS.items():
        groups = {}
        for variant in experiment.variants(settings, "builtin"):
            rest = {k: v for k, v in variant.changes.items() if k not in compared}
            label = variant.name.split(":")[0] if ":" in variant.name else ""
            groups.setdefault(label, set()).add(json.dumps(rest, sort_keys=True))
            assert "lr" not in variant.changes
        assert all(len(group) == 1 for group in groups.values()), name


def test_matched_parameters(settings):
    variants = {v.name: v.changes for v in EXPERIMENTS["cell-count"].variants(settings, "builtin")}
    assert variants["4 x 4 cells"] == {"cells": (4, 4)} and variants["one network"] == {"cells": ()}
    assert variants["12 cells, matched"] == variants["12 cells"]
    scene, counts = runs.open_scene("builtin", settings), {}
    for name in ("12 cells", "4 cells, matched", "32 cells, matched", "one network, matched"):
        run = runs.make_run(runs.Variant(name, variants[name]), "builtin", 0, settings)
        config = resolve(run.config, scene)
        options = {} if config.parameters is None else {"width": solve_width(config, config.parameters)}
        counts[name] = count_parameters(config, **options)
    assert all(0.9 * counts["12 cells"] < count <= counts["12 cells"] for count in counts.values())


def test_a_slice_through_a_known_density():
    class Field(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.thickness = torch.nn.Parameter(torch.tensor([20.0, 60.0]))

        def forward(self, positions, directions, ray_index):
            return positions[:, :3], torch.where(positions[:, 0] < 0, *self.thickness)

    field, points = Field().train(), slices.slice_points(builtin_scene(4), size=31)
    assert points.shape == (31, 31, 3) and (points[..., 2] - points[0, 0, 2]).abs().max() == 0
    assert points[0, 0, 0] < points[0, 1, 0] and points[0, 0, 1] > points[1, 0, 1]
    for cones in (False, True):
        density = slices.slice_density(field, points, cones=cones)
        assert field.training and torch.equal(density, torch.where(points[..., 0] < 0, 20.0, 60.0))
    picture = slices.picture_of_density(torch.tensor([[0.0, 1.0, 10.0], [100.0, 1e6, math.nan]]))
    light = picture.float().sum(-1).flatten().tolist()
    assert picture.dtype == torch.uint8 and light[0] == light[5] < 10
    assert light[0] < light[1] < light[2] < light[3] == light[4]


def test_every_experiment_has_a_plot_or_a_sheet():
    assert figures.PLOTS.keys() | figures.SHEETS.keys() == ABOUT.keys()
    figure, axes = figures.panes(1)
    line = figures.banded(axes[0], "x", [[(0, 1.0), (2, 3.0)], [(1, 4.0), (2, 5.0)]])
    x, y = line.get_data()
    assert (x[0], x[-1]) == (1, 2) and y[0] == pytest.approx(3.0) and y[-1] == pytest.approx(4.0)
    (band,) = axes[0].collections
    assert band.get_paths()[0].vertices[:, 1].min() == 2.0 and band.get_paths()[0].vertices[:, 1].max() == 5.0
    figures.pyplot.close(figure)
