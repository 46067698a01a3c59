"""Scripts of benchmarks/ from end to end: occupancy.py on a run that is there, balance.py, centres.py and others."""

import dataclasses
import itertools
import re
from pathlib import Path

import noisy_neighbour
import pytest
import torch
from helpers import read_json, script

from voronerf.data import builtin_scene
from voronerf.training.config import ConfigError, TrainConfig
from voronerf.training.trainer import Trainer

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def outcome(name, folder, options):
    """Metadata, results and what was printed."""
    path = folder / "results" / "outcome.json"
    said = script(BENCHMARKS / f"{name}.py", *options.split(), "--json", path)
    found = read_json(path)
    assert found["metadata"]["benchmark"] == name
    return found["metadata"], found["results"], said


def test_pictures_of_a_trained_run(tmp_path):
    config = TrainConfig(
        out=tmp_path / "run",
        steps=4,
        field="nerf",
        occupancy=False,
        cells=(),
        width=8,
        depth=2,
        rays=64,
        samples=8,
        final_views=1,
    )
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
    options = "--cells 2 --width 16 --rays 64 --samples 8 --warm 5 --steps 2 --field mipnerf --sampling hierarchical"
    about, rows, _ = outcome("step_profile", tmp_path, options)
    settings = {"cells": 2, "rays": 64, "field": "mipnerf", "sampling": "hierarchical", "width": 16, "samples": 8}
    assert about["step_ms"] > 0 and {name: about[name] for name in settings} == settings
    parts = {row["part"]: row["ms"] for row in rows if "part" in row}
    assert all(parts[part] > 0 for part in ("batch", "cells", "forward", "backward", "loss", "PyTorch and Python"))
    assert sum(parts.values()) == pytest.approx(about["processor_ms"])
    assert any("aten::" in row.get("operator", "") for row in rows)


def test_a_noisy_neighbour_is_compared_with_the_turn_before():
    turns = [[(8.0, 7.0), (10.0, 6.0), (40.0, 9.0)], [(12.0, 7.0), (20.0, 6.0), (60.0, 9.0)]]
    quiet, noisy = ([{"ms": ms, "cpu_ms": cpu, "others": 0.5} for ms, cpu in some] for some in turns)
    found = {("sleep", 0): quiet, ("sleep", 1): noisy}
    row = noisy_neighbour.row(found, "sleep", 1, cores=4, threads=4)
    assert row == {
        "step_ms": 20.0, "least_step_ms": 12.0, "cpu_ms": 7.0, "times_alone": 1.5, "fair": 1.25, "others": 0.5
    }  # fmt: skip
    assert noisy_neighbour.row(found, "sleep", 1, cores=4, threads=3)["fair"] == 1.0  # a core is left


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
    assert not re.search("^builtin .* regular", said, re.MULTILINE)
    gains = [row["psnr"] - first[0]["psnr"] for row in second]
    texts = [f"{gain:+.2f} ({gain:+.2f} to {gain:+.2f})" for gain in gains[1:]]
    assert f"| builtin, nerf, 3x2 cells | {texts[1]} | {texts[0]} |" in said  # centroidal-transport, regular


def test_defaults_make_only_the_columns_that_are_missing(tmp_path):
    path = tmp_path / "defaults.json"
    sides = ("default: --rays 32 --samples 8", "more: --rays 64 --samples 8")
    options = ("--budget", "0.2", "--eval-views", "1", "--json", path, "--sides", *sides)
    options += ("--scenes", "builtin", "--downscale", "10", "--variants", "narrow: --width 16")
    script(BENCHMARKS / "defaults.py", *options)
    first = read_json(path)["results"]
    assert [(row["scene"], row["downscale"], row["side"], len(row["psnr"])) for row in first] == [
        ("builtin", 10, "default", 2),
        ("builtin", 10, "more", 2),
    ]
    said = script(BENCHMARKS / "defaults.py", *options, "wide: --width 64")
    rows = read_json(path)["results"]
    assert rows[:2] == first and [row["variant"] for row in rows[2:]] == ["wide: --width 64"] * 2
    gains = [[b - a for a, b in zip(*(row["psnr"] for row in pair))] for pair in (rows[:2], rows[2:])]
    means = [sum(at) / 2 for at in zip(*gains)]
    expected = [", ".join(f"{x:+.2f}" for x in pair) for pair in (*gains, means)]
    assert "|  | builtin / 10, narrow | builtin / 10, wide | mean |" in said
    assert f"| more | {' | '.join(expected)} |" in said


def test_sides_train_for_the_same_time(tmp_path):
    sides = ["cells: --cells 4", "one network: --cells", "grid: --centres uniform --occupancy --cells 2", "rival: ngp"]
    sides[-1] += " --batch 256 --resolution 8 --levels 2 --log2-entries 10 --samples 8"
    path = tmp_path / "outcome.json"
    options = "--downscale 10 --budget 0.3 --turn 0.1 --evaluations 3 --eval-views 1 --seeds 2 --clock cpu"
    common = "--common=--rays 64 --samples 8 --width 8 --depth 2 --cells 3"
    said = script(BENCHMARKS / "time_to_quality.py", *options.split(), common, "--sides", *sides, "--json", path)
    found = read_json(path)
    assert found["metadata"]["benchmark"] == "time_to_quality" and found["metadata"]["clock"] == "cpu"
    assert [(row["side"], row["seed"]) for row in found["results"]] == [
        (side.split(":")[0], seed) for side in sides for seed in (0, 1)
    ]
    assert [row["settings"].get("cells") for row in found["results"][::2]] == [[4], [], [2], None]
    for row in found["results"]:
        assert row["steps"] > 0 and row["curve"][-1]["seconds"] >= 0.29 and row["curve"][-1]["psnr"] == row["psnr"]
        assert row["seconds_to"]["32"] is None
    assert sum(line.startswith(tuple(f"| {side.split(':')[0]} |" for side in sides)) for line in said.splitlines()) == 4


@pytest.mark.parametrize(
    ("side", "message"),
    [
        ("cells", "--sides must be \"NAME: OPTIONS\", got 'cells'"),
        ("a: --seed 3", "--sides must not set --seed, got 'a: --seed 3'"),
        ("a: --steps 3", "--sides must not set --steps, got 'a: --steps 3'"),
    ],
)
def test_sides_that_cannot_be_compared(side, message):
    import time_to_quality

    with pytest.raises(ConfigError, match=re.escape(message)):
        time_to_quality.parse_side(side, "")


def test_seconds_to_a_quality():
    import time_to_quality

    curve = [{"seconds": s, "psnr": p} for s, p in ((5.0, 20.0), (10.0, 24.0), (15.0, 22.0), (20.0, 30.0))]
    found = [time_to_quality.seconds_to(quality, curve) for quality in (19, 23, 24, 26, 31)]
    assert found == [5.0, 8.75, 10.0, 17.5, None]


def test_the_rival_contracts_a_scene_without_a_box():
    import rival_ngp

    scene = dataclasses.replace(builtin_scene(8, train_views=3, test_views=1), box=None)
    config = rival_ngp.RivalConfig(levels=2, log2_entries=10, batch=512, samples=8)
    rival = rival_ngp.Rival(
        config, scene, budget=3, evaluations=1, eval_views=1, seed=0, clock=itertools.count().__next__
    )
    assert rival.run()["psnr"] > 0 and rival.step == 3 and rival.rays == 64


def test_the_rival_learns_and_its_encoding_is_the_published_one():
    import rival_ngp

    config = rival_ngp.RivalConfig(levels=2, log2_entries=10, base=8, finest=40, batch=512, resolution=16, samples=16)
    field = rival_ngp.NGP(config, 40)
    field.table.data.normal_()
    positions, expected = torch.rand(20, 3), torch.zeros(20, 2, 2)
    for n, level in itertools.product(range(20), range(2)):
        places = positions[n] * (8, 40)[level]
        for corner in itertools.product((0, 1), repeat=3):
            x, y, z = (places.floor().long() + torch.tensor(corner)).tolist()
            entry = (x ^ y * 2654435761 ^ z * 805459861) % 1024 + 1024 * level
            expected[n, level] += (1 - (places.floor() + torch.tensor(corner) - places).abs()).prod() * field.table[
                entry
            ]
    torch.testing.assert_close(field.encode(positions), expected.view(20, 4), rtol=1e-4, atol=1e-5)
    gradient = torch.rand(20, 4)
    found, right = (
        torch.autograd.grad(out, field.table, gradient)[0] for out in (field.encode(positions), expected.view(20, 4))
    )
    torch.testing.assert_close(found, right, rtol=1e-4, atol=1e-5)

    ticks, scene = itertools.count(), builtin_scene(16, train_views=6, test_views=1)
    rival = rival_ngp.Rival(
        config, scene, budget=150, evaluations=15, eval_views=1, seed=0, clock=lambda: float(next(ticks))
    )
    rival.advance(75)
    assert rival.step == 75 and len(rival.metrics) == 7
    last = rival.run()
    assert rival.step == last["steps"] == 150 and last["psnr"] > rival.metrics[0]["psnr"] + 1
    assert not rival.occupied.all()


def test_tables_of_centres_and_defaults_are_those_of_the_programs():
    import centres
    import defaults

    for page, table, names in (
        ("centres", lambda found: centres.table(found["results"]), ("centres_lego_ship", "centres_builtin_rich")),
        ("defaults", defaults.table, ("defaults_second", "defaults_rays")),
        ("centres", defaults.table, ("cells", "quality")),
    ):
        text = (BENCHMARKS.parent / "docs" / f"{page}.md").read_text()
        for name in names:
            assert f"\n\n{table(read_json(BENCHMARKS / 'results' / f'{name}.json'))}\n\n" in text
