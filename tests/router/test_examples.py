"""The scripts of examples/ run unchanged, and three lines add cells to the training loop."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import pytest
from helpers import script
from ops.foreign_fields import EXAMPLES

ELSEWHERE = ("nerf_pytorch_style", "poisson", "train")  # these scripts have tests of their own
SCRIPTS = sorted(path for path in EXAMPLES.glob("*.py") if path.stem not in ELSEWHERE)


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_script(path: Path) -> None:
    assert re.search(r"\d+ (cells|modules in one router)", script(path))


SMALL = {"downscale": 5, "seconds": 1.5, "width": 16, "depth": 3, "rays": 256, "samples": 16, "views": 2, "lr": 0.01}


@pytest.mark.parametrize("voronoi", [False, True], ids=["one network", "cells"])
def test_training_loop(voronoi: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = itertools.count()
    monkeypatch.setattr("time.perf_counter", lambda: 0.03 * next(ticks))  # 0.03 seconds a step on any machine
    options = [f"--{name}={value}" for name, value in SMALL.items()]
    last = script(EXAMPLES / "nerf_pytorch_style.py", "builtin", *options, *["--voronoi"] * voronoi).splitlines()[-1]
    result = re.fullmatch(r"(16 cells|one network) of width 16: (\d+) steps in (\d+) s, test PSNR ([\d.]+) dB", last)
    assert result is not None, last
    assert result[1] == ("16 cells" if voronoi else "one network")
    assert float(result[4]) > 8


def test_three_lines_are_changed() -> None:
    lines = (EXAMPLES / "nerf_pytorch_style.py").read_text().splitlines()
    assert sum(line.endswith("# changed") for line in lines) == 3


@pytest.mark.slow
def test_conditions_on_faces_join_the_solutions_of_cells() -> None:
    said = [script(EXAMPLES / "poisson.py", "--cells=3", "--steps=700", *more) for more in ([], ["--alone"])]
    errors = [float(out.split()[-1]) for out in said]
    assert errors[0] < 0.06 and errors[1] > 3 * errors[0], errors
