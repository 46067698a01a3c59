"""The training loop on a tiny built-in scene: stages, files, resume, ablations, and that it never dies."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from voronerf.data import Scene, builtin_scene
from voronerf.training.checkpoint import CheckpointError, load_checkpoint
from voronerf.training.config import TrainConfig
from voronerf.training.evaluation import evaluate, render_view
from voronerf.training.trainer import Trainer, TrainingError, checkpoint_path, load_run


@pytest.fixture(scope="module")
def scene() -> Scene:
    return builtin_scene(16)


def small(out: Path, **settings: Any) -> TrainConfig:
    defaults: dict[str, Any] = {
        "steps": 24,
        "cells": (4,),
        "split_at": (0.5,),
        "width": 8,
        "depth": 2,
        "rays": 64,
        "samples": 12,
        "reservoir": 400,
        "reservoir_batches": 10,
        "min_cell_samples": 8,
        "evaluations": 2,
        "eval_views": 2,
        "final_views": 2,
    }
    if "cells" in settings and "split_at" not in settings:
        settings["split_at"] = None
    return TrainConfig(out=out, **{**defaults, **settings})


def test_a_run_and_its_directory(tmp_path: Path, scene: Scene) -> None:
    lines: list[str] = []
    steps: list[int] = []
    trainer = Trainer(small(tmp_path), scene, on_event=lines.append, on_step=lambda p: steps.append(p.step))
    summary = trainer.run()
    assert steps == list(range(1, 25))
    assert summary == json.loads((tmp_path / "summary.json").read_text())
    assert summary["complete"] and summary["steps"] == 24 and summary["cells"] == 4
    assert summary["parameters"] == sum(p.numel() for p in trainer.router.parameters())
    assert summary["rays_per_second"] == pytest.approx(24 * 64 / summary["seconds"])
    coarse, local = summary["stages"]
    assert (coarse["cells"], coarse["started_at_second"], coarse["balance_before"]) == (1, 0, None)
    assert (local["cells"], local["started_at_step"], local["split_cells"]) == (4, 12, 1)
    assert local["balance_after"] < local["balance_before"]
    metrics = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [m["step"] for m in metrics] == [12, 24]
    assert metrics[-1]["psnr"] == summary["psnr"] and 0 < summary["ssim"] <= 1
    assert TrainConfig.from_json((tmp_path / "config.json").read_text()) == trainer.config
    assert (tmp_path / "samples" / "level-1.npz").is_file()
    assert len(lines) == 3


def test_training_learns(tmp_path: Path, scene: Scene) -> None:
    config = small(tmp_path, steps=150, rays=256, samples=24, width=32, evaluations=1)
    white = -10 * (scene.test.truth(0, torch.ones(3)) - 1).square().mean().log10()
    summary = Trainer(config, scene).run()
    assert summary["psnr"] > float(white) + 3


@pytest.mark.parametrize("background", ["white", "random"])
@pytest.mark.parametrize("seed", range(4))
def test_no_collapse_to_white(tmp_path: Path, scene: Scene, seed: int, background: str) -> None:
    """A NeRF that gives up paints every ray white; its opacity is then 0 and no gradient brings it back."""
    config = small(tmp_path, steps=100, seed=seed, rays=256, samples=24, width=32, cells=(), background=background)
    trainer = Trainer(config, scene)
    trainer.advance()
    image = render_view(trainer.router, scene, 0, samples=24, backend="auto")
    alpha = scene.test.images[0][..., 3].float() / 255
    assert image.opacity[alpha > 0.99].mean() > 0.5


def test_nested_levels_and_cells_too_small(tmp_path: Path, scene: Scene) -> None:
    summary = Trainer(small(tmp_path / "a", cells=(3, 3), steps=30), scene).run()
    assert [s["cells"] for s in summary["stages"]][:2] == [1, 3]
    assert summary["stages"][2]["cells"] == 3 + 2 * summary["stages"][2]["split_cells"]
    assert summary["stages"][2]["split_cells"] >= 2
    # No cell holds that many samples, so none is split on the second level, and training goes on.
    summary = Trainer(small(tmp_path / "b", cells=(3, 3), split_at=(0.5, 0.9), min_cell_samples=300), scene).run()
    assert [s["cells"] for s in summary["stages"]] == [1, 3, 3]
    assert summary["stages"][2]["balance_after"] is None


@pytest.mark.parametrize(
    "settings",
    [
        {"centres": "random"},
        {"centres": "uniform"},
        {"balance": "transport"},
        {"init": "random"},
        {"assignment": "stochastic"},
        {"cells": (3, 2), "split": "worst"},
        {"backend": "reference"},
        {"background": "white"},
        {"view_directions": False},
        {"cells": ()},
    ],
    ids=str,
)
def test_every_variant_of_the_paper_runs(tmp_path: Path, scene: Scene, settings: dict[str, Any]) -> None:
    summary = Trainer(small(tmp_path, **settings), scene).run()
    expected = {"(3, 2)": 4, "()": 1}.get(str(settings.get("cells")), 4)
    assert summary["cells"] == expected
    assert summary["psnr"] > 3


def tensors(run: Path) -> dict[str, torch.Tensor]:
    return load_checkpoint(checkpoint_path(run)).tensors


@pytest.mark.parametrize("stop_at", [5, 11, 17])
def test_resume_is_bit_for_bit(tmp_path: Path, scene: Scene, stop_at: int) -> None:
    whole = small(tmp_path / "whole", assignment="stochastic")
    Trainer(whole, scene).run()
    part = replace(whole, out=tmp_path / "part")
    first = Trainer(part, scene)
    first.on_step = lambda p: first.request_stop() if p.step == stop_at else None
    summary = first.run()
    assert not summary["complete"] and summary["steps"] == stop_at
    Trainer(replace(part, resume=True), scene).run()
    a, b = tensors(tmp_path / "whole"), tensors(tmp_path / "part")
    assert a.keys() == b.keys()
    assert [name for name in a if not torch.equal(a[name], b[name])] == []

    def scores(run: Path) -> list[tuple[int, float]]:
        lines = (run / "metrics.jsonl").read_text().splitlines()
        return [(m["step"], m["psnr"]) for m in map(json.loads, lines)]

    assert scores(tmp_path / "whole") == scores(tmp_path / "part")


def test_resume_drops_evaluations_made_after_the_checkpoint(tmp_path: Path, scene: Scene) -> None:
    config = small(tmp_path)
    trainer = Trainer(config, scene)
    trainer.on_step = lambda p: trainer.request_stop() if p.step == 14 else None
    trainer.run()
    with open(tmp_path / "metrics.jsonl", "a") as file:
        file.write(json.dumps({"step": 20, "psnr": 99.0}) + "\n")
    Trainer(replace(config, resume=True), scene).run()
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [12, 24]


def test_seeds_decide_everything(tmp_path: Path, scene: Scene) -> None:
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        Trainer(small(tmp_path / name, seed=seed), scene).run()
    a, b, c = (tensors(tmp_path / name) for name in "abc")
    assert all(torch.equal(a[name], b[name]) for name in a)
    assert not torch.equal(a["router.module.density.weight"], c["router.module.density.weight"])


def test_a_loaded_run_renders_the_same(tmp_path: Path, scene: Scene) -> None:
    trainer = Trainer(small(tmp_path, cells=(3, 2)), scene)
    trainer.run()
    config, router = load_run(tmp_path)
    assert config == trainer.config
    assert evaluate(router, scene, samples=12, views=2) == evaluate(trainer.router, scene, samples=12, views=2)


def test_another_configuration_is_refused(tmp_path: Path, scene: Scene) -> None:
    config = small(tmp_path)
    Trainer(config, scene).run()
    with pytest.raises(CheckpointError, match=r"a checkpoint of another configuration: --width 8 -> 16; --lr"):
        Trainer(replace(config, width=16, lr=1e-4, resume=True), scene)
    checkpoint = load_checkpoint(checkpoint_path(tmp_path))
    del checkpoint.tensors["router.module.density.weight"]
    with pytest.raises(CheckpointError, match="another architecture"):
        from voronerf.training.trainer import make_router, restore_router

        restore_router(make_router(config), checkpoint)


def test_a_loss_that_is_not_finite_stops_training(tmp_path: Path, scene: Scene) -> None:
    trainer = Trainer(small(tmp_path), scene)
    trainer.advance()
    trainer.save()
    before = tensors(tmp_path)
    with torch.no_grad():
        next(iter(trainer.router.parameters())).fill_(float("nan"))
    trainer.config = replace(trainer.config, steps=99, split_at=(0.01,))
    with pytest.raises(TrainingError, match=r"the loss is nan at step 25; the last checkpoint in .* is untouched"):
        trainer.run()
    after = tensors(tmp_path)
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_more_cells_than_samples(tmp_path: Path, scene: Scene) -> None:
    with pytest.raises(ValueError, match="more cells than samples"):
        Trainer(small(tmp_path, cells=(500,), min_cell_samples=0), scene).run()
