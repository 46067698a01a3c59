"""The training loop on a tiny built-in scene: stages, files, resume, ablations, and that it never dies."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import voronerf.training.trainer as trainer_module
from voronerf.backends import BackendUnavailable
from voronerf.data import Scene, builtin_scene
from voronerf.evaluation.scores import evaluate, mean_scores, render_view
from voronerf.rendering.occupancy import OccupancyGrid
from voronerf.rendering.renderer import Renderer
from voronerf.training.batches import Batch
from voronerf.training.checkpoint import CheckpointError, load_checkpoint
from voronerf.training.config import ConfigError, TrainConfig
from voronerf.training.model import (
    checkpoint_path,
    count_parameters,
    load_grid,
    load_run,
    make_renderer,
    make_routers,
    octaves_for,
    resolve_config,
    restore_routers,
    solve_width,
)
from voronerf.training.runs import choose_directory, held
from voronerf.training.trainer import Trainer, TrainingError


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


def test_lpips_is_of_the_final_evaluation(tmp_path: Path, scene: Scene) -> None:
    trainer = Trainer(small(tmp_path), scene)
    assert trainer.lpips is None
    trainer.lpips = lambda image, truth: torch.tensor(0.25)
    summary = trainer.run()
    assert summary["lpips"] == 0.25 and summary["psnr_of_mean_error"] <= summary["psnr"]
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [line["lpips"] for line in lines] == [None, 0.25]
    assert lines[-1]["psnr_of_mean_error"] == summary["psnr_of_mean_error"]


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
    image = render_view(trainer.renderer, scene, 0)
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


def test_splits_that_never_come_are_told(tmp_path: Path, scene: Scene) -> None:
    lines: list[str] = []
    config = small(tmp_path, cells=(2, 2), split_at=None, split_at_steps=(12, 1000), steps=None, budget=0.2)
    trainer = Trainer(config, scene, on_event=lines.append)
    trainer.on_step = lambda p: setattr(trainer, "seconds", p.step / 100)
    summary = trainer.run()
    assert summary["complete"] and summary["cells"] == 2 and summary["splits_left"] == 1
    assert "1 of 2 planned splits not made: the run ended before" in lines


def test_a_stop_in_the_last_step_leaves_nothing_out(tmp_path: Path, scene: Scene) -> None:
    trainer = Trainer(small(tmp_path, evaluations=1), scene)
    trainer.on_step = lambda p: trainer.request_stop() if p.step == 24 else None
    summary = trainer.run()
    assert summary["complete"] and summary["views"] == 2 and summary["psnr"] > 0


def test_a_panorama_from_one_place_trains(tmp_path: Path, scene: Scene) -> None:
    cameras = scene.train.cameras
    poses = cameras.poses.clone()
    poses[:, :3, 3] = 0
    train = replace(scene.train, cameras=replace(cameras, poses=poses))
    panorama = replace(scene, train=train, box=None, near=0.05)
    assert 4 <= octaves_for(panorama) <= 14


def test_a_run_directory_has_one_run(tmp_path: Path, scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    config = replace(small(tmp_path), out=None)
    names = [str(choose_directory(config, scene).out) for _ in range(3)]
    assert names == [f"runs/{scene.name}{end}" for end in ("", "-2", "-3")]
    with held(Path("runs/other")):
        if sys.platform != "win32":
            with (
                pytest.raises(ConfigError, match="--out must not be in use by another run, got runs/other"),
                held(Path("runs/other")),
            ):
                raise AssertionError("two hold it")
        Path("runs/other/config.json").write_text("")
    with held(Path("runs/other")), held(Path("runs/empty")):
        pass
    assert Path("runs/other").is_dir() and not Path("runs/empty").exists()


def test_the_final_scores_are_blended_as_the_pictures_are(tmp_path: Path, scene: Scene) -> None:
    plain = Trainer(small(tmp_path / "plain"), scene).run()
    trainer = Trainer(small(tmp_path / "blended", blend=0.3), scene)
    blended = trainer.run()
    assert plain["steps"] == blended["steps"] and plain["psnr"] != blended["psnr"]
    assert blended["psnr"] == mean_scores(evaluate(trainer.renderer, scene, views=2))["psnr"]
    config, routers = load_run(tmp_path / "blended")
    assert config.blend == 0.3
    for router in routers.values():
        router.blend = 0.0
    unblended = mean_scores(evaluate(make_renderer(config, scene, routers), scene, views=2))
    assert unblended["psnr"] == plain["psnr"]


def after_the_split(tmp_path: Path, scene: Scene, **settings: Any) -> Trainer:
    """A trainer of four cells that has made one step since its split."""
    trainer = Trainer(small(tmp_path, **settings), scene)
    trainer.on_step = lambda p: trainer.request_stop() if p.step == 13 else None
    trainer.advance()
    assert trainer.router.num_cells == 4
    return trainer


@pytest.mark.parametrize("centres", ["random", "uniform"])
def test_centres_that_are_not_balanced(tmp_path: Path, scene: Scene, centres: str) -> None:
    stages = {}
    for name in ("balanced", centres):
        stages[name] = after_the_split(tmp_path / name, scene, centres=name).stages[-1]
        assert (stages[name].balance_before == stages[name].balance_after) == (name == centres)
    if centres == "random":  # the same draw, moved or not
        assert stages["balanced"].balance_before == stages["random"].balance_before


def test_balance_by_transport_has_power_weights(tmp_path: Path, scene: Scene) -> None:
    assert after_the_split(tmp_path / "a", scene, balance="transport").router.diagram.power is not None
    assert after_the_split(tmp_path / "b", scene).router.diagram.power is None


def test_children_inherit_or_start_afresh(tmp_path: Path, scene: Scene) -> None:
    spread = {}
    for init in ("inherit", "random"):
        weight = after_the_split(tmp_path / init, scene, init=init).router.module.trunk[0].weight
        spread[init] = float((weight[0] - weight[1]).detach().abs().mean())
    assert 0 < spread["inherit"] < 0.05 < 0.1 < spread["random"]


def test_random_initialisation_leaves_cells_that_are_not_split(tmp_path: Path, scene: Scene) -> None:
    trainer = Trainer(small(tmp_path, cells=(3, 2), split_at=(0.4, 0.8), split="worst", init="random"), scene)
    before: dict[str, torch.Tensor] = {}

    def keep(progress: Any) -> None:
        weight = trainer.router.module.trunk[0].weight.detach().clone()
        before["now" if progress.cells == 4 else "then"] = weight
        if progress.cells == 4:
            trainer.request_stop()

    trainer.on_step = keep
    trainer.advance()
    distance = (before["now"][:, None] - before["then"][None]).abs().mean((2, 3)).amin(1)
    assert (distance < 0.05).sum() == 2 and (distance > 0.1).sum() == 2, distance


def test_assignment_reaches_the_router(tmp_path: Path, scene: Scene) -> None:
    router = Trainer(small(tmp_path / "a", assignment="stochastic", temperature=0.7), scene).router
    assert (router.assignment, router.temperature) == ("stochastic", 0.7)
    summary = Trainer(small(tmp_path / "b", assignment="stochastic"), scene).run()
    assert summary["cells"] == 4


@pytest.mark.parametrize("settings", [{"backend": "reference"}, {"view_directions": False}, {"cells": ()}], ids=str)
def test_further_settings_run(tmp_path: Path, scene: Scene, settings: dict[str, Any]) -> None:
    trainer = Trainer(small(tmp_path, **settings), scene)
    assert trainer.run()["complete"]
    assert trainer.router.field.layers.uses_directions == settings.get("view_directions", True)


def test_the_reference_backend_trains_to_the_same_curve(tmp_path: Path, scene: Scene) -> None:
    psnr = {}
    for backend in ("auto", "reference"):
        config = small(tmp_path / backend, backend=backend, steps=60, rays=128, width=16)
        psnr[backend] = Trainer(config, scene).run()["psnr"]
    assert psnr["auto"] == pytest.approx(psnr["reference"], abs=0.5)


def test_kept_samples_are_weight_times_ray_error(tmp_path: Path, scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Importance w * E(r), E the squared error of the ray's colour summed over its channels."""
    rendered, targets = [], []
    whole, target = Renderer.render, Batch.target
    monkeypatch.setattr(Renderer, "render", lambda *a, **k: rendered.extend(whole(*a, **k)) or tuple(rendered[-1:]))
    monkeypatch.setattr(Batch, "target", lambda *a: targets.append(target(*a)) or targets[-1])
    trainer = Trainer(small(tmp_path, reservoir=40, reservoir_batches=1, cells=(4,), split_at=(0.9,)), scene)
    trainer.on_step = lambda p: trainer.request_stop()
    trainer.advance()
    points, importance = trainer.reservoir.samples()
    error = (rendered[0].colour - targets[0]).square().sum(1)
    expected = (rendered[0].weights * error[:, None]).detach().reshape(-1)
    heaviest = expected.topk(40)
    torch.testing.assert_close(importance.sort(descending=True).values, heaviest.values)
    at = rendered[0].positions.detach().reshape(-1, 3)[heaviest.indices]
    assert {tuple(p) for p in points.tolist()} == {tuple(p) for p in at.tolist()}


@pytest.mark.parametrize(
    ("settings", "expected"),
    [({"split_at": None, "split_at_steps": (7,)}, [0, 7]), ({"split_at": None, "split_at_seconds": (1e-6,)}, [0, 1])],
)
def test_splits_by_steps_and_by_seconds(
    tmp_path: Path, scene: Scene, settings: dict[str, Any], expected: list[int]
) -> None:
    trainer = Trainer(small(tmp_path, **settings), scene)
    trainer.advance()
    assert [stage.started_at_step for stage in trainer.stages] == expected


def test_worst_cell_first_until_there_are_enough(tmp_path: Path, scene: Scene) -> None:
    settings = {"cells": (3, 4), "split": "worst", "max_cells": 11, "split_at": (0.2, 0.8), "steps": 50}
    trainer = Trainer(small(tmp_path, **settings), scene)
    summary = trainer.run()
    # The last of them into what is missing: 3, then the worst into 4, 4 and 3.
    assert [stage.cells for stage in trainer.stages] == [1, 3, 6, 9, 11]
    assert [stage.started_at_step for stage in trainer.stages] == [0, 10, 20, 30, 40]
    assert [stage.split_cells for stage in trainer.stages[1:]] == [1, 1, 1, 1]
    assert summary["cells"] == trainer.config.final_cells == 11


def test_the_learning_rate_changes_at_each_split(tmp_path: Path, scene: Scene) -> None:
    plain, slower = (
        Trainer(small(tmp_path / name, cells=(3, 2), lr_split=factor), scene)
        for name, factor in (("a", 1.0), ("b", 0.5))
    )
    rates = []
    for trainer in (plain, slower):
        seen: list[tuple[int, float]] = []
        trainer.on_step = lambda p, trainer=trainer, seen=seen: seen.append((trainer.level, trainer.learning_rate()))
        trainer.advance()
        rates.append(seen)
    assert [level for level, _ in rates[0]] == [level for level, _ in rates[1]] and rates[0][-1][0] == 2
    for (level, usual), (_, rate) in zip(*rates):
        assert rate == pytest.approx(0.5**level * usual)


def test_the_temperature_falls_to_its_last_value(tmp_path: Path, scene: Scene) -> None:
    settings = {"cells": (3,), "assignment": "stochastic", "temperature": 0.2, "temperature_final": 0.01, "steps": 40}
    trainer = Trainer(small(tmp_path, **settings, sampling="hierarchical"), scene)
    seen: list[tuple[float, float]] = []
    trainer.on_step = lambda p: seen.extend((p.step, router.temperature) for router in trainer.routers.values())
    trainer.advance()
    assert len(seen) == 2 * 40
    for step, temperature in seen:
        assert temperature == pytest.approx(0.2 * 0.01 ** ((step - 1) / 40))


def test_a_proposal_is_annealed(tmp_path: Path, scene: Scene) -> None:
    for slope in (0.0, 1.0, 10.0):
        trainer = Trainer(small(tmp_path / f"{slope}", sampling="proposal", proposal_anneal=slope, steps=10), scene)
        seen: list[float] = []
        trainer.on_step = lambda p, trainer=trainer, seen=seen: seen.append(trainer.renderer.sharpness)
        trainer.advance()
        times = [step / 10 for step in range(10)]
        assert seen == pytest.approx([slope * t / ((slope - 1) * t + 1) if slope else 1.0 for t in times])


@pytest.mark.parametrize("field", ["nerf", "kilonerf"])
def test_parameters_decide_the_width(tmp_path: Path, scene: Scene, field: str) -> None:
    trainer = Trainer(small(tmp_path, width=None, depth=None, field=field, parameters=30_000), scene)
    summary = trainer.run()
    config = trainer.config
    width = solve_width(config, 30_000)
    assert summary["width"] == width == config.width
    assert summary["parameters"] == count_parameters(config) == sum(p.numel() for p in trainer.router.parameters())
    assert count_parameters(config) <= 30_000 < count_parameters(config, width + 1)
    assert config.lr == 0.02
    assert load_run(tmp_path)[0] == config
    Trainer(replace(config, width=None, lr=None, resume=True), scene)


def test_too_few_parameters(tmp_path: Path, scene: Scene) -> None:
    with pytest.raises(ConfigError, match=r"--parameters must be at least \d+ for 4 cells, got 7"):
        resolve_config(small(tmp_path, parameters=7), scene)
    wide = resolve_config(small(tmp_path, cells=(), parameters=1_000_000), scene)
    assert wide.width is not None and wide.width > 256 and wide.lr == pytest.approx(0.02 * 64 / wide.width)


def test_octaves_follow_the_pixels() -> None:
    """100 x 100 images of a Blender-like scene: 8 octaves; the paper's 10 at 400 x 400; one more for half the pixel."""
    octaves = [octaves_for(builtin_scene(size, train_views=2, test_views=1)) for size in (50, 100, 200, 400)]
    assert octaves == [7, 8, 9, 10]


def test_octaves_of_cones_are_those_that_a_pixel_leaves() -> None:
    """At the middle of the scene the last octave keeps more than a thousandth, the next would keep nothing."""
    for size in (50, 100):
        scene = builtin_scene(size, train_views=2, test_views=1)
        config = resolve_config(TrainConfig(field="mipnerf"), scene)
        assert config.position_octaves == octaves_for(scene) + 2
        rays = scene.train.cameras.rays(0, torch.tensor([size // 2]), torch.tensor([size // 2]), cones=True)
        assert rays.radii is not None
        variance = float(4 * rays.radii) ** 2 / 4
        left = [math.exp(-0.5 * 4.0**octave * variance) for octave in range(config.position_octaves + 1)]
        assert left[-2] > 1e-4 and left[-1] < 1e-9


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
    config, routers = load_run(tmp_path)
    assert config == trainer.config
    loaded = make_renderer(config, scene, routers)
    assert evaluate(loaded, scene, views=2) == evaluate(trainer.renderer, scene, views=2)
    coarser = make_renderer(config, scene, routers, samples=3, backend="reference")
    assert (coarser.samples, coarser.backend) == (3, "reference")


def test_another_configuration_is_refused(tmp_path: Path, scene: Scene) -> None:
    config = small(tmp_path)
    Trainer(config, scene).run()
    with pytest.raises(CheckpointError, match=r"a checkpoint of another configuration: --width 8 -> 16; --lr"):
        Trainer(replace(config, width=16, lr=1e-4, resume=True), scene)
    checkpoint = load_checkpoint(checkpoint_path(tmp_path))
    del checkpoint.tensors["router.module.density.weight"]
    with pytest.raises(CheckpointError, match="another architecture"):
        restore_routers(make_routers(small(tmp_path, position_octaves=octaves_for(scene)), "cpu"), checkpoint)


def test_a_loss_that_is_not_finite_stops_training(tmp_path: Path, scene: Scene) -> None:
    trainer = Trainer(small(tmp_path), scene)
    trainer.advance()
    trainer.save()
    before = tensors(tmp_path)
    with torch.no_grad():
        next(iter(trainer.router.parameters())).fill_(float("nan"))
    trainer.config = replace(trainer.config, steps=99, split_at=(0.01,))
    with pytest.raises(TrainingError, match=r"the loss is nan at step 25, .*the checkpoint is as it was"):
        trainer.run()
    after = tensors(tmp_path)
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_more_cells_than_samples(tmp_path: Path, scene: Scene) -> None:
    config = small(tmp_path, cells=(390,), split_at=(0.1,))
    with pytest.raises(TrainingError, match=r"more cells than samples: --cells asks for 390, .* in 3 steps"):
        Trainer(config, scene).run()
    assert load_checkpoint(checkpoint_path(tmp_path)).values["step"] == 3


def test_a_level_without_samples_is_skipped(tmp_path: Path, scene: Scene) -> None:
    lines: list[str] = []
    config = small(tmp_path, cells=(4, 64), split_at=(0.5, 0.54))
    summary = Trainer(config, scene, on_event=lines.append).run()
    assert [s["cells"] for s in summary["stages"]] == [1, 4, 4]
    assert any(line.startswith("no cell split") and "40 samples kept" in line for line in lines)


def test_a_backend_that_cannot_train_says_so_before_writing(tmp_path: Path, scene: Scene) -> None:
    with pytest.raises(BackendUnavailable):
        Trainer(small(tmp_path, backend="warp"), scene)
    assert list(tmp_path.iterdir()) == []


def test_longer_resumed_runs_are_evaluated(tmp_path: Path, scene: Scene) -> None:
    config = small(tmp_path, steps=8, cells=(), evaluations=4)
    Trainer(config, scene).run()
    summary = Trainer(replace(config, steps=16, resume=True), scene).run()
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [2, 4, 6, 8, 12, 16]
    assert lines[-1]["psnr"] == summary["psnr"]


def test_training_through_an_occupancy_grid(tmp_path: Path, scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trainer_module, "OCCUPANCY_EVERY", 2)
    config = small(tmp_path / "a", split_at=(0.9,), reservoir_batches=5, occupancy=True, occupancy_resolution=8)
    trainer = Trainer(config, scene)
    assert trainer.occupancy is not None and trainer.occupancy.share == 1
    # What is empty: the upper half of the box, which the field is then never asked about.
    monkeypatch.setattr(trainer_module.OccupancyGrid, "update", _only_below)
    monkeypatch.setattr(trainer_module.OccupancyGrid, "observe", _only_below)
    summary = trainer.run()
    assert trainer.occupancy.share == 0.5
    middle = float(trainer.occupancy.box[:, 2].mean())
    points = np.load(tmp_path / "a" / "samples" / "level-1.npz")["points"]
    assert summary["cells"] == 4 and len(points) > 0 and points[:, 2].max() < middle
    config, routers = load_run(tmp_path / "a")
    grid = load_grid(tmp_path / "a", config, routers["field"], scene, wanted=False)
    assert grid is not None and torch.equal(grid.occupied, trainer.occupancy.occupied)
    loaded = make_renderer(config, scene, routers, occupancy=grid)
    assert trainer.renderer.occupancy is trainer.occupancy
    assert evaluate(loaded, scene, views=1) == evaluate(trainer.renderer, scene, views=1)


def _only_below(self: OccupancyGrid, *_: Any, **__: Any) -> None:
    self.occupied[:, :, self.occupied.shape[2] // 2 :] = False


def test_a_run_with_a_grid_resumes_bit_for_bit(tmp_path: Path, scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trainer_module, "OCCUPANCY_EVERY", 2)
    whole = small(tmp_path / "whole", occupancy=True, occupancy_resolution=8)
    Trainer(whole, scene).run()
    parts = replace(whole, out=tmp_path / "parts")
    first = Trainer(parts, scene, on_step=lambda p: first.request_stop() if p.step == 15 else None)
    first.run()
    Trainer(replace(parts, resume=True), scene).run()
    a, b = tensors(tmp_path / "whole"), tensors(tmp_path / "parts")
    assert a.keys() == b.keys() and "occupancy.density" in a
    assert all(torch.equal(a[name], b[name]) for name in a)
    assert not bool((a["occupancy.density"] == a["occupancy.density"].flatten()[0]).all())


def test_a_grid_needs_a_box(tmp_path: Path, scene: Scene) -> None:
    with pytest.raises(ConfigError, match="--occupancy needs a scene with a box around everything, builtin has none"):
        Trainer(small(tmp_path, occupancy=True), replace(scene, box=None))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.cuda
def test_training_on_a_gpu(tmp_path: Path, scene: Scene) -> None:
    config = small(tmp_path, device="cuda", assignment="stochastic")
    assert Trainer(config, scene).run()["cells"] == 4
    config, routers = load_run(tmp_path, device="cpu")
    assert len(evaluate(make_renderer(config, scene, routers), scene, views=1)) == 1
