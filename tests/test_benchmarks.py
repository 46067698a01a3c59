"""What the scripts under benchmarks/ share."""

from __future__ import annotations

import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import voronerf

BENCHMARKS = Path(__file__).resolve().parent.parent / "benchmarks"


def test_metadata_says_what_was_measured_where() -> None:
    harness = runpy.run_path(str(BENCHMARKS / "harness.py"))
    metadata = json.loads(json.dumps(harness["metadata"](benchmark="balance", seeds=3)))
    assert (metadata["benchmark"], metadata["seeds"]) == ("balance", 3)
    assert (metadata["voronerf"], metadata["torch"]) == (voronerf.__version__, torch.__version__)
    assert metadata["threads"] == torch.get_num_threads() and metadata["machine"] and metadata["python"]
    assert "available" in metadata["native"]


@pytest.mark.parametrize("name", ["Makefile", "README.md", "CONTRIBUTING.md"])
def test_scripts_that_are_named_are_there(name: str) -> None:
    path = BENCHMARKS.parent / name
    for script in re.findall(r"benchmarks/\w+\.py", path.read_text()):
        assert (BENCHMARKS.parent / script).is_file(), f"{name} names {script}"


def test_balance_runs_as_a_script(tmp_path: Path) -> None:
    path = tmp_path / "results" / "balance.json"
    arguments = ["--cells", "4", "--seeds", "1", "--count", "300", "--json", str(path)]
    command = [sys.executable, str(BENCHMARKS / "balance.py"), *arguments, "--methods", "published"]
    subprocess.run(command, check=True, capture_output=True)
    outcome = json.loads(path.read_text())
    assert outcome["metadata"]["benchmark"] == "balance" and outcome["metadata"]["count"] == 300
    (row,) = outcome["results"]
    assert row["after"] < row["before"]
