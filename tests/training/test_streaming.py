"""A run of parts whose networks are pages of files, within a bound on memory."""

from __future__ import annotations

import os
import shutil
import sys

import pytest
import torch
from helpers import refuses

from voronerf import Run, open_run
from voronerf.data import builtin_scene
from voronerf.router import Similarity
from voronerf.training import streaming
from voronerf.training.checkpoint import CheckpointError
from voronerf.training.config import ConfigError, TrainConfig
from voronerf.training.trainer import Trainer

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="what is in memory is told on Linux alone")


@pytest.fixture(scope="module")
def scene():
    return builtin_scene(16, train_views=4, test_views=2)


@pytest.fixture(scope="module")
def joined(tmp_path_factory, scene):
    """Four different parts of half a MiB."""
    folder, runs = tmp_path_factory.mktemp("runs"), []
    for seed in range(4):
        config = TrainConfig(
            out=folder / str(seed), seed=seed, steps=30, cells=(4,), width=8, rays=64, samples=16, evaluations=1,
            occupancy_resolution=16, field_options=("log2_entries=13", "levels=8"), reservoir=1000,
        )  # fmt: skip
        Trainer(config, scene).run()
        runs.append(open_run(config.out, scene=scene))
    frames = [Similarity.of((2.4 * i, 0, 0)) for i in range(4)]
    Run.join(runs, folder / "joined", frames=frames)
    return folder / "joined"


def test_pictures_are_the_same_bits_while_networks_come_and_go(joined, scene, tmp_path, monkeypatch) -> None:
    whole = open_run(joined, scene=scene)
    cameras = scene.test.cameras
    wanted = [whole.render(cameras, view) for view in (0, 1)]
    shutil.copytree(joined, tmp_path / "run")  # pages that another run has mapped would stay
    os.sync()
    streamed = open_run(tmp_path / "run", scene=scene, memory="4G")
    pages = streamed.router.on_use.__self__
    dropped = []
    monkeypatch.setattr(streaming, "EVERY", 0.0)
    drop = streaming._File.drop
    monkeypatch.setattr(streaming._File, "drop", lambda file: (dropped.append(file), drop(file)))
    largest = max(file.size for file in pages.files.values())
    monkeypatch.setattr(streaming, "anonymous_bytes", lambda: int(4 * 2**30 * (1 - streaming.SPARE)) - largest)
    points = torch.rand(2000, 3) * torch.tensor([9.0, 2, 1]) - 1
    asked = points, torch.tensor([[0.0, 0, 1]]), torch.zeros(2000, dtype=torch.int32)
    with torch.no_grad():
        for _ in range(2):
            assert torch.equal(streamed.router(*asked)[1], whole.router(*asked)[1])
    assert len(set(map(id, dropped))) == 4
    resident = [file.resident(pages.libc) for file in pages.files.values()]
    assert sum(resident) <= 2 * largest
    for view in (0, 1):
        found = streamed.render(cameras, view)
        assert torch.equal(found.colour, wanted[view].colour) and torch.equal(found.depth, wanted[view].depth)


def test_opening_reads_no_networks(joined, scene, tmp_path) -> None:
    shutil.copytree(joined, tmp_path / "run")
    os.sync()  # pages that are not on disk yet stay in memory
    streamed = open_run(tmp_path / "run", scene=scene, memory="4G")
    pages = streamed.router.on_use.__self__
    read = sum(file.resident(pages.libc) for file in pages.files.values())
    assert read < 0.3 * sum(file.size for file in pages.files.values())


@pytest.mark.parametrize("text", ["", "512X", "0", "-1M", "M"])
def test_a_bound_is_a_size(joined, scene, text: str) -> None:
    refuses(
        "--memory must be a size such as 512M", lambda: open_run(joined, scene=scene, memory=text), error=ConfigError
    )


def test_sizes() -> None:
    sizes = {"512M": 2**29, "2g": 2**31, "1.5 GiB": 3 * 2**29, 4096: 4096, "64k": 2**16, "1MB": 2**20}
    assert {text: streaming.bytes_of(text) for text in sizes} == sizes


def test_what_a_bound_cannot_do(joined, scene) -> None:
    refuses("--memory must be at least", lambda: open_run(joined, scene=scene, memory="1M"), error=ConfigError)
    one = joined.parent / "0"
    refuses(
        "--memory needs --device cpu and a run of parts",
        lambda: open_run(one, scene=scene, memory="4G"),
        error=ConfigError,
    )


@pytest.mark.parametrize("damage", ["cut", "header"])
def test_damaged_files_are_named(joined, scene, tmp_path, damage: str) -> None:
    shutil.copytree(joined, tmp_path / "run")
    path = sorted((tmp_path / "run" / "checkpoints").glob("networks-*"))[0]
    if damage == "cut":
        os.truncate(path, path.stat().st_size // 2)
    else:
        path.write_bytes(b"\xff" * 100)
    with pytest.raises(CheckpointError, match=path.name):
        open_run(tmp_path / "run", scene=scene, memory="4G")
