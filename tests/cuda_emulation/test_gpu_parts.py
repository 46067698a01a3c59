"""The programs of ``make gpu-check`` on the CPU, so that their first run on a GPU does not end in a slip of theirs."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest
from emulated import emulated

ROOT = Path(__file__).resolve().parent.parent.parent


@pytest.fixture
def parts(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.setattr(sys, "path", [*sys.path])
    spec = importlib.util.spec_from_file_location("gpu_parts", ROOT / ".ci" / "gpu_parts.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_small_case_is_right_on_the_emulated_device(parts: ModuleType) -> None:
    with emulated():
        for name, run in parts.small_cases("cpu"):
            try:
                run()
            except Exception as error:
                raise AssertionError(name) from error


def test_a_wrong_result_is_told(
    parts: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    def wrong() -> None:
        raise ValueError("not what it should be")

    monkeypatch.setattr(parts, "small_cases", lambda device: [("fine", lambda: None), ("bad", wrong)])
    monkeypatch.setattr("torch.cuda.synchronize", lambda: None)
    assert parts.small() == 1
    said = capsys.readouterr().out
    assert "right  fine" in said and "WRONG  bad: ValueError: not what it should be" in said
    assert said.endswith("1 of 2 cases are right\n")


@pytest.mark.native
def test_roofs(parts: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Every row is measured, on the CPU's kernels."""
    import harness  # of benchmarks/, to which gpu_parts.py has led

    monkeypatch.setattr(harness, "_cuda_peak", lambda kind, device: 1e12)
    assert parts.roofs(tmp_path, "cpu", 256) == 0
    rows = json.loads((tmp_path / "roofs.json").read_text())["rows"]
    assert len(rows) == 18 and all(row["seconds"] > 0 and row["share"] > 0 for row in rows)


def test_training(parts: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert parts.training(tmp_path, "builtin", "cpu", 0.5) == 0
    ungraphed = [settings for settings in parts.TRAININGS.values() if "cuda_graph" not in settings]
    assert capsys.readouterr().out.count("PSNR") == len(ungraphed) == 2


def test_machine(parts: ModuleType, capsys: pytest.CaptureFixture) -> None:
    parts.machine()
    assert "missing: " in capsys.readouterr().out
