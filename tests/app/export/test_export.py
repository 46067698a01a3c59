"""Tests of exported points, meshes and cells, which are loaded again; the runs' fields are formulas."""

import functools
import itertools
import json
import re
import struct
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import refuses, renderer_of, seeded

from voronerf import VoronoiDiagram
from voronerf.app.evaluate.panels import palette
from voronerf.app.evaluate.scores import in_silence
from voronerf.app.export import cell_meshes, export_cells, export_mesh, export_points
from voronerf.app.export.mesh import REACH, _fused
from voronerf.app.export.space import SurfaceView, views_of, write_geometry
from voronerf.app.run import Run
from voronerf.app.scenes import builtin_scene
from voronerf.app.train.config import ConfigError
from voronerf.nerf import Cameras, Contraction, orbit_cameras
from voronerf.nerf.cameras import look_at
from voronerf.nerf.contraction import Perspective

trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed")
pytest.importorskip("skimage", reason="scikit-image is not installed")
pytest.importorskip("fast_simplification", reason="fast-simplification is not installed")

RADIUS = 0.6
BOX = torch.tensor([[-1.0, -1, -1], [1.0, 1, 0.8]])
RED, BLUE = torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.1, 0.1, 0.9])


def shell(positions, directions, ray_index):
    """Computes colours and densities of a hollow ball (red above, blue below) and of a speck beside it."""
    apart = (positions.norm(dim=-1) - (RADIUS - 0.1)).abs() < 0.1
    speck = (positions - torch.tensor([0.9, 0.9, 0.6])).norm(dim=-1) < 0.04
    return torch.where(positions[:, 2:] > 0, RED, BLUE), 300.0 * (apart | speck)


def test_pixels_without_a_ray_show_no_surface():
    """The corners of a wide lens, which have no rays, give no surface points."""
    cameras = orbit_cameras(2, radius=2, elevation=5, width=20, height=16, focal=10)
    cameras = replace(cameras, distortion=torch.tensor([[-0.25] + 7 * [0.0], 8 * [0.0]]))
    image = SimpleNamespace(colour=torch.ones(16, 20, 3), opacity=torch.ones(16, 20), heaviest=torch.ones(16, 20, 3))
    run = SimpleNamespace(render=lambda *_: image, renderer=SimpleNamespace(contraction=None))
    wide, plain = views_of(run, cameras)
    has_ray = cameras.has_ray(0)
    assert 0.5 < float(has_ray.float().mean()) < 0.9 and cameras.has_ray(1) is None
    assert torch.equal(wide.surface.isfinite().all(-1), has_ray) and bool(plain.surface.isfinite().all())


def read_glb(path):
    """Returns {node name: (arrays by attribute, material)} of a GLB file, whose nodes must have no transform."""
    data = path.read_bytes()
    magic, version, length, size = struct.unpack_from("<4s3I", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    tree, buffer = json.loads(data[20 : 20 + size]), data[28 + size :]
    meshes = {}
    for node in tree["nodes"]:
        assert node.keys() <= {"name", "mesh", "children"}
        if "mesh" not in node:
            continue
        (part,) = tree["meshes"][node["mesh"]]["primitives"]
        arrays = {}
        for name, index in part["attributes"].items():
            accessor = tree["accessors"][index]
            view = tree["bufferViews"][accessor["bufferView"]]
            kind = {5121: "u1", 5123: "<u2", 5126: "<f4"}[accessor["componentType"]]
            start, width = view["byteOffset"], {"VEC3": 3, "VEC4": 4}[accessor["type"]]
            values = np.frombuffer(buffer, kind, accessor["count"] * width, start).reshape(-1, width)
            assert accessor["min"] == values.min(0).tolist() and accessor["max"] == values.max(0).tolist()
            assert accessor.get("normalized", False) == (name == "COLOR_0")
            arrays[name] = values
        meshes[node["name"]] = arrays, tree["materials"][part["material"]]
    return meshes


def linear(colour):
    """Converts sRGB values in 0..1 to linear ones."""
    return np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)


@pytest.fixture(scope="module")
def run():
    scene = replace(builtin_scene(24, train_views=20, test_views=1), box=BOX)
    diagram = VoronoiDiagram(torch.rand(5, 3, generator=seeded()) - 0.5)
    router = SimpleNamespace(diagram=diagram)
    return Run(Path("unused"), SimpleNamespace(), scene, router, renderer_of({"field": shell}, samples=192))


@pytest.fixture(scope="module", autouse=True)
def rendered_once():
    """Renders the views of a run only once, unless their progress is shown."""
    rendered = {}

    def views_once(shown, cameras, track=in_silence):
        key = id(shown), len(cameras), cameras.width
        if key not in rendered or track is not in_silence:
            rendered[key] = views_of(shown, cameras, track), shown
        return rendered[key][0]

    with pytest.MonkeyPatch.context() as patched:
        for module in ("mesh", "points"):
            patched.setattr(f"voronerf.app.export.{module}.views_of", views_once)
        yield


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_a_mesh_is_the_outer_surface_alone(run, tmp_path, suffix):
    path = tmp_path / "deep" / f"ball{suffix}"
    export_mesh(run, path, resolution=48)
    mesh = trimesh.load(path, force="mesh", process=False)
    colours = mesh.visual.vertex_colors[:, :3]
    assert mesh.is_watertight and mesh.body_count == 1  # no inner surface, and no speck
    distance = np.abs(np.linalg.norm(mesh.vertices, axis=-1) - RADIUS)
    assert distance.mean() < 0.02 and distance.max() < 0.06
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.08)
    assert (mesh.vertex_normals * mesh.vertices).sum(-1).min() > 0
    for colour, where in ((RED, mesh.vertices[:, 2] > 0.05), (BLUE, mesh.vertices[:, 2] < -0.05)):
        assert np.abs(np.median(colours[where], axis=0) - colour.numpy() * 255).max() < 12  # rim pixels mix colours


def test_steps_of_pixels_and_samples_are_smoothed(run, tmp_path, monkeypatch):
    def slope(mesh):  # mean angle between triangles and the ball, in degrees
        along = (mesh.face_normals * mesh.triangles_center).sum(-1) / np.linalg.norm(mesh.triangles_center, axis=-1)
        return np.degrees(np.arccos(along.clip(-1, 1))).mean()

    sharp = replace(run.scene, train=builtin_scene(64, train_views=20, test_views=1).train)
    seen = replace(run, scene=sharp)
    smooth = export_mesh(seen, tmp_path / "smooth.ply", resolution=48)
    monkeypatch.setattr("voronerf.app.export.mesh.SMOOTH", 1e-3)
    before = export_mesh(seen, tmp_path / "before.ply", resolution=48)
    assert slope(smooth) < 0.5 * slope(before)
    assert smooth.volume == pytest.approx(before.volume, rel=0.03)


@pytest.mark.parametrize("plain", [True, False])
def test_the_surface_of_an_object_on_a_plain_background_lies_before_its_distances(run, tmp_path, monkeypatch, plain):
    seen, radii = run if plain else replace(run, scene=replace(run.scene, box=None)), []
    for share in (0.0, 0.01):
        monkeypatch.setattr("voronerf.app.export.mesh.BEFORE", share)
        mesh = export_mesh(seen, tmp_path / "mesh.ply", resolution=48, box=None if plain else BOX)
        radii.append(np.linalg.norm(mesh.triangles_center, axis=-1).mean())
    moved = (radii[1] - radii[0]) / (0.01 * float((BOX[1] - BOX[0]).max()))
    assert 0.1 < moved < 1 if plain else moved == 0  # distances are measured along oblique rays


@pytest.mark.parametrize("to_files", [False, True])
def test_a_glb_stands_upright_and_has_linear_colours(run, tmp_path, to_files):
    transform = torch.eye(4, dtype=torch.float64)
    transform[:3, :3] = 0.5 * torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = replace(run, scene=replace(run.scene, transform=transform))
    returned, _ = (
        export_mesh(turned, tmp_path / f"ball.{kind}", resolution=32, to_files=to_files) for kind in ("glb", "ply")
    )
    ply, glb = (trimesh.load(tmp_path / f"ball.{kind}", force="mesh", process=False) for kind in ("ply", "glb"))
    assert np.array_equal(ply.faces, glb.faces)
    ((arrays, material),) = read_glb(tmp_path / "ball.glb").values()
    rough = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    assert material == {"pbrMetallicRoughness": rough, "doubleSided": True}
    x, y, z = np.asarray(ply.vertices, dtype=np.float32).T
    assert np.array_equal(arrays["POSITION"], np.stack((x, z, -y), 1))
    assert np.abs(returned.vertices - ply.vertices).max() < 1e-6  # both have z up
    radius = RADIUS * (2 if to_files else 1)
    assert np.abs(np.linalg.norm(arrays["POSITION"], axis=-1) - radius).max() < 0.2
    assert (arrays["NORMAL"] * arrays["POSITION"]).sum(-1).min() > 0
    assert arrays["COLOR_0"].dtype == np.uint16 and (arrays["COLOR_0"][:, 3] == 65535).all()
    colours = np.asarray(ply.visual.vertex_colors[:, :3]) / 255
    assert np.abs(arrays["COLOR_0"][:, :3] / 65535 - linear(colours)).max() < 1e-5
    red = colours[:, 0] > 0.8
    assert red.any() and arrays["POSITION"][red, 1].min() > -0.1 * radius  # the red half is above


def test_dark_colours_of_a_glb_stay_apart(tmp_path):
    grey = np.arange(256).repeat(3).reshape(256, 3).astype(np.uint8)
    points = np.random.default_rng(0).random((256, 3))
    ramp = trimesh.Trimesh(points, np.arange(255).reshape(-1, 3), vertex_colors=grey, process=False)
    write_geometry(tmp_path / "ramp.GLB", ramp)
    ((arrays, _),) = read_glb(tmp_path / "ramp.GLB").values()
    back = linear(np.arange(256) / 255)[:, None] - arrays["COLOR_0"][None, :, 0] / 65535
    assert np.array_equal(np.abs(back).argmin(0), np.arange(256))
    assert np.array_equal(ramp.visual.vertex_colors[:, :3], grey) and np.array_equal(ramp.vertices, points)


def test_a_mesh_has_as_many_triangles_as_asked_for(run, tmp_path):
    whole, few = (export_mesh(run, tmp_path / "ball.ply", resolution=48, faces=faces) for faces in (10**6, 600))
    assert len(whole.faces) > 4000 and 500 < len(few.faces) <= 600
    assert np.bincount(few.edges_unique_inverse).min() > 1 and few.body_count == 1  # the mesh is closed
    distance = np.abs(np.linalg.norm(few.vertices, axis=-1) - RADIUS)
    assert distance.mean() < 0.02 and distance.max() < 0.06
    assert few.volume == pytest.approx(whole.volume, rel=0.03)


def test_colours_are_those_seen_from_the_front(run, tmp_path):
    """The mesh takes the colours of a frontal view: the ball is green from the front and darker from the side."""

    def glossy(positions, directions, ray_index):
        _, density = shell(positions, directions, ray_index)
        rays = len(directions) != len(positions)
        along = directions[ray_index.long()] if rays else directions
        facing = -(along * torch.nn.functional.normalize(positions, dim=-1)).sum(-1)
        return facing.clamp(0, 1)[:, None] * torch.tensor([0.0, 1.0, 0.0]), density

    shiny = replace(run, renderer=renderer_of({"field": glossy}, samples=192))
    mesh = export_mesh(shiny, tmp_path / "ball.ply", resolution=48)
    seen = mesh.vertices[:, 2] > 0  # the side of the cameras
    red, green, _ = np.median(mesh.visual.vertex_colors[seen, :3], axis=0)
    assert green > 0.8 * 255 and red < 2


def test_a_mesh_of_an_unbounded_scene_is_what_the_cameras_see(run, tmp_path):
    renderer = renderer_of({"field": shell}, samples=192, contraction=Contraction(torch.zeros(3), 1.2))
    unbounded = replace(run, scene=replace(run.scene, box=None), renderer=renderer)
    mesh = export_mesh(unbounded, tmp_path / "ball.ply", resolution=48)
    distance = np.abs(np.linalg.norm(mesh.vertices, axis=-1) - RADIUS)
    assert distance.mean() < 0.03 and distance.max() < 0.12  # no walls around unseen space
    half = torch.tensor([[-1.0, -1, 0], [1.0, 1, 1]])
    told, said = [], []
    track = lambda parts, name: told.append((name, len(parts))) or parts  # noqa: E731
    cut = export_mesh(run, tmp_path / "half.ply", resolution=48, box=half, track=track, say=said.append)
    assert [name for name, count in told if count] == ["views", "fusing"]
    assert re.fullmatch(r"\d\d% of the surfaces in the views lie outside of the box -1 -1 0 1 1 1 \(--crop .*", said[0])
    assert not cut.is_watertight and cut.vertices[:, 2].min() > -0.01


def test_a_mesh_is_what_the_cameras_look_at_and_not_what_lies_around(run, tmp_path):
    def with_sky(positions, directions, ray_index):  # the sky is at distance 7 and in every picture
        colour, density = shell(positions, directions, ray_index)
        return colour, density + 300.0 * (positions.norm(dim=-1) > 2.2)

    renderer = renderer_of({"field": with_sky}, samples=384, contraction=Contraction(torch.zeros(3), 1.2))
    shown, said = replace(run, scene=replace(run.scene, box=None, far=20.0), renderer=renderer), []
    mesh = export_mesh(shown, tmp_path / "ball.ply", resolution=48, say=said.append)
    assert mesh.body_count == 1 and np.abs(np.linalg.norm(mesh.vertices, axis=-1) - RADIUS).max() < 0.12
    share, *corners = (float(number) for number in re.findall(r"-?\d+\.?\d*", said[0])[:7])
    assert 30 < share < 95 and np.abs(np.abs(corners) - 1.2 * RADIUS).max() < 0.3  # no camera sees the ball from below
    assert not said[0].startswith("0%") and len(said) == 1
    export_mesh(run, tmp_path / "boxed.ply", resolution=16, say=said.append)
    assert len(said) == 1  # no note, since the scene's box holds the whole scene


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


@pytest.mark.parametrize("to_files", [False, True])
def test_cells_are_objects_of_their_own_colour(run, tmp_path, to_files):
    transform = torch.eye(4, dtype=torch.float64)
    transform[:3] = torch.tensor([[0.0, -0.5, 0, 1], [0.5, 0, 0, 2], [0, 0, 0.5, 3]])
    turned = replace(run, scene=replace(run.scene, transform=transform))
    export_cells(turned, tmp_path / "cells.glb", to_files=to_files)
    scene = trimesh.load(tmp_path / "cells.glb")
    assert sorted(scene.geometry) == [f"cell_{cell:04}" for cell in range(5)]
    wanted, read = cell_meshes(run.diagram, BOX), read_glb(tmp_path / "cells.glb")
    for cell, mesh in wanted.items():
        if to_files:
            mesh.apply_transform(torch.linalg.inv(transform).numpy())
        arrays, material = read[f"cell_{cell:04}"]
        x, y, z = mesh.vertices.T
        assert np.abs(arrays["POSITION"] - np.stack((x, z, -y), 1)).max() < 1e-5
        colour = material["pbrMetallicRoughness"]["baseColorFactor"]
        assert np.abs(colour[:3] - linear(palette(5).numpy()[cell] / 255)).max() < 1e-6 and colour[3] == 1
        assert material["pbrMetallicRoughness"]["metallicFactor"] == 0
    volume = float((BOX[1] - BOX[0]).prod()) * (8 if to_files else 1)
    assert sum(mesh.volume for mesh in scene.geometry.values()) == pytest.approx(volume)


def test_what_is_refused(run, tmp_path, monkeypatch):
    path = tmp_path / "mesh.ply"
    forward = replace(run, renderer=SimpleNamespace(contraction=object.__new__(Perspective)))
    refuses("--cells needs cells with flat sides", export_cells, forward, tmp_path / "a.glb", error=ConfigError)
    refuses("mesh.stl: the file must end in .ply or .glb or .obj", export_mesh, run, tmp_path / "mesh.stl")
    refuses("cells.ply: the file must end in .glb", export_cells, run, tmp_path / "cells.ply")
    refuses("points.xyz: the file must end in .ply", export_points, run, tmp_path / "points.xyz")
    rule = "--resolution must be 8 to "
    refuses(rule, export_mesh, run, path, resolution=7, error=ConfigError)
    refuses(rule, export_mesh, run, path, resolution=10**6, error=ConfigError)
    refuses("--faces must be at least 4, got 0", export_mesh, run, path, faces=0, error=ConfigError)
    folder = path.with_name("folder.ply")
    folder.mkdir()
    refuses("folder.ply: must be a file, got a folder", export_mesh, run, folder)
    folder.rmdir()
    unbounded = replace(run, scene=replace(run.scene, box=None))
    refuses("--crop must be given", export_points, unbounded, path, error=ConfigError)
    for export in (export_points, export_mesh):
        rule = "--crop must be x y z of a corner and of a larger one"
        refuses(rule, export, run, path, box=BOX.flip(0), error=ConfigError)
    empty = torch.tensor([[5.0, 5, 5], [6.0, 6, 6]])
    fog = lambda positions, *rest: (torch.ones_like(positions), torch.full_like(positions[:, 0], 0.01))  # noqa: E731
    faint = replace(run, renderer=renderer_of({"field": fog}, samples=16))
    coarse = functools.partial(export_mesh, resolution=16)
    for export, shown, box in itertools.product((export_points, coarse), (run, faint), (empty, BOX, None)):
        if shown is faint or box is empty:
            rule = "unused: the training views show no surface in the box"
            refuses(rule, export, shown, path, box=box, error=ConfigError)
    for module, package in {"skimage": "scikit-image", "fast_simplification": "fast-simplification"}.items():
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, module, None)
            refuses(f"needs {package}: pip install 'voronerf[export]'", export_mesh, run, path, error=ImportError)
    assert not list(tmp_path.iterdir())


def test_a_floor_within_a_layer_of_blocks_has_no_hole():
    """The layer of blocks that contains the floor is filled too, not only the layers above and below."""
    pose = look_at(torch.tensor([[0.0, 0.0, 3.0]]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    camera = Cameras(pose, torch.tensor([[60.0, 60, 32, 32]]), 64, 64)
    y, x = torch.meshgrid(torch.arange(64) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    rays = camera.rays(0, x.reshape(-1), y.reshape(-1))
    floor = 0.03
    points = rays.origins + rays.directions * ((floor - 3) / rays.directions[:, 2:])
    view = SurfaceView(camera, torch.full((64, 64, 3), 0.5), points.view(64, 64, 3))
    side, low = 1 / 64, torch.full((3,), -0.5)
    value, seen = _fused(low, side, torch.full((3,), 8), [view], False, lambda items, name: items)
    heights = low[2] + side * torch.arange(64)
    near_floor = (heights - floor).abs() < REACH * side / 2
    assert bool(seen[8:-8, 8:-8, near_floor].all())
    expected = ((heights - floor) / (REACH * side))[near_floor].expand(48, 48, -1)
    torch.testing.assert_close(value[8:-8, 8:-8, near_floor], expected, atol=0.1, rtol=0)
