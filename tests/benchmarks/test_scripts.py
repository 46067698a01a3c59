"""Scripts of benchmarks/ from end to end: occupancy.py on a run that is there, balance.py, centres.py and others."""

from pathlib import Path

import pytest
from helpers import python, read_json

from voronerf.data import builtin_scene
from voronerf.training.config import TrainConfig
from voronerf.training.trainer import Trainer

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def outcome(script, folder, options):
    """Metadata, results and what was printed."""
    path = folder / "results" / "outcome.json"
    said = python(BENCHMARKS / f"{script}.py", *options.split(), "--json", path)
    found = read_json(path)
    assert found["metadata"]["benchmark"] == script
    return found["metadata"], found["results"], said


def test_pictures_of_a_trained_run(tmp_path):
    config = TrainConfig(out=tmp_path / "run", steps=4, cells=(), width=8, depth=2, rays=64, samples=8, final_views=1)
    Trainer(config, builtin_scene(16, train_views=4, test_views=1)).run()
    options = f"--trained {config.out} --size 12 --views 1 --repeats 1"
    _, results, said = outcome("occupancy", tmp_path, options)
    dense, grid = results["rendering"]
    assert results["training"] == [] and (dense["way"], grid["way"]) == ("dense", "grid") and dense["occupied"] is None
    assert 0 < grid["occupied"] <= 1 and grid["grid_seconds"] > 0
    assert min(dense["seconds"], grid["seconds"]) > 0 and abs(dense["psnr"] - grid["psnr"]) < 1
    assert "rendering: " in said


def test_balance(tmp_path):
    about, (row,), _ = outcome("balance", tmp_path, "--cells 4 --seeds 1 --count 300 --methods published")
    assert about["count"] == 300 and row["after"] < row["before"]


@pytest.mark.native
def test_step_profile_accounts_for_the_step(tmp_path):
    options = "--cells 2 --width 16 --rays 64 --samples 8 --steps 2 --field mipnerf --sampling hierarchical"
    about, rows, _ = outcome("step_profile", tmp_path, options)
    settings = {"cells": 2, "rays": 64, "field": "mipnerf", "sampling": "hierarchical", "width": 16, "samples": 8}
    assert about["step_ms"] > 0 and {name: about[name] for name in settings} == settings
    parts = {row["part"]: row["ms"] for row in rows if "part" in row}
    operators = {row["operator"]: row["ms"] for row in rows if "operator" in row}
    assert all(parts[part] > 0 for part in ("route", "composite", "optimiser", "other operators"))
    assert sum(operators.values()) == pytest.approx(sum(parts.values()) - parts["Python and dispatch"])


def test_centres_makes_only_the_rows_that_are_missing(tmp_path):
    options = "--steps 12 --rays 32 --samples 8 --downscale 8 --eval-views 1 --seeds 1 --cells 3x2"
    options += " --placements single regular"
    about, first, _ = outcome("centres", tmp_path, options)
    assert about["steps"] == 12 and [row["placement"] for row in first] == ["single", "regular"]
    single, regular = first
    assert "imbalance" not in single and single["cells"] == "1" and regular["cells"] == "3x2"
    assert 0 < regular["radius_mean"] <= regular["radius_max"] < 1 and 0 <= regular["imbalance"] <= 0.5
    assert regular["radius_mean"] < regular["diagonal_mean"] <= regular["diagonal_max"] <= 1
    _, second, said = outcome("centres", tmp_path, options + " centroidal-transport")
    assert second[:2] == first and second[2]["placement"] == "centroidal-transport"
    assert "regular" not in said
