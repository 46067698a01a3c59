"""Tests of the settings: every rule has its message, and settings survive a JSON round trip."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from helpers import refuses
from tiny_runs import small

from voronerf.app.train.build import build, present_device
from voronerf.app.train.config import CHOICES, RESUMABLE, ConfigError, TrainConfig, differences
from voronerf.app.train.defaults import PEAK, machine_speed, resolve
from voronerf.nerf import Cameras


@pytest.mark.parametrize(
    ("cells", "expected"), [((), ()), ((4,), (0.2,)), ((4, 4), (0.15, 0.5)), ((2, 2, 2), (0.15, 0.325, 0.5))]
)
def test_default_splits(cells, expected):
    assert TrainConfig().budget == 480
    assert tuple(split.at for split in TrainConfig(cells=cells).plan) == pytest.approx(expected)


def test_json_round_trip(tmp_path):
    config = TrainConfig(data="x", out=tmp_path, field="nerf", steps=3, cells=(4, 4), split_at=(0.2, 0.7))
    assert TrainConfig.from_values(json.loads(config.to_json())) == config
    config = dataclasses.replace(config, split_at=(1, 2), steps=5, lpips=tmp_path, parameters=5000)
    assert TrainConfig.from_values(json.loads(config.to_json())) == config
    assert TrainConfig.from_values(TrainConfig().to_values()) == TrainConfig()


@pytest.mark.parametrize("values", [None, [], {}, {"out": None, "colour": 3}, {"out": 3}])
def test_values_of_something_else(values):
    with pytest.raises(ConfigError, match=r"run/config.json: not a configuration of this version"):
        TrainConfig.from_values(values, "run/config.json")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"budget": 3.0, "steps": 3}, "give --budget SECONDS or --steps N, not both"),
        ({"budget": 0.0}, "--budget must be a positive number of seconds, got 0$"),
        ({"budget": float("nan")}, "--budget must be a positive number of seconds, got nan"),
        ({"steps": 0}, r"--steps must lie in 1\.\.2\^53 - 1, got 0"),
        ({"steps": 2**70}, r"--steps must lie in 1\.\.2\^53 - 1, got "),
        ({"downscale": 0}, "--downscale must be at least 1, got 0"),
        ({"rays": 0}, "--rays must be at least 1, got 0"),
        ({"width": 1}, "--width must be at least 2 and at most 65536, got 1"),
        ({"width": 10**400}, "--width must be at least 2 and at most 65536, got 1000"),
        ({"lr": 0.0}, "--lr must be a positive number, got 0$"),
        ({"average": 1.0}, r"--average must lie in \[0, 1\), got 1$"),
        ({"cells": (0,)}, r"--cells must lie in 2..10000 on every level \(none for one network\), got 0$"),
        ({"cells": (20_000,)}, r"--cells must lie in 2..10000 on every level .*, got 20000$"),
        ({"cells": (4,), "split_at": (0.2, 0.4)}, "--split-at must have 1 times, one for each level of --cells"),
        (
            {"cells": (4, 4), "split_at": (0.4, 0.2)},
            "--split-at must be rising fractions of the run, or .*, got 0.4 0.2$",
        ),
        ({"cells": (4, 4), "split_at": (0.4, 20)}, "--split-at must be rising fractions of the run, or numbers of"),
        ({"split_at": (7,), "steps": 7}, r"--split-at must be rising .* numbers of steps below --steps 7, got 7$"),
        ({"max_cells": 16}, "--max-cells must exceed the 16 cells of the first split, got 16"),
        ({"max_cells": 9, "cells": (2, 2, 2)}, "--max-cells must come with one or two numbers of"),
        (
            {"max_cells": 9, "cells": (2,), "split_at": (0.1,)},
            "--split-at must have 2 times, one for each of the first",
        ),
        ({"parameters": 0}, "--parameters must be at least 1, got 0"),
        ({"samples": (0,)}, r"--samples must be one number of at least 1, got 0$"),
        (
            {"samples": (8,), "sampling": "hierarchical"},
            "--samples must be 2 numbers, one for each pass, of at least 1, got 8$",
        ),
        ({"sampling": "hierachical"}, "--sampling must be stratified or hierarchical, got 'hierachical'"),
        ({"init": "inherited"}, "--init must be inherit or random, got 'inherited'"),
        ({"backend": "fast"}, "--backend must be auto, .*got 'fast'"),
        ({"eval_views": 0}, "--eval-views must be at least 1, got 0"),
        ({"seed": 10**22}, r"--seed must lie in 0\.\.2\^63 - 1"),
        ({"sparse_depth": -1.0}, "--sparse-depth must be a factor of 0 or more, got -1$"),
    ],
)
def test_bad_settings(settings, message):
    with pytest.raises(ConfigError, match=message):
        TrainConfig(**settings)


def test_every_choice_of_words_is_checked():
    names = "format kind images centres init assignment contraction precision"
    assert set(CHOICES) == set(names.split())
    for name in CHOICES:
        with pytest.raises(ConfigError, match=f"--{name} must be .* or .*, got 'nonsense'"):
            TrainConfig(**{name: "nonsense"})


@pytest.mark.parametrize(
    ("name", "rule"),
    [(name, "be auto, cpu or cuda") for name in ("meta", "mps")]
    + [(name, "be auto, cpu or a GPU that is present") for name in ("gpu7", "cuda:99")],
)
def test_a_device_that_is_not_there(name, rule):
    refuses(f"--device must {rule}, got '{name}'", present_device, name, error=ConfigError)


@pytest.mark.parametrize(
    ("gpu", "backend", "device"), [(True, "native", "cuda"), (True, "reference", "cpu"), (False, "", "cpu")]
)
def test_auto_is_a_gpu_that_has_kernels(monkeypatch, gpu, backend, device):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    monkeypatch.setattr("voronerf.ops._core.backends.chosen", lambda *_: backend)
    assert present_device("auto") == device


def test_a_training_on_auto_keeps_the_device_that_it_has(scene):
    assert build(small(device="auto"), scene).config.device == present_device("auto")


def test_defaults_of_the_architectures(scene):
    """Each field has its default width and depth; networks of width 256 have a smaller learning rate."""
    for settings, expected in (
        ({}, (32, 1, 0.02)),
        ({"field": "nerf"}, (64, 4, 0.02)),
        ({"field": "kilonerf"}, (32, 2, 0.02)),
        ({"field": "kilonerf", "width": 48, "depth": 3}, (48, 3, 0.02)),
        ({"field": "nerf", "width": 16}, (16, 4, 0.02)),
        ({"field": "nerf", "width": 256}, (256, 4, 0.005)),
        ({"field": "nerf", "width": 256, "lr": 0.3}, (256, 4, 0.3)),
    ):
        config = resolve(TrainConfig(**settings), scene)
        assert (config.width, config.depth, config.lr) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("peak", "speed"), [(0.01, 1), (0.7, 1), (1.4, 1), (1.5, 2), (2.8, 2), (2.9, 4), (8, 8), (90, 64)]
)
def test_a_faster_machine_is_so_by_a_power_of_two(monkeypatch, peak, speed):
    """The speed is a power of two; slow or busy machines get the reference machine's speed."""
    monkeypatch.setattr("voronerf.ops._core.native.measure_peak", lambda kind: peak * PEAK)
    assert machine_speed() == speed
    monkeypatch.setattr("voronerf.ops._core.native.missing", lambda device: "not built")
    assert machine_speed() == 1


def test_differences_name_what_cannot_change():
    assert {f.name for f in dataclasses.fields(TrainConfig)} >= RESUMABLE
    a = TrainConfig(steps=10)
    assert differences(a, dataclasses.replace(a, steps=20, out=Path("x"))) == []
    changed = dataclasses.replace(a, width=64, average=0.5)
    assert differences(a, changed) == ["--width None -> 64", "--average 0.98 -> 0.5"]


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"cells": (4, 3)}, [(0.15, 4, "all"), (0.5, 3, "all")]),
        ({"cells": (4, 3), "split_at": (5, 9)}, [(5, 4, "all"), (9, 3, "all")]),
        (
            {"cells": (4, 3), "max_cells": 9, "split_at": (20, 50)},
            [(20, 4, "all"), (30, 3, "worst"), (40, 3, "worst"), (50, 3, "worst")],
        ),
        ({"cells": (4,), "max_cells": 5}, [(0.15, 4, "all"), (0.5, 4, "worst")]),
    ],
)
def test_plan(settings, expected):
    plan = TrainConfig(**settings).plan
    assert [(round(p.at, 9), p.children, p.cells) for p in plan] == expected
    assert all(p.max_cells == settings.get("max_cells") for p in plan if p.cells == "worst")


def test_there_are_at_most_38_settings():
    assert len(dataclasses.fields(TrainConfig)) <= 38


def test_long_trainings_of_objects_take_more_rays_a_step(scene):
    some = scene.train.cameras
    cameras = Cameras(some.poses, some.intrinsics * 400 / some.width, 400, 400)
    large = dataclasses.replace(scene, train=dataclasses.replace(scene.train, cameras=cameras))

    def rays(scene=scene, **settings):
        return resolve(TrainConfig(**settings), scene).rays

    # The box of the larger scene is about 350 pixels long.
    assert [rays(large, budget=seconds) for seconds in (60, 75, 180, 300)] == [512, 1024, 1024, 2048]
    short_to_long = [rays(budget=seconds) for seconds in (1, 39, 40, 159, 160, 640, 1e6)]
    assert short_to_long == [512, 512, 1024, 1024, 2048, 4096, 4096]
    assert resolve(TrainConfig(budget=40), scene, speed=4.0).rays == 2048
    assert rays(steps=10**6) == rays(budget=1e6, field="nerf") == rays(budget=1e6, contraction="sphere") == 512
    assert rays(budget=1e6, rays=100) == 100
