"""Settings: every rule has its message, and JSON gives back what went in."""

import dataclasses
from pathlib import Path

import pytest
from helpers import refuses

from voronerf.app.train.config import CHOICES, RESUMABLE, ConfigError, TrainConfig, differences
from voronerf.app.train.config_checks import check_device


@pytest.mark.parametrize(
    ("cells", "expected"), [((), ()), ((4,), (0.2,)), ((4, 4), (0.15, 0.5)), ((2, 2, 2), (0.15, 0.325, 0.5))]
)
def test_default_splits(cells, expected):
    assert TrainConfig().budget == 480 and TrainConfig().splits == (0.2,)
    assert TrainConfig(cells=cells).splits == pytest.approx(expected)


def test_json_round_trip(tmp_path):
    config = TrainConfig(data="x", out=tmp_path, field="nerf", steps=3, cells=(4, 4), split_at=(0.2, 0.7))
    assert TrainConfig.from_json(config.to_json()) == config
    config = dataclasses.replace(config, split_at=None, split_at_steps=(1, 2), lpips=tmp_path, parameters=5000)
    assert TrainConfig.from_json(config.to_json()) == config
    assert TrainConfig.from_json(TrainConfig().to_json()) == TrainConfig()


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"out": null, "colour": 3}', '{"out": 3}'])
def test_json_of_something_else(text):
    with pytest.raises(ConfigError, match=r"run/config.json: not a configuration of this version"):
        TrainConfig.from_json(text, "run/config.json")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"budget": 3.0, "steps": 3}, "give --budget SECONDS or --steps N, not both"),
        ({"budget": 0.0}, "--budget must be a positive number of seconds, got 0.0"),
        ({"budget": float("nan")}, "--budget must be a positive number of seconds, got nan"),
        ({"steps": 0}, "--steps must be at least 1, got 0"),
        ({"downscale": 0}, "--downscale must be at least 1, got 0"),
        ({"rays": 0}, "--rays must be at least 1, got 0"),
        ({"ray_growth": 17.0}, "--ray-growth must lie in 1..16, got 17.0"),
        ({"width": 1}, "--width must be at least 2, got 1"),
        ({"lr": 0.0}, "--lr must be positive, got 0.0"),
        ({"lr_hold": 1.0}, r"--lr-hold must lie in \[0, 1\), got 1.0"),
        ({"lr_final": 2.0}, r"--lr-final must lie in \(0, 1\], got 2.0"),
        ({"average": 1.0}, r"--average must lie in \[0, 1\), got 1.0"),
        ({"cells": (0,)}, r"--cells must be at least 2 on every level \(none for one network\), got \(0,\)"),
        ({"cells": (4,), "split_at": (0.2, 0.4)}, "--split-at must have one fraction for each of the 1 levels"),
        ({"cells": (4, 4), "split_at": (0.4, 0.2)}, "--split-at must be rising fractions between 0 and 1"),
        ({"split_at": (1.0,)}, "--split-at must be rising fractions between 0 and 1"),
        ({"split_at_steps": (7,), "steps": 7}, r"--split-at-steps must be rising numbers between 0 and 7, got \(7,\)"),
        ({"split_at_steps": (7, 8)}, "--split-at-steps must have one number for each of the 1 levels of --cells"),
        ({"split_at": (0.1,), "split_at_steps": (7,)}, "give --split-at or --split-at-steps, not both"),
        ({"max_cells": 32}, "--max-cells must come with --split worst, got 32"),
        ({"max_cells": 16, "split": "worst"}, "--max-cells must exceed the 16 cells of the first split, got 16"),
        ({"max_cells": 9, "split": "worst", "cells": (2, 2, 2)}, "--max-cells must come with one or two numbers of"),
        ({"max_cells": 9, "split": "worst", "cells": (2,), "split_at": (0.1,)}, "--split-at must have two fractions, "),
        ({"parameters": 0}, "--parameters must be at least 1, got 0"),
        ({"fine_samples": 0}, "--fine-samples must be at least 1, got 0"),
        ({"field": "mip-nerf"}, "--field must be nerf, mipnerf, kilonerf or hashgrid, got 'mip-nerf'"),
        ({"sampling": "hierachical"}, "--sampling must be stratified, hierarchical or proposal, got 'hierachical'"),
        ({"init": "inherited"}, "--init must be inherit or random, got 'inherited'"),
        ({"background": None}, "--background must be random or white, got None"),
        ({"backend": "fast"}, "--backend must be auto, .*got 'fast'"),
        ({"eval_views": 0}, "--eval-views must be at least 1, got 0"),
        ({"temperature": -1.0}, "--temperature must be positive and finite, got -1.0"),
        ({"temperature": float("inf")}, "--temperature must be positive and finite, got inf"),
        ({"seed": 10**22}, r"--seed must lie in 0\.\.2\^63 - 1"),
        ({"cells": (20_000,)}, r"--cells must not exceed --reservoir, the 10000 samples of a split, got \(20000,\)"),
    ],
)
def test_bad_settings(settings, message):
    with pytest.raises(ConfigError, match=message):
        TrainConfig(**settings)


def test_every_choice_of_words_is_checked():
    names = "format kind images split centres init assignment contraction precision background"
    assert set(CHOICES) == set(names.split())
    for name in CHOICES:
        with pytest.raises(ConfigError, match=f"--{name} must be .* or .*, got 'nonsense'"):
            TrainConfig(**{name: "nonsense"})


@pytest.mark.parametrize(
    ("name", "rule"),
    [(name, "be cpu or cuda") for name in ("meta", "mps")]
    + [(name, "name a device that is present") for name in ("gpu7", "cuda:99")],
)
def test_a_device_that_is_not_there(name, rule):
    refuses(f"--device must {rule}, got '{name}'", check_device, name, error=ConfigError)


def test_defaults_of_the_architectures():
    """Wide networks learn slower."""
    for settings, expected in (
        ({}, (32, 1, 0.02)),
        ({"field": "nerf"}, (64, 4, 0.02)),
        ({"field": "kilonerf"}, (32, 2, 0.02)),
        ({"field": "kilonerf", "width": 48, "depth": 3}, (48, 3, 0.02)),
        ({"field": "nerf", "width": 16}, (16, 4, 0.02)),
        ({"field": "nerf", "width": 256}, (256, 4, 0.005)),
        ({"field": "nerf", "width": 256, "lr": 0.3}, (256, 4, 0.3)),
    ):
        config = TrainConfig(**settings)
        assert (config.width, config.depth, config.lr) == pytest.approx(expected)


def test_differences_name_what_cannot_change():
    assert {f.name for f in dataclasses.fields(TrainConfig)} >= RESUMABLE
    a = TrainConfig(steps=10)
    assert differences(a, dataclasses.replace(a, steps=20, out=Path("x"), resume=True)) == []
    changed = dataclasses.replace(a, width=64, lr_final=0.5)
    assert differences(a, changed) == ["--width 32 -> 64", "--lr-final 0.05 -> 0.5"]


def test_final_cells():
    assert [TrainConfig(cells=cells).final_cells for cells in ((), (12,), (4, 4))] == [1, 12, 16]
    assert TrainConfig(cells=(4, 3), split="worst").final_cells == 6
    assert TrainConfig(cells=(4, 3), split="worst", max_cells=15).final_cells == 15


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"cells": (4, 3)}, [(0.15, 4, "all"), (0.5, 3, "all")]),
        ({"cells": (4, 3), "split_at_steps": (5, 9)}, [(5, 4, "all"), (9, 3, "all")]),
        (
            {"cells": (4, 3), "split": "worst", "max_cells": 9, "split_at_steps": (20, 50)},
            [(20, 4, "all"), (30, 3, "worst"), (40, 3, "worst"), (50, 3, "worst")],
        ),
        ({"cells": (4,), "split": "worst", "max_cells": 5}, [(0.15, 4, "all"), (0.5, 4, "worst")]),
    ],
)
def test_planned_splits(settings, expected):
    plan = TrainConfig(**settings).planned_splits
    assert [(round(p.at, 9), p.children, p.cells) for p in plan] == expected
    assert all(p.most == settings.get("max_cells") for p in plan if p.cells == "worst")
