"""Tests of the nerfstudio model with stubs for the few nerfstudio classes that it uses.

The stubs have the interface of nerfstudio 1.1.5; `test_method.py` runs the model in nerfstudio itself.
"""

from __future__ import annotations

import dataclasses
import enum
import importlib
import sys
import types
from typing import Any

import pytest
import torch
from torch import nn

from voronerf.app.scenes import builtin_scene
from voronerf.nerf.adam import Adam
from voronerf.ops import forward_with_tape

pytestmark = pytest.mark.native
STEPS = 40


class Model(nn.Module):
    """A stub of nerfstudio.models.base_model.Model for training."""

    def __init__(self, config: Any, scene_box: Any, num_train_data: int, **kwargs: Any) -> None:
        super().__init__()
        self.config, self.scene_box, self.num_train_data, self.kwargs = config, scene_box, num_train_data, kwargs
        self.device = torch.device("cpu")
        self.populate_modules()

    def populate_modules(self) -> None:
        pass

    def forward(self, ray_bundle: Any) -> Any:
        return self.get_outputs(ray_bundle)


@dataclasses.dataclass
class ModelConfig:
    enable_collider: bool = True
    eval_num_rays_per_chunk: int = 4096


class Location(enum.Enum):
    BEFORE_TRAIN_ITERATION = 1
    AFTER_TRAIN_ITERATION = 2


@dataclasses.dataclass
class Callback:
    where_to_run: list[Location]
    func: Any
    update_every_num_iters: int


@dataclasses.dataclass
class Bundle:
    origins: torch.Tensor
    directions: torch.Tensor
    pixel_area: torch.Tensor | None = None
    nears: torch.Tensor | None = None
    fars: torch.Tensor | None = None


@pytest.fixture
def model_module(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module `voronerf.app.nerfstudio.model`, imported with the stubs."""
    names: dict[str, dict[str, Any]] = {
        "": {},
        "cameras": {},
        "cameras.rays": {"RayBundle": Bundle},
        "cameras.cameras": {"Cameras": object},
        "engine": {},
        "engine.callbacks": {
            "TrainingCallback": Callback,
            "TrainingCallbackAttributes": object,
            "TrainingCallbackLocation": Location,
        },
        "model_components": {"renderers": types.SimpleNamespace(BACKGROUND_COLOR_OVERRIDE=None)},
        "models": {},
        "models.base_model": {"Model": Model, "ModelConfig": ModelConfig},
        "utils": {"colormaps": None},
        "utils.rich_utils": {"CONSOLE": types.SimpleNamespace(log=lambda line: None)},
    }
    for name, members in names.items():
        full = ".".join(["nerfstudio", *filter(None, [name])])
        module = types.ModuleType(full)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, full, module)
    for name in ("model", "scene"):
        monkeypatch.delitem(sys.modules, f"voronerf.app.nerfstudio.{name}", raising=False)
    yield importlib.import_module("voronerf.app.nerfstudio.model")
    for name in ("model", "scene"):
        sys.modules.pop(f"voronerf.app.nerfstudio.{name}", None)


def test_a_step_is_one_operation_and_learns(model_module: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    scene = builtin_scene(20)
    views = scene.train.cameras
    assert scene.box is not None

    class Cameras:
        camera_to_worlds = views.poses[:, :3]
        fx, fy, cx, cy = (views.intrinsics[:, i : i + 1] for i in range(4))
        width, height = torch.tensor([views.width]), torch.tensor([views.height])

        def __len__(self) -> int:
            return len(views)

    config = model_module.VoronerfModelConfig(
        cells=(4,), split_at=(0.5,), samples=(24,), field_options=("log2_entries=10", "levels=2")
    )
    box = types.SimpleNamespace(aabb=scene.box)
    metadata = {"cameras": Cameras(), "background": torch.ones(3)}
    model = model_module.VoronerfModel(config, box, len(views), metadata=metadata, device="cpu").train()
    assert "loss: networks, colours, loss and gradients in one operation, on the native" in model.ray_loss.explain()
    calls = []
    evaluate, name = forward_with_tape, "voronerf.nerf.loss.forward_with_tape"
    monkeypatch.setattr(name, lambda *given, **rule: calls.append(len(calls)) or evaluate(*given, **rule))
    groups = model.get_param_groups()
    optimizers = {name: Adam([{"params": p, "sparse": name == "tables"}], lr=0.02) for name, p in groups.items()}
    trainer = types.SimpleNamespace(config=types.SimpleNamespace(max_num_iterations=STEPS))
    attributes = types.SimpleNamespace(trainer=trainer, optimizers=types.SimpleNamespace(optimizers=optimizers))
    before, after = model.get_training_callbacks(attributes)
    assert before.where_to_run == [Location.BEFORE_TRAIN_ITERATION]
    losses = []
    for step in range(STEPS):
        before.func(step)
        image = int(torch.randint(len(views), ()))
        pixels = torch.randint(views.width * views.height, (128,))
        rays = views.image_rays(image)
        batch = {"image": scene.train.images[image].reshape(-1, 4)[pixels].float() / 255}
        outputs = model(Bundle(rays.origins[pixels], rays.directions[pixels]))
        metrics = model.get_metrics_dict(outputs, batch)  # nerfstudio computes metrics first
        loss = model.get_loss_dict(outputs, batch, metrics)["rgb_loss"]
        for optimizer in optimizers.values():
            optimizer.zero_grad()
        loss.backward()
        assert all(p.grad is not None for group in groups.values() for p in group)
        for optimizer in optimizers.values():
            optimizer.step()
        after.func(step)
        losses.append(float(loss.detach()))
        assert len(calls) == step + 1  # metrics and loss share one evaluation
    assert model.num_cells == 4 and int(metrics["cells"]) == 4
    assert sum(losses[-8:]) < 0.7 * sum(losses[:8])
