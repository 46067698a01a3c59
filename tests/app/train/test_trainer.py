"""The training loop on a tiny built-in scene: stages, files, resume, ablations, and that it never dies."""

import itertools
import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import read_json, refuses
from tiny_runs import small, stopping

from voronerf import open_run
from voronerf.app.evaluate.scores import evaluate, render_view
from voronerf.app.files import read_json_lines
from voronerf.app.train.batches import RayBatches
from voronerf.app.train.checkpoint import checkpoint_path, load_checkpoint
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.train.networks import count_parameters, octaves_for, resolve_config, solve_width
from voronerf.app.train.run_directory import choose_directory, held, write_curve
from voronerf.app.train.trainer import Trainer, TrainingError
from voronerf.nerf.cameras import Cameras
from voronerf.nerf.occupancy import OccupancyGrid
from voronerf.nerf.renderer import Renderer
from voronerf.ops._core.backends import BackendUnavailable


def weight_of(trainer):
    return trainer.router.module.trunk[0].weight.detach().clone()


def test_a_run_and_its_directory(tmp_path, scene):
    lines, steps = [], []
    trainer = Trainer(small(tmp_path), scene, on_event=lines.append, on_step=lambda p: steps.append(p.step))
    assert trainer.lpips is None
    trainer.lpips = lambda image, truth: torch.tensor(0.25)  # of the final evaluation alone
    summary = trainer.run()
    assert steps == list(range(1, 25))
    assert summary == read_json(tmp_path / "summary.json")
    assert summary["complete"] and summary["steps"] == 24 and summary["cells"] == 4
    assert summary["parameters"] == sum(p.numel() for p in trainer.router.parameters())
    assert summary["rays_per_second"] == pytest.approx(24 * 64 / summary["seconds"])
    coarse, local = summary["stages"]
    assert (coarse["cells"], coarse["started_at_second"], coarse["balance_before"]) == (1, 0, None)
    assert (local["cells"], local["started_at_step"], local["split_cells"]) == (4, 12, 1)
    assert local["balance_after"] < local["balance_before"]
    metrics = read_json_lines(tmp_path / "metrics.jsonl")
    assert [(line["step"], line["lpips"]) for line in metrics] == [(12, None), (24, 0.25)]
    assert summary["lpips"] == 0.25 and summary["psnr_of_mean_error"] <= summary["psnr"]
    assert all(metrics[-1][name] == summary[name] for name in ("psnr", "psnr_of_mean_error"))
    assert 0 < summary["ssim"] <= 1
    assert TrainConfig.from_json((tmp_path / "config.json").read_text()) == trainer.config
    assert (tmp_path / "samples" / "level-1.npz").is_file()
    assert len(lines) == 3


def test_infinite_scores_are_null_in_files(tmp_path, scene, monkeypatch):
    monkeypatch.setattr("voronerf.app.evaluate.scores.psnr", lambda image, truth: torch.tensor(math.inf))
    config = small(tmp_path)
    for now in (config, replace(config, steps=26, resume=True)):
        assert Trainer(now, scene).run()["psnr"] == math.inf
        for name in ("metrics.jsonl", "summary.json"):
            text = (tmp_path / name).read_text()
            for value in [text] if name == "summary.json" else text.splitlines():
                found = json.loads(value, parse_constant=pytest.fail)
                assert found["psnr"] is None
                assert found["not_finite"] == {"psnr": "inf", "psnr_of_mean_error": "inf"}
        assert write_curve(tmp_path) is None
    (tmp_path / "metrics.jsonl").write_text('{"step": "x"}')
    refuses("metrics.jsonl: line 1: step must be an integer, got 'x'", Trainer, replace(config, resume=True), scene)


def test_training_learns(tmp_path, scene):
    config = small(tmp_path, steps=150, rays=256, samples=24, width=32, evaluations=1)
    white = -10 * (scene.test.truth(0, torch.ones(3)) - 1).square().mean().log10()
    assert Trainer(config, scene).run()["psnr"] > float(white) + 3


@pytest.mark.parametrize("background", ["white", "random"])
@pytest.mark.parametrize("seed", range(2))
def test_no_collapse_to_white(tmp_path, scene, seed, background):
    """A NeRF that gives up paints every ray white; its opacity is then 0 and no gradient brings it back."""
    config = small(tmp_path, steps=100, seed=seed, rays=256, samples=24, width=32, cells=(), background=background)
    trainer = Trainer(replace(config, evaluations=1), scene)
    trainer.advance()
    image = render_view(trainer.renderer, scene, 0)
    alpha = scene.test.images[0][..., 3].float() / 255
    assert image.opacity[alpha > 0.99].mean() > 0.5


def test_nested_levels_and_cells_too_small(tmp_path, scene):
    coarse, first, second = Trainer(small(tmp_path / "a", cells=(3, 3), steps=30), scene).run()["stages"]
    assert (coarse["cells"], first["cells"], second["cells"]) == (1, 3, 3 + 2 * second["split_cells"])
    assert second["split_cells"] >= 2
    # No cell holds that many samples, so none is split on the second level, and training goes on.
    summary = Trainer(small(tmp_path / "b", cells=(3, 3), split_at=(0.5, 0.9), min_cell_samples=300), scene).run()
    assert [s["cells"] for s in summary["stages"]] == [1, 3, 3]
    assert summary["stages"][2]["balance_after"] is None


def test_splits_that_never_come_are_told(tmp_path, scene):
    lines = []
    config = small(tmp_path, cells=(2, 2), split_at_steps=(12, 1000), steps=None, budget=0.2)
    trainer = Trainer(config, scene, on_event=lines.append)
    trainer.on_step = lambda p: setattr(trainer, "seconds", p.step / 100)
    summary = trainer.run()
    assert summary["complete"] and summary["cells"] == 2 and summary["splits_left"] == 1
    assert "Run ended before 1 of 2 planned splits." in lines


def test_a_stop_in_the_last_step_leaves_nothing_out(tmp_path, scene):
    summary = stopping(small(tmp_path, evaluations=1), scene, 24).run()
    assert summary["complete"] and summary["views"] == 2 and summary["psnr"] > 0


def test_a_panorama_from_one_place_trains(tmp_path, scene):
    poses = scene.train.cameras.poses.clone()
    poses[:, :3, 3] = 0
    train = replace(scene.train, cameras=replace(scene.train.cameras, poses=poses))
    assert 4 <= octaves_for(replace(scene, train=train, box=None, near=0.05)) <= 14


def test_a_run_directory_has_one_run(tmp_path, scene, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = replace(small(tmp_path), out=None)
    names = [str(choose_directory(config, scene).out) for _ in range(3)]
    assert names == [f"runs/{scene.name}{end}" for end in ("", "-2", "-3")]
    other = Path("runs/other")
    with held(other):
        if sys.platform != "win32":
            in_use = pytest.raises(ConfigError, match="--out must not be in use by another run, got runs/other")
            with in_use, held(other):
                raise AssertionError("two hold it")
        (other / "config.json").write_text("")
    with held(other), held(Path("runs/empty")):
        pass
    assert other.is_dir() and not Path("runs/empty").exists()


def after_the_split(folder, scene, **settings):
    """A trainer of four cells that has made one step since its split."""
    trainer = stopping(small(folder, **settings), scene, 13)
    trainer.advance()
    assert trainer.router.num_cells == 4
    return trainer


def test_centres_are_balanced_or_not(tmp_path, scene):
    kinds = {"balanced": {"centres": "balanced"}, "random": {"centres": "random"}, "uniform": {"centres": "uniform"}}
    trainers = {name: after_the_split(tmp_path / name, scene, **settings) for name, settings in kinds.items()}
    stages = {name: trainer.stages[-1] for name, trainer in trainers.items()}
    for name, stage in stages.items():
        assert (stage.balance_before == stage.balance_after) == (name != "balanced")
    assert stages["balanced"].balance_before == stages["random"].balance_before  # the same draw, moved or not
    afresh = after_the_split(tmp_path / "afresh", scene, init="random")
    # Children inherit or start afresh.
    inherited, random = (weight_of(trainer) for trainer in (trainers["balanced"], afresh))
    spread = [float((weight[0] - weight[1]).abs().mean()) for weight in (inherited, random)]
    assert 0 < spread[0] < 0.05 < 0.1 < spread[1]


def test_random_initialisation_leaves_cells_that_are_not_split(tmp_path, scene):
    trainer = Trainer(small(tmp_path, cells=(3, 2), split_at=(0.4, 0.8), split="worst", init="random"), scene)
    found = {}

    def keep(progress):
        found[progress.cells] = weight_of(trainer)
        if progress.cells == 4:
            trainer.request_stop()

    trainer.on_step = keep
    trainer.advance()
    distance = (found[4][:, None] - found[3][None]).abs().mean((2, 3)).amin(1)
    assert (distance < 0.05).sum() == 2 and (distance > 0.1).sum() == 2, distance


@pytest.mark.parametrize(
    "settings",
    [
        {"backend": "reference"},
        {"field_options": ("view_directions=False",)},
        {"cells": ()},
        {"assignment": "stochastic"},
    ],
    ids=str,
)
def test_further_settings_run(tmp_path, scene, settings):
    trainer = Trainer(small(tmp_path, temperature=0.7, **settings), scene)
    router = trainer.router
    assert (router.assignment, router.temperature) == (settings.get("assignment", "nearest"), 0.7)
    summary = trainer.run()
    assert summary["complete"] and summary["cells"] == len(trainer.config.cells) * 3 + 1
    assert router.field.layers.uses_directions == ("field_options" not in settings)


def test_the_reference_backend_trains_to_the_same_curve(tmp_path, scene):
    psnr = {}
    for backend in ("auto", "reference"):
        config = small(tmp_path / backend, backend=backend, steps=60, rays=128, width=16, evaluations=1)
        psnr[backend] = Trainer(config, scene).run()["psnr"]
    assert psnr["auto"] == pytest.approx(psnr["reference"], abs=0.5)


def test_kept_samples_are_weight_times_ray_error(tmp_path, scene, monkeypatch):
    """Importance w * E(r), E the squared error of the ray's colour summed over its channels."""
    rendered, targets = [], []
    whole, draw = Renderer.render, RayBatches.draw
    monkeypatch.setattr(Renderer, "render", lambda *a, **k: rendered.extend(whole(*a, **k)) or tuple(rendered[-1:]))
    monkeypatch.setattr(RayBatches, "draw", lambda *a, **k: targets.append(draw(*a, **k)) or targets[-1])
    trainer = stopping(small(tmp_path, reservoir=40, reservoir_batches=1, split_at=(0.9,)), scene, 1)
    trainer.advance()
    points, importance = trainer.cells.reservoir.samples()
    error = (rendered[0].colour - targets[0].target).square().sum(1)
    expected = (rendered[0].samples.by_ray(rendered[0].weights) * error[:, None]).detach().reshape(-1)
    heaviest = expected.topk(40)
    torch.testing.assert_close(importance.sort(descending=True).values, heaviest.values)
    at = rendered[0].samples.positions.detach()[heaviest.indices]
    assert {tuple(p) for p in points.tolist()} == {tuple(p) for p in at.tolist()}


@pytest.mark.parametrize(
    ("settings", "started", "cells"),
    [
        ({"split_at_steps": (7,)}, [0, 7], [1, 4]),
        # The worst cell first until there are enough, the last of them into what is missing: 4, 4 and 3.
        (
            {"cells": (3, 4), "split": "worst", "max_cells": 11, "split_at": (0.2, 0.8), "steps": 50},
            [0, 10, 20, 30, 40],
            [1, 3, 6, 9, 11],
        ),
    ],
)
def test_when_and_into_what_is_split(tmp_path, scene, settings, started, cells):
    trainer = Trainer(small(tmp_path, **settings), scene)
    assert trainer.run()["cells"] == trainer.config.final_cells == cells[-1]
    assert [stage.started_at_step for stage in trainer.stages] == started
    assert [stage.cells for stage in trainer.stages] == cells
    assert all(stage.split_cells == 1 for stage in trainer.stages[1:])


@pytest.mark.parametrize("field", ["nerf", "kilonerf"])
def test_parameters_decide_the_width(tmp_path, scene, field):
    trainer = Trainer(small(tmp_path, width=None, depth=None, field=field, parameters=30_000), scene)
    summary, config = trainer.run(), trainer.config
    width = solve_width(config, 30_000)
    assert summary["width"] == width == config.width
    assert summary["parameters"] == count_parameters(config) == sum(p.numel() for p in trainer.router.parameters())
    assert count_parameters(config) <= 30_000 < count_parameters(config, width + 1)
    assert config.lr == 0.02
    assert open_run(tmp_path, scene=scene).config == config
    Trainer(replace(config, width=None, lr=None, resume=True), scene)


def test_too_few_parameters(tmp_path, scene):
    with pytest.raises(ConfigError, match=r"--parameters must be at least \d+ for 4 cells, got 7"):
        resolve_config(small(tmp_path, parameters=7), scene)
    wide = resolve_config(small(tmp_path, cells=(), parameters=1_000_000), scene)
    assert wide.width is not None and wide.width > 256 and wide.lr == pytest.approx(0.02 * 64 / wide.width)


def test_octaves_follow_the_pixels(scene):
    """100 x 100 images of a Blender-like scene: 8 octaves; the paper's 10 at 400 x 400; one more for half the pixel.

    Of cones, those that a pixel leaves: at the middle of the scene the last keeps more than a thousandth, the next
    would keep nothing.
    """
    some = scene.train.cameras
    for size, octaves in ((50, 7), (100, 8), (200, 9), (400, 10)):
        cameras = Cameras(some.poses, some.intrinsics * size / some.width, size, size)
        sharp = replace(scene, train=replace(scene.train, cameras=cameras))
        assert octaves_for(sharp) == octaves
        cones = resolve_config(TrainConfig(field="mipnerf"), sharp).network_options["position_octaves"]
        assert cones == octaves + 2
        rays = cameras.rays(0, torch.tensor([size // 2]), torch.tensor([size // 2]), cones=True)
        variance = float(4 * rays.radii) ** 2 / 4
        left = [math.exp(-0.5 * 4.0**octave * variance) for octave in (cones - 1, cones)]
        assert left[0] > 1e-4 and left[1] < 1e-9


def test_more_cells_than_samples(tmp_path, scene):
    config = small(tmp_path / "a", cells=(390,), split_at=(0.1,))
    with pytest.raises(TrainingError, match=r"more cells than samples: --cells asks for 390, .* in 3 steps"):
        Trainer(config, scene).run()
    assert load_checkpoint(checkpoint_path(config.out)).values["step"] == 3
    # A level without samples is skipped.
    lines = []
    trainer = Trainer(small(tmp_path / "b", cells=(4, 64), split_at=(0.5, 0.54)), scene, on_event=lines.append)
    trainer.advance()
    assert [stage.cells for stage in trainer.stages] == [1, 4, 4]
    assert any(line.startswith("no cell split") and "40 samples kept" in line for line in lines)


def test_refused_before_anything_is_written(tmp_path, scene):
    with pytest.raises(BackendUnavailable):
        Trainer(small(tmp_path, backend="warp"), scene)
    assert list(tmp_path.iterdir()) == []


def only_below(grid, *_, **__):
    grid.occupied[:, :, grid.occupied.shape[2] // 2 :] = False


def test_training_through_an_occupancy_grid(tmp_path, scene, monkeypatch):
    monkeypatch.setattr("voronerf.nerf.cells.REVISIT_EVERY", 2)
    config = small(tmp_path, split_at=(0.9,), reservoir_batches=5, occupancy=True, occupancy_resolution=8)
    trainer = Trainer(config, scene)
    assert trainer.occupancy is not None and trainer.occupancy.share == 1
    # What is empty: the upper half of the box, which the field is then never asked about.
    for method in ("update", "observe"):
        monkeypatch.setattr(OccupancyGrid, method, only_below)
    summary = trainer.run()
    assert trainer.occupancy.share == 0.5
    middle = float(trainer.occupancy.box[:, 2].mean())
    points = np.load(tmp_path / "samples" / "level-1.npz")["points"]
    assert summary["cells"] == 4 and len(points) > 0 and points[:, 2].max() < middle
    loaded = open_run(tmp_path, scene=scene).renderer
    grid = loaded.occupancy
    assert grid is not None and torch.equal(grid.occupied, trainer.occupancy.occupied)
    assert trainer.renderer.occupancy is trainer.occupancy
    with trainer.averaged():
        assert evaluate(loaded, scene, views=1) == evaluate(trainer.renderer, scene, views=1)


@pytest.mark.parametrize(("contraction", "settling"), [("sphere", 4), ("none", 0)])
def test_a_grid_in_a_sphere_settles_before_it_learns(tmp_path, scene, monkeypatch, contraction, settling):
    monkeypatch.setattr("voronerf.nerf.cells.SETTLING_STEPS", 4)
    monkeypatch.setattr("voronerf.nerf.cells.REVISIT_EVERY", 1)
    settings = {"contraction": contraction, "occupancy": True, "occupancy_resolution": 8, "cells": ()}
    trainer = Trainer(small(tmp_path, **settings), scene)
    new, learnt, most = trainer.occupancy.density.clone(), [], []
    sample = trainer.renderer.sampler.sample

    def counted(*rays, **given):
        samples = sample(*rays, **given)
        most.append(int(samples.ray_offsets.diff().max()))
        return samples

    def look(progress):
        learnt.append(not torch.equal(trainer.occupancy.density, new))
        if progress.step == 6:
            trainer.request_stop()

    monkeypatch.setattr(trainer.renderer.sampler, "sample", counted)
    trainer.on_step = look
    trainer.advance()
    assert learnt == [step >= settling for step in range(6)]
    assert all((count <= 12 // 4) == (step < settling) for step, count in enumerate(most[:6]))


@pytest.mark.cuda
def test_training_on_a_gpu(tmp_path, scene):
    config = small(tmp_path, device="cuda", assignment="stochastic")
    assert Trainer(config, scene).run()["cells"] == 4
    assert len(open_run(tmp_path, scene=scene, device="cpu").evaluate(views=1)["views"]) == 1


@pytest.mark.parametrize(("final_views", "views"), [(None, 3), (2, 2)])
def test_evaluations_are_part_of_the_budget(tmp_path, scene, final_views, views):
    """A second for each step and for each evaluation, whatever its views: a tenth of 40 is four evaluations."""
    seconds = itertools.count()
    limits = {"steps": None, "budget": 40.0, "eval_views": 5, "final_views": final_views, "evaluations": 4}
    trainer = Trainer(small(tmp_path, **limits), scene, clock=lambda: float(next(seconds)))
    summary = trainer.run()
    assert summary["complete"] and summary["views"] == views
    assert trainer.scoring <= 2 and 36 <= trainer.seconds + trainer.scoring <= 42
    uncounted = small(tmp_path / "uncounted", **limits, evaluation_share=0.0)
    trainer = Trainer(uncounted, scene, clock=lambda: float(next(seconds)))
    assert 40 <= trainer.run()["seconds"] <= 44
    assert [line["views"] for line in trainer.metrics] == [5, 5, 5, final_views or len(scene.test.names)]


def test_holes_of_the_grid_are_filled_once_at_the_end_by_the_averaged_field(tmp_path, scene, monkeypatch):
    filled = []
    monkeypatch.setattr(OccupancyGrid, "fill_holes", lambda grid, field, **_: filled.append(weight_of(trainer)))
    config = small(tmp_path / "a", occupancy=True, occupancy_resolution=8, contraction="sphere")
    trainer = stopping(config, scene, 12)
    trainer.run()
    assert trainer.step == 12 and not filled
    trainer = Trainer(replace(config, resume=True), scene)
    trainer.run()
    with trainer.averaged():
        averaged = weight_of(trainer)
    assert len(filled) == 1 and torch.equal(filled[0], averaged)
    assert not torch.equal(averaged, weight_of(trainer))
    # What is in a box gains nothing by it.
    Trainer(small(tmp_path / "b", occupancy=True, occupancy_resolution=8, contraction="none"), scene).run()
    assert len(filled) == 1
