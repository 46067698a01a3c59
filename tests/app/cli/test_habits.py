"""Comparisons of runs, TensorBoard, extras, and what is said to one who says nothing."""

import json
import re
import struct
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from cli_commands import TINY, words
from PIL import Image

from voronerf.app.cli import commands, info, main

ROOT = Path(__file__).resolve().parents[3]


def make_run(folder, psnr, cells, *, ended=True, views=("r_0", "r_1")):
    """A run as far as its files tell; a line of metrics for one that has not ended."""
    (folder / "images").mkdir(parents=True)
    for view in views:
        Image.new("RGB", (8, 4), "red").save(folder / "images" / f"{view}.png")
    (folder / "config.json").write_text(json.dumps({"cells": cells, "width": 32, "out": str(folder)}))
    scores = {
        "psnr": psnr,
        "ssim": 0.9,
        "lpips": None,
        "steps": 1200,
        "seconds": 60.0,
        "stages": [{}, {"started_at_second": 9}],
    }
    if ended:
        (folder / "summary.json").write_text(json.dumps(scores))
    lines = ({"step": step, "seconds": step / 20, "psnr": psnr - 1 / step} for step in (600, 1200))
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


def test_runs_are_compared_on_one_page(tmp_path, capsys):
    first = make_run(tmp_path / "a<b>", 30.125, [16])
    second = make_run(tmp_path / "wide", 31.5, [4, 4], views=("r_1", "r_2"))
    third = make_run(tmp_path / "other" / "wide", 29.0, [], ended=False, views=())
    out = tmp_path / "pages" / "all.html"
    assert main(words("compare", first, second, third, "--out", out)) == 0
    page = out.read_text()
    assert "a&lt;b&gt;" in page and "a<b>" not in page
    assert "<b>31.50</b>" in page and "<td>30.12</td>" in page and "1,200" in page
    assert "--cells" in page and "<td>4 4</td>" in page and "--width" not in page and "--out" not in page
    assert f"<th>{second}</th>" in page and f"<td>{third}</td>" in page  # two of one name are told by their folders
    # The curve, and the one view that two of them have: nothing is loaded from elsewhere.
    assert page.count("src='data:image/png;base64,") == page.count("src=") == 3 and "http" not in page
    assert "<h3>r_1</h3>" in page and "<h3>r_0</h3>" not in page
    assert "31.50" in capsys.readouterr().out


def test_what_is_not_compared(tmp_path, fails):
    run = make_run(tmp_path / "run", 30.0, [16])
    broken = make_run(tmp_path / "broken", 30.0, [16])
    out = tmp_path / "page.html"
    fails("compare needs at least two runs, got 1", "compare", run)
    fails("--out must end in .html, got page", "compare", run, run, "--out page")
    fails("--views must not be negative, got -1", "compare", run, run, "--views -1")
    fails(f"{tmp_path}: there is no run, it has no config.json", "compare", run, tmp_path)
    (broken / "images" / "r_0.png").write_bytes(b"no picture")
    fails("r_0.png: is not a PNG", "compare", run, broken, "--out", out)
    (broken / "summary.json").write_text("[1]")
    fails("summary.json: must be an object, got [1]", "compare", run, broken, "--out", out)
    assert not out.exists()


def scalars(folder):
    """Names of the scalars of an event file: records of a length, a checksum, a message and a checksum."""
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
    found = scalars(tmp_path / "run" / "tensorboard")
    assert found.count("train/loss") == found.count("train/cells") == 1  # of 16 steps the tenth
    assert found.count("test/psnr") == found.count("test/ssim") == 2 and "test/lpips" not in found
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    fails("needs tensorboard: pip install 'voronerf[tensorboard]'", "train --tensorboard --out", tmp_path / "x", TINY)
    assert not (tmp_path / "x").exists()


def test_a_training_without_options_says_what_to_try(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(commands, "load_scene", lambda *args, **options: SimpleNamespace(name="x"))
    monkeypatch.setattr(commands, "run_training", lambda *args, **options: {"complete": True})
    assert main(["train"]) == 0
    said = capsys.readouterr().out
    assert "trains the built-in scene for 480 s" in said and "voronerf train --data DIR" in said
    assert main(["train", "--steps", "1"]) == 0
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
