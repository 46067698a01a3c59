"""Tests of `open_run`: a trained run is opened again."""

from __future__ import annotations

import os
import shutil
import sys
from dataclasses import replace

import pytest
import torch
from helpers import read_json, refuses, trained

from voronerf.app import open_run
from voronerf.app.scenes import builtin_scene
from voronerf.app.train.checkpoint import CheckpointError
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.nerf import turntable_cameras

SIZE = {"field": "nerf", "occupancy": False, "width": 8, "depth": 1, "rays": 64, "samples": (8,)}
SIZE |= {"evaluations": 1, "eval_views": 3}


@pytest.fixture(scope="module")
def scene():
    return builtin_scene(16, train_views=6, test_views=3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, scene):
    out = tmp_path_factory.mktemp("run")
    trained(TrainConfig(out=out, steps=20, cells=(4,), **SIZE), scene)
    return out


def test_a_run_is_what_was_trained(folder, scene) -> None:
    summary, run = read_json(folder / "summary.json"), open_run(str(folder), scene=scene)
    assert run.path == folder and run.config == TrainConfig.from_values(read_json(folder / "config.json"))
    assert run.diagram is run.router.diagram and run.renderer.field is run.router and run.diagram.num_cells == 4
    scores = run.evaluate(lpips="off")
    assert {name: scores[name] for name in ("psnr", "ssim")} == {name: summary[name] for name in ("psnr", "ssim")}
    assert [view["name"] for view in scores["views"]] == list(scene.test.names)
    assert len(run.evaluate(views=2, lpips="off")["views"]) == 2
    refuses("views must be at least 1, got 0", run.evaluate, views=0, lpips="off", error=ConfigError)


def test_any_camera_is_rendered(folder, scene) -> None:
    run = open_run(folder, scene=scene)
    first, picture = run.render(0), run.render(1)
    assert picture.colour.shape == (16, 16, 3) and picture.depth.shape == picture.opacity.shape == (16, 16)
    assert not torch.equal(first.colour, picture.colour) and not picture.colour.requires_grad
    assert torch.equal(run.render(scene.test.cameras, 1).colour, picture.colour)
    around = turntable_cameras(scene.train.cameras, 3)
    assert not torch.equal(run.render(around).colour, run.render(around, 2).colour)
    for camera, index in ((3, 0), (-1, 0), (around, 3)):
        with pytest.raises(IndexError, match=r"render: there are 3 cameras, got number (3|-1)"):
            run.render(camera, index)


def test_an_opened_run_needs_its_files_no_longer(folder, scene, tmp_path) -> None:
    """Reading a mapped page of a file that was cut short would end the process by SIGBUS."""
    out = shutil.copytree(folder, tmp_path / "run")
    run, expected = open_run(out, scene=scene), open_run(folder, scene=scene).render(0)
    for path in out.rglob("*.*"):
        os.truncate(path, 0)
    assert torch.equal(run.render(0).colour, expected.colour)


def test_how_a_run_is_rendered_may_differ(folder, scene, monkeypatch) -> None:
    monkeypatch.setattr(sys.modules["voronerf.app.train.build"], "PICTURE_RESOLUTION", 24)  # to save time
    other = open_run(folder, scene=scene, samples=(5,), occupancy=True, backend="reference")
    assert other.renderer.sampler.samples == 5
    assert {other.renderer.backend, other.router.backend} == {"reference"}
    assert other.renderer.occupancy is not None and open_run(folder, scene=scene).renderer.occupancy is None
    smaller = open_run(folder, data="builtin", downscale=10)
    assert smaller.config.downscale == 10 and smaller.render(0).opacity.shape == (10, 10)


def test_what_cannot_be_opened(folder, scene, tmp_path) -> None:
    refuses("there is no checkpoint in it", open_run, tmp_path, scene=scene, error=CheckpointError)
    refuses(
        "--device must be auto, cpu or cuda, got 'meta'",
        open_run,
        folder,
        scene=scene,
        device="meta",
        error=ConfigError,
    )
    with pytest.raises(ConfigError, match="--occupancy needs a scene with a box or --contraction"):
        open_run(folder, scene=replace(scene, box=None), occupancy=True)
