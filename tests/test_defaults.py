"""Tests that torch's default device and default dtype change no result, and that the package names its devices."""

from __future__ import annotations

import ast
import itertools
from pathlib import Path

import pytest
import torch
from helpers import same, seeded, trained
from torch.utils._device import _device_constructors

import voronerf
from voronerf import HashGrid, HashGridField, NeRF, OccupancyGrid, SampleReservoir, VoronoiDiagram, balance, editing
from voronerf.app import open_run
from voronerf.app.export.mesh import export_mesh
from voronerf.app.export.points import export_points
from voronerf.app.scenes import builtin_scene, load_scene
from voronerf.app.train import TrainConfig, build, load, snapshot, train
from voronerf.app.web import pack
from voronerf.diagram.balance import CENTRES
from voronerf.editing import Similarity, Solid, edits
from voronerf.nerf import occupancy, orbit_cameras
from voronerf.nerf.lenses import LensTables

PACKAGE = Path(voronerf.__file__).parent
CPU = torch.device("cpu")
FACTORIES = {function.__name__ for function in _device_constructors()}
SMALL = {"rays": 64, "samples": (16,), "cells": (4,), "width": 8, "evaluations": 1}


@pytest.fixture(params=["meta", "float64"])
def defaults(request):
    """Returns a context with another default device, or another default dtype."""

    class Defaults:
        def __enter__(self):
            if request.param == "meta":
                torch.set_default_device("meta")
            else:
                torch.set_default_dtype(torch.float64)

        def __exit__(self, *error):
            torch.set_default_device(None)
            torch.set_default_dtype(torch.float32)

    return Defaults()


def unchanged(compute, defaults):
    """Fails unless a function returns the same tensors under other defaults."""
    expected = compute()
    with defaults:
        results = compute()
    assert same(expected, results)
    assert [tensor.dtype for tensor in expected] == [tensor.dtype for tensor in results]
    assert all(tensor.device == CPU for tensor in results)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Returns the folder of a run of the built-in scene, with an occupancy grid."""
    out, scene = tmp_path_factory.mktemp("defaults") / "run", builtin_scene(16, train_views=6, test_views=2)
    options = ("log2_entries=10", "levels=4")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(occupancy, "RESOLUTION", 16)  # to save time
        trained(TrainConfig(steps=20, out=out, data="builtin:25", field_options=options, **SMALL), scene)
    return out


def test_calls_name_their_device():
    missing = [
        f"{path.relative_to(PACKAGE.parent)}:{call.lineno}: torch.{call.func.attr}"
        for folder in (PACKAGE, PACKAGE.parent / "kernels")
        for path in sorted(folder.rglob("*.py"))
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(call, ast.Call)
        and isinstance(call.func, ast.Attribute)
        and isinstance(call.func.value, ast.Name)
        and call.func.value.id == "torch"
        and call.func.attr in FACTORIES
        and not any(keyword.arg in ("device", None) for keyword in call.keywords)
    ]
    assert not missing, f"these calls must pass device=, since a program may set a default device: {missing}"


def test_fields_are_made_on_the_default_device():
    with torch.device("meta"):
        fields = NeRF(width=8, depth=2), HashGridField(log2_entries=10, levels=2)
    assert {parameter.device.type for field in fields for parameter in field.parameters()} == {"meta"}


def test_library(defaults):
    points, weights = torch.rand(500, 3, generator=seeded()), torch.rand(500, generator=seeded(1))
    chosen, box = torch.tensor([0, 4]), torch.tensor([[-1.0, -1, -1], [1.0, 1, 1]])
    lenses = torch.tensor([[20.0, 20, 8, 6, 0.1, *[0.0] * 8]])

    def fog(positions, directions, ray_index):
        return torch.ones_like(positions), torch.full_like(positions[:, 0], 0.5)

    def compute():
        diagram = VoronoiDiagram.from_points(points, 8, generator=seeded())
        nested, parents = diagram.refine({1: points[:3], 4: points[3:5]})
        grid, reservoir, tables = (
            OccupancyGrid(box, 8, threshold=1.0),
            SampleReservoir(50, 2),
            LensTables(lenses, 16, 9),
        )
        grid.update(fog, generator=seeded())
        reservoir.add(points, weights)
        cameras = orbit_cameras(3, radius=2.0, elevation=20.0, width=8, height=8, focal=9.0)
        tables = LensTables(lenses, 16, 9)
        scales = [row.scale for row in HashGrid(levels=8, finest=300).rows]
        return [
            *(balance(points, weights, 6, centres=name, generator=seeded(), steps=9).centres for name in CENTRES),
            *(diagram.centres, nested.centres, parents, nested.paths(), nested.part(chosen).centres),
            *(VoronoiDiagram.without_centres(4).centres, grid.density, grid.occupied, *reservoir.samples()),
            *(tables.on(CPU), tables.has_direction(0), cameras.poses, cameras.image_rays(1).directions),
            torch.tensor([*scales, grid.can_learn_from(fog)], dtype=torch.float64, device=CPU),
        ]

    unchanged(compute, defaults)


@pytest.mark.parametrize("source", ["builtin", "colmap", "llff"])
def test_scenes(defaults, source, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parent / "app" / "scenes")
    from scene_files import write_both

    write_both(tmp_path)

    def compute():
        scene = load_scene("builtin:20") if source == "builtin" else load_scene(tmp_path, format=source)
        cameras = scene.train.cameras, scene.test.cameras
        tensors = [tensor for each in cameras for tensor in (each.poses, each.intrinsics)]
        numbers = scene.near, scene.far, scene.pixel(scene.space())
        return [*tensors, scene.train.images, torch.tensor(numbers, dtype=torch.float64, device=CPU)]

    unchanged(compute, defaults)


def test_opened_run(defaults, run, tmp_path):
    pytest.importorskip("trimesh")
    pytest.importorskip("skimage")

    def compute():
        opened = open_run(run, scene=builtin_scene(16, train_views=6, test_views=2))
        orbit = orbit_cameras(2, radius=3.0, elevation=20.0, width=12, height=10, focal=14.0)
        pictures = [opened.render(0), opened.render(orbit, 1), opened.cropped([[-0.5] * 3, [0.5] * 3]).render(1)]
        scores, packed = opened.evaluate(), pack(opened)
        cloud = export_points(opened, tmp_path / "points.ply", count=200)
        mesh = export_mesh(opened, tmp_path / "mesh.ply", resolution=16, faces=500)
        return [
            *(tensor for picture in pictures for tensor in picture),
            *(torch.from_numpy(array.copy()) for array in (cloud.vertices, mesh.vertices, mesh.faces)),
            torch.tensor([scores["psnr"], scores["ssim"], *packed.data], dtype=torch.float64, device=CPU),
        ]

    unchanged(compute, defaults)


def test_edited_runs(defaults, run, tmp_path, monkeypatch):
    monkeypatch.setattr(edits, "MOST_VOXELS", 1 << 12)
    turned = Similarity.of((1.0, 0.2, 0), degrees=(0, 10, 30), scale=0.7)
    numbers = itertools.count()

    def compute():
        folder = tmp_path / str(next(numbers))
        folder.mkdir()
        made = [
            editing.join([run, run], folder / "joined", frames=[Similarity(), turned]),
            editing.place(run, run, (0.3, 0.2, 0.5), folder / "placed"),
            editing.cut(run, Solid(ball=(0, 0, 0.3, 0.6)), folder / "cut"),
        ]
        grids = [tensor for each in made for tensor in (each.grid.density, each.grid.occupied)]
        return [*grids, *editing.open_run(folder / "joined").render(0)]

    unchanged(compute, defaults)


def test_training(defaults):
    config = TrainConfig(steps=20, field="nerf", occupancy=False, **SMALL)
    scene = builtin_scene(8, train_views=4, test_views=2)

    def compute():
        state, resumed = build(config, scene), build(config, scene)
        train(state)
        load(resumed, snapshot(state))
        return [*state.router.parameters(), *resumed.router.parameters()]

    unchanged(compute, defaults)
