"""Tests of the training loop on a tiny built-in scene: stages, splits, files, the occupancy grid, and robustness."""

import math
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import read_json, refuses, same, script, trained
from tiny_runs import HIERARCHICAL, Each, small, started, steps_of

from voronerf.app import open_run
from voronerf.app.evaluate.scores import evaluate
from voronerf.app.files import read_json_lines
from voronerf.app.render.camera import render_camera
from voronerf.app.scenes import builtin_scene
from voronerf.app.train import ConfigError, TrainConfig, build, load, loop, run, snapshot, train
from voronerf.app.train.build import count_parameters, solve_width
from voronerf.app.train.defaults import octaves_for, resolve
from voronerf.app.train.loop import prepare
from voronerf.app.train.run_directory import choose_directory, held
from voronerf.nerf import OccupancyGrid
from voronerf.nerf.cameras import Cameras
from voronerf.nerf.schedule import FINAL
from voronerf.ops._core import backends, native
from voronerf.ops._core.backends import BackendUnavailable


def weight_of(state):
    return state.router.module.trunk[0].weight.detach().clone()


def test_a_run_and_its_directory(tmp_path, scene):
    lines, steps = [], []
    follow = Each(lambda state: steps.append(state.step))
    summary = trained(small(tmp_path), scene, on_event=lines.append, callbacks=[follow])
    assert steps == list(range(1, 25))
    assert summary == read_json(tmp_path / "summary.json")
    assert summary["complete"] and summary["steps"] == 24 and summary["cells"] == 4
    assert summary["rays_per_second"] == pytest.approx(24 * 64 / summary["seconds"])
    coarse, local = summary["stages"]
    assert (coarse["cells"], coarse["started_at_second"], coarse["balance_before"]) == (1, 0, None)
    assert (local["cells"], local["started_at_step"], local["split_cells"]) == (4, 12, 1)
    metrics = read_json_lines(tmp_path / "metrics.jsonl")
    assert [line["step"] for line in metrics] == [12, 24]
    assert all(metrics[-1][name] == summary[name] for name in ("psnr", "psnr_of_mean_error"))
    assert [score["psnr"] for score in metrics[-1]["scores"]] and len(metrics[-1]["scores"]) == metrics[-1]["views"]
    assert summary["far_views"] == sum((score["angle"] or 0) > 15 for score in metrics[-1]["scores"])
    assert summary["psnr_of_mean_error"] <= summary["psnr"] and 0 < summary["ssim"] <= 1
    config = TrainConfig.from_values(read_json(tmp_path / "config.json"))
    assert config == resolve(small(tmp_path), scene)
    opened = open_run(tmp_path, scene=scene)
    assert opened.config == config and summary["parameters"] == sum(p.numel() for p in opened.router.parameters())
    assert (tmp_path / "samples" / "level-1.npz").is_file() and len(lines) == 3


def test_training_learns_and_the_reference_learns_the_same(scene):
    white = -10 * (scene.test.truth(0, torch.ones(3)) - 1).square().mean().log10()
    psnr = {}
    for backend in ("auto", "reference"):
        state = started(scene, 60, backend=backend, steps=60, rays=128, width=16)
        psnr[backend] = evaluate(state.renderer, scene, views=1)[0].psnr
    assert psnr["auto"] > float(white) + 1 and psnr["auto"] == pytest.approx(psnr["reference"], abs=0.5)


def test_the_middle_of_a_view_is_that_of_the_whole_view(scene):
    """The score of a view's middle equals the score of the same pixels of the whole picture, its truth and its mask."""
    state = started(scene, 4)
    count, cameras = len(scene.test), scene.test.cameras
    distortion = torch.zeros(count, 8)
    distortion[:, 0] = 0.05
    sizes = torch.tensor([[15, 16]] + [[16, 13]] * (count - 1))
    masks = torch.rand(count, 16, 16, generator=torch.Generator().manual_seed(0)) > 0.3
    test = replace(scene.test, cameras=replace(cameras, distortion=distortion, sizes=sizes), masks=masks)
    scene = replace(scene, test=test)
    for view, rows, columns in ((0, slice(5, 10), slice(5, 10)), (1, slice(4, 8), slice(5, 10))):
        whole = render_camera(state.renderer, scene, scene.test.cameras, view).colour.clamp(0, 1)[rows, columns]
        kept = test.mask(view)[rows, columns]
        error = (whole - test.truth(view, torch.ones(3))[rows, columns])[kept].double().square().mean()
        (score,) = evaluate(state.renderer, scene, views=[view], middle=3)
        assert score.psnr == pytest.approx(float(-10 * error.log10()), abs=1e-5)


def test_the_middle_of_a_view_lies_where_the_mask_shows_something(scene):
    masks = torch.ones(len(scene.test), 16, 16, dtype=torch.bool)
    masks[0, :, :14] = False  # the middle of 5 x 5 pixels is hidden
    state = started(replace(scene, test=replace(scene.test, masks=masks)), 1)
    (score,) = evaluate(state.renderer, state.scene, views=[0], middle=3)
    assert math.isfinite(score.psnr)


def test_no_collapse_to_white(scene):
    """The opacity does not collapse to 0; every ray would then be white and have no gradient."""
    state = started(scene, 100, steps=100, rays=256, samples=(24,), width=32, cells=())
    image = render_camera(state.renderer, scene, scene.test.cameras, 0)
    alpha = scene.test.images[0][..., 3].float() / 255
    assert image.opacity[alpha > 0.99].mean() > 0.5


# --- splits ----------------------------------------------------------------------------------------------------------


def test_cells_too_small_to_be_split_are_left(scene):
    state = build(small(cells=(3, 3), split_at=(0.5, 0.9)), scene)
    state.strategy.min_samples = 10_000
    assert [stage.cells for stage in steps_of(state, 24).stages] == [1, 3, 3]
    assert state.stages[2].balance_after is None


@pytest.mark.parametrize(
    ("settings", "at", "cells"),
    [
        ({"split_at": (7,)}, [0, 7], [1, 4]),
        # The worst cells are split first: two into 4 cells each, and a third into the remaining 3.
        (
            {"cells": (3, 4), "max_cells": 11, "split_at": (0.2, 0.8), "steps": 50},
            [0, 10, 20, 30, 40],
            [1, 3, 6, 9, 11],
        ),
    ],
)
def test_when_and_into_what_is_split(scene, monkeypatch, settings, at, cells):
    state = build(small(**settings), scene)
    state.strategy.min_samples = 8
    steps_of(state, state.config.steps)
    assert state.router.num_cells == state.config.final_cells == cells[-1]
    assert [stage.started_at_step for stage in state.stages] == at
    assert [stage.cells for stage in state.stages] == cells


def test_splits_that_never_come_are_said(tmp_path, scene):
    lines = []
    summary = trained(small(tmp_path, cells=(2, 2), split_at=(0.5, 0.99)), scene, on_event=lines.append)
    assert summary["complete"] and summary["cells"] == 2 and summary["splits_left"] == 1
    assert "Run ended before 1 of 2 planned splits." in lines


def test_more_cells_than_samples(scene):
    with pytest.raises(ValueError, match="390 cells need at least 390 samples, got 60 after 3 steps; split later"):
        train(build(small(cells=(390,), split_at=(3,)), scene))


def test_children_inherit_or_start_afresh(scene):
    spread = []
    for init in ("inherit", "random"):
        weight = weight_of(started(scene, 13, init=init))
        spread.append(float((weight[0] - weight[1]).abs().mean()))
    assert 0 < spread[0] < 0.05 < 0.1 < spread[1]


def test_coarse_and_fine_networks_inherit_alike(scene):
    """After a split every cell of both networks has its parent's parameters and Adam's moments."""
    state = started(scene, 12, **HIERARCHICAL)

    def network_state():
        weights = {name: router.module.trunk[0].weight for name, router in state.routers.items()}
        return {n: (w.detach().clone(), state.optimizer.state[w]["exp_avg"].clone()) for n, w in weights.items()}

    before = network_state()
    assert state.strategy.step_pre_backward(state.optimizer, 0.5, 12) is not None
    assert not torch.equal(before["field"][0], before["coarse"][0])
    for name, (weight, moment) in network_state().items():
        assert torch.equal(weight, before[name][0].expand_as(weight))
        assert bool(moment.any())
        assert torch.equal(moment, before[name][1].expand_as(moment))
    assert torch.equal(state.routers["coarse"].diagram.centres, state.router.diagram.centres)


# --- settings that depend on the scene -------------------------------------------------------------------------------


@pytest.mark.parametrize("field", ["nerf", "kilonerf"])
def test_parameters_decide_the_width(scene, field):
    state = build(small(width=None, depth=None, field=field, parameters=30_000), scene)
    config = state.config
    assert config.width == solve_width(config, 30_000) and config.lr == 0.02
    assert count_parameters(config) <= 30_000 < count_parameters(config, width=config.width + 1)
    steps_of(state, 13)
    assert count_parameters(config) == state.parameter_count
    again = build(replace(small(field=field, parameters=30_000, width=None, depth=None), **HIERARCHICAL), scene)
    assert again.config.width < config.width  # two networks share the parameters
    refuses("--parameters must be at least", build, small(parameters=7), scene, error=ConfigError)
    both = small(parameters=30_000, field=field)
    refuses("--width must be left out with --parameters, which decide", build, both, scene, error=ConfigError)
    assert build(config, scene).config == config  # as a resume does


def test_octaves_follow_the_pixels(scene):
    """A 100 x 100 image needs 8 octaves, and halving the pixel size adds one: 10 at 400 x 400, as in the paper.

    The integrated encoding of cones needs two octaves more. In the middle of the scene, its last octave still has a
    visible amplitude, and one more octave would have none.
    """
    some = scene.train.cameras
    for size, octaves in ((50, 7), (100, 8), (200, 9), (400, 10)):
        cameras = Cameras(some.poses, some.intrinsics * size / some.width, size, size)
        sharp = replace(scene, train=replace(scene.train, cameras=cameras))
        assert octaves_for(sharp.pixel(sharp.space())) == octaves
        cones = resolve(TrainConfig(field="mipnerf"), sharp).network_options["position_octaves"]
        assert cones == octaves + 2
        rays = cameras.rays(0, torch.tensor([size // 2]), torch.tensor([size // 2]), cones=True)
        variance = float(4 * rays.radii) ** 2 / 4
        amplitudes = [math.exp(-0.5 * 4.0**octave * variance) for octave in (cones - 1, cones)]
        assert amplitudes[0] > 1e-4 and amplitudes[1] < 1e-9


def test_a_panorama_from_one_place_trains(scene):
    poses = scene.train.cameras.poses.clone()
    poses[:, :3, 3] = 0
    around = replace(scene, train=replace(scene.train, cameras=replace(scene.train.cameras, poses=poses)), near=0.05)
    assert 4 <= octaves_for(replace(around, box=None).pixel(around.space("none"))) <= 14


def test_empty_space_is_skipped_wherever_that_works(scene):
    for settings in (HIERARCHICAL, {"field": "mipnerf"}):
        assert not resolve(TrainConfig(**settings), scene).occupancy
    sphere = {"contraction": "sphere"}
    for settings in ({}, {"field": "kilonerf"}, {"field": "nerf"}, sphere, sphere | {"field": "kilonerf"}):
        assert resolve(TrainConfig(**settings), scene).occupancy
        assert not resolve(TrainConfig(occupancy=False, **settings), scene).occupancy
        resolved = resolve(TrainConfig(**settings), replace(scene, box=None))
        assert resolved.occupancy == (resolved.contraction != "none")


# --- the occupancy grid ----------------------------------------------------------------------------------------------


def test_training_through_an_occupancy_grid(tmp_path, scene, monkeypatch):
    def only_below(grid, *_, **__):
        grid.occupied[:, :, grid.occupied.shape[2] // 2 :] = False

    # The upper half of the box is empty, so the field is never evaluated there.
    monkeypatch.setattr("voronerf.nerf.samplers.WARMUP_STEPS", 0)
    monkeypatch.setattr(OccupancyGrid, "can_learn_from", lambda *_, **__: True)
    for method in ("update", "observe"):
        monkeypatch.setattr(OccupancyGrid, method, only_below)
    summary = trained(small(tmp_path, split_at=(0.9,), occupancy=True), scene)
    opened = open_run(tmp_path, scene=scene).renderer
    points = np.load(tmp_path / "samples" / "level-1.npz")["points"][-20:]
    grid = opened.occupancy
    assert grid.share == 0.5 and summary["cells"] == 4
    assert len(points) > 0 and points[:, 2].max() < float(grid.box[:, 2].mean())
    assert evaluate(opened, scene, views=2)[1].psnr == pytest.approx(
        2 * summary["psnr"] - evaluate(opened, scene, views=1)[0].psnr
    )


@pytest.mark.parametrize(("contraction", "settling"), [("sphere", 4), ("none", 2)])
def test_a_grid_settles_before_it_learns(scene, monkeypatch, contraction, settling):
    monkeypatch.setattr("voronerf.nerf.samplers.SETTLING_STEPS", 4)
    monkeypatch.setattr("voronerf.nerf.samplers.WARMUP_STEPS", 2)
    monkeypatch.setattr("voronerf.nerf.schedule.GROUP", 1)
    monkeypatch.setattr(OccupancyGrid, "can_learn_from", lambda *_, **__: True)
    state = build(small(contraction=contraction, occupancy=True, cells=()), scene)
    new, learnt, most = state.sampler.grid.density.clone(), [], []
    sample = state.sampler.sample

    def counted(*rays, **options):
        samples = sample(*rays, **options)
        most.append(int(samples.ray_offsets.diff().max()))
        return samples

    monkeypatch.setattr(state.sampler, "sample", counted)
    steps_of(state, 6, Each(lambda s: learnt.append(not torch.equal(s.sampler.grid.density, new))))
    assert learnt == [step >= settling for step in range(6)]
    assert all((count <= 12 // 4) == (step < settling) for step, count in enumerate(most[:6]))


def test_holes_of_the_grid_are_filled_once_at_the_end_by_the_averaged_field(scene, monkeypatch):
    filled = []
    monkeypatch.setattr(OccupancyGrid, "fill_holes", lambda grid, field, **_: filled.append(weight_of(state)))
    state = started(scene, 12, occupancy=True, contraction="sphere")
    assert not filled
    train(state)
    with state.averaged():
        assert len(filled) == 1 and torch.equal(filled[0], weight_of(state))
    assert not torch.equal(filled[0], weight_of(state))
    train(build(small(occupancy=True, contraction="none"), scene))  # not needed in a box
    assert len(filled) == 1


def test_floaters_are_dropped_at_the_end_of_a_long_training_with_many_views(monkeypatch):
    scene, dropped = builtin_scene(16, train_views=4, test_views=2), []
    monkeypatch.setattr(OccupancyGrid, "drop_floaters", lambda grid, seen: dropped.append(seen))
    monkeypatch.setattr(loop, "FLOATER_STEPS", 24)
    for views, steps, contraction, expected in (
        *((5, 24, "sphere", 0), (4, 23, "sphere", 0)),
        *((4, 24, "sphere", 1), (4, 24, "none", 1)),
    ):
        monkeypatch.setattr(loop, "FLOATER_VIEWS", views)
        state = started(scene, 12, occupancy=True, contraction=contraction, steps=steps)
        train(state)
        assert len(dropped) == expected
    assert dropped[0].shape == (128, 128, 128) and 0 <= int(dropped[0].max()) <= 4


def test_long_trainings_have_a_lower_rate_and_more_rays(scene):
    """Twice `LONG_STEPS` steps halve the rate, but not the decay; with a budget, a step has four times as many rays.

    Neither holds for tables in a box, and fields without tables keep their rays.
    """

    def at_half(field="hashgrid", **options):
        table = ("levels=2", "log2_entries=10") if field == "hashgrid" else ()
        state = build(TrainConfig(field=field, width=8, cells=(), rays=64, field_options=table, **options), scene)
        state.step, state.seconds = 3904, 50.0
        output = SimpleNamespace(loss=0.0, samples=10**9)  # so many samples that `next_rays` adds no rays
        prepare(state)
        state.read_output(output)
        rate, decay = state.optimizer.param_groups[0]["lr"], state.optimizer.decay
        return rate / state.config.lr, rate / state.config.lr * decay, state.rays

    decay = lambda fraction, hold=0.25: FINAL ** ((fraction - hold) / (1 - hold))  # noqa: E731
    for options, length, fraction, rays in (
        ({"steps": 7808, "contraction": "sphere"}, 7808 / 3500, 0.5, 64),
        ({"steps": 7808}, 1, 0.5, 64),
        ({"budget": 100.0, "contraction": "sphere"}, 2, 0.5, 256),
        ({"budget": 100.0}, 1, 0.5, 64),
        ({"steps": 3600, "contraction": "none"}, 1, 1, 64),
        ({"field": "nerf", "steps": 7808}, 7808 / 3500, 0.5, 64),
        ({"field": "nerf", "budget": 100.0}, 2, 0.5, 64),
    ):
        rate, decayed, drawn = at_half(**options)
        expected = decay(fraction, 0.25 if "field" not in options else 0.0)
        assert rate == pytest.approx(expected / length, rel=5e-3) and drawn == rays
        assert decayed == pytest.approx(expected, rel=5e-3)


def test_long_trainings_in_empty_space_can_be_resumed(scene, monkeypatch):
    """A checkpoint with the most rays is readable; a step has at most the strata that `march_rays` can hold."""
    table = ("levels=2", "log2_entries=10")
    settings = {"field": "hashgrid", "contraction": "sphere", "cells": (), "field_options": table, "budget": 100.0}
    for most, rays in ((2**27, 64 * 4 * 8), (16 * 1000, 1000)):
        monkeypatch.setattr("voronerf.nerf.schedule.MOST_STRATA", most)
        state = steps_of(build(TrainConfig(width=8, rays=64, samples=(64,), **settings), scene), 1)
        state.step, state.seconds, state.rays = 3904, 50.0, 2048
        state.read_output(SimpleNamespace(loss=0.0, samples=0))
        assert state.rays == rays and state.sampler.strata == 16
        load(build(state.config, scene), snapshot(state))


def test_a_gpu_reads_the_loss_after_a_restart_too():
    read = []
    for step in range(200, 400, 16):  # a restart at step 200
        state = SimpleNamespace(device=SimpleNamespace(type="cuda"), step=step, began=200, count_steps=lambda *_: None)
        state.read_output = lambda output, step=step: read.append(step)
        loop.count(state, 16, SimpleNamespace(rays=64))
    assert read == [200, 248, 296, 344, 392]


@pytest.mark.native
def test_results_do_not_depend_on_how_many_steps_are_made_at_once(scene, monkeypatch):
    """Single steps (for a callback), groups of steps and interrupted groups give the same bits."""
    monkeypatch.setattr("voronerf.nerf.samplers.WARMUP_STEPS", 20)
    monkeypatch.setattr("voronerf.nerf.schedule.FILL", 1.5)  # the number of rays varies
    settings = {"field": "hashgrid", "depth": 1, "occupancy": True, "steps": 90, "split_at": (0.6,), "cells": (3,)}
    alone, groups, stopped = (build(small(**settings), scene) for _ in range(3))
    steps = []
    train(groups)
    steps_of(alone, 90, Each(lambda state: steps.append(state.step)))
    for count in (7, 30, 53):
        steps_of(stopped, count)
    assert steps == list(range(1, 91)) and groups.step == stopped.step == 90 and groups.rays > 64
    for other in (alone, stopped):
        assert same(groups.router.state_dict(), other.router.state_dict())
        assert same(groups.sampler.grid.state_dict(), other.sampler.grid.state_dict())


def test_a_step_takes_more_rays_where_space_is_empty(scene, monkeypatch):
    """A step draws more rays as space becomes empty, up to eight times as many."""
    monkeypatch.setattr("voronerf.nerf.schedule.GROUP", 1)
    state = build(small(field="hashgrid", depth=1, occupancy=True, steps=12, cells=()), scene)
    rays, voxels = [], state.sampler.grid.occupied.numel()
    for kept in (voxels, voxels // 4, voxels // 16, 0):
        state.sampler.grid.density.view(-1)[kept:] = state.sampler.grid.occupied.view(-1)[kept:] = 0
        steps_of(state, 1)
        rays.append(state.rays)
    assert 64 <= rays[0] <= rays[1] < rays[2] <= 512 and rays[3] == 512


# --- directories, backends, devices ----------------------------------------------------------------------------------


def test_a_run_directory_has_one_run(tmp_path, scene, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = [str(choose_directory(small(), scene.name).out) for _ in range(3)]
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


def test_refused_before_anything_is_written(tmp_path, scene, monkeypatch):
    monkeypatch.setattr(backends, "missing", lambda backend, device: "it is not here")
    backends._choose_once.cache_clear()
    with pytest.raises(BackendUnavailable, match="'warp' is not available: it is not here"):
        build(small(tmp_path, backend="warp"), scene)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.warp
@pytest.mark.parametrize("field", ["hashgrid", "nerf"])
def test_warp_trains_as_the_reference_does(scene, field):
    """Steps and a split on the Warp backend give the losses of the reference backend."""
    losses = {"reference": [], "warp": []}
    for backend, history in losses.items():
        config = small(backend=backend, field=field, width=17, occupancy=field == "hashgrid", split_at=(8,))
        steps_of(build(config, scene), 16, Each(lambda state, history=history: history.append(state.loss)))
    assert len(losses["warp"]) == 16 and losses["warp"] == pytest.approx(losses["reference"], rel=0.02)


@pytest.mark.native
@pytest.mark.parametrize("occupancy", [False, True])
def test_the_reference_calls_nothing_compiled(scene, monkeypatch, occupancy):
    """Three steps and a split on the reference backend never use the compiled module; the native backend does."""
    calls = []
    real = native.compiled

    class Counted:
        def __getattr__(self, name):
            calls.extend({name} - {"Unchanged"})  # `Unchanged` computes nothing
            return getattr(real, name)

    for backend in ("reference", "warp", "native"):
        if backends.missing(backend, torch.device("cpu")) is not None:
            continue
        settings = {"cells": (2,), "split_at": (2,), "field": "hashgrid", "depth": 1}
        state = build(small(backend=backend, occupancy=occupancy, **settings), scene)
        with monkeypatch.context() as patch:
            patch.setattr(native, "compiled", Counted())
            calls.clear()
            steps_of(state, 3)
        assert bool(calls) == (backend == "native"), sorted(set(calls))


@pytest.mark.cuda
def test_training_on_a_gpu(tmp_path, scene):
    assert trained(small(tmp_path, device="cuda", assignment="stochastic"), scene)["cells"] == 4
    assert len(open_run(tmp_path, scene=scene, device="cpu").evaluate(views=1)["views"]) == 1


def test_callbacks_are_called_in_their_order(scene):
    said = []

    class Says(Each):
        def __init__(self, name):
            super().__init__(lambda state: said.append((name, state.step)))
            self.on_start = lambda state: said.append((name, "start"))
            self.on_end = lambda state: said.append((name, "end"))
            self.after_split = lambda state, done: said.append((name, len(done.points) > 0))

    run(build(small(steps=2, split_at=(1,)), scene), [Says("a"), Says("b")])
    assert said[:2] == [("a", "start"), ("b", "start")] and said[-2:] == [("a", "end"), ("b", "end")]
    assert said[2:-2] == [(name, what) for what in (1, True, 2) for name in "ab"]


def test_the_example_is_the_whole_method(scene, monkeypatch):
    """The example uses only the library, learns within a second, and splits its cell."""
    file = Path(__file__).resolve().parents[3] / "examples" / "train.py"
    lines = file.read_text().splitlines()
    assert len(lines) <= 45 and not any("voronerf.app.train" in line for line in lines)
    monkeypatch.setattr("voronerf.app.scenes.load_scene", lambda name: scene)
    match = re.search(r"(\d+) steps, 16 cells, PSNR ([\d.]+)", script(file, "builtin", 1))
    assert int(match[1]) > 10 and float(match[2]) > 12
