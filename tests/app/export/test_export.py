"""Points, meshes and cells of runs whose field is a formula, loaded again."""

import itertools
import math
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import refuses, renderer_of, seeded

from voronerf import VoronoiDiagram
from voronerf.app.export import cell_meshes, export_cells, export_mesh, export_points, export_splats
from voronerf.app.export.splats import Splats, picture
from voronerf.app.run import Run
from voronerf.app.scenes import builtin_scene
from voronerf.app.train.config import ConfigError
from voronerf.nerf import Contraction, OccupancyGrid

trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed")
pytest.importorskip("skimage", reason="scikit-image is not installed")

RADIUS = 0.6
BOX = torch.tensor([[-1.0, -1, -1], [1.0, 1, 0.8]])
RED, BLUE = torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.1, 0.1, 0.9])


def shell(positions, directions, ray_index):
    """A hollow ball, red above and blue below, and a speck beside it."""
    apart = (positions.norm(dim=-1) - (RADIUS - 0.1)).abs() < 0.1
    speck = (positions - torch.tensor([0.9, 0.9, 0.6])).norm(dim=-1) < 0.04
    return torch.where(positions[:, 2:] > 0, RED, BLUE), 300.0 * (apart | speck)


@pytest.fixture(scope="module")
def run():
    scene = replace(builtin_scene(24, train_views=20, test_views=1), box=BOX)
    diagram = VoronoiDiagram(torch.rand(5, 3, generator=seeded()) - 0.5)
    router = SimpleNamespace(diagram=diagram)
    return Run(Path("unused"), SimpleNamespace(), scene, router, renderer_of({"field": shell}, samples=192))


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".obj"])
def test_a_mesh_is_the_outer_surface_alone(run, tmp_path, suffix):
    path = tmp_path / "deep" / f"ball{suffix}"
    export_mesh(run, path, resolution=48)
    mesh = trimesh.load(path, force="mesh", process=False)
    assert mesh.is_watertight and mesh.body_count == 1  # neither the inside of the shell nor the speck
    distance = np.abs(np.linalg.norm(mesh.vertices, axis=-1) - RADIUS)
    assert distance.mean() < 0.02 and distance.max() < 0.06
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.05)
    assert (mesh.vertex_normals * mesh.vertices).sum(-1).min() > 0
    colours = mesh.visual.vertex_colors[:, :3]
    for colour, where in ((RED, mesh.vertices[:, 2] > 0.05), (BLUE, mesh.vertices[:, 2] < -0.05)):
        assert np.abs(np.median(colours[where], axis=0) - colour.numpy() * 255).max() < 2


def test_vertices_in_empty_cells_of_an_occupancy_grid_have_colours(run, tmp_path):
    grid = OccupancyGrid(BOX, 40, threshold=1.0)
    grid.density = shell(grid.points(torch.arange(40**3)), None, None)[1].view(40, 40, 40)
    grid.occupied = grid.density > 0
    skipping = replace(run, renderer=renderer_of({"field": shell}, samples=192, occupancy=grid))
    mesh = export_mesh(skipping, tmp_path / "ball.ply", resolution=48)
    assert mesh.is_watertight and mesh.visual.vertex_colors[:, :3].max(-1).min() > 200


def test_a_mesh_of_an_unbounded_scene_is_what_the_cameras_see(run, tmp_path):
    renderer = renderer_of({"field": shell}, samples=192, contraction=Contraction(torch.zeros(3), 1.2))
    unbounded = replace(run, scene=replace(run.scene, box=None), renderer=renderer)
    mesh = export_mesh(unbounded, tmp_path / "ball.ply", resolution=48)
    distance = np.abs(np.linalg.norm(mesh.vertices, axis=-1) - RADIUS)
    assert distance.mean() < 0.03 and distance.max() < 0.12  # no walls where space is unknown
    half = torch.tensor([[-1.0, -1, 0], [1.0, 1, 1]])
    told = []
    track = lambda parts, name: told.append((name, len(parts))) or parts  # noqa: E731
    cut = export_mesh(run, tmp_path / "half.ply", resolution=48, box=half, track=track)
    assert [name for name, count in told if count] == ["density", "views", "what the views see"]
    assert not cut.is_watertight and cut.vertices[:, 2].min() > -0.01


def test_points_have_colours_and_normals(run, tmp_path):
    export_points(run, tmp_path / "ball.ply", count=1000)
    points = trimesh.load(tmp_path / "ball.ply", process=False)
    assert len(points.vertices) == 1000
    place = np.asarray(points.vertices)
    ball = np.linalg.norm(place, axis=-1) < 0.8
    assert np.abs(np.linalg.norm(place[ball], axis=-1) - RADIUS).max() < 0.05
    text = (tmp_path / "ball.ply").read_bytes()[:400].decode(errors="ignore")
    assert "property float nx" in text and "property uchar red" in text
    normals = export_points(run, tmp_path / "again.ply", count=1000).vertex_normals
    along = (normals[ball] * place[ball]).sum(-1) / np.linalg.norm(place[ball], axis=-1)
    assert np.quantile(along, 0.05) > 0.9
    assert (tmp_path / "ball.ply").read_bytes() == (tmp_path / "again.ply").read_bytes()


def test_points_of_a_contracted_scene_lie_in_the_world(run, tmp_path):
    space = Contraction(torch.zeros(3), 0.3)
    field = lambda positions, *rest: shell(space.inverse(positions), *rest)  # noqa: E731
    contracted = replace(run, renderer=renderer_of({"field": field}, samples=192, contraction=space))
    place = np.asarray(export_points(contracted, tmp_path / "ball.ply", count=500, box=BOX).vertices)
    assert np.abs(np.linalg.norm(place[np.linalg.norm(place, axis=-1) < 0.8], axis=-1) - RADIUS).max() < 0.05


def diagrams():
    centres = 2 * torch.rand(8, 3, generator=seeded(1)) - 1
    nested, _ = VoronoiDiagram(centres).refine({i: centres[i] + 0.2 * torch.randn(4, 3) for i in (1, 5)})
    far = torch.cat((centres, torch.tensor([[50.0, 0, 0]])))
    return {"nested": nested, "one": VoronoiDiagram(torch.zeros(1, 3)), "far": VoronoiDiagram(far)}


@pytest.mark.parametrize("name", ["nested", "one", "far"])
def test_cells_fill_the_box_and_hold_their_points(name):
    diagram = diagrams()[name]
    meshes = cell_meshes(diagram, BOX)
    assert sum(mesh.volume for mesh in meshes.values()) == pytest.approx(float((BOX[1] - BOX[0]).prod()))
    points = torch.lerp(BOX[0], BOX[1], torch.rand(300, 3, generator=seeded()))
    for cell, mesh in meshes.items():
        assert mesh.is_watertight and mesh.is_convex
        mine = points[diagram.locate(points) == cell].numpy()
        planes = ((mine[:, None] - mesh.triangles[None, :, 0]) * mesh.face_normals).sum(-1)
        assert not planes.size or planes.max() < 1e-5
    assert (name != "far") == (len(meshes) == diagram.num_cells)


def test_cells_are_objects_of_their_own_colour(run, tmp_path):
    export_cells(run, tmp_path / "cells.glb")
    scene = trimesh.load(tmp_path / "cells.glb")
    assert sorted(scene.geometry) == [f"cell_{cell:04}" for cell in range(5)]
    colours = {tuple(mesh.visual.material.baseColorFactor) for mesh in scene.geometry.values()}
    assert len(colours) == 5


def test_what_is_refused(run, tmp_path, monkeypatch):
    path = tmp_path / "mesh.ply"
    refuses("mesh.stl: the file must end in .ply or .glb or .obj", export_mesh, run, tmp_path / "mesh.stl")
    refuses("cells.ply: the file must end in .glb", export_cells, run, tmp_path / "cells.ply")
    refuses("points.xyz: the file must end in .ply", export_points, run, tmp_path / "points.xyz")
    rule = "--resolution must be 8 to "
    refuses(rule, export_mesh, run, path, resolution=7, error=ConfigError)
    refuses(rule, export_mesh, run, path, resolution=10**6, error=ConfigError)
    refuses("--density must be positive", export_mesh, run, path, density=0.0, error=ConfigError)
    rule = "--density must be lower: nothing in the box is as dense as 1e+06"
    refuses(rule, export_mesh, run, path, resolution=8, density=1e6, error=ConfigError)
    unbounded = replace(run, scene=replace(run.scene, box=None))
    for export in (export_points, export_mesh):
        refuses("--crop must be given", export, unbounded, path, error=ConfigError)
        rule = "--crop must be x y z of a corner and of a larger one"
        refuses(rule, export, run, path, box=BOX.flip(0), error=ConfigError)
    empty = torch.tensor([[5.0, 5, 5], [6.0, 6, 6]])
    refuses("unused: the training views show no surface", export_points, run, path, box=empty, error=ConfigError)
    monkeypatch.setitem(sys.modules, "skimage", None)
    refuses("needs scikit-image: pip install 'voronerf[export]'", export_mesh, run, path, error=ImportError)
    assert not list(tmp_path.iterdir())


def read_splats(path):
    """The columns of a file of splats, by the format's definition, which other programs go by."""
    data = path.read_bytes()
    head, body = data.split(b"end_header\n", 1)
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = int(lines[2].removeprefix("element vertex "))
    names = [line.removeprefix("property float ") for line in lines[3:]]
    values = np.frombuffer(body, "<f4").reshape(count, len(names))
    return {name: values[:, i].astype(np.float64) for i, name in enumerate(names)}


def seen(columns, camera):
    """A picture [h, w, 3] of splats on white as Kerbl et al. 2023 define it, by loops over pixels and Gaussians."""
    place = np.stack([columns[name] for name in "xyz"], 1)
    pose, (fx, fy, cx, cy) = camera.poses[0].double().numpy(), camera.intrinsics[0].tolist()
    local = (place - pose[:3, 3]) @ pose[:3, :3] * (1, -1, -1)  # x right, y down, z forward
    away = (place - pose[:3, 3]) / np.linalg.norm(place - pose[:3, 3], axis=1, keepdims=True)
    harmonics = [0.28209479 + 0 * away[:, 0], *(0.48860251 * away[:, (1, 2, 0)] * (-1, 1, -1)).T]
    image = np.empty((camera.height, camera.width, 3))
    order = np.argsort(local[:, 2])
    gaussians = []
    for i in order:
        x, y, z = local[i]
        w, a, b, c = (columns[f"rot_{k}"][i] for k in range(4))
        turn = np.array([
            [1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)],
            [2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)],
            [2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)],
        ])  # fmt: skip
        axes = turn * np.exp([columns[f"scale_{k}"][i] for k in range(3)])
        slope = np.array([[fx / z, 0, -fx * x / z**2], [0, fy / z, -fy * y / z**2]])
        flat = slope @ (np.diag([1, -1, -1]) @ pose[:3, :3].T) @ axes
        inverse = np.linalg.inv(flat @ flat.T + 0.3 * np.eye(2))
        coefficients = [
            [columns[f"f_dc_{k}"][i], *(columns[f"f_rest_{3 * k + j}"][i] for j in range(3))] for k in range(3)
        ]
        colour = [max(0.5 + sum(h[i] * value for h, value in zip(harmonics, row)), 0) for row in coefficients]
        opacity = 1 / (1 + np.exp(-columns["opacity"][i]))
        numbers = fx * x / z + cx, fy * y / z + cy, inverse[0, 0], inverse[0, 1], inverse[1, 1], opacity
        gaussians.append((*map(float, numbers), np.array(colour)))
    for row, column in itertools.product(range(camera.height), range(camera.width)):
        left, image[row, column] = 1.0, 0
        for u, v, across, mixed, down, opacity, colour in gaussians:
            x, y = column + 0.5 - u, row + 0.5 - v
            alpha = min(opacity * math.exp(-(across * x * x + 2 * mixed * x * y + down * y * y) / 2), 0.99)
            if alpha >= 1 / 255 and left > 1e-3:
                image[row, column] += left * alpha * colour
                left *= 1 - alpha
        image[row, column] += left
    return image


def test_splats_look_like_the_run_in_another_reader(run, tmp_path):
    path = tmp_path / "ball.ply"
    clock = itertools.count().__next__  # 200 steps: it is asked before each, and once more in each hundredth
    splats, scores = export_splats(run, path, count=400, seconds=300, clock=clock)
    assert len(splats) == 400 and scores["after"] > scores["before"] + 6 and scores["after"] > 23
    camera = run.scene.test.cameras[[0]]
    columns = read_splats(path)
    image = seen(columns, camera)
    assert np.abs(image - run.render(0).colour.numpy()).mean() < 0.04
    assert np.abs(image - picture(splats, camera, torch.ones(3)).numpy()).max() < 2e-3


def test_splats_and_meshes_in_the_coordinates_of_the_files(run, tmp_path):
    turn = torch.linalg.qr(torch.randn(3, 3, generator=seeded(), dtype=torch.float64))[0]
    turn *= torch.linalg.det(turn)
    transform = torch.eye(4, dtype=torch.float64)
    transform[:3, :3], transform[:3, 3] = 0.25 * turn, torch.tensor([0.1, 0.2, 0.3])  # 1 of the scene is 4 metres
    moved = replace(run, scene=replace(run.scene, transform=transform))
    assert export_mesh(run, tmp_path / "scene.ply", resolution=32).extents.max() < 1.3
    extents = export_mesh(moved, tmp_path / "metres.ply", resolution=32, to_files=True).extents
    assert extents.min() > 4.2 and extents.max() < 5.4
    splats, _ = export_splats(moved, tmp_path / "splats.ply", count=100, seconds=0, to_files=True)
    radius = np.linalg.norm(
        np.stack([read_splats(tmp_path / "splats.ply")[name] for name in "xyz"], 1)
        - torch.linalg.inv(transform)[:3, 3].numpy(),
        axis=1,
    )
    assert abs(np.median(radius) - 4 * RADIUS) < 0.1
    # A similarity changes nothing of what a camera that is moved along sees, colours by direction included.
    splats.colours += 0.2 * torch.randn(splats.colours.shape, generator=seeded())
    camera = run.scene.test.cameras[[0]]
    away = torch.linalg.inv(transform)
    pose = away @ camera.poses[0].double()
    pose[:3, :3] /= 4
    there = picture(splats.moved(away), replace(camera, poses=pose.float()[None]), torch.ones(3))
    assert (there - picture(splats, camera, torch.ones(3))).abs().max() < 2e-3


def test_splats_of_a_part_and_what_is_refused(run, tmp_path):
    upper = torch.tensor([[-1.0, -1, 0], [1.0, 1, 0.8]])
    splats, _ = export_splats(run, tmp_path / "half.ply", count=200, seconds=0, box=upper)
    assert isinstance(splats, Splats) and splats.positions[:, 2].min() >= 0
    for options, rule in (
        ({"count": 0}, "--count must be at least 1, got 0"),
        ({"seconds": -1.0}, "--fit must be 0 or more seconds, got -1"),
        ({"box": torch.tensor([[5.0, 5, 5], [6.0, 6, 6]])}, "the training views show no surface"),
    ):
        refuses(rule, export_splats, run, tmp_path / "none.ply", error=ConfigError, **options)
