"""Tests of benchmarks/cores.py: the measured rows, and the modelled step times on more cores."""

import cores
import pytest
from helpers import read_json


@pytest.mark.slow
def test_steps_and_regions_are_measured(tmp_path, capsys):
    path = tmp_path / "cores.json"
    cores.main(["--quick", "--json", str(path)])
    said = capsys.readouterr().out
    assert "grouped_program" in said and "| quick, 32 x 32 |" in said and "| picture, quick, 32 x 32 |" in said
    result = read_json(path)
    assert result["metadata"]["benchmark"] == "cores" and result["metadata"]["threads"] >= 2
    region, steps, picture = result["results"]
    assert region["case"] == "a region" and region["serial_us"] > 10
    assert set(steps["ms"]) == set(cores.ways(2)) and all(ms > 0 for ms in steps["ms"].values())
    assert 0 < steps["python_percent"] < 100 and steps["turns"] == 1
    assert picture["case"] == "picture, quick"
    for row in (steps, picture):
        assert row["regions"] > 0 and 0 < row["serial_percent"] < 100
        assert sum(part["us"] for part in row["parts"].values()) == pytest.approx(1e3 * row["traced_ms"], rel=0.01)


def test_more_cores_are_bound_by_what_is_serial_and_by_memory():
    # A step has 1 ms of Python, and 9 ms in two parallel regions with evenly distributed work.
    step = cores.parts(0.010, [("op", 0.009, 2, 0.009, [0.009 / team for team in cores.TEAMS])])
    found = cores.model([step] * 3, 0.0, 0.0)
    assert found["traced_ms"] == pytest.approx(10) and found["serial_percent"] == 10 and found["regions"] == 2
    assert found["x on 8 cores at 40 GB/s"] == pytest.approx(10 / (1 + 9 / 8), abs=0.01)
    assert cores.model([step] * 3, 0.0, 500.0)["x on 8 cores at 40 GB/s"] == pytest.approx(10 / (2 + 9 / 8), abs=0.01)
    assert cores.model([step] * 3, 80e9 * 0.004, 0.0)["x on 32 cores at 80 GB/s"] == pytest.approx(10 / 5, abs=0.01)


def test_what_is_missing_is_said(monkeypatch):
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    for arguments, said in (([], "--data must name"), (["--data", "."], "OMP_WAIT_POLICY must be set")):
        with pytest.raises(SystemExit, match=f"cores: error: {said}"):
            cores.main(arguments)
