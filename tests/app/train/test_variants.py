"""Every field with every sampling: alone, with cells of every kind, inherited alike, resumed, and learning."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers import read_json
from tiny_runs import assert_resumes, small, stopping

from voronerf import open_run
from voronerf.app.cli import main
from voronerf.app.evaluate.panels import write_panels
from voronerf.app.evaluate.scores import evaluate, render_view
from voronerf.app.scenes import builtin_scene
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.train.networks import count_parameters, network_names, resolve_config, solve_width
from voronerf.app.train.renderers import make_contraction
from voronerf.app.train.trainer import Trainer

HIERARCHICAL, PROPOSAL = {"sampling": "hierarchical"}, {"sampling": "proposal"}
CONTRACTION, KILO, CONES = {"contraction": "sphere"}, {"field": "kilonerf"}, {"field": "mipnerf"}
#: In an order in which every third has every kind of field and of sampling.
VARIANTS = {
    "kilonerf": KILO,
    "mipnerf": CONES,
    "mipnerf contraction": CONTRACTION | CONES,
    "nerf hierarchical": HIERARCHICAL,
    "nerf proposal": PROPOSAL,
    "nerf contraction": CONTRACTION | HIERARCHICAL,
    "mipnerf proposal": CONES | PROPOSAL,
    "kilonerf hierarchical": KILO | HIERARCHICAL,
    "kilonerf proposal": KILO | PROPOSAL,
    "mipnerf hierarchical": CONES | HIERARCHICAL,
    "mipnerf 360": CONTRACTION | CONES | PROPOSAL,
}
#: The PSNR in dB that 200 steps reach, about 1 dB below the least of three seeds; white has 9.7. Every kind of field,
#: of sampling, and of space is among them.
LEARNT = {"nerf hierarchical": 19.5, "kilonerf proposal": 19.0, "mipnerf": 19.0, "mipnerf 360": 19.5}
CELLS = {
    "alone": {"cells": ()},
    "uniform": {"cells": (4,), "centres": "uniform"},
    "centroidal": {"cells": (4,), "centres": "centroidal"},
    "nested centroidal": {"cells": (3, 2), "centres": "centroidal", "min_cell_samples": 2},
    "nested uniform": {"cells": (3, 2), "centres": "uniform", "min_cell_samples": 2},
    "nested": {"cells": (3, 2, 2)},
    "random init": {"cells": (4,), "init": "random"},
    "stochastic": {"cells": (3, 2), "assignment": "stochastic"},
    "worst": {"cells": (2,), "split": "worst", "max_cells": 5},
}


@pytest.mark.parametrize(
    ("variant", "cells"),
    [(variant, cells) for i, variant in enumerate(VARIANTS) for j, cells in enumerate(CELLS) if i % 3 == j % 3],
)
def test_every_variant_with_every_kind_of_cells(tmp_path, scene, variant, cells):
    trainer = Trainer(small(tmp_path, samples=10, **VARIANTS[variant], **CELLS[cells]), scene)
    summary, config = trainer.run(), trainer.config
    assert summary["complete"] and summary["cells"] == config.final_cells
    assert summary["parameters"] == count_parameters(config)
    assert set(trainer.routers) == set(network_names(config))
    for name, router in trainer.routers.items():
        if name == "proposal":
            assert router.num_cells == 1
        else:
            assert torch.equal(router.diagram.centres, trainer.router.diagram.centres)
            assert router.num_cells == config.final_cells
    run = open_run(tmp_path, scene=scene)
    assert run.config == config
    with trainer.averaged():
        assert evaluate(run.renderer, scene, views=2) == evaluate(trainer.renderer, scene, views=2)
    assert len(write_panels(run.renderer, run.diagram, scene, tmp_path / "images", views=1)) == 1


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_resumes_bit_for_bit(tmp_path, scene, variant):
    assert_resumes(tmp_path, scene, 9, assignment="stochastic", cells=(3, 2), **VARIANTS[variant])


@pytest.mark.parametrize(("variant", "floor"), LEARNT.items())
def test_variants_learn(tmp_path, variant, floor):
    size = {"steps": 200, "rays": 256, "samples": 16, "fine_samples": 16, "width": 32, "depth": 3}
    config = small(tmp_path, **VARIANTS[variant], **size, cells=(6,), evaluations=1, final_views=4)
    assert Trainer(config, builtin_scene(25)).run()["psnr"] > floor


def test_coarse_and_fine_inherit_alike(tmp_path, scene):
    """After the split every cell of both networks has its parent's parameters and Adam's moments."""
    trainer = stopping(small(tmp_path, **HIERARCHICAL), scene, 12)
    trainer.advance()

    def state():
        weights = {name: router.module.trunk[0].weight for name, router in trainer.routers.items()}
        return {n: (w.detach().clone(), trainer.optimizer.state[w]["exp_avg"].clone()) for n, w in weights.items()}

    before = state()
    trainer.split()
    assert not torch.equal(before["field"][0], before["coarse"][0])
    for name, (weight, moment) in state().items():
        assert torch.equal(weight, before[name][0].expand_as(weight))
        assert bool(moment.any()) and torch.equal(moment, before[name][1].expand_as(moment))
    assert torch.equal(trainer.routers["coarse"].diagram.centres, trainer.router.diagram.centres)


def test_importance_is_that_of_the_last_pass(tmp_path, scene, monkeypatch):
    trainer = stopping(small(tmp_path, **HIERARCHICAL, reservoir=50, reservoir_batches=1, split_at=(0.9,)), scene, 1)
    results, run = [], trainer.learner.run
    keep = lambda *a, **options: results.append((a[0], run(*a, **options))) or results[-1][1]  # noqa: E731
    monkeypatch.setattr(trainer.learner, "run", keep)
    render = trainer.renderer.render
    passes = []
    monkeypatch.setattr(trainer.renderer, "render", lambda *a, **k: passes.append(render(*a, **k)) or passes[-1])
    trainer.advance()
    (batch, _), (_, fine) = results[0], passes[0]
    error = (fine.colour - batch.target).square().sum(1)
    expected = (fine.samples.by_ray(fine.weights) * error[:, None]).detach().reshape(-1).topk(50).values
    kept = trainer.cells.reservoir.samples()[1]
    torch.testing.assert_close(kept.sort(descending=True).values, expected)


def test_widths_count_all_networks(scene):
    def solved(**options):
        config = resolve_config(small(Path("x"), cells=(12,), parameters=200_000, **options), scene)
        width = solve_width(config, 200_000)
        assert config.width == width and count_parameters(config) <= 200_000 < count_parameters(config, width + 1)
        return width

    assert solved(**HIERARCHICAL) < solved() and solved(**CONES, **HIERARCHICAL)
    assert solved(**PROPOSAL) <= solved()


def test_empty_space_is_skipped_wherever_that_works(scene):
    for settings in (HIERARCHICAL, CONES):
        assert not resolve_config(TrainConfig(**settings), scene).occupancy
    graph = {"cuda_graph": True, "device": "cuda"}
    for settings in ({}, KILO, {"field": "nerf"}, graph, CONTRACTION, CONTRACTION | KILO):
        assert resolve_config(TrainConfig(**settings), scene).occupancy
        assert not resolve_config(TrainConfig(occupancy=False, **settings), scene).occupancy
        resolved = resolve_config(TrainConfig(**settings), replace(scene, box=None))
        assert resolved.occupancy == (resolved.contraction != "none")


def test_a_hash_grid_in_a_scene_without_bounds_is_contracted(scene):
    unbounded = replace(scene, box=None)
    assert resolve_config(TrainConfig(), unbounded).contraction == "sphere"
    assert resolve_config(TrainConfig(), scene).contraction == "none"
    assert resolve_config(TrainConfig(field="nerf"), unbounded).contraction == "none"


def test_the_sphere_of_a_contraction(tmp_path, scene):
    boxed = make_contraction(scene)
    assert torch.equal(boxed.centre, scene.box.mean(0)) and bool((boxed.points(scene.box) == scene.box).all())
    far = make_contraction(replace(scene, box=None))
    assert far.radius == pytest.approx(4.0, rel=1e-3) and not far.centre.any()
    poses = scene.train.cameras.poses.clone()
    poses[:, :3, 3] = 0
    train = replace(scene.train, cameras=replace(scene.train.cameras, poses=poses))
    with pytest.raises(ConfigError, match="--contraction sphere needs cameras in several places"):
        make_contraction(replace(scene, box=None, train=train))
    open_space = replace(scene, box=None, near=0.5, far=60.0, spacing="disparity")
    trainer = Trainer(small(tmp_path, **CONTRACTION, **HIERARCHICAL), open_space)
    assert trainer.run()["complete"]
    heaviest, centres = render_view(trainer.renderer, open_space, 0).heaviest, trainer.router.diagram.centres
    assert float(heaviest.norm(dim=-1).max()) < 8.01 and float(centres.norm(dim=1).max()) < 8


def test_the_command_line(tmp_path, capsys):
    run = str(tmp_path / "run")
    tiny = "--downscale 6 --steps 12 --cells 3 --split-at-steps 5 --width 8 --rays 64 --samples 8 --fine-samples 4"
    tiny += " --eval-views 1 --final-views 1 --panels 1 --field mipnerf --sampling hierarchical"
    assert main(["train", "--out", run, *tiny.split()]) == 0
    assert "no occupancy grid with --field mipnerf, which takes cones" in " ".join(capsys.readouterr().out.split())
    assert read_json(tmp_path / "run" / "summary.json")["width"] == 8
    assert main(["eval", run, "--views", "1", "--panels", "1", "--fine-samples", "6"]) == 0
    assert main(["render", run, "--frames", "2", "--samples", "6"]) == 0
    for options, message in (
        (["--views", "1", "--occupancy"], "--occupancy does not work with --field mipnerf, which takes cones"),
        (["--fine-samples", "0"], "--fine-samples must be at least 1, got 0"),
    ):
        capsys.readouterr()
        assert main(["eval", run, *options]) == 1 and message in capsys.readouterr().err
    capsys.readouterr()
    assert main(["train", "--out", run, "--resume", "--steps", "14"]) == 0
    assert "no occupancy grid" not in capsys.readouterr().out  # the run in --out says --no-occupancy by now


def test_a_worst_cell_without_samples_is_split_when_it_has_them(tmp_path, scene):
    """Few samples a step, 5 of them, and splits planned sooner than enough are kept."""
    kept = {"samples": 10, "reservoir": 200, "reservoir_batches": 40, "min_cell_samples": 20}
    config = small(tmp_path, cells=(2,), split="worst", max_cells=4, split_at_steps=(4, 6), **kept)
    trainer = Trainer(config, scene)
    trainer.advance()
    started = [stage.started_at_step for stage in trainer.stages]
    assert [stage.cells for stage in trainer.stages] == [1, 2, 3, 4]
    assert started[1] == 4 and started[2] > 6 and all(step % 5 == 0 for step in started[2:])


def test_a_cell_of_a_proposal_is_a_module(tmp_path, scene):
    router, points = Trainer(small(tmp_path, **PROPOSAL), scene).routers["proposal"], torch.rand(5, 3)
    for found, expected in zip(router.cell(0)(points), router(points, torch.rand(5, 3), torch.arange(5).int())):
        torch.testing.assert_close(found, expected)
