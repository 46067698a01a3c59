"""Tests of joined, cut and placed runs, as files and as pictures."""

from __future__ import annotations

import errno
import importlib
import os
import platform
import shutil
import signal
from dataclasses import replace

import pytest
import torch
from helpers import refuses, trained

from voronerf import editing
from voronerf.app import open_run
from voronerf.app.cli import main
from voronerf.app.scenes import builtin_scene
from voronerf.app.scenes.record import read_scene, write_scene
from voronerf.app.train.checkpoint import Checkpoint, CheckpointError, checkpoint_path, load_checkpoint, save_checkpoint
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.editing import Similarity, Solid, edits
from voronerf.editing.parts import Parts

SMALL = ("log2_entries=10", "levels=4")


@pytest.fixture(autouse=True, scope="module")
def coarse_grids():
    """Coarsens the occupancy grids that are built for runs without one, to save time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(importlib.import_module("voronerf.app.train.build"), "PICTURE_RESOLUTION", 24)
        patch.setattr(edits, "PICTURE_RESOLUTION", 24)
        patch.setattr(edits, "MOST_VOXELS", 1 << 16)
        yield


@pytest.fixture(scope="module")
def scene():
    return builtin_scene(16, train_views=6, test_views=2)


@pytest.fixture(scope="module")
def runs(tmp_path_factory, scene):
    """The folders of two runs: a hash grid with an occupancy grid, and a wider NeRF without a grid."""
    folder = tmp_path_factory.mktemp("runs")
    shared = {"steps": 60, "rays": 128, "samples": (16,), "evaluations": 1}
    first = TrainConfig(out=folder / "first", cells=(4,), width=8, field_options=SMALL, **shared)
    second = TrainConfig(out=folder / "second", cells=(4,), width=12, depth=2, field="nerf", occupancy=False, **shared)
    for config in (first, second):
        trained(config, scene)
    return first.out, second.out


@pytest.fixture(scope="module")
def opened(runs, scene):
    return [open_run(run, scene=scene) for run in runs]


def joined_run(runs, out, frames=None):
    editing.join([run.path for run in runs], out, frames=frames)
    return editing.open_run(out, scene=runs[0].scene)


def cut_run(run, kept, out, outside=False):
    editing.cut(run.path, kept, out, outside=outside)
    return editing.open_run(out, scene=run.scene)


def placed_run(run, thing, at, out, scale=1.0):
    editing.place(run.path, thing.path, at, out, scale=scale)
    return editing.open_run(out, scene=run.scene)


def in_region(part, points):
    """Returns which points of the scene lie in all solids of a part, bool [n]."""
    local = part.frame.inverse.points(points)
    inside = [solid.holds(local) for solid in part.region]
    return torch.stack(inside).all(0) if inside else torch.ones(len(local)).bool()


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_runs_of_different_fields_are_joined(opened, runs, tmp_path) -> None:
    before = [contents(run) for run in runs]
    joined = joined_run(opened, tmp_path / "joined")
    assert isinstance(joined.router, Parts) and joined.router.num_cells == sum(run.router.num_cells for run in opened)
    points = torch.rand(400, 3) * 2 - 1
    centres = torch.cat([run.diagram.leaf_centres for run in opened])
    inside = in_region(joined.router[0], points)
    nearest = torch.cdist(points, centres).argmin(1)[inside]
    who = joined.router.assign(points)[inside]
    k = opened[0].router.num_cells
    assert torch.equal(who < k, nearest < k)
    inputs = points, torch.tensor([[0.0, 0, 1]]), torch.zeros(400, dtype=torch.int32)
    density = joined.router(*inputs)[1][inside]
    for mask, run in ((who < k, opened[0]), (who >= k, opened[1])):
        assert torch.allclose(density[mask], run.router(*inputs)[1][inside][mask], rtol=1e-4, atol=1e-5)
    assert joined.evaluate(lpips="off")["psnr"] > 8
    assert [contents(run) for run in runs] == before


@pytest.mark.slow
def test_a_joined_run_is_joined_and_cut_again(opened, tmp_path) -> None:
    frames = [Similarity(), Similarity.of((3, 0, 0))]
    pair = joined_run(opened, tmp_path / "pair", frames=frames)
    four = joined_run([pair, pair], tmp_path / "four", frames=[Similarity(), Similarity.of((0, 3, 0), (0, 0, 90))])
    assert len([*four.router]) == 4 and four.router.num_cells == 2 * pair.router.num_cells
    files = list((tmp_path / "four" / "checkpoints").glob("networks-*"))
    assert len(files) == 2  # networks in two places are stored once
    assert four.router[0].network is four.router[2].network
    low, high = pair.router[1].frame.points(opened[1].scene.box)
    back = cut_run(four, Solid.box(low.tolist(), high.tolist()), tmp_path / "back")
    assert len([*back.router]) < 4 and any(
        torch.equal(p.diagram.centres, pair.router[1].diagram.centres) for p in back.router
    )
    x = torch.rand(300, 3) * (high - low) + low
    inputs = x, torch.tensor([[0.0, 0, 1]]), torch.zeros(300, dtype=torch.int32)
    assert torch.allclose(back.router(*inputs)[1], pair.router(*inputs)[1], rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_the_grid_has_all_that_the_grids_of_the_runs_have(opened, tmp_path, scene) -> None:
    frames = [Similarity(), Similarity.of((0.7, 0.2, 0.1), (20, 30, 40), 0.6)]
    joined = joined_run(opened, tmp_path / "joined", frames=frames)
    assert joined.scene.box[1, 0] > scene.box[1, 0] and joined.config.samples[0] > 16
    grid = joined.renderer.occupancy
    for run, frame in zip(opened, frames, strict=True):
        run_grid = edits.RunContents.of(run.path).grid
        full = run_grid.occupied.view(-1).nonzero()[:, 0]
        points = run_grid.points(full, torch.rand(len(full), 3))
        assert grid.occupied.view(-1)[grid.voxels(frame.points(points)).long()].all()
    assert grid.share < 1


def test_a_region_is_cut_exactly(opened, tmp_path) -> None:
    run, ball = opened[0], Solid(ball=(0.2, 0.1, 0.0, 0.4))
    points = torch.rand(500, 3) * 2 - 1
    inputs = points, torch.tensor([[0.0, 0, 1]]), torch.zeros(500, dtype=torch.int32)
    inside = ball.holds(points)
    kept, rest = cut_run(run, ball, tmp_path / "kept"), cut_run(run, ball, tmp_path / "rest", outside=True)
    for cut, where in ((kept, inside), (rest, ~inside)):
        density, occupied = cut.router(*inputs)[1], cut.router.assign(points) >= 0
        assert not density[~where].any()
        # Only the occupied rows are evaluated, since rounding depends on the number of rows.
        wanted = run.router(points[occupied], inputs[1], inputs[2][occupied])[1]
        assert occupied.any() and torch.equal(density[occupied], wanted)
    assert (kept.scene.box[1] - kept.scene.box[0]).max() <= 0.8 + 2 * 2.36 / 16
    size = {path: sum(map(len, contents(tmp_path / path).values())) for path in ("kept", "rest")}
    voxels = run.renderer.occupancy.occupied.numel()  # bytes of the training's voxels, which a cut run keeps, too
    assert size["kept"] <= size["rest"] < sum(map(len, contents(run.path).values())) + voxels


@pytest.mark.slow
def test_cells_are_cut(opened, tmp_path) -> None:
    run = opened[1]
    kept = cut_run(run, [1, 2], tmp_path / "kept")
    assert kept.router.num_cells == 2 and kept.router[0].network.router.module.trunk[0].weight.shape[0] == 2
    rest = cut_run(run, [1, 2], tmp_path / "rest", outside=True)
    assert rest.router.num_cells == run.router.num_cells - 2
    for said, part, outside in (
        *(("--cells must be numbers of 0..", cells, False) for cells in ([99], [])),
        ("nothing is left", Solid.box((5, 5, 5), (6, 6, 6)), False),
        ("nothing is left", range(run.router.num_cells), True),
    ):
        refuses(said, cut_run, run, part, tmp_path / "no", outside, error=ConfigError)
    assert not (tmp_path / "no").exists()


@pytest.mark.slow
def test_an_object_is_placed_on_top(opened, tmp_path) -> None:
    thing = cut_run(opened[0], Solid(ball=(0, 0, 0, 0.5)), tmp_path / "thing")
    both = placed_run(opened[1], thing, (0.1, 0.2, 0.5), tmp_path / "both", scale=0.5)
    assert [part.layer for part in both.router] == [0, 1]
    assert read_scene(both.path / "scene.json").train.names == opened[1].scene.train.names
    foot = both.router[1].frame.points(torch.cat((thing.scene.box.mean(0)[:2], thing.scene.box[0, 2:]))[None])
    assert torch.allclose(foot, torch.tensor([[0.1, 0.2, 0.5]]), atol=1e-5)
    points = torch.rand(500, 3) * 2 - 1
    inputs = points, torch.tensor([[0.0, 0, 1]]), torch.zeros(500, dtype=torch.int32)
    assert (both.router(*inputs)[1] >= opened[1].router(*inputs)[1] * in_region(both.router[0], points) - 1e-5).all()
    again = cut_run(both, [both.router.num_cells - 1], tmp_path / "again")  # only the object
    assert [part.layer for part in again.router] == [0]


@pytest.mark.parametrize("what", ["gone", "damaged", "elsewhere"])
def test_damaged_networks_are_named(opened, tmp_path, scene, what: str) -> None:
    joined_run(opened, tmp_path / "run")
    path = next((tmp_path / "run" / "checkpoints").glob("networks-*"))
    if what == "gone":
        path.unlink()
    elif what == "damaged":
        data = bytearray(path.read_bytes())
        data[-5] ^= 1
        path.write_bytes(bytes(data))
    else:
        index = path.with_name("last.safetensors")
        data = index.read_bytes()
        assert data.count(path.name.encode()) >= 1
        index.write_bytes(data.replace(path.name.encode(), b"../" + path.name.encode()[3:]))
    with pytest.raises(CheckpointError, match=r"networks-|last\.safetensors"):
        editing.open_run(tmp_path / "run", scene=scene)


def test_a_full_disk_leaves_nothing(opened, tmp_path, monkeypatch) -> None:
    def full(path, checkpoint):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr("voronerf.editing.run.save_checkpoint", full)
    with pytest.raises(OSError, match=r"No space left on device.*joined"):
        joined_run(opened, tmp_path / "joined")
    assert not list(tmp_path.iterdir())


def test_a_command_that_is_ended_leaves_nothing(runs, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(edits, "write_scene", lambda *_: os.kill(os.getpid(), signal.SIGTERM))
    with pytest.raises(SystemExit) as ended:
        main(["cut", str(runs[0]), "--cells", "0", "--out", str(tmp_path / "out")])
    assert ended.value.code == 128 + signal.SIGTERM and not list(tmp_path.iterdir())
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


@pytest.mark.skipif(os.name != "posix", reason="whether a process runs is not known")
def test_what_a_killed_command_left_is_removed_by_the_next(opened, tmp_path) -> None:
    child = os.fork()
    if not child:
        os._exit(0)
    os.waitpid(child, 0)
    host = platform.node()
    others = [".backup.2024-01-01.partial", f".other.{host}.{os.getppid()}.partial", f".other.{host}x.{child}.partial"]
    for name in (f".other.{host}.{child}.partial", *others[1:]):
        (tmp_path / name).mkdir()
        (tmp_path / name / "scene.json").touch()
    (tmp_path / ".backup.2024-01-01.partial").mkdir()
    joined_run(opened, tmp_path / "run")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*others, "run"])


def test_out_is_a_new_folder(opened, tmp_path) -> None:
    joined_run(opened, tmp_path / "run")
    before = contents(tmp_path / "run")
    refuses("--out must not hold a run already", lambda: joined_run(opened, tmp_path / "run"), error=ConfigError)
    (tmp_path / "file").write_text("mine")
    refuses("--out must be a new or an empty folder", lambda: joined_run(opened, tmp_path / "file"), error=ConfigError)
    assert contents(tmp_path / "run") == before and (tmp_path / "file").read_text() == "mine"


def altered(run, out, *, config=None, bias=0.0, **scene):
    """Copies a run with changed settings or scene, or a density bias and empty voxels; returns the copy's folder."""
    shutil.copytree(run, out)
    write_scene(out / "scene.json", replace(read_scene(run / "scene.json"), **scene))
    checkpoint = load_checkpoint(checkpoint_path(out))
    tensors = {name: tensor.clone() for name, tensor in checkpoint.tensors.items() if not name.startswith("optimizer.")}
    if bias:
        tensors["router.module.density.bias"] += bias
        tensors["occupancy.occupied"][:64] = False  # the half at low x
    values = {**checkpoint.values, "config": {**checkpoint.values["config"], **(config or {})}}
    save_checkpoint(checkpoint_path(out), Checkpoint(tensors, values))
    return out


def test_what_cannot_be_joined(runs, tmp_path) -> None:
    one, two = runs
    cones = altered(two, tmp_path / "cones", config={"field": "mipnerf", "field_options": []})
    endless, black = altered(two, tmp_path / "endless", box=None), altered(two, tmp_path / "black", background=None)
    for settings, said in (
        ([one], "two runs or more"),
        ([cones, two], "cannot be joined or cut: its cones"),
        ([one, endless], "must have bounds to be joined"),
        ([one, black], "must have the background of first, white, got none"),
    ):
        refuses(said, editing.join, settings, tmp_path / "no", error=ConfigError)
    refuses("there is no checkpoint in it", editing.join, [one, tmp_path], tmp_path / "no", error=CheckpointError)
    refuses("an object must have bounds", editing.place, one, endless, (0, 0, 0), tmp_path / "no", error=ConfigError)
    assert not (tmp_path / "no").exists()


@pytest.mark.slow
def test_pictures_are_where_the_joined_run_has_their_cameras(opened, scene, tmp_path) -> None:
    frames = [Similarity.of((3, 0, 0), (0, 0, 90), 0.5), Similarity.of((0, 0, 1), (40, 0, 0))]
    joined = joined_run(opened, tmp_path / "joined", frames=frames)
    moved = scene.test.cameras.moved(frames[0].matrix).poses
    assert torch.allclose(joined.scene.test.cameras.poses, moved, atol=1e-5)
    assert torch.equal(joined.scene.test.images, scene.test.images)
    record = read_scene(tmp_path / "joined" / "scene.json")
    assert record.test.names == tuple(f"{i}-{name}" for i in (0, 1) for name in scene.test.names)


def test_coordinates_of_files_are_the_first_runs(runs, tmp_path) -> None:
    own, frame = Similarity.of((1, 2, 3), (10, 20, 30), 2.0).matrix, Similarity.of((3, 0, 0), (0, 0, 90), 0.5)
    first = altered(runs[0], tmp_path / "first", transform=own)
    joined = editing.join([first, runs[1]], tmp_path / "joined", frames=[frame, Similarity()])
    record = read_scene(tmp_path / "joined/scene.json")
    torch.testing.assert_close(record.transform, frame.matrix @ own)
    torch.testing.assert_close(joined.scene.transform, frame.matrix @ own)


@pytest.mark.slow
def test_a_join_of_joins_keeps_every_pose(opened, scene, tmp_path) -> None:
    places = [[Similarity.of((0, 0, 1)), Similarity.of((x, 0, 0))] for x in (2, 3)]
    pairs = [joined_run(opened, tmp_path / f"pair-{i}", frames=frames) for i, frames in enumerate(places)]
    both = joined_run(pairs, tmp_path / "both")
    poses = [read_scene(run.path / "scene.json").test.cameras.poses for run in (*pairs, both)]
    assert torch.equal(poses[2].flatten(1).unique(dim=0), torch.cat(poses[:2]).flatten(1).unique(dim=0))
    names = read_scene(both.path / "scene.json").test.names
    shown, first = (run.scene.test.cameras.poses for run in (both, pairs[0]))
    assert len(set(names)) == len(names) and torch.equal(shown, first)


def test_joined_views_keep_their_names(scene) -> None:
    """Splits of one scene may hold different views, as regions do."""
    cameras = scene.train.cameras
    splits = [
        replace(scene.train, cameras=cameras[list(numbers)], names=names)
        for numbers, names in (((0, 1), ("a", "b")), ((2,), ("y",)), ((1, 3), ("b", "c")))
    ]
    joined = edits._join_views([(split, Similarity()) for split in splits])
    assert joined.names == ("a", "b", "y", "c") and torch.equal(joined.cameras.poses, cameras.poses[:4])
    moved = edits._join_views([(split, Similarity.of((i, 0, 0))) for i, split in enumerate(splits)])
    assert moved.names == ("0-a", "0-b", "0-y", "1-b", "1-c")


def test_a_run_of_parts_is_neither_opened_nor_trained_as_one_of_a_training(opened, tmp_path, scene) -> None:
    path = joined_run(opened, tmp_path / "joined").path
    refuses("must be the checkpoint of one training", lambda: open_run(path, scene=scene), error=CheckpointError)
    config = replace(opened[0].config, out=path)
    refuses("checkpoint of one training", lambda: trained(config, scene, resume=True), error=CheckpointError)


def test_runs_are_aligned_by_shared_images(scene) -> None:
    frame = Similarity.of((1, 2, 3), (10, 20, 30), 1.7)
    moved = with_cameras(scene, lambda cameras: cameras.moved(frame.inverse.matrix))
    fitted, error, count = edits.align(scene, moved, "run")
    assert count == 8 and error < 1e-5
    assert abs(fitted.scale - 1.7) < 1e-5 and torch.allclose(fitted.translation, frame.translation, atol=1e-4)
    train, test = replace(scene.train, names=tuple("abcdef")), replace(scene.test, names=tuple("gh"))
    said = "at least 3 images of the same names in both runs, got 0"
    refuses(said, edits.align, scene, replace(scene, train=train, test=test), "run", error=ConfigError)
    line = with_cameras(scene, lambda cameras: placed(cameras, torch.arange(len(cameras))[:, None] * torch.ones(3)))
    refuses("not on one line", edits.align, line, line, "run", error=ConfigError)


@pytest.mark.parametrize("degrees", [(10, 20, 30), (200, 20, 30), (10, 200, 30), (10, 20, 200)])
def test_cameras_of_one_height_are_aligned_without_a_mirror(scene, degrees) -> None:
    """Coplanar cameras are aligned by a rotation, although a reflection would fit them as well."""
    frame = Similarity.of((1, 2, 3), degrees, 1.7)
    flat = with_cameras(scene, lambda cameras: placed(cameras, cameras.origins * torch.tensor([1.0, 1, 0])))
    moved = with_cameras(flat, lambda cameras: cameras.moved(frame.matrix))
    fitted, error, _ = edits.align(moved, flat, "run")
    assert error < 1e-5 and torch.allclose(fitted.rotation, frame.rotation, atol=1e-4)


def with_cameras(scene, change):
    """Returns a scene whose cameras are mapped by a function."""
    parts = {"train": scene.train, "test": scene.test}
    return replace(scene, **{name: replace(part, cameras=change(part.cameras)) for name, part in parts.items()})


def placed(cameras, origins):
    poses = cameras.poses.clone()
    poses[:, :3, 3] = origins
    return replace(cameras, poses=poses)


@pytest.mark.slow
def test_an_unbounded_run_is_cut_and_gets_an_object(tmp_path, scene) -> None:
    open_space = replace(scene, box=None, kind="unbounded", near=0.05, far=20.0)
    small = {"steps": 40, "width": 8, "rays": 128, "samples": (16,), "evaluations": 1, "field_options": SMALL}
    config = TrainConfig(out=tmp_path / "wide", cells=(4,), **small)
    trained(config, open_space)
    wide = altered(tmp_path / "wide", tmp_path / "dense", bias=4)  # dense enough to cut
    run = open_run(wide, scene=open_space)
    assert run.renderer.contraction is not None
    refuses("must lie within", lambda: cut_run(run, Solid(ball=(0, 0, 0, 99)), tmp_path / "no"), error=ConfigError)
    thing = cut_run(run, Solid(ball=(0, 0, 0, 0.6)), tmp_path / "thing")
    assert thing.scene.box is not None and thing.renderer.occupancy is not None
    assert thing.router[0].contraction is None
    assert thing.scene.box[0, 0] > -0.3 and thing.scene.box[1, 0] > 0.4  # half of the ball was empty in the run's grid
    both = placed_run(run, thing, (0, 0, 0.5), tmp_path / "both", scale=0.4)
    assert both.scene.box is None and both.router[0].contraction is not None and both.renderer.occupancy is None
    points = torch.randn(300, 3)
    inputs = points, torch.tensor([[0.0, 0, 1]]), torch.zeros(300, dtype=torch.int32)
    contracted, grid = run.renderer.contraction.points(points), run.renderer.occupancy
    alone = run.router(contracted, *inputs[1:])[1] * grid.occupied.view(-1)[grid.voxels(contracted).long()]
    density, inside = both.router(*inputs)[1], in_region(both.router[1], points)
    assert torch.allclose(density - alone * ~inside, density * inside, atol=1e-4)
    assert both.evaluate(lpips="off", views=1)["psnr"] > 5
    refuses("must have bounds to be joined", lambda: joined_run([thing, run], tmp_path / "no"), error=ConfigError)


# Command line ---------------------------------------------------------------------------------------------------------


def test_the_commands(runs, tmp_path, capsys) -> None:
    one, two = map(str, runs)
    joined = str(tmp_path / "joined")
    assert main(["join", one, two, "--out", joined, "--move", "2", "2.5 0 0 0 0 90 0.5"]) == 0
    assert "cells in 2 parts" in capsys.readouterr().out
    moves = ["--move", "2", "2.5 0 0 0 0 0 1", "--move", "3", "5 0 0 0 0 0 1"]
    assert main(["join", one, two, one, "--out", str(tmp_path / "three"), *moves]) == 0
    three = editing.open_run(tmp_path / "three", scene=read_scene(runs[0] / "scene.json")).router
    assert [part.frame.translation.tolist() for part in three] == [[0, 0, 0], [2.5, 0, 0], [5, 0, 0]]
    assert main(["join", one, two, "--out", str(tmp_path / "aligned"), "--align"]) == 0
    assert "8 images in common" in capsys.readouterr().out
    assert main(["cut", joined, "--out", str(tmp_path / "cut"), "--box", *["-1"] * 3, *["1"] * 3]) == 0
    assert main(["place", one, str(tmp_path / "cut"), "--out", str(tmp_path / "placed"), "--at", "0", "0", "1"]) == 0
    capsys.readouterr()
    for command, said in {
        f"join {one} {two} --out {joined}": "--out must not hold a run already",
        f"join {one} --out X": "join needs two runs or more, got 1",
        f"join {one} {tmp_path / 'none'} --out X": "none: there is no such folder",
        f"cut {one} --out X": "cut needs one of --box, --sphere and --cells, got none",
        f"cut {one} --out X --box 1 1 1 0 0 0": "--box must be x y z of a corner and of a larger one, got 1 1 1 0 0 0",
        f"cut {one} --out X --box 0 0 nan 1 1 1": "of a larger one, got 0 0 nan 1 1 1\n",
        f"cut {one} --out X --sphere 0 0.5 0 -1": "and a radius above 0, got 0 0.5 0 -1\n",
        f"cut {one} --out X --cells 3 99": "at least one, got 3 99\n",
        f"cut {one} --out X --cells": "at least one, got none\n",
        f"cut {one} --out X --sphere 9 9 9 0.1": "nothing is left",
        f"place {one} {two} --out X --at 0 0 nan": "--at must be three finite numbers, got 0 0 nan\n",
        f"place {one} {two} --out X --at 0 0 0 --turn 0 inf 5": "--turn must be three finite numbers, got 0 inf 5\n",
        f"place {one} {two} --out X --at 0 0 0 --scale 0": "--scale must be 1e-9 to 1e9, got 0\n",
        f"place {one} {two} --out X --at 0 0 0 --scale 1e30": "--scale must be 1e-9 to 1e9, got 1e+30\n",
        f"place {one} {two} --out X --at 0 0 0 --scale 1e-5": "second: must be at least 0.0001 times as large as",
        f"place {one} {two} --out X --at 0 0 0 --scale 1e5": "first: must be at least 0.0001 times as large as",
        f"place {one} {two} --out X --at 0 0 1e30": "first: must be at least 0.0001 times as large as",
    }.items():
        assert main(command.replace("X", str(tmp_path / "x")).split()) == 1
        told = capsys.readouterr().err
        assert said in told and told.count("\n") == 1, told
    for move, said in {
        ("2", "1 0 0 0 0 0 0"): "--move 2 must be seven finite numbers tx ty tz rx ry rz s, the scale s 1e-9",
        ("2", "1 0 0"): "got '1 0 0'\n",
        ("3", "1 0 0 0 0 0 1"): "--move 3: must be the number of a run, 1 to 2",
        ("2", "1 0 0 0 0 0 1", "--move", "2", "2 0 0 0 0 0 1"): "--move 2: must be given once",
        ("2", "1 0 0 0 0 0 -1"): "got '1 0 0 0 0 0 -1'\n",
        ("2", "a,0,0 0 0 0 1"): "got 'a,0,0 0 0 0 1'\n",
        ("2", "0 0 0 inf 0 0 1"): "got '0 0 0 inf 0 0 1'\n",
    }.items():
        assert main(["join", one, two, "--out", str(tmp_path / "x"), "--move", *move]) == 1
        assert said in capsys.readouterr().err
    assert not (tmp_path / "x").exists() and not [path for path in tmp_path.iterdir() if path.name.startswith(".")]
