"""Joint training: the same bits on any number of ranks, what these hold and send, moved and resumed runs."""

import functools
import gc
import json
import shutil
from dataclasses import replace

import pytest
import torch
from helpers import refuses
from ranks import joint_tensors, on_ranks

from voronerf.app.scenes import builtin_scene
from voronerf.app.scenes.scene import Sightings
from voronerf.app.train.checkpoint import CheckpointError, checkpoint_path, load_checkpoint
from voronerf.app.train.config import TrainConfig
from voronerf.town.distributed.group import joined
from voronerf.town.joint import JointTrainer, balanced
from voronerf.town.ray_runs import _Pass

CONFIGS = {
    "nerf": {"field": "nerf", "samples": 24, "depth": 2, "cells": (3, 3), "min_cell_samples": 4},
    "dense": {"field": "nerf", "samples": 24, "depth": 2, "cells": (4,), "occupancy": False, "sightings": 0.1},
    "hashgrid": {"cells": (4,)},
    "contracted": {"cells": (4,), "contraction": "sphere", "occupancy_resolution": 32, "assignment": "stochastic"},
    "random": {"field": "nerf", "samples": 24, "depth": 2, "cells": (2,), "init": "random", "precision": "fp16"},
}


def settings(out, name, **more):
    given = {
        "steps": 20,
        "split_at_steps": (8, 14)[: len(CONFIGS[name]["cells"])],
        "width": 16,
        "rays": 64,
        "territories": 4,
        "evaluations": 1,
        "final_views": 2,
        "reservoir_batches": 10,
        "checkpoint_every": 600.0,  # none by the clock, on a busy machine
        **CONFIGS[name],
        **more,
    }
    return TrainConfig(out=out, **given)


def scene():
    """Scales gradients if contracted, and says where some pixels show points."""
    found = builtin_scene(24, train_views=8, test_views=2)
    sightings = Sightings(torch.arange(200, 4600, 7), torch.linspace(2, 4, 629))
    return replace(found, kind="unbounded", train=replace(found.train, sightings=sightings))


def after_step(trainer, stop, moves, progress):
    if progress.step == stop:
        trainer.request_stop()
    if progress.step in moves:
        trainer._move(*moves[progress.step])


def train(folder, configs, stop=None, moves={}):  # noqa: B006
    """Trains configurations one after the other; writes what each rank held and sent."""
    with joined(torch.device("cpu")) as group:
        for name, config in configs.items():
            group.sent.clear()
            trainer = JointTrainer(config, scene(), group=group)
            trainer.on_step = functools.partial(after_step, trainer, stop, moves)
            trainer.run()
            held = [p for each in trainer.trainers.values() for p in each.router.parameters()]
            found = {"own": list(trainer.trainers), "held": sum(v.numel() for v in held), "sent": group.sent}
            (folder / f"{name}-{group.rank}.json").write_text(json.dumps(found))


#: Ranks of each; of nerf there are other numbers below.
RANKS = {"nerf": 4, "dense": 2, "hashgrid": 4, "contracted": 2, "random": 3}


def run_of_one(folder, name):
    """A run of one process; returns its tensors."""
    config = settings(folder / f"1-{name}", name)
    JointTrainer(config, scene()).run()
    return joint_tensors(config.out)


def assert_same(first, second):
    assert first.keys() == second.keys()
    different = [name for name in first if not torch.equal(first[name].nan_to_num(), second[name].nan_to_num())]
    assert not different


@pytest.mark.parametrize("name", CONFIGS)
def test_ranks_are_one_process_to_the_bit(tmp_path, name):
    """And a rank holds the networks of its own territories, and of the rays of others 32 bytes each."""
    one, size = run_of_one(tmp_path, name), RANKS[name]
    assert any(key.endswith("router.diagram.centres") and len(value) > 1 for key, value in one.items())
    both = [tmp_path / f"{ranks}-{name}" for ranks in (1, size)]
    codes, _ = on_ranks(train, tmp_path, {name: settings(both[1], name)}, folder=tmp_path, size=size)
    assert codes == [0] * size
    assert_same(one, joint_tensors(both[1]))
    files = [{p.name.split("-")[0] for p in run.rglob("*.*")} for run in both]
    assert files[0] == files[1]
    scores = [json.loads((run / "summary.json").read_text()) for run in both]
    for key in ("psnr", "ssim", "parameters", "cells", "splits_left"):
        assert scores[0][key] == scores[1][key], key
    found = [json.loads((tmp_path / f"{name}-{rank}.json").read_text()) for rank in range(size)]
    assert sorted(number for each in found for number in each["own"]) == [0, 1, 2, 3]
    for each in found:
        keys = [key for key in one for number in each["own"] if key.startswith(f"{number}.router.module.")]
        assert each["held"] == sum(one[key].numel() for key in keys)
        assert each["sent"]["sums"] > 0 and each["sent"]["answers"] > 0
        if name == "hashgrid":
            steps, rays = 20, 64
            most = 2 * rays  # of a territory to which few of others come
            assert each["sent"]["rays"] < steps * 3 * (32 * (most + 8) * 9 / 8 + 64)


def test_territories_move_and_ranks_change(tmp_path):
    """Moved territories, other numbers of ranks, and a restart in one process go on to the bit."""
    expected = run_of_one(tmp_path, "nerf")
    moving = settings(tmp_path / "moving", "nerf")
    moves = {5: ([1, 2], [0, 1, 0, 1]), 11: ([0, 1, 3], [1, 0, 0, 0])}
    codes, _ = on_ranks(train, tmp_path, {"moving": moving}, None, moves, folder=tmp_path)
    assert codes == [0, 0]
    assert_same(expected, joint_tensors(moving.out))
    own = [json.loads((tmp_path / f"moving-{rank}.json").read_text())["own"] for rank in range(2)]
    assert own == [[1, 2, 3], [0]]

    half = settings(tmp_path / "half", "nerf")
    assert on_ranks(train, tmp_path, {"half": half}, 11, folder=tmp_path)[0] == [0, 0]
    assert load_checkpoint(checkpoint_path(half.out)).values["step"] == 16
    for ranks in (3, 1):  # with as many as before: test_a_rank_that_is_killed
        config = replace(half, out=tmp_path / f"to-{ranks}", resume=True)
        shutil.copytree(half.out, config.out)
        if ranks == 1:
            JointTrainer(config, scene()).run()
        else:
            assert on_ranks(train, tmp_path, {"rest": config}, folder=tmp_path, size=ranks)[0] == [0] * ranks
        assert_same(expected, joint_tensors(config.out))
    other = replace(half, resume=True, territories=2)
    refuses("--territories 4 -> 2", JointTrainer, other, scene(), error=CheckpointError)


def test_eight_ranks_are_one_process_to_the_bit(tmp_path):
    """Two splits; two territories change places between them."""
    given = {"territories": 8, "steps": 24, "cells": (2, 2), "split_at_steps": (8, 18)}
    one, eight = (settings(tmp_path / name, "hashgrid", **given) for name in ("one", "eight"))
    JointTrainer(one, scene()).run()
    moves = {13: ([0, 5], [5, 1, 2, 3, 4, 0, 6, 7])}
    assert on_ranks(train, tmp_path, {"eight": eight}, None, moves, folder=tmp_path, size=8)[0] == [0] * 8
    assert_same(joint_tensors(one.out), joint_tensors(eight.out))
    assert json.loads((tmp_path / "eight-5.json").read_text())["own"] == [0]


@pytest.mark.parametrize("name", ["dense", "hashgrid"])
def test_a_step_leaves_no_tensors_for_the_collector(tmp_path, name):
    """Else the next one is given new pages by the system, which takes an eighth of its time."""
    trainer = JointTrainer(settings(tmp_path / "run", name), scene())
    gc.collect()
    gc.disable()
    try:
        trainer.train_step()
        assert not [each for each in gc.get_objects() if type(each) is _Pass]
    finally:
        gc.enable()


def test_the_heaviest_rank_gives_territories_away():
    assert balanced([0, 0, 1, 1], [1.0, 1.1, 1.0, 1.0], 2) == [0, 0, 1, 1], "within bounds"
    assert balanced([0, 0, 0, 1], [1.0, 2.0, 3.0, 1.0], 2) == [0, 1, 0, 1]
    assert balanced([0, 1], [9.0, 1.0], 2) == [0, 1], "a rank keeps one"
    assert balanced([0, 0, 1], [5.0, 0.1, 5.0], 2) == [0, 0, 1], "no move would help"
    many = balanced([0] * 6 + [1, 2], [1.0] * 8, 3)
    assert sorted(many.count(rank) for rank in range(3)) == [2, 3, 3]


def ask_early():
    """Asks for two kinds of messages at once, and gets them in the other order, and more rows than fit."""
    with joined(torch.device("cpu")) as group:
        other = 1 - group.rank
        for rows in (3, 0, 40):
            for kind in ("first", "second"):
                group.expect(kind, 2, {other: 1})
            for kind, value in (("second", 2.0), ("first", 1.0)):
                part = torch.full((rows, 2), value)
                came = group.exchange(kind, 2, {other: [part]}, {other: 1})
                assert torch.equal(came[other][0], part), (kind, rows)


def test_messages_can_be_asked_for_early(tmp_path):
    assert on_ranks(ask_early, folder=tmp_path)[0] == [0, 0]
