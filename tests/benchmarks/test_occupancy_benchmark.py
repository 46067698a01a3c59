"""That benchmarks/occupancy.py renders a run that is there, dense and through a grid made from its field."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from voronerf.data import builtin_scene
from voronerf.training.config import TrainConfig
from voronerf.training.trainer import Trainer

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "occupancy.py"


def test_pictures_of_a_trained_run(tmp_path: Path) -> None:
    config = TrainConfig(out=tmp_path / "run", steps=4, cells=(), width=8, depth=2, rays=64, samples=8, final_views=1)
    Trainer(config, builtin_scene(16, train_views=4, test_views=1)).run()
    path = tmp_path / "pictures.json"
    arguments = ["--trained", str(tmp_path / "run"), "--size", "12", "--views", "1", "--repeats", "1"]
    command = [sys.executable, str(SCRIPT), *arguments, "--json", str(path)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    outcome = json.loads(path.read_text())
    assert outcome["metadata"]["benchmark"] == "occupancy" and outcome["results"]["training"] == []
    dense, grid = outcome["results"]["rendering"]
    assert (dense["way"], grid["way"]) == ("dense", "grid") and dense["occupied"] is None
    assert 0 < grid["occupied"] <= 1 and grid["grid_seconds"] > 0
    assert min(dense["seconds"], grid["seconds"]) > 0 and abs(dense["psnr"] - grid["psnr"]) < 1
    assert "rendering: " in done.stdout
