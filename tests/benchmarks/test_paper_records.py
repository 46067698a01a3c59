"""benchmarks/paper.py in parts: what is trained now, what a file of results keeps, what a table says is missing."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from helpers import read_json, refuses
from paper import balance, claims, records, runs
from paper import main as paper
from paper.experiments import EXPERIMENTS
from paper_results import TINY, as_options

from voronerf.training.config import ConfigError

#: Came after benchmarks/results/paper_16s.json was made.
LATER = "uniform centres, twice the box"


@pytest.fixture
def settings(tmp_path):
    return runs.Settings(**TINY | {"seeds": 2}, out=tmp_path / "out")


def finish(run, psnr, **more):
    """A result as an older version wrote it, with a configuration and without machine and looks."""
    run.folder.mkdir(parents=True, exist_ok=True)
    curve = [{"seconds": t, "psnr": psnr * t / 10} for t in (5.0, 10.0)]
    row = {"psnr": psnr, "ssim": 0.5, "lpips": None, "size": [20, 20], "curve": curve, "stages": [], **more}
    (run.folder / "result.json").write_text(json.dumps(row))
    (run.folder / "config.json").write_text(run.config.to_json())


def elsewhere():
    return {**records.made_on(), "machine": "another"}


@pytest.fixture
def trained(monkeypatch):
    """Groups that were trained; nothing is: they have results at once."""
    groups = []

    def train_group(group, scene, settings, say):
        groups.append([f"{run.variant.name}, {run.seed}" for run in group])
        for run in group:
            finish(run, 20.0 + run.seed + 2 * (run.variant.name == "inherited"))

    monkeypatch.setattr(runs, "train_group", train_group)
    return groups


def test_names_of_runs_stay(tmp_path, monkeypatch):
    """Results that were kept are found by these names: a setting added to the configuration must not change them."""
    (tmp_path / "lego").mkdir()
    monkeypatch.setenv("VORONERF_DATA", str(tmp_path))
    size = {"scene": ("lego",), "evaluations": 8, "eval_views": 3, "final_views": 25}
    for budget in (480, 480.0):
        made = EXPERIMENTS["sampling"].runs(runs.Settings(**size, budget=budget))
        names = {run.variant.name: run.folder.name for run in made if run.seed == 0}
        assert names["NeRF, stratified: one network, width 256"] == "lego-0-0e0d08c58b73"
        assert names["NeRF, stratified: one network, width 64"] == "lego-0-e591eb1cb98a"
        assert names["NeRF, stratified: 12 Voronoi cells, width 64"] == "lego-0-5173d9c5022a"
    small = {"downscale": 8, "budget": 16, "rays": 512, "samples": 48}
    small = runs.Settings(scene=("lego",), **small, evaluations=6, eval_views=4, final_views=10)
    committed = Path(__file__).resolve().parents[2] / "benchmarks" / "results" / "paper_16s.json"
    for name in ("sampling", "kilonerf", "seams", "early-late", "split-kinds", "initialisation"):
        made = {run.folder.name for run in EXPERIMENTS[name].runs(small) if run.variant.name != LATER}
        assert made <= records.read_record(committed).keys(), name


def test_a_table_is_made_in_parts(settings, tmp_path, trained, capsys):
    record = tmp_path / "record.json"
    kept = replace(settings, record=record)

    outcome = paper.experiment("initialisation", replace(kept, train=False))
    assert trained == [] and outcome["results"] == [] and outcome["claims"][0]["verdict"] == "not measured"
    names = "inherited", "random parameters"
    assert outcome["metadata"]["missing"] == [f"{name} on builtin, seeds 0, 1" for name in names]

    outcome = paper.experiment("initialisation", replace(kept, variants="^inher", only_seeds=(0,)))
    assert trained == [["inherited, 0"]] and len(outcome["results"]) == 1
    outcome = paper.experiment("initialisation", replace(kept, only_seeds=(0,)))
    assert trained[1:] == [["random parameters, 0"]]
    (claim,) = outcome["claims"]
    assert claim["verdict"] == "holds (one seed)" and claim["here"] == "+2.00 dB"
    assert outcome["metadata"]["seeds"] == 1
    text = (settings.out / "initialisation.md").read_text()
    assert "; one seed; " in text
    assert "Missing: inherited on builtin, seed 1; random parameters on builtin, seed 1." in text
    page = tmp_path / "paper.md"
    paper.report(settings.out, page)
    assert "Missing: inherited on builtin, seed 1; random" in page.read_text()

    # another sitting, on a machine that has the file only
    there = replace(kept, out=tmp_path / "there")
    rows = paper.experiment("initialisation", replace(there, train=False))["results"]
    assert [row.pop("made_on") for row in rows] == [records.made_on()] * 2
    assert rows == outcome["results"]
    assert "2 results taken from" in capsys.readouterr().out
    finished = paper.experiment("initialisation", there)
    assert trained[2:] == [["inherited, 1", "random parameters, 1"]]
    assert finished["claims"][0]["verdict"] == "holds for every seed" and finished["metadata"]["missing"] == []
    assert finished["metadata"]["seeds"] == 2
    assert "Missing" not in (there.out / "initialisation.md").read_text()
    assert len(records.read_record(record)) == 4

    place = ["--record", str(record), "--out", str(tmp_path / "third")]
    size = {name: value for name, value in (TINY | {"seeds": 2}).items() if name != "turn"}
    paper.main(["figure", "initialisation", *as_options(size), "--no-train", *place])
    assert len(read_json(tmp_path / "third" / "initialisation.json")["results"]) == 4

    # what is made again is not found in the file meanwhile
    with pytest.MonkeyPatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(runs, "train_group", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        paper.experiment("initialisation", replace(there, again=True, variants="inherited"))
    names = {row["run"] for row in finished["results"] if row["variant"] == "random parameters"}
    assert records.read_record(record).keys() == names


def test_what_is_asked_for_now_is_checked():
    settings = runs.Settings
    refuses("--variants must be a regular expression, got '(':", settings, variants="(", error=ConfigError)
    refuses("--only-seeds must be below --seeds 2, got (2,)", settings, seeds=2, only_seeds=(2,), error=ConfigError)


def test_options_are_those_of_all_variants(settings):
    cones = EXPERIMENTS["split-kinds"].runs(replace(settings, options=("field=mipnerf", "sampling=hierarchical")))
    assert all((run.config.field, run.config.sampling) == ("mipnerf", "hierarchical") for run in cones)
    given = replace(settings, options=("lr_split=0.5", "split_at=[0.3]", "balance=transport"))
    plain, made = (EXPERIMENTS["split-kinds"].runs(s) for s in (settings, given))
    for before, run in zip(plain, made, strict=True):
        assert (run.config.lr_split, run.config.split_at, run.config.balance) == (0.5, (0.3,), "transport")
        assert run.config.cells == before.config.cells and run.folder != before.folder
    assert paper.experiment("split-kinds", replace(given, train=False))["metadata"]["options"] == list(given.options)
    assert "; lr_split=0.5; split_at=[0.3]; balance=transport; " in (settings.out / "split-kinds.md").read_text()
    names = {"early-late": "split_at", "limits": "cells, split_at", "sampling": "field", "cell-count": "cells"}
    for name, compared in names.items():
        wrong = tuple(f"{option}={'kilonerf' if option == 'field' else '[3]'}" for option in compared.split(", "))
        with pytest.raises(ConfigError, match=f"--options must not name what the experiment compares, got {compared}"):
            EXPERIMENTS[name].runs(replace(settings, options=wrong))
    unknown = "must name settings of `voronerf train` that have no option here, got"
    for wrong, message in (
        ("lr", "--options must be NAME=VALUE, got 'lr'"),
        ("lr=0.1", f"--options {unknown} lr"),
        ("colour=3", f"--options {unknown} colour"),
        ("lr_split=much", "--options must have values that their settings take, got"),
        ("lr_split=-1", "--lr-split must be a positive factor, got -1"),
        ("init=inherited", "--init must be inherit or random, got 'inherited'"),
    ):
        with pytest.raises(ConfigError, match=message):
            EXPERIMENTS["split-kinds"].runs(replace(settings, options=(wrong,)))


def test_widths_that_names_tell_are_widths_trained(settings):
    small = replace(settings, options=("field=kilonerf",))
    for run in EXPERIMENTS["convergence"].runs(small):
        assert run.config.field == "kilonerf" and run.variant.name.endswith(f"width {run.config.width}")
    assert {run.config.width for run in EXPERIMENTS["split-kinds"].runs(small)} == {32}


def test_blended_scores_are_other_results(settings):
    experiment = EXPERIMENTS["initialisation"]
    plain, none, blended = (
        [run.folder for run in experiment.runs(replace(settings, options=options))]
        for options in ((), ("blend=0.0",), ("blend=0.1",))
    )
    assert plain == none and not set(plain) & set(blended)


def test_a_record_holds_results_and_nothing_of_the_machine_s_folders(settings, tmp_path, capsys):
    made = EXPERIMENTS["initialisation"].runs(settings)
    refuses("--out must hold finished trainings in runs/, got", paper.export, tmp_path / "none.json", settings.out)
    finish(made[0], 20.0)
    finish(made[2], 19.0, made_on=elsewhere(), looks=[{"look": "end", "at": 1.0, "seam": 3.0}])
    made[1].folder.mkdir(parents=True)  # not finished
    record = tmp_path / "results" / "record.json"
    paper.main(["export", str(record), "--out", str(settings.out)])
    assert "2 trainings, 2 of them new" in capsys.readouterr().out
    text = record.read_text()
    assert str(tmp_path) not in text and str(Path.cwd()) not in text
    found = records.read_record(record)
    assert found.keys() == {made[0].folder.name, made[2].folder.name}
    mine, other = found[made[0].folder.name], found[made[2].folder.name]
    assert mine["made_on"] == records.made_on() and other["made_on"]["machine"] == "another"
    assert mine["config"]["cells"] == [4] and mine["config"]["budget"] == 0.25 and "out" not in mine["config"]
    assert other["config"]["init"] == "random" and other["looks"] == [{"look": "end", "at": 1.0, "seam": 3.0}]
    assert len(json.loads(text)["metadata"]["machines"]) == 2

    # what comes back is what was there, and a result of the folder is not overwritten by the file's
    back = [replace(run, config=replace(run.config, out=tmp_path / "back" / run.folder.name)) for run in made]
    finish(back[0], 30.0)
    assert records.restore([run.folder for run in back], record) == 1
    assert json.loads(back[2].result.read_text()) == other and records.read_result(back[0].folder)["psnr"] == 30.0
    assert records.keep([run.folder for run in back], record) == (0, 2)
    assert records.read_record(record)[made[0].folder.name]["psnr"] == 30.0

    for wrong in ("{", "[]", '{"metadata": {"benchmark": "balance"}, "results": {}}', '{"results": {}}'):
        record.write_text(wrong)
        with pytest.raises(ConfigError, match=r"--record must be a file of results written by paper\.py, got"):
            records.read_record(record)


def test_seconds_of_different_machines_are_not_compared(settings):
    experiment = EXPERIMENTS["initialisation"]
    rows_of, here = claims.Rows, records.made_on()
    made = experiment.runs(settings)
    for run in made:
        where = elsewhere() if (run.variant.name, run.seed) == ("inherited", 1) else here
        finish(run, 20.0, made_on=where, looks=[{"look": "end", "at": 1.0, "seam": 2.0 + run.seed, "psnr": 20.0}])
    rows = rows_of(runs.results(made))
    assert rows.paired("inherited", "random parameters") == {("builtin", 0): 0.0}
    seams = claims.fewer_seams(rows, "builtin", "inherited", "random parameters", ("end",))
    assert seams == [0.0]
    finish(made[1], 25.0)  # from before results said where they were made: taken as they are
    assert rows_of(runs.results(made)).gains("inherited", "random parameters") == [0.0, 5.0]
    name = records.machine_name
    assert name({**here, "threads": 2, "machine": "x", "processor": None}) == "2 threads; x"


def test_rates_count_when_all_were_searched(settings):
    searched = replace(settings, rates=(1.0, 2.0), only_seeds=(0,))
    made = EXPERIMENTS["initialisation"].runs(searched)

    def found():
        return [(row["variant"], row["seed"], row["rate"]) for row in runs.results(made)]

    for run in made:
        if run.rate == 1.0 and run.seed == 0:
            finish(run, 20.0)
    usual = [("inherited", 0, 1.0), ("random parameters", 0, 1.0)]
    assert found() == usual
    doubled = [run for run in made if run.rate == 2.0 and run.seed == 0]
    finish(doubled[0], 25.0)
    assert found() == usual  # the other one has not had its chance
    finish(doubled[1], 19.0)
    assert found() == [("inherited", 0, 2.0), ("random parameters", 0, 1.0)]
    assert runs.still_missing(made)[0] == "inherited on builtin, seed 1"
    assert "random parameters on builtin, rate x 2, seed 1" in runs.still_missing(made)


def test_balance_says_which_samples_it_has_not(settings, tmp_path):
    assert balance.without_samples(settings) == ["samples of builtin, seed 0", "samples of builtin, seed 1"]
    path = balance.samples_path(balance.runs(settings)[0])
    path.parent.mkdir(parents=True)
    path.touch()
    assert balance.without_samples(settings) == ["samples of builtin, seed 1"]
