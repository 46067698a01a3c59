"""benchmarks/paper.py: trainings, and the files of tiny experiments."""

import contextlib
import json
from dataclasses import replace

import numpy as np
import pytest
import turns
from helpers import read_json, refuses
from paper import claims, looks, runs
from paper import main as paper
from paper.experiments import EXPERIMENTS
from PIL import Image

from voronerf.training import networks
from voronerf.training.config import ConfigError
from voronerf.training.trainer import Trainer, TrainingError

pytestmark = pytest.mark.usefixtures("steady_clock")


def test_turns():
    class Fake:
        def __init__(self, name, seconds, step):
            self.name, self.seconds, self.step = name, seconds, step

        def advance(self, until):
            while self.seconds < until:
                self.seconds += self.step
            log.append((self.name, round(until, 3)))

    log = []
    fakes = [Fake("a", 0.0, 0.5), Fake("b", 2.0, 0.5), Fake("c", 0.0, 2.5)]
    turns.take_turns(
        fakes,
        budget=3.0,
        turn=1.0,
        stops=lambda fake: (0.5, 2.0) if fake.name == "a" else (),
        on_stop=lambda fake, second: log.append(("look", second, fake.seconds)),
        after_turn=lambda fake: log.append(("after", fake.name)),
    )
    first = [("a", 0.5), ("look", 0.5, 0.5), ("a", 1.0), ("after", "a"), ("c", 1.0), ("after", "c")]
    assert log[:6] == first  # b has come further and waits
    assert log[6:9] == [("a", 2.0), ("look", 2.0, 2.0), ("a", 2.0)]
    assert log[-5:] == [("after", "a"), ("b", 3.0), ("after", "b"), ("c", 3.0), ("after", "c")]
    assert all(fake.seconds >= 3.0 for fake in fakes)
    refuses("--turn must be positive, got 0", turns.take_turns, fakes, budget=1, turn=0, error=ConfigError)

    # resumed in the midst of a turn, after a stop that a long step had passed: it is due all the same
    log.clear()
    turns.take_turns(
        [Fake("a", 4.7, 0.5)],
        budget=6.0,
        turn=2.0,
        stops=lambda fake: (3.0, 4.5, 5.0),
        on_stop=lambda fake, second: log.append(("look", second)),
    )
    assert [entry for entry in log if entry[0] == "look"] == [("look", 4.5), ("look", 5.0)]


@pytest.mark.parametrize("told", [False, True])
def test_one_that_fails_leaves_the_turns(told):
    class Fake:
        def __init__(self, limit):
            self.seconds, self.limit = 0.0, limit

        def advance(self, until):
            if until > self.limit:
                raise TrainingError("the loss is nan")
            self.seconds = until

    failing, other = Fake(1.0), Fake(9.0)
    failed = []
    both = [failing, other]
    if told:
        turns.take_turns(both, budget=3, turn=1, on_failure=lambda fake, error: failed.append((fake, str(error))))
        assert failed == [(failing, "the loss is nan")] and other.seconds == 3
    else:
        with pytest.raises(TrainingError):
            turns.take_turns(both, budget=3, turn=1)
    assert both == [failing, other] and failing.seconds == 1


def test_an_experiment_writes_its_files_and_is_not_run_again(settings, out, monkeypatch):
    outcome = paper.experiment("initialisation", settings)
    stored = read_json(out / "initialisation.json")
    assert stored == json.loads(json.dumps(outcome)) and stored["metadata"]["experiment"] == "initialisation"
    assert stored["metadata"]["size"] == [20, 20] and stored["metadata"]["machine"]
    assert [row["variant"] for row in stored["results"]] == ["inherited", "random parameters"]
    for row in stored["results"]:
        assert row["cells"] == 4 and row["seconds"] >= 0.25 and row["psnr"] == row["curve"][-1]["psnr"]
        assert row["looks"][0]["look"] == "before" and row["looks"][-1]["look"] == "end"
        assert [e["num_cells"] for e in row["looks"] if e["look"] in ("before", "after", "end")] == [1, 4, 4]
        assert row["looks"][-1]["psnr"] > 0 and (out / "runs" / row["run"] / "samples" / "level-1.npz").is_file()
    table = (out / "initialisation.md").read_text()
    assert "| builtin | inherited |" in table and "holds?" in table and "published" in table
    assert f"{stored['results'][0]['psnr']:.2f}" in table and stored["claims"][0]["verdict"] in table
    with Image.open(out / "initialisation.png") as picture:
        assert picture.width > 400 and len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 10

    def refuse(*_, **__):
        raise AssertionError("must not be trained again")

    monkeypatch.setattr(runs, "Trainer", refuse)
    assert paper.experiment("initialisation", settings)["results"] == outcome["results"]
    for name in ("density", "ghosting"):  # the same trainings
        same = zip(paper.experiment(name, settings)["results"], outcome["results"], strict=True)
        assert all(row["run"] == other["run"] for row, other in same)
        assert (out / f"{name}-pictures.png").is_file()
    for other in (replace(settings, again=True), replace(settings, budget=0.3), replace(settings, seeds=2)):
        refuses("trained again", paper.experiment, "initialisation", other, error=AssertionError)


def one(settings, seed=0, **changes):
    """The training of one network."""
    return runs.make_run(runs.Variant("one", {"cells": (), **changes}), "builtin", seed, settings)


@pytest.fixture
def interrupted(monkeypatch):
    """Within it a training ends with its first checkpoint; the steps at which one was written."""
    save, saved = Trainer.save, []

    def write(self):
        save(self)
        saved.append(self.step)
        raise KeyboardInterrupt

    @contextlib.contextmanager
    def ending():
        with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
            patched.setattr(Trainer, "save", write)
            yield saved

    return ending


def test_an_interrupted_training_goes_on(settings, tmp_path, interrupted, monkeypatch):
    settings = replace(settings, out=tmp_path)
    run = one(settings)
    with interrupted() as saved:
        runs.train_missing([run], settings)
    assert not (run.folder / "result.json").exists() and not runs.results([run])
    began, advance = [], Trainer.advance
    monkeypatch.setattr(Trainer, "advance", lambda self, *args: (began.append(self.step), advance(self, *args))[1])
    runs.train_missing([run, run], settings)
    assert began[0] == saved[0] > 0
    (row,) = runs.results([run])
    assert row["seconds"] >= settings.budget and row["steps"] > saved[0]


def test_again_leaves_no_old_result_and_goes_on(settings, tmp_path, interrupted, monkeypatch):
    settings = replace(settings, out=tmp_path, seeds=2)
    made = [one(settings, seed, width=8) for seed in range(2)]
    runs.train_missing(made, settings)
    assert len(runs.results(made)) == 2
    with interrupted():
        runs.train_missing(made, replace(settings, again=True))
    assert runs.results(made) == [] and not list((made[1].folder / "looks").glob("*.npz"))
    resumed, start = [], Trainer.__init__

    def begin(self, config, *args, **options):
        resumed.append(config.resume)
        start(self, config, *args, **options)

    monkeypatch.setattr(Trainer, "__init__", begin)
    runs.train_missing(made, settings)
    assert resumed == [True, False] and len(runs.results(made)) == 2


def test_looks_of_steps_that_are_made_again_are_not_kept(settings, tmp_path, monkeypatch):
    settings = replace(settings, out=tmp_path)
    made = one(settings, width=8)
    scene = runs.open_scene("builtin", settings)
    first = Trainer(made.config, scene)
    first.advance(0.07)
    looks.look(first, 0.0625, "at-25")
    first.save()
    first.advance(0.2)
    looks.look(first, 0.125, "at-50")
    lost, stale = first.step, (made.folder / "looks" / "at-50.npz").read_bytes()
    second = Trainer(replace(made.config, resume=True), scene)
    looks.forget_later(second)
    assert [entry["look"] for entry in looks.numbers(made.folder)] == ["at-25"] and second.step < lost
    assert looks.missed(second) == ["at-50", "at-75"]
    monkeypatch.setattr(looks, "seam", lambda *_, **__: 0.25)
    assert looks.seams(second) == {"seam": 0.25}
    monkeypatch.setattr(looks, "seam", lambda *_, **__: float("nan"))  # no border is visible
    assert looks.seams(second) == {}
    said = []
    (made.folder / "looks" / "at-25.npz").unlink()  # its time is passed for good where turns are shorter than it
    (made.folder / "looks" / "at-50.npz").write_bytes(stale)
    runs.train_group([made], scene, replace(settings, turn=0.01), said.append)
    found = {entry["look"]: entry["step"] for entry in looks.numbers(made.folder)}
    assert list(found) == ["at-50", "at-75", "end"] and found["at-50"] < lost
    assert any("no look 'at-25': its time had passed" in line for line in said)
    assert sum(line.startswith("LPIPS is not computed, images of 20 x 20 are below") for line in said) == 1


def test_a_curve_is_of_the_same_views_throughout(settings, tmp_path):
    settings = replace(settings, out=tmp_path, final_views=3)
    made = one(settings, width=8)
    runs.train_missing([made], settings)
    (row,) = runs.results([made])
    assert row["views"] == 3 and [entry["views"] for entry in row["curve"]] == [1, 1]
    assert row["psnr"] != row["curve"][-1]["psnr"] and row["curve"][-1]["seconds"] >= settings.budget


def test_failures_of_a_training_are_told(settings, tmp_path):
    variant = runs.Variant("too many", {"cells": (5000,), "split_at_steps": (2,)})
    small = replace(settings, out=tmp_path)
    failing = runs.make_run(variant, "builtin", 0, small)
    other = one(small)
    said = []
    runs.train_missing([other, failing], small, said.append)
    assert any("too many" in line and "failed: more cells than samples" in line for line in said)
    (row,) = runs.results([other, failing])
    assert row["variant"] == "one" and row["seconds"] >= small.budget
    stored = read_json(failing.folder / "result.json")
    assert stored["psnr"] is None and stored["failed"].startswith("more cells than samples")
    assert runs.failures([failing, other, failing]) == [f"too many on builtin, seed 0: {stored['failed']}"]
    runs.train_missing([other, failing], small, said.append)
    assert said[-1].startswith("2 trainings, 2 of them made already")


def test_runs_are_known_by_what_they_learn(settings):
    one = runs.Variant("one", {"cells": ()})

    def folder(variant=one, scene="builtin", seed=0, **changes):
        return str(runs.make_run(variant, scene, seed, replace(settings, **changes)).folder)

    assert folder() == folder(runs.Variant("another name", {"cells": ()})) == folder(turn=3.0)
    others = [folder(seed=1), folder(budget=1.0), folder(samples=9), folder(downscale=40), folder(final_views=2)]
    others += [folder(scene="builtin-translucent"), folder(runs.Variant("one", {"cells": (), "width": 8}))]
    assert len({folder(), *others}) == 1 + len(others)


def test_every_variant_has_the_best_of_the_same_rates(settings, tmp_path):
    searched = replace(settings, rates=(1.0, 2.0), seeds=2, out=tmp_path)
    made = EXPERIMENTS["initialisation"].runs(searched)
    assert len(made) == 2 * 2 * 2 and len({run.folder for run in made}) == 8
    usual, doubled = (next(run.config for run in made if run.rate == rate) for rate in searched.rates)
    assert usual.lr is not None and doubled.lr == 2 * usual.lr
    scores = {("inherited", 1.0): 20.0, ("inherited", 2.0): 21.0}
    for run in made:
        run.folder.mkdir(parents=True)
        score = scores.get((run.variant.name, run.rate), 19.0 - run.rate) + run.seed
        (run.folder / "result.json").write_text(json.dumps({"psnr": score}))
    rows = runs.results(made)
    expected = [("inherited", seed, 2.0, 21.0 + seed) for seed in (0, 1)]
    expected += [("random parameters", seed, 1.0, 18.0 + seed) for seed in (0, 1)]
    assert [(row["variant"], row["seed"], row["rate"], row["psnr"]) for row in rows] == expected
    assert rows[0]["rates"] == {"1": 20.5, "2": 21.5}

    judge = EXPERIMENTS["initialisation"].claims

    def fail(rate):
        (run,) = (r for r in made if (r.variant.name, r.rate, r.seed) == ("inherited", rate, 1))
        (run.folder / "result.json").write_text(json.dumps({"failed": "the loss is nan", "psnr": None}))
        return [(row["variant"], row["rate"]) for row in runs.results(made)]

    rest = [("random parameters", 1.0)] * 2
    assert fail(2.0) == [("inherited", 1.0)] * 2 + rest  # a rate at which a seed failed is none to choose
    assert runs.failures(made) == ["inherited on builtin, seed 1, rate x 2: the loss is nan"]
    assert judge(claims.Rows(runs.results(made)), searched)[0].verdict == "holds for every seed"
    assert fail(1.0) == rest
    assert judge(claims.Rows(runs.results(made)), searched)[0].verdict == "not measured"
    refuses("--rates must be positive factors, got", runs.Settings, rates=(0.0,), error=ConfigError)


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
    """Variants differ in what is compared: no side has rays, samples, a rate or a schedule of its own."""
    compared = {"cells", "width", "parameters", "centres", "init"}
    compared |= {"assignment", "split_at", "split_at_steps", "uniform_scale"}
    for name, experiment in EXPERIMENTS.items():
        groups = {}
        for variant in experiment.variants(settings, "builtin"):
            rest = {k: v for k, v in variant.changes.items() if k not in compared}
            label = variant.name.split(":")[0] if ":" in variant.name else ""
            groups.setdefault(label, set()).add(json.dumps(rest, sort_keys=True))
            assert "lr" not in variant.changes
        assert all(len(group) == 1 for group in groups.values()), name


def test_matched_parameters(settings):
    experiment = EXPERIMENTS["cell-count"]
    variants = {v.name: v.changes for v in experiment.variants(replace(settings, large=True), "builtin")}
    assert variants["4 x 4 cells"] == {"cells": (4, 4)} and "16 x 16 cells" in variants
    assert len({v["parameters"] for v in variants.values() if "parameters" in v}) == 1
    assert variants["12 cells, matched"] == variants["12 cells"]
    scene = runs.open_scene("builtin", settings)
    counts = {}
    for name in ("12 cells", "12 cells, matched", "4 cells, matched", "32 cells, matched", "one network, matched"):
        variant = runs.Variant(name, variants[name])
        counts[name] = networks.count_parameters(
            networks.resolve_config(runs.make_run(variant, "builtin", 0, settings).config, scene)
        )
    total = counts["12 cells"]
    assert counts["12 cells, matched"] == total and all(0.9 * total < count <= total for count in counts.values())
    assert variants["one network"] == {"cells": ()}
    cones = {v.name: v.changes for v in experiment.variants(replace(settings, options=("field=mipnerf",)), "builtin")}
    assert cones["4 cells, matched"]["parameters"] > variants["4 cells, matched"]["parameters"]
