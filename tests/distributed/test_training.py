"""Training over two ranks: as one process, memory, bytes, checkpoints, resumed runs."""

import functools
import json
import shutil
from dataclasses import replace

import pytest
import torch
from helpers import refuses, same
from ranks import on_ranks

from voronerf import open_run
from voronerf.data import builtin_scene
from voronerf.data.scene import Sightings
from voronerf.distributed.group import joined
from voronerf.training.checkpoint import checkpoint_path, load_checkpoint
from voronerf.training.config import TrainConfig
from voronerf.training.trainer import Trainer

CONFIGS = {
    "nerf": {"field": "nerf", "samples": 24, "depth": 2, "cells": (3, 3), "min_cell_samples": 4},
    "dense": {"field": "nerf", "samples": 24, "depth": 2, "cells": (4,), "occupancy": False, "sightings": 0.1},
    "hashgrid": {"cells": (4,)},
    "contracted": {"cells": (4,), "contraction": "sphere", "occupancy_resolution": 32},
}


def settings(out, name):
    config = CONFIGS[name]
    return TrainConfig(
        out=out,
        steps=20,
        split_at_steps=(8, 14)[: len(config["cells"])],
        width=16,
        rays=128,
        evaluations=1,
        final_views=1,
        reservoir_batches=10,
        **config,
    )


def scene():
    """Scales gradients if contracted, and says where some pixels show points."""
    found = builtin_scene(24, train_views=8, test_views=2)
    sightings = Sightings(torch.arange(200, 4600, 7), torch.linspace(2, 4, 629))
    return replace(found, kind="unbounded", train=replace(found.train, sightings=sightings))


def stop_at(trainer, step, progress):
    if progress.step == step:
        trainer.request_stop()


def train(folder, configs, stop=None):
    """Trains configurations one after the other; writes what each rank held and sent."""
    with joined(torch.device("cpu")) as group:
        for name, config in configs.items():
            group.sent.clear()
            trainer = Trainer(config, scene(), group=group)
            trainer.on_step = functools.partial(stop_at, trainer, stop)
            trainer.run()
            held = list(trainer.router.parameters())
            held += [v for state in trainer.optimizer.state.values() for v in state.values()]
            found = {"cells": trainer.router.num_cells, "held": sum(v.numel() for v in held), "sent": group.sent}
            (folder / f"{name}-{group.rank}.json").write_text(json.dumps(found))


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Runs of one process and of two ranks."""
    folder = tmp_path_factory.mktemp("ranks")
    codes, _ = on_ranks(train, folder, {n: settings(folder / f"two-{n}", n) for n in CONFIGS}, folder=folder)
    assert codes == [0, 0]
    for name in CONFIGS:
        Trainer(settings(folder / f"one-{name}", name), scene()).run()
    return folder


def tensors(run):
    return load_checkpoint(checkpoint_path(run)).tensors


@pytest.mark.parametrize("name", CONFIGS)
def test_two_ranks_are_one_process(runs, name):
    one, two = tensors(runs / f"one-{name}"), tensors(runs / f"two-{name}")
    assert two.keys() - one.keys() == {"sharing.owner", "sharing.weights"}
    for key, expected in one.items():
        if not expected.is_floating_point():
            assert torch.equal(two[key], expected), key
        else:
            assert (two[key] - expected).norm() <= 1e-5 * expected.norm(), key
    first, second = (open_run(runs / f"{count}-{name}", scene=scene()) for count in ("one", "two"))
    assert torch.allclose(first.render(0).colour, second.render(0).colour, atol=1e-4)
    files = [{str(p.relative_to(run.path)) for p in run.path.rglob("*.*")} for run in (first, second)]
    assert all(name.startswith("checkpoints/cells-") for name in files[0] ^ files[1])
    scores = [json.loads((run.path / "summary.json").read_text()) for run in (first, second)]
    # Pictures of one process end rays at opaque surfaces.
    assert scores[0]["psnr"] == pytest.approx(scores[1]["psnr"], abs=0.02)
    assert scores[0]["parameters"] == scores[1]["parameters"] and scores[0]["cells"] == scores[1]["cells"]


def test_what_a_rank_holds_and_sends(runs):
    """Its own cells, and 28 bytes a run there and back with some room, where points are learnt from too."""
    one = tensors(runs / "one-dense")
    whole = sum(v.numel() for k, v in one.items() if k.startswith(("router.module.", "optimizer.")))
    for rank in (0, 1):
        found = json.loads((runs / f"dense-{rank}.json").read_text())
        assert found["cells"] == 2 and found["held"] < 0.6 * whole
        assert 0 < found["sent"]["sums"] <= 20 * 128 * 64


def test_resumed_on_other_numbers_of_ranks(runs, tmp_path):
    """The same number goes on bit for bit; another one, also a single process, as it would have but for rounding."""
    half = settings(tmp_path / "half", "nerf")
    codes, _ = on_ranks(train, tmp_path, {"half": half}, 11, folder=tmp_path)
    assert codes == [0, 0] and load_checkpoint(checkpoint_path(half.out)).values["step"] == 12
    files = sorted(path.name.split("-")[0] for path in (half.out / "checkpoints").iterdir())
    assert files == ["cells", "cells", "last.safetensors"]
    expected = tensors(runs / "two-nerf")
    for ranks in (2, 3, 1):
        config = replace(half, out=tmp_path / f"to-{ranks}", resume=True)
        shutil.copytree(half.out, config.out)
        if ranks == 1:
            Trainer(config, scene()).run()
        else:
            assert on_ranks(train, tmp_path, {"rest": config}, folder=tmp_path, size=ranks)[0] == [0] * ranks
        found = tensors(config.out)
        if ranks == 2:
            assert same(found, expected)
        for key, value in expected.items():
            if value.is_floating_point() and not key.startswith("sharing"):
                assert (found[key] - value).norm() <= 1e-5 * value.norm(), (ranks, key)
    shard = next(path for path in half.out.rglob("cells-*"))
    shard.rename(shard.with_name("elsewhere"))
    refuses(f"{shard}: there is no checkpoint", load_checkpoint, checkpoint_path(half.out))
