"""Tests of voronerf as a method of nerfstudio, in nerfstudio's trainer and pipeline, on a scene of a few pixels."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image
from torch import nn

pytest.importorskip("nerfstudio.plugins.types", reason="nerfstudio is not installed: pip install voronerf[nerfstudio]")

from nerfstudio.configs.method_configs import all_methods
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.models.nerfacto import NerfactoModelConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig

from voronerf import VoronoiRouter
from voronerf.app.nerfstudio.method import method
from voronerf.app.nerfstudio.model import VoronerfModel, VoronerfModelConfig
from voronerf.app.scenes import load_scene
from voronerf.app.train.config import ConfigError

STEPS = 12
SMALL = ("log2_entries=10", "levels=2")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the built-in scene at 10 x 10 pixels, in the format of nerfstudio's parser for Blender scenes."""
    path = tmp_path_factory.mktemp("scene")
    scene = load_scene("builtin", downscale=10)
    for split, views in (("train", scene.train), ("val", scene.test), ("test", scene.test)):
        frames = []
        for i in range(3):
            Image.fromarray(views.images[i].numpy()).save(path / f"{split}{i}.png")
            frames.append({"file_path": f"./{split}{i}", "transform_matrix": views.cameras.poses[i].tolist()})
        focal = float(views.cameras.intrinsics[0, 0])
        angle = 2 * float(torch.tensor(views.cameras.width / 2 / focal).atan())
        (path / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    return path


@pytest.fixture(autouse=True)
def _no_download(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(VoronerfModel, "lpips", lambda self, a, b: torch.zeros(()))


def trainer_of(folder: Path, out: Path, *, load: Path | None = None, alpha: str | None = "white", **model: Any) -> Any:
    """Returns nerfstudio's trainer of the registered method."""
    config = copy.deepcopy(method.config)
    config.set_timestamp()
    config.output_dir, config.load_dir, config.vis = out, load, "tensorboard"
    config.max_num_iterations, config.steps_per_save, config.steps_per_eval_batch = STEPS, 100, 6
    config.steps_per_eval_image = 11
    config.machine.device_type = "cpu"
    config.logging.local_writer.enable = False
    data = config.pipeline.datamanager
    data.data, data.dataparser = folder, BlenderDataParserConfig(alpha_color=alpha)
    data.train_num_rays_per_batch = data.eval_num_rays_per_batch = 64
    config.pipeline.model = VoronerfModelConfig(**{"cells": (4,), "split_at": (0.5,), "samples": (48,), **model})
    trainer = config.setup()
    trainer.setup()
    return trainer


def test_it_is_registered() -> None:
    """nerfstudio finds the method by the entry point of the installed package; a plain checkout has none."""
    if "voronerf" not in all_methods:
        pytest.skip("voronerf is not installed here, only on the path")
    assert all_methods["voronerf"].pipeline.model == VoronerfModelConfig()


def test_it_trains_splits_evaluates_and_resumes(folder: Path, tmp_path: Path) -> None:
    trainer = trainer_of(folder, tmp_path, field_options=SMALL)
    model, optimizer = trainer.pipeline.model, trainer.optimizers.optimizers["fields"]
    parameters = list(model.get_param_groups()["fields"])
    before = model.num_cells
    trainer.train()
    assert (before, model.num_cells) == (1, 4)
    optimised = optimizer.param_groups[0]["params"]
    assert all(a is b and len(a) == 4 for a, b in zip(parameters, optimised, strict=True))
    assert all(optimizer.state[p]["exp_avg"].shape == p.shape for p in optimised)
    assert optimizer.param_groups[0]["lr"] == pytest.approx(0.001)  # the rate decays over the whole run
    scores = trainer.pipeline.get_average_eval_image_metrics()
    assert 5 < scores["psnr"] < 60 and 0 < scores["ssim"] <= 1

    again = trainer_of(folder, tmp_path, load=trainer.checkpoint_dir, field_options=SMALL)
    resumed = again.pipeline.model
    assert (again._start_step, resumed.num_cells) == (STEPS, 4)
    state, other = model.state_dict(), resumed.state_dict()
    extra, other_extra = state.pop("_extra_state"), other.pop("_extra_state")
    assert all(torch.equal(value, other[name]) for name, value in state.items())
    assert torch.equal(extra["occupancy"]["density"], other_extra["occupancy"]["density"])
    rays = trainer.pipeline.datamanager.eval_dataset.cameras[0:1]
    shown = [each.eval().get_outputs_for_camera(rays) for each in (model, resumed)]
    assert all(torch.equal(shown[0][name], shown[1][name]) for name in ("rgb", "depth", "accumulation", "cells"))
    again.train()
    assert resumed.num_cells == 4  # the cell had been split already


def test_a_training_that_ends_before_the_split_makes_it_when_it_is_resumed(folder: Path, tmp_path: Path) -> None:
    trainer = trainer_of(folder, tmp_path, field_options=SMALL, split_at=(0.99,))
    trainer.train()
    kept = len(trainer.pipeline.model.strategy.reservoir)
    again = trainer_of(folder, tmp_path, load=trainer.checkpoint_dir, field_options=SMALL, split_at=(0.99,))
    assert again.pipeline.model.num_cells == 1 and len(again.pipeline.model.strategy.reservoir) == kept > 0
    again.train()
    assert again.pipeline.model.num_cells == 4


@pytest.mark.parametrize(
    "model",
    [
        {"field": "nerf", "width": 8, "sampling": "hierarchical", "samples": (8, 8)},
        {"field": "mipnerf", "width": 8, "sampling": "hierarchical", "samples": (8, 8)},
        {"samples": (8,), "contraction": "sphere", "field_options": SMALL},
        {"occupancy": False, "samples": (8,), "field_options": SMALL},
    ],
    ids=lambda model: "-".join(map(str, model.values())),
)
def test_other_fields_and_samplers_train(folder: Path, tmp_path: Path, model: dict[str, Any]) -> None:
    trainer = trainer_of(folder, tmp_path, **model)
    trainer.train()
    assert trainer.pipeline.model.num_cells == 4


def test_transparent_images_lie_over_colours_that_are_drawn(folder: Path, tmp_path: Path) -> None:
    """An empty field has no loss where the image is transparent, for any drawn background colour."""
    trainer = trainer_of(folder, tmp_path, alpha=None, field_options=SMALL)
    model = trainer.pipeline.model
    bundle, batch = trainer.pipeline.datamanager.next_train(0)
    batch["image"] = torch.tensor((1.0, 0.5, 0.0, 0.0)).expand(len(bundle), 4)
    for parameter in model.routers["field"].module.density.parameters():
        nn.init.constant_(parameter, -50.0)
    assert float(model.get_loss_dict(model(bundle), batch)["rgb_loss"]) < 1e-4


def test_a_camera_inside_of_the_scene_box_sees_all_of_space(folder: Path, tmp_path: Path) -> None:
    cameras = trainer_of(folder, tmp_path, field_options=SMALL).pipeline.datamanager.train_dataset.cameras
    settings = []
    for size in (1.0, 10.0):
        box = SceneBox(torch.tensor(((-size,) * 3, (size,) * 3)))
        model = VoronerfModel(VoronerfModelConfig(), box, 3, metadata={"cameras": cameras}, device="cpu")
        settings.append((model.settings.contraction, model.settings.occupancy))
    assert settings == [("none", True), ("sphere", True)]


def test_wrong_settings_are_one_line(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--split-at"):
        trainer_of(folder, tmp_path, split_at=(0.2, 0.5))


def test_a_router_takes_the_place_of_nerfactos_field(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A router replaces the field of nerfacto's model, as docs/nerfstudio.md shows."""
    monkeypatch.setattr("torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity", lambda **_: None)
    sizes = {"num_levels": 2, "log2_hashmap_size": 8, "hidden_dim": 8, "hidden_dim_color": 8}
    sizes |= {"num_proposal_samples_per_ray": (8, 8), "num_nerf_samples_per_ray": 8}
    config = NerfactoModelConfig(implementation="torch", background_color="white", **sizes)
    data = VanillaDataManagerConfig(dataparser=BlenderDataParserConfig(data=folder), train_num_rays_per_batch=64)
    data.data = folder
    pipeline = VanillaPipelineConfig(datamanager=data, model=config).setup(device="cpu")
    model = pipeline.model
    bundle, _ = pipeline.datamanager.next_train(0)
    pipeline.eval()
    wanted = model(bundle)["rgb"]
    model.field = VoronoiRouter(
        model.field,
        torch.rand(4, 3) - 0.5,
        coords=lambda samples, *_, **__: samples.frustums.get_positions(),
        share=["*hash_table", "embedding_appearance.*"],
    )
    torch.testing.assert_close(model(bundle)["rgb"], wanted, rtol=1e-4, atol=1e-5)
    pipeline.train()
    optimizer = torch.optim.Adam(model.get_param_groups()["fields"], lr=0.01)
    losses = []
    for step in range(20):
        optimizer.zero_grad()
        loss = pipeline.get_train_loss_dict(step)[1]["rgb_loss"]
        loss.backward()
        optimizer.step()
        losses.append(float(loss))
    assert sum(losses[-4:]) < 0.9 * sum(losses[:4])
    assert model.field.explain().startswith("forward: grouped"), model.field.explain()
