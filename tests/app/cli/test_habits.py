"""Tests of `voronerf compare`, TensorBoard output, optional packages, and a command without arguments."""

import json
import re
import shutil
import struct
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cli_commands import TINY, words
from PIL import Image
from scene_files import write_capture

from voronerf.app.cli import info, main, train
from voronerf.app.cli.compare import shown, written
from voronerf.app.evaluate.panels import picture_of_colour
from voronerf.app.run import open_run
from voronerf.app.train import TensorBoard
from voronerf.app.train.config import TrainConfig
from voronerf.app.train.run_directory import read_curve
from voronerf.nerf import orbit_cameras

ROOT = Path(__file__).resolve().parents[3]


def make_run(folder, psnr, cells, *, ended=True):
    """Writes the files of a run and returns its folder; an unfinished run has no summary.json."""
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps({"cells": cells, "width": 32, "out": str(folder)}))
    scores = {"psnr": psnr, "ssim": 0.9, "lpips": None, "steps": 1200, "seconds": 60.0}
    if ended:
        (folder / "summary.json").write_text(json.dumps(scores))
    (folder / "metrics.jsonl").write_text(json.dumps({"step": 1200, "seconds": 60, "psnr": psnr}) + "\n")
    return folder


def test_runs_are_compared(tmp_path, capsys):
    runs = make_run(tmp_path / "a[b]", 30.125, [16]), make_run(tmp_path / "wide", 31.5, [4, 4], ended=False)
    assert main(words("compare", *runs)) == 0
    rows = [line.split() for line in capsys.readouterr().out.replace("│", " ").splitlines()]
    assert ["PSNR", "[dB]", "30.12", "31.50"] in rows and ["SSIM", "0.900", "-"] in rows and ["LPIPS", "-", "-"] in rows
    assert not any(row[0] in ("width", "out") for row in rows if row) and any(row[:1] == ["cells"] for row in rows)


def test_a_run_that_was_stopped_before_its_scores_shows_those_of_eval(tmp_path, capsys):
    runs = make_run(tmp_path / "a", None, [16]), make_run(tmp_path / "b", None, [16])
    (runs[0] / "eval.json").write_text(json.dumps({"psnr": 20.25, "ssim": 0.5, "lpips": None, "views": [1, 2]}))
    assert main(words("compare", *runs)) == 0
    out = capsys.readouterr().out
    assert "20.25" in out and f"{runs[1]} has no scores" in out and f"{runs[0]} has no scores" not in out


def test_numbers_are_compared_as_people_write_them(tmp_path, capsys):
    short, long = make_run(tmp_path / "short", 30.125, [16]), make_run(tmp_path / "long", 27.5, [4, 4])
    summaries = {"seconds": 4.6075, "steps": 1234}, {"seconds": 479.8, "steps": 99}
    one = {"lr": 1e-5, "budget": None, "field_options": ["finest=42", "x=1"]}
    other = {"lr": 0.1 + 0.2, "budget": 1e6, "field_options": ["finest=107", "x=1"]}
    for run, *changes in zip((short, long), summaries, (one, other)):
        for name, change in zip(("summary.json", "config.json"), changes):
            (run / name).write_text(json.dumps(json.loads((run / name).read_text()) | change))
    assert main(words("compare", short, long)) == 0
    cells = [line.strip("│").split("│") for line in capsys.readouterr().out.splitlines() if line.startswith("│")]
    rows = [[cell.strip() for cell in row] for row in cells]
    assert ["training", "4.6 s", "8 min"] in rows and ["steps", "1,234", "99"] in rows
    assert rows[-4:] == [
        ["cells", "16", "4 4"],
        *(["lr", "0.00001", "0.3"], ["budget", "-", "1,000,000"], ["finest", "42", "107"]),
    ]
    assert [shown(seconds, None) for seconds in (0.25, 59.4, 59.6, 90)] == ["0.25 s", "59 s", "1 min", "1 min 30 s"]
    assert [written(value) for value in (True, [], "off")] == ["yes", "none", "off"]


def test_scores_of_parts_of_views_are_marked(tmp_path, capsys):
    short, long = make_run(tmp_path / "short", 30.125, [16]), make_run(tmp_path / "long", 27.5, [16])
    for run, views, part in ((short, 1, 1 / 16), (long, 3, 1.0)):
        figures = json.loads((run / "summary.json").read_text())
        (run / "summary.json").write_text(json.dumps({**figures, "views": views, "part": part}))
    assert main(words("compare", short, long)) == 0
    shown = capsys.readouterr().out
    rows = [line.split() for line in shown.replace("│", " ").splitlines()]
    assert ["PSNR", "[dB]", "30.12*", "27.50"] in rows and ["SSIM", "0.900*", "0.900"] in rows
    assert "the middle 6% of 1 view" in shown and "3 views" in shown
    (short / "metrics.jsonl").write_text(
        '{"step": 1, "seconds": 1, "psnr": 20.0, "part": 1}\n{"step": 2, "seconds": 2, "psnr": 30.0, "part": 0.06}\n'
    )
    assert read_curve(short) == [(1, 20.0)]


def test_a_joined_run_shows_what_is_known(tmp_path, tiny_run, capsys):
    one, joined = tiny_run, tmp_path / "two runs"
    assert main(words("join", one, one, "--out", joined)) == 0
    capsys.readouterr()

    def rows():
        assert main(words("compare", one, joined)) == 0
        shown = capsys.readouterr().out
        cells = [line.strip("│").split("│") for line in shown.splitlines() if line.startswith("│")]
        return {row[0].strip(): [value.strip() for value in row[1:]] for row in cells}, shown

    figures, shown = rows()
    count = json.loads((one / "summary.json").read_text())["parameters"]
    assert figures["cells"] == ["3", "6"] and figures["parameters"] == [f"{count:,}"] * 2  # one network, placed twice
    assert figures["PSNR [dB]"][1] == figures["scores of"][1] == figures["training"][1] == "-"
    assert f"{joined} has no scores: voronerf eval '{joined}' computes them" in shown and f"{one} has" not in shown
    assert main(words("eval --views 3 --panels 0", joined)) == 0
    psnr = json.loads((joined / "eval.json").read_text())["psnr"]
    capsys.readouterr()
    figures, shown = rows()
    assert figures["PSNR [dB]"][1] == f"{psnr:.2f}" and figures["scores of"][1] == "3 views" and "makes" not in shown


def test_cut_runs_placed_runs_and_panoramas(tmp_path, tiny_run, capsys, fails):
    one, part, placed = shutil.copytree(tiny_run, tmp_path / "one"), tmp_path / "part", tmp_path / "placed"
    assert main(words("cut", one, "--out", part, "--sphere 0 0 0 0.4")) == 0
    assert main(words("place", one, part, "--out", placed, "--at 0 0 1")) == 0
    for run, is_cut in ((one, False), (part, True), (placed, False)):
        capsys.readouterr()
        assert main(words("eval --views 1 --panels 0", run)) == 0
        said = f"{run} was cut: its pictures are empty outside of the part that is left, but are compared with whole"
        assert (said in capsys.readouterr().out) == is_cut
    assert main(words("join", part, one, "--out", tmp_path / "joined")) == 0
    capsys.readouterr()
    assert main(words("compare", part, placed, tmp_path / "joined")) == 0
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in capsys.readouterr().out.splitlines()]
    assert ["scores of", "1 view, cut", "1 view", "cut"] in rows
    assert main(words("render", one, "--panorama --frames 1 --size 8x4")) == 0
    assert (one / "panorama.mp4").is_file() and not (one / "video.mp4").exists()
    for run in (part, placed):
        fails("it has several parts, as runs made by join, cut or place; export the runs", "export --web x.html", run)


def test_videos_through_the_cameras_of_a_capture(tmp_path, capsys):
    capture, run = tmp_path / "capture", tmp_path / "run"
    seen = orbit_cameras(9, radius=4, elevation=20, width=12, height=10, focal=20, centre=(1, 2, 3))
    write_capture(capture, seen, k1=0.05)
    assert main(words("train --out", run, TINY.replace("--downscale 6", ""), "--data", capture)) == 0
    assert main(words("render --images --path", capture / "transforms.json", run)) == 0
    opened = open_run(run, data=capture)
    names = [frame["file_path"] for frame in json.loads((capture / "transforms.json").read_text())["frames"]]
    for split in (opened.scene.train, opened.scene.test):
        for index, name in enumerate(split.names):
            picture = np.asarray(Image.open(run / "transforms" / f"{names.index(f'{name}.png'):05}.png"))
            expected = picture_of_colour(opened.render(split.cameras, index).colour).numpy()
            assert np.abs(picture.astype(int) - expected).max() <= 1


def test_what_is_not_compared(tmp_path, fails):
    run, broken = make_run(tmp_path / "run", 30.0, [16]), make_run(tmp_path / "broken", 30.0, [16])
    fails("compare needs at least two runs, got 1", "compare", run)
    fails(f"no run at {tmp_path}: there is no config.json in it", "compare", run, tmp_path)
    (broken / "summary.json").write_text("[1]")
    fails("summary.json: must be an object, got [1]", "compare", run, broken)


def scalars(folder):
    """Returns the names of the scalars in an event file, whose records are length, checksum, message, checksum."""
    (file,) = folder.iterdir()
    data, at, names = file.read_bytes(), 0, []
    while at < len(data):
        (length,) = struct.unpack_from("<Q", data, at)
        names += re.findall(rb"(?:train|test)/\w+", data[at + 12 : at + 12 + length])
        at += 16 + length
    return [name.decode() for name in names]


def test_tensorboard(tmp_path, fails, monkeypatch):
    pytest.importorskip("tensorboard", reason="tensorboard is not installed")
    pytest.importorskip("torch.utils.tensorboard", reason="tensorboard is not complete")
    assert main(words("train --tensorboard --out", tmp_path / "run", TINY)) == 0
    names = scalars(tmp_path / "run" / "tensorboard")
    assert names.count("train/loss") == names.count("train/cells") == 1  # after 16 steps
    assert names.count("test/psnr") == names.count("test/ssim") == 2 and "test/lpips" not in names
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    monkeypatch.setattr("voronerf.app.cli.train.load_scene", None)  # the package is checked before data is read
    fails("needs tensorboard: pip install 'voronerf[tensorboard]'", "train --tensorboard --out", tmp_path / "x", TINY)
    assert not (tmp_path / "x").exists()


def test_tensorboard_has_the_evaluation_that_a_resume_makes_up_for(tmp_path, monkeypatch):
    written = []
    writer = SimpleNamespace(add_scalar=lambda *entry: written.append(entry), close=lambda: None)
    monkeypatch.setattr("voronerf.app.train.callbacks.tensorboard_writer", lambda: lambda *_, **__: writer)
    lines = [{"step": 12, "psnr": 20.0}, {"step": 24, "psnr": 21.0}]  # the second by `Scores.on_start`
    board = TensorBoard(tmp_path, SimpleNamespace(metrics=lines))
    board.on_start(SimpleNamespace(step=24))
    board.on_end(SimpleNamespace(step=24))
    assert written == [("test/psnr", 21.0, 24)]


def test_a_training_without_options_says_what_to_try(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train, "load_scene", lambda *args, **options: SimpleNamespace(name="x"))
    monkeypatch.setattr(train, "run_training", lambda *args, **options: {"complete": True})
    assert main(["train"]) == 0
    said = capsys.readouterr().out
    assert "trains the built-in scene for 480 s" in said and "voronerf train --data DIR" in said
    assert main(["train", "--steps", "1"]) == 0
    assert capsys.readouterr().out == ""


def test_warp_on_the_cpu_names_the_device(monkeypatch, capsys):
    pytest.importorskip("warp", reason="warp is not installed")
    monkeypatch.setattr("voronerf.kernels.loads", lambda *_: [])
    train._compile_kernels(TrainConfig(backend="warp"))
    assert capsys.readouterr().out.endswith("far slower than --backend auto; for a GPU add --device cuda\n")
    train._compile_kernels(TrainConfig())
    assert capsys.readouterr().out == ""


def test_info_lists_the_extras(capsys, monkeypatch):
    project = (ROOT / "pyproject.toml").read_text()
    listed = re.search(r"\[project.optional-dependencies\]\n(.*?)\n\n", project, re.DOTALL)[1]
    assert set(re.findall(r"^(\w+) =", listed, re.MULTILINE)) == {"test", "docs", *info.EXTRAS}
    absent = {"imaginary": info.Extra("what is not there", ("voronerf", "no_such_module"))}
    monkeypatch.setattr(info, "EXTRAS", {**info.EXTRAS, **absent})
    assert main(["info"]) == 0
    said = capsys.readouterr().out
    assert "what is not there: no no_such_module; pip install 'voronerf[imaginary]'" in said
    assert all(f"extra {name}" in said for name in info.EXTRAS)


def test_what_the_demo_installs_is_what_the_package_needs():
    project = (ROOT / "pyproject.toml").read_text()
    lists = (re.search(rf"\n{name} = \[(.*?)\]", project, re.DOTALL)[1] for name in ("requires", "dependencies", "app"))
    needed = {name for text in lists for name in re.findall(r'"([a-z0-9-]+)', text)}
    pinned = set(re.findall(r"^([a-z0-9-]+)==", (ROOT / "requirements.txt").read_text(), re.MULTILINE))
    assert pinned == needed | {"wheel"}
