"""Tests of every field with every sampling: with one cell, flat and nested cells, after a resume, and learning."""

import pytest
import torch
from helpers import read_json, trained
from tiny_runs import assert_resumes, small, steps_of

from voronerf.app import open_run
from voronerf.app.cli import main
from voronerf.app.evaluate.panels import write_panels
from voronerf.app.evaluate.scores import evaluate
from voronerf.app.scenes import builtin_scene
from voronerf.app.train import Checkpoints, build, run
from voronerf.app.train.build import count_parameters

HIERARCHICAL = {"sampling": "hierarchical", "samples": (10, 6)}
CONTRACTION, KILO, CONES = {"contraction": "sphere"}, {"field": "kilonerf"}, {"field": "mipnerf"}
#: Training variants; the 1st, 3rd, 5th and 7th together have every field and every sampling.
VARIANTS = {
    "kilonerf": KILO,
    "mipnerf": CONES,
    "mipnerf contraction": CONTRACTION | CONES,
    "nerf hierarchical": HIERARCHICAL,
    "nerf contraction": CONTRACTION | HIERARCHICAL,
    "kilonerf hierarchical": KILO | HIERARCHICAL,
    "mipnerf hierarchical": CONES | HIERARCHICAL,
}
#: The least PSNR in dB after 200 steps, about 1 dB below the worst of three seeds; a white image has 9.7.
LEARNT = {"nerf hierarchical": 19.5, "kilonerf": 18.5, "mipnerf": 19.0}
CELLS = {
    "alone": {"cells": ()},
    "uniform": {"cells": (4,), "centres": "uniform"},
    "nested": {"cells": (3, 2, 2)},
    "random init": {"cells": (4,), "init": "random", "centres": "balanced"},
    "stochastic": {"cells": (3, 2), "assignment": "stochastic", "centres": "random"},
    "worst": {"cells": (2,), "max_cells": 5},
}


@pytest.mark.parametrize(
    ("variant", "cells"),
    [(variant, cells) for i, variant in enumerate(VARIANTS) for j, cells in enumerate(CELLS) if i % 6 == j],
)
def test_every_variant_with_every_kind_of_cells(tmp_path, scene, variant, cells):
    state = build(small(tmp_path, **{"samples": (10,), **VARIANTS[variant], **CELLS[cells]}), scene)
    state.strategy.min_samples = 2
    run(state, [Checkpoints(tmp_path)])
    config = state.config
    assert state.router.num_cells == config.final_cells and state.parameter_count == count_parameters(config)
    for router in state.routers.values():
        assert torch.equal(router.diagram.centres, state.router.diagram.centres)
    opened = open_run(tmp_path, scene=scene)
    assert opened.config == config
    with state.averaged():
        assert evaluate(opened.renderer, scene, views=2) == evaluate(state.renderer, scene, views=2)
    assert len(write_panels(opened.renderer, opened.diagram, scene, tmp_path / "images", views=1)) == 1


@pytest.mark.parametrize("variant", list(VARIANTS)[::2])
def test_every_variant_resumes_bit_for_bit(tmp_path, scene, variant):
    assert_resumes(tmp_path, scene, 9, assignment="stochastic", cells=(3, 2), **VARIANTS[variant])


@pytest.mark.slow
@pytest.mark.parametrize(("variant", "floor"), LEARNT.items())
def test_variants_learn(tmp_path, variant, floor):
    size = {"steps": 200, "rays": 256, "width": 32, "depth": 3, "cells": (6,), "evaluations": 1, "eval_views": 4}
    samples = {"samples": (16, 16) if "hierarchical" in variant else (16,)}
    config = small(tmp_path, **VARIANTS[variant] | size | samples)
    assert trained(config, builtin_scene(25))["psnr"] > floor


def test_a_worst_cell_without_samples_is_split_when_it_has_them(scene):
    """If the worst cell has too few samples when a split is due, the split waits for more samples."""
    state = build(small(cells=(2,), max_cells=4, split_at=(4, 6)), scene)
    state.strategy.min_samples = 60
    stages = steps_of(state, 24).stages
    started = [stage.started_at_step for stage in stages]
    assert [stage.cells for stage in stages] == [1, 2, 3, 4]
    assert started[1] == 4 and started[2] > 6 and all(step % 5 == 0 for step in started[2:])


def test_the_command_line(tmp_path, capsys):
    folder = str(tmp_path / "run")
    tiny = "--downscale 6 --steps 12 --cells 3 --split-at 5 --width 8 --rays 64 --samples 8 4"
    tiny += " --eval-views 1 --panels 1 --field mipnerf --sampling hierarchical"
    assert main(["train", "--out", folder, *tiny.split()]) == 0
    assert "no occupancy grid with --field mipnerf, which takes cones" in " ".join(capsys.readouterr().out.split())
    assert read_json(tmp_path / "run" / "summary.json")["width"] == 8
    assert main(["eval", folder, "--views", "1", "--panels", "1", "--samples", "8", "6"]) == 0
    assert main(["render", folder, "--frames", "2", "--samples", "6", "4"]) == 0
    for options, message in (
        (["--views", "1", "--occupancy"], "--occupancy does not work with --field mipnerf, which takes cones"),
        (["--samples", "6", "0"], "--samples must be 2 numbers, one for each pass, of at least 1, got 6 0\n"),
        (["--samples", "6"], "--samples must be 2 numbers, one for each pass, of at least 1, got 6\n"),
    ):
        capsys.readouterr()
        assert main(["eval", folder, *options]) == 1 and message in capsys.readouterr().err
    capsys.readouterr()
    assert main(["train", "--out", folder, "--resume", "--steps", "14"]) == 0
    assert "no occupancy grid" not in capsys.readouterr().out  # the saved run has no grid
