"""benchmarks/paper.py: plots, the fit of a picture, the page and the command line."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import read_json, refuses, script
from paper import balance, figures, nested, report
from paper import main as paper
from paper.experiments import EXPERIMENTS
from paper.runs import data_folder
from paper_results import TINY, as_options, synthetic
from PIL import Image

from voronerf.training.config import ConfigError

pytestmark = pytest.mark.usefixtures("steady_clock")

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks" / "results"
SMALL = "--budget 16 --downscale 8 --rays 512 --samples 48 --evaluations 6 --eval-views 4 --final-views 10"
LONG = "--scene lego ship --evaluations 8 --eval-views 3 --final-views 25"
#: The committed pages: the record of each, how large its trainings are, what it does not show.
COMMITTED = {
    "paper": ("paper_16s", SMALL, {"balance", "nested-2d"}),
    "paper-480s": ("paper_sampling_480s", LONG, set(report.ORDER) - {"convergence", "sampling"}),
}
#: What the tables in the notes of docs/paper.md are made of: record, experiment and options.
FURTHER = {
    "paper_16s": ("convergence", ""),
    "paper_16s_later": ("convergence", ""),
    "paper_16s_split_kinds_ship": ("split-kinds", "--seeds 4 --scene ship"),
    "paper_30s_split_kinds_width_16": ("split-kinds", "--seeds 3 --budget 30 --options width=16"),
    "paper_16s_temperature_0.05": ("seams", "--options temperature=0.05"),
    "paper_16s_temperature_0.02": ("seams", "--seeds 4 --options temperature=0.02"),
    "paper_16s_temperature_falling": ("seams", "--seeds 4 --options temperature=0.05 temperature_final=0.01"),
}
needs_scenes = pytest.mark.skipif(
    not all((data_folder() / name).is_dir() for name in ("lego", "ship")), reason="lego and ship are not there"
)


def test_bands_hold_mean_and_range():
    figure, axes = figures.panes(1)
    line = figures.banded(axes[0], "x", [[(0, 1.0), (2, 3.0)], [(1, 4.0), (2, 5.0)]])
    x, y = line.get_data()
    assert (x[0], x[-1]) == (1, 2) and y[0] == pytest.approx(3.0) and y[-1] == pytest.approx(4.0)
    (band,) = axes[0].collections
    assert band.get_paths()[0].vertices[:, 1].min() == 2.0 and band.get_paths()[0].vertices[:, 1].max() == 5.0
    figures.pyplot.close(figure)


def test_a_variant_has_one_colour_in_all_panes(settings, tmp_path, monkeypatch):
    """Also where a scene has no results of the variants before it, as tables made in parts do."""
    made = []
    monkeypatch.setattr(figures, "save", lambda figure, path: made.append(figure) or path)
    for name in ("convergence", "seams"):
        rows = synthetic(EXPERIMENTS[name], settings, lambda i: 20.0 + i)
        first = rows[0]["variant"]
        rows += [{**row, "scene": "other"} for row in rows if row["variant"] != first]
        figures.PLOTS[name](tmp_path / "x.png", rows)
        panes = made.pop().axes
        drawn = [dict(zip((text.get_text() for text in pane.get_legend().texts), pane.lines)) for pane in panes]
        whole, part = ({label: line.get_color() for label, line in lines.items()} for lines in drawn)
        assert first in whole and first not in part and part.items() <= whole.items() and part, name
        assert len(set(whole.values())) == len(whole)
    figures.pyplot.close("all")


def test_every_plot_is_drawn(settings, tmp_path):
    drawn = set()
    for name, experiment in EXPERIMENTS.items():
        rows = synthetic(experiment, settings, lambda i: 20.0 + i)
        drawn |= {path.name for path in figures.draw(name, rows, tmp_path)}
    assert drawn == {f"{name}.png" for name in figures.PLOTS if name in EXPERIMENTS}
    assert not figures.draw("convergence", [], tmp_path)


def test_balance_and_a_nested_picture(settings, out, monkeypatch):
    paper.experiment("initialisation", settings)  # its first variant keeps the samples
    outcome = balance.measure(settings, diagrams=3)
    assert [row["variant"] for row in outcome["results"]] == ["kept by a training, builtin", "separate objects"]
    for row, claim in zip(outcome["results"], outcome["claims"]):
        assert len(row["after_all"]) == 3 and row["after"] == sorted(row["after_all"])[1] < row["before"]
        assert claim["published"] == "0.246 -> 0.0018" and f"{row['after']:.4f}" in claim["here"]

    small = replace(settings, budget=0.4, downscale=4 * settings.downscale)  # the picture is taken four times as large
    outcome = paper.experiment("nested-2d", small)
    cells = {row["variant"]: row["cells"] for row in outcome["results"]}
    assert cells[nested.ONE] == cells[nested.MATCHED] == 1 and cells[nested.NESTED] >= 4
    (levels,) = (row["levels"] for row in outcome["results"] if row["variant"] == nested.NESTED)
    assert [level["cells"] for level in levels[:2]] == [1, 4] and len(levels) == 4
    assert (out / "nested-2d.png").is_file() and (out / "nested-2d-pictures.png").is_file()
    again = paper.experiment("nested-2d", small)
    assert again["results"] == outcome["results"]
    for option, value in (("options", ("width=8",)), ("rates", (1.0, 2.0)), ("record", out / "record.json")):
        with pytest.raises(ConfigError, match=f"--{option} must be left out for nested-2d, a fit, got"):
            paper.experiment("nested-2d", replace(small, **{option: value}))

    def refuse(*_):
        raise AssertionError("fitted again")

    monkeypatch.setattr(nested, "nested", refuse)
    assert paper.experiment("nested-2d", replace(small, train=False))["results"] == outcome["results"]
    absent = paper.experiment("nested-2d", replace(small, train=False, budget=0.5))
    assert absent["results"] == [] and absent["metadata"]["missing"] == ["the fit of a picture"]
    assert {claim["verdict"] for claim in absent["claims"]} == {"not measured"}
    assert paper.experiment("nested-2d", small)["results"] == outcome["results"]
    for name, value in (("WIDTH", 8), ("SPLITS", (0.5,)), ("RATE", 0.02)):
        with monkeypatch.context() as patched, pytest.raises(AssertionError, match="fitted again"):
            patched.setattr(nested, name, value)
            paper.experiment("nested-2d", small)


def test_nested_pictures_of_several_scenes(settings, tmp_path):
    scenes = ("builtin", "builtin-translucent")
    size = {"budget": 0.2, "downscale": 4 * settings.downscale}
    outcome = paper.experiment("nested-2d", replace(settings, scene=scenes, out=tmp_path, **size))
    variants = (nested.ONE, nested.MATCHED, nested.NESTED)
    assert [(row["scene"], row["variant"]) for row in outcome["results"]] == [(s, v) for s in scenes for v in variants]
    claims = [claim["claim"].split(":")[0] for claim in outcome["claims"]]
    assert claims == [f"a picture of {scene}" for scene in scenes for _ in range(2)]
    assert outcome["metadata"]["scenes"] == list(scenes)
    both = Image.open(tmp_path / "nested-2d-pictures.png").height
    paper.experiment("nested-2d", replace(settings, out=tmp_path / "one", **size))
    assert both == 2 * Image.open(tmp_path / "one" / "nested-2d-pictures.png").height
    text = (tmp_path / "nested-2d.md").read_text()
    assert all(f"| {scene} | {nested.NESTED} |" in text for scene in scenes)


def test_nested_fit_inherits_and_stays_in_the_plane():
    y, x = torch.meshgrid(torch.arange(24), torch.arange(30), indexing="ij")
    image = torch.stack(((x // 4 + y // 4) % 2, x > 15, y > 12), -1).float()
    options = {"seed": 0, "backend": "auto"}
    for width, rate in ((16, nested.RATE), (128, nested.RATE / 2)):
        assert nested.ImageFit(image, budget=1.0, width=width, splits=(), **options).rate == rate
    fit = nested.ImageFit(image, budget=1e9, width=8, splits=(0.0,), **options)
    for _ in range(3):
        fit._step(0.0)
    before = fit.picture()
    fit._split()
    assert fit.router.num_cells == 4 and bool((fit.router.diagram.centres[:, 2] == 0).all())
    torch.testing.assert_close(fit.picture(), before)
    borders = nested.outlined(fit.level().cell_of)
    assert borders.shape == (24, 30, 3) and len(np.unique(borders.reshape(-1, 3), axis=0)) >= 4
    width = nested.matching_width(5000, 6)
    assert nested.parameters(width, 6) <= 5000 < nested.parameters(width + 1, 6)
    assert nested.parameters(8, 5) == sum(p.numel() for p in nested.ImageField(8, 3, 5).parameters())


def test_the_page_shows_what_came_out_and_keeps_notes(settings, out, tmp_path):
    paper.experiment("initialisation", settings)
    page = tmp_path / "docs" / "paper.md"
    report.write_report(out, page)
    text = page.read_text()
    stored = read_json(out / "initialisation.json")
    assert all(claim["verdict"] in text and claim["here"] in text for claim in stored["claims"])
    summary = text.split("## Figure")[0]
    assert all(summary.count(f"| {claim['claim']} |") == 1 for claim in stored["claims"])
    assert all(f"| {claim['verdict']} | 0.25 | 1 | 20 x 20 |" in summary for claim in stored["claims"])
    assert "failed:" not in text
    assert "Not run: convergence" in text and "RTX 2080 Ti" in text and "20 x 20 pixels; 0.25 s a variant" in text
    assert "(images/paper/initialisation.png)" in text
    assert (page.parent / "images" / "paper" / "initialisation.png").stat().st_size < 60_000

    page.write_text(text + "What was seen.\n")
    stored["claims"][0]["verdict"] = "changed"
    stored["metadata"] |= {"budget_seconds": 30.0, "seeds": 3, "failed": ["random parameters on builtin: nan"]}
    report.write_report(out, page.parent / "long.md")
    assert "(images/long/initialisation.png)" in (page.parent / "long.md").read_text()
    assert (page.parent / "images" / "long" / "initialisation.png").is_file()
    other = tmp_path / "other"
    other.mkdir()
    (other / "initialisation.json").write_text(json.dumps(stored))
    report.write_report(other, page)
    text = page.read_text()
    assert "| changed | 30 | 3 | 20 x 20 |" in text and "; failed: random parameters on builtin: nan." in text
    assert text.endswith(f"{report.NOTES}\nWhat was seen.\n")
    refuses("--out must hold results of experiments", report.write_report, tmp_path / "nothing", page)


def test_the_command_line(settings, out, capsys):
    options = as_options(TINY)
    paper.main(["figure", "density", *options, "--out", str(out)])
    assert "| builtin | inherited |" in capsys.readouterr().out and (out / "density.json").is_file()
    page = out / "page.md"
    paper.main(["all", *options, "--out", str(out), "--page", str(page), "--only", "density", "ghosting"])
    printed = capsys.readouterr().out
    assert "  2 trainings, 2 of them made already" in printed and "## Figure: ghosting" in page.read_text()
    refuses("--only must name experiments", paper.everything, settings, page, ("nothing",))
    for name in (*paper.Table.__args__, *paper.Figure.__args__):
        assert name in paper.ORDER
    assert len(paper.ORDER) == len(paper.Table.__args__) + len(paper.Figure.__args__)


def from_record(name, folder):
    """The options that make tables of a committed record without a training."""
    return ["--no-train", "--out", str(folder), "--record", str(shutil.copy(RESULTS / f"{name}.json", folder))]


def table_rows(text):
    """The cells of every line of the tables in a text."""
    lines = (line.strip() for line in text.splitlines())
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]


@needs_scenes
@pytest.mark.parametrize("name", COMMITTED)
def test_a_committed_page_is_what_the_program_writes(name, tmp_path):
    """Apart from its notes, and from pictures, of which a record has none."""
    record, size, absent = COMMITTED[name]
    if name == "paper":
        shutil.copy(RESULTS / "paper_balance_objects.json", tmp_path / "balance.json")
    page = tmp_path / f"{name}.md"
    shown = [experiment for experiment in report.ORDER if experiment not in absent]
    options = [*size.split(), *from_record(record, tmp_path), "--page", str(page), "--only", *shown]
    script(ROOT / "benchmarks" / "paper.py", "all", *options)
    written, committed = (
        [
            line
            for line in path.read_text().partition(report.NOTES)[0].splitlines()
            if line and not line.startswith("![")
        ]
        for path in (page, ROOT / "docs" / page.name)
    )
    assert committed == written


@needs_scenes
def test_tables_in_the_notes_are_of_their_records(tmp_path, capsys):
    notes = (ROOT / "docs" / "paper.md").read_text().partition(report.NOTES)[2]
    made = []
    for name, (experiment, options) in FURTHER.items():
        folder = tmp_path / name
        folder.mkdir()
        paper.main(
            ["figure", experiment, *SMALL.split(), "--scene", "lego", *options.split(), *from_record(name, folder)]
        )
        made.append((folder / f"{experiment}.md").read_text())
    rows = [[cell for cell in row[1:] if re.search(r"\d\.\d\d", cell)] for row in table_rows(notes)]
    assert sum(map(bool, rows)) == 12
    for row in rows:
        assert any(all(f"| {cell} |" in text for cell in row) for text in made), row


def test_leads_over_time_are_of_their_record():
    """The table of docs/paper-480s.md: dB over one network of width 64, at each evaluation and at the end."""
    rows = read_json(RESULTS / "paper_sampling_480s.json")["results"].items()

    def points(scene, seed, field, sampling, cells):
        (row,) = (
            row
            for name, row in rows
            if name.startswith(f"{scene}-{seed}-") and (row["cells"], row["width"]) == (cells, 64)
            if row["config"].get("field", "nerf") == field and "centres" not in row["config"]
            if row["config"].get("sampling", "stratified") == sampling
        )
        return [*(entry["psnr"] for entry in row["curve"]), row["psnr"]]

    expected = []
    for scene in ("lego", "ship"):
        for field in ("nerf", "mipnerf"):
            for sampling in ("stratified", "hierarchical"):
                for seed in (0, 1):
                    cells, one = (points(scene, seed, field, sampling, count) for count in (12, 1))
                    expected.append([f"{a - b:+.2f}" for a, b in zip(cells, one)])
    notes = (ROOT / "docs" / "paper-480s.md").read_text().partition(report.NOTES)[2]
    assert [row[1:] for row in table_rows(notes)[2:]] == expected
