from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "step_profile.py"


@pytest.mark.native
def test_step_profile_accounts_for_the_step(tmp_path: Path) -> None:
    path = tmp_path / "profile.json"
    small = ["--cells", "2", "--width", "16", "--rays", "64", "--samples", "8", "--steps", "2", "--json", str(path)]
    small += ["--field", "mipnerf", "--sampling", "hierarchical"]
    subprocess.run([sys.executable, str(SCRIPT), *small], check=True, capture_output=True)
    outcome = json.loads(path.read_text())
    about, rows = outcome["metadata"], outcome["results"]
    assert (about["benchmark"], about["cells"], about["rays"]) == ("step_profile", 2, 64)
    assert (about["field"], about["sampling"], about["width"], about["samples"]) == ("mipnerf", "hierarchical", 16, 8)
    assert about["step_ms"] > 0
    parts = {row["part"]: row["ms"] for row in rows if "part" in row}
    operators = {row["operator"]: row["ms"] for row in rows if "operator" in row}
    assert all(parts[part] > 0 for part in ("route", "composite", "optimiser", "other operators"))
    assert sum(operators.values()) == pytest.approx(sum(parts.values()) - parts["Python and dispatch"])
