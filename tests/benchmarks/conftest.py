"""Scripts and packages of benchmarks/ are imported by their own names, as they import one another."""

import itertools
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from paper_results import TINY

from voronerf.training import trainer

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks"))


@pytest.fixture
def steady_clock(monkeypatch):
    """A step takes ten milliseconds however busy the machine is, so that every run splits and ends where it should."""
    from paper import nested

    ticks = itertools.count()
    clock = SimpleNamespace(perf_counter=lambda: 0.0101 * next(ticks), time=time.time)
    for module in (trainer, nested):
        monkeypatch.setattr(module, "time", clock)


@pytest.fixture(scope="session")
def out(tmp_path_factory):
    """One output folder for trainings, so that they are shared as `make paper` shares them."""
    return tmp_path_factory.mktemp("paper")


@pytest.fixture
def settings(out):
    from paper.runs import Settings

    return Settings(**TINY, out=out)
