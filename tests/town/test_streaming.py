"""A run of parts whose networks are pages of files, within a bound on memory."""

from __future__ import annotations

import ctypes
import mmap
import os
import shutil
import sys
from dataclasses import replace

import pytest
import torch
from helpers import refuses

from voronerf import Run, open_run
from voronerf.app import run as run_module
from voronerf.app.scenes import builtin_scene
from voronerf.app.train.checkpoint import CheckpointError
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.train.trainer import Trainer
from voronerf.town import streaming
from voronerf.town.joint import JointTrainer
from voronerf.town.parts import Similarity

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
    made = []
    monkeypatch.setattr(run_module, "Pages", lambda *given: made.append(streaming.Pages(*given)) or made[0])
    streamed = open_run(joined, scene=scene, memory="4G")
    (pages,) = made
    largest = max(file.size for file in pages.files.values())
    # As if the process took all but the room for two files.
    limit = int(4 * 2**30 * (1 - streaming.SPARE))
    monkeypatch.setattr(
        streaming, "anonymous_bytes", lambda: limit - 2 * largest + sum(file.size for file in pages.held.values())
    )
    points = torch.rand(2000, 3) * torch.tensor([9.0, 2, 1]) - 1
    asked = points, torch.tensor([[0.0, 0, 1]]), torch.zeros(2000, dtype=torch.int32)
    with torch.no_grad():
        for _ in range(2):
            assert torch.equal(streamed.router(*asked)[1], whole.router(*asked)[1])
            assert len(pages.held) == 2
    assert pages.reads == 8  # of four files twice
    for view in (0, 1):
        found = streamed.render(cameras, view)
        assert torch.equal(found.colour, wanted[view].colour) and torch.equal(found.depth, wanted[view].depth)
    streamed.cut([0, 5, 9], tmp_path / "cut")  # asks for networks that are not in memory
    whole.cut([0, 5, 9], tmp_path / "other")
    assert {path.name for path in (tmp_path / "cut").rglob("networks-*")} == {
        path.name for path in (tmp_path / "other").rglob("networks-*")
    }


def test_a_run_of_territories_comes_and_goes_by_its_averages_alone(scene, tmp_path, monkeypatch) -> None:
    """Their files have Adam's moments, too, which nobody reads."""
    config = TrainConfig(
        out=tmp_path / "run", steps=20, cells=(2,), width=8, rays=64, samples=16, evaluations=1, territories=4,
        occupancy_resolution=16, field_options=("log2_entries=13", "levels=8"), reservoir=1000,
    )  # fmt: skip
    JointTrainer(config, scene).run()
    whole = open_run(config.out, scene=scene)
    made = []
    monkeypatch.setattr(run_module, "Pages", lambda *given: made.append(streaming.Pages(*given)) or made[0])
    streamed = open_run(config.out, scene=scene, memory="4G")
    (pages,) = made
    networks = [sum(p.nbytes for p in router.parameters()) for router in streamed.router.routers]
    for (name, file), least in zip(pages.files.items(), networks, strict=True):
        length = (config.out / "checkpoints" / name).stat().st_size
        assert least <= file.size < least + 20 * mmap.PAGESIZE < length / 2
    limit, largest = int(4 * 2**30 * (1 - streaming.SPARE)), max(file.size for file in pages.files.values())
    monkeypatch.setattr(
        streaming, "anonymous_bytes", lambda: limit - 2 * largest + sum(file.size for file in pages.held.values())
    )
    for view in (0, 1):
        assert torch.equal(streamed.render(view).colour, whole.render(view).colour)
        assert len(pages.held) == 2
    assert pages.reads > 4


def test_a_run_whose_averages_are_in_one_file_is_refused_a_bound(joined, scene, tmp_path) -> None:
    out = tmp_path / "run"
    shutil.copytree(joined, out)
    Trainer(replace(open_run(out, scene=scene).config, out=out, resume=True, steps=2), scene).run()
    refuses(
        "--memory needs networks in files of their own",
        lambda: open_run(out, scene=scene, memory="4G"),
        error=ConfigError,
    )
    trained = open_run(out, scene=scene)
    trained.cut(range(trained.router.num_cells), tmp_path / "cut")
    assert torch.equal(open_run(tmp_path / "cut", scene=scene, memory="4G").render(0).colour, trained.render(0).colour)


def test_reading_leaves_nothing_in_the_cache_of_the_system(joined, scene, tmp_path) -> None:
    shutil.copytree(joined, tmp_path / "run")  # pages that another run has mapped would stay
    os.sync()
    streamed = open_run(tmp_path / "run", scene=scene, memory="4G")
    with torch.no_grad():
        streamed.router(torch.rand(2000, 3) * 8, torch.tensor([[0.0, 0, 1]]), torch.zeros(2000, dtype=torch.int32))
    cached = {path: cached_bytes(path) for path in (tmp_path / "run" / "checkpoints").iterdir()}
    assert sum(cached.values()) < 0.2 * sum(path.stat().st_size for path in cached)


def cached_bytes(path) -> int:
    """What the system has of a file in memory."""
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, flags=mmap.MAP_PRIVATE) as pages:
        states = (ctypes.c_ubyte * -(-len(pages) // mmap.PAGESIZE))()
        start = ctypes.addressof(ctypes.c_char.from_buffer(pages))
        assert ctypes.CDLL(None).mincore(ctypes.c_void_p(start), ctypes.c_size_t(len(pages)), states) == 0
        return sum(state & 1 for state in bytes(states)) * mmap.PAGESIZE


def test_far_parts_are_drawn_from_their_coarse_level(joined, scene) -> None:
    """From afar it looks nearly the same, and asks no networks; where pixels are small it is the same."""
    fine, far = (open_run(joined, scene=scene, detail=detail) for detail in (0.0, 1.0))
    camera = scene.test.cameras[[0]]
    closer = replace(camera, intrinsics=camera.intrinsics * torch.tensor([100.0, 100, 1, 1]))
    assert torch.equal(far.render(closer).colour, fine.render(closer).colour)
    poses = camera.poses.clone()
    poses[:, :3, 3] *= 12
    distant = replace(camera, poses=poses)
    wide = {"near": 1.0, "far": 100.0}
    found, wanted = (run.renderer.image(distant, 0, box=run.scene.box, **wide) for run in (far, fine))
    assert not torch.equal(found.colour, wanted.colour)
    assert (found.colour - wanted.colour).square().mean() < 1e-3
    for router in far.router.routers:
        router.register_forward_pre_hook(lambda *_: pytest.fail("a network was asked"))
    far.renderer.image(distant, 0, box=far.scene.box, **wide)
    refuses("--detail must be a number of pixels", lambda: open_run(joined, scene=scene, detail=-1), error=ConfigError)
    one = joined.parent / "0"
    refuses("--detail needs coarse levels", lambda: open_run(one, scene=scene, detail=1), error=ConfigError)


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
