"""Tests of benchmarks/time_to_quality.py from end to end, and of its rival, Instant NGP."""

import dataclasses
import itertools
import re
from pathlib import Path

import pytest
import torch
from helpers import read_json, script

from voronerf.app.scenes import builtin_scene
from voronerf.app.train.config import ConfigError

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def test_sides_train_for_the_same_time(tmp_path):
    sides = ["cells: --cells 4", "one network: --cells", "grid: --centres uniform --occupancy --cells 2", "rival: ngp"]
    sides[-1] += " --batch 256 --resolution 8 --levels 2 --log2-entries 10 --samples 8"
    path = tmp_path / "outcome.json"
    options = "--downscale 10 --budget 0.09 --turn 0.03 --evaluations 3 --eval-views 1 --seeds 2 --clock cpu"
    common = "--common=--rays 64 --samples 8 --width 8 --depth 2 --cells 3"
    said = script(BENCHMARKS / "time_to_quality.py", *options.split(), common, "--sides", *sides, "--json", path)
    result = read_json(path)
    assert result["metadata"]["benchmark"] == "time_to_quality" and result["metadata"]["clock"] == "cpu"
    assert [(row["side"], row["seed"]) for row in result["results"]] == [
        (side.split(":")[0], seed) for side in sides for seed in (0, 1)
    ]
    assert [row["settings"].get("cells") for row in result["results"][::2]] == [[4], [], [2], None]
    for row in result["results"]:
        assert row["steps"] > 0 and row["curve"][-1]["seconds"] >= 0.08 and row["curve"][-1]["psnr"] == row["psnr"]
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
            weight = (1 - (places.floor() + torch.tensor(corner) - places).abs()).prod()
            expected[n, level] += weight * field.table[entry]
    torch.testing.assert_close(field.encode(positions), expected.view(20, 4), rtol=1e-4, atol=1e-5)
    gradient = torch.rand(20, 4)
    outs = field.encode(positions), expected.view(20, 4)
    found, right = (torch.autograd.grad(out, field.table, gradient)[0] for out in outs)
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
