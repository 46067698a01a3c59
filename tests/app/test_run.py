"""A trained run, opened again."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers import refuses

from voronerf import open_run
from voronerf.app.scenes import builtin_scene
from voronerf.app.train.checkpoint import CheckpointError
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.train.trainer import Trainer
from voronerf.nerf import turntable_cameras

SIZE = {
    "field": "nerf",
    "occupancy": False,
    "width": 8,
    "depth": 1,
    "rays": 64,
    "samples": 8,
    "evaluations": 1,
    "reservoir": 400,
    "reservoir_batches": 10,
}


@pytest.fixture(scope="module")
def scene():
    return builtin_scene(16, train_views=6, test_views=3)


@pytest.fixture(scope="module")
def trained(tmp_path_factory, scene):
    folder = tmp_path_factory.mktemp("run")
    trainer = Trainer(TrainConfig(out=folder, steps=20, cells=(4,), **SIZE), scene)
    return trainer, trainer.run()


def test_a_run_is_what_was_trained(trained, scene) -> None:
    trainer, summary = trained
    run = open_run(str(trainer.out), scene=scene)
    assert (run.config, run.path) == (trainer.config, trainer.out)
    assert run.router is run.routers["field"] and run.diagram is run.router.diagram and run.renderer.field is run.router
    assert torch.equal(run.diagram.centres, trainer.router.diagram.centres)
    scores = run.evaluate(lpips="off")
    assert {name: scores[name] for name in ("psnr", "ssim")} == {name: summary[name] for name in ("psnr", "ssim")}
    assert [view["name"] for view in scores["views"]] == list(scene.test.names)
    assert len(run.evaluate(views=2, lpips="off")["views"]) == 2


def test_any_camera_is_rendered(trained, scene) -> None:
    run = open_run(trained[0].out, scene=scene)
    first, picture = run.render(0), run.render(1)
    assert picture.colour.shape == (16, 16, 3) and picture.depth.shape == picture.opacity.shape == (16, 16)
    assert not torch.equal(first.colour, picture.colour) and not picture.colour.requires_grad
    assert torch.equal(run.render(scene.test.cameras, 1).colour, picture.colour)
    around = turntable_cameras(scene.train.cameras, 3)
    assert not torch.equal(run.render(around).colour, run.render(around, 2).colour)
    for camera, index in ((3, 0), (-1, 0), (around, 3)):
        with pytest.raises(IndexError, match=r"render: there are 3 cameras, got number (3|-1)"):
            run.render(camera, index)


def mappings(folder):
    """Start, end and bytes in memory of their own (not pages of the file) of each mapped file in a folder."""
    if sys.platform != "linux":
        pytest.skip("asks Linux what memory holds")
    lines = Path("/proc/self/smaps").read_text()
    found = re.findall(r"^(\w+)-(\w+) .*?(/\S+)?$((?:\n[A-Z]\w+:.*)+)", lines, re.MULTILINE)
    return [
        (int(start, 16), int(end, 16), 1024 * int(re.search(r"Anonymous:\s+(\d+)", rest)[1]))
        for start, end, path, rest in found
        if path.startswith(str(folder))
    ]


def test_networks_stay_in_their_file(scene, tmp_path) -> None:
    size = SIZE | {"width": 320, "depth": 3, "min_cell_samples": 1, "final_views": 1, "average": 0.0}
    trainer = Trainer(TrainConfig(out=tmp_path, steps=2, cells=(8,), split_at_steps=(1,), **size), scene)
    trainer.run()
    run = open_run(tmp_path, scene=scene)
    assert run.diagram.num_cells == 8
    run.render(0)
    mapped = mappings(tmp_path)
    assert (
        mapped and sum(copied for _, _, copied in mapped) < 2 * trainer.parameter_count
    )  # half of the networks' bytes
    for parameter in run.router.parameters():
        assert any(start <= parameter.data_ptr() < end for start, end, _ in mapped)


def test_how_a_run_is_rendered_may_differ(trained, scene) -> None:
    folder = trained[0].out
    other = open_run(folder, scene=scene, samples=5, occupancy=True, backend="reference")
    assert other.renderer.sampler.samples == 5
    assert {other.renderer.backend, other.router.backend} == {"reference"}
    assert other.renderer.occupancy is not None and open_run(folder, scene=scene).renderer.occupancy is None
    smaller = open_run(folder, data="builtin", downscale=10)
    assert smaller.config.downscale == 10 and smaller.render(0).opacity.shape == (10, 10)


def test_what_cannot_be_opened(trained, scene, tmp_path) -> None:
    folder = trained[0].out
    refuses("last.safetensors: there is no checkpoint", open_run, tmp_path, scene=scene, error=CheckpointError)
    refuses("--device must be cpu or cuda, got 'meta'", open_run, folder, scene=scene, device="meta", error=ConfigError)
    with pytest.raises(ConfigError, match="--occupancy needs a scene with a box or --contraction"):
        open_run(folder, scene=replace(scene, box=None), occupancy=True)
