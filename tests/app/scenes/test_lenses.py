"""Tests of the rays of every COLMAP camera model against pixels from pycolmap 4.2.

OpenCV 5.0 (`projectPoints`, `fisheye.projectPoints`) gives the same pixels to 1e-13 for all models except FOV and
THIN_PRISM_FISHEYE, which it lacks.
"""

import json
import math
from pathlib import Path

import pytest
import torch
from helpers import refuses
from scene_files import oriented, write_colmap, write_frames, write_images

from voronerf.app.scenes import SceneError, load_scene
from voronerf.app.scenes.lenses import COEFFICIENTS, MODELS, OTHER_MODELS, colmap_lens
from voronerf.app.scenes.record import read_scene, write_scene
from voronerf.nerf import Cameras, orbit_cameras
from voronerf.nerf.lenses import EQUIRECTANGULAR, FISHEYE, PERSPECTIVE, distort, fold

TABLE = json.loads((Path(__file__).parent / "lenses.json").read_text())


@pytest.mark.parametrize("model", [name for name, _ in MODELS.values()])
def test_rays_go_where_colmap_and_opencv_see_the_points(model):
    row = TABLE[model]
    lens = colmap_lens(model, row["params"])
    intrinsics, bent = (torch.tensor([part]) for part in (lens.intrinsics, lens.coefficients))
    cameras = Cameras(torch.eye(4)[None], intrinsics, 640, 480, bent, torch.tensor([lens.model], dtype=torch.int32))
    points = torch.tensor(row["points"], dtype=torch.float64) * torch.tensor([1.0, -1.0, -1.0])  # OpenGL's axes
    pixels = torch.tensor(row["pixels"])
    rays = cameras.rays(0, *pixels.unbind(-1))
    expected = torch.nn.functional.normalize(points, dim=-1)
    assert float((rays.directions - expected).norm(dim=-1).max()) * max(lens.intrinsics[:2]) < 1e-4
    again, _ = cameras.project(points.float(), 0)
    torch.testing.assert_close(again, pixels, atol=1e-4, rtol=0)


def test_each_image_of_a_folder_has_its_own_model(tmp_path):
    """Each image has its own camera model; its file has a tenth or a twentieth of the COLMAP camera's size."""
    names = [name for name, _ in MODELS.values()]
    poses = orbit_cameras(len(names), radius=4, elevation=20, width=1, height=1, focal=1).poses
    write_images(tmp_path, [(64, 48) if index % 3 else (32, 24) for index in range(len(names))])
    write_colmap(tmp_path, poses, [(640, 480)] * len(names), [], lenses=[(n, TABLE[n]["params"]) for n in names])
    scene = load_scene(tmp_path, normalise=False)
    write_scene(tmp_path / "scene.json", scene)
    for read in (scene, read_scene(tmp_path / "scene.json")):
        for part in (read.train, read.test):
            for index, view in enumerate(map(int, part.names)):
                row, cameras = TABLE[names[view]], part.cameras
                scale = cameras.size(index)[0] / 640
                pixels = torch.tensor(row["pixels"]) * scale
                rays = cameras.rays(index, *pixels.unbind(-1))
                points = torch.tensor(row["points"]) * torch.tensor([1.0, -1.0, -1.0])  # OpenGL's axes
                expected = torch.nn.functional.normalize(points, dim=-1) @ poses[view, :3, :3].T
                assert float((rays.directions - expected).norm(dim=-1).max()) * max(row["params"]) * scale < 1e-4
                projected, _ = cameras.project(points @ poses[view, :3, :3].T + poses[view, :3, 3], index)
                torch.testing.assert_close(projected, pixels, atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    "lens",
    [{"camera_model": "EQUIRECTANGULAR", "w": 64, "h": 32}, {"latlong": True}, {"latlong": 1, "fl_x": None}],
)
def test_pictures_all_around(tmp_path, lens):
    """Equirectangular images of nerfstudio and instant-ngp load; their focal length is ignored."""
    poses = orbit_cameras(3, radius=4, elevation=20, width=1, height=1, focal=1).poses
    write_images(tmp_path, [(64, 32)] * 3)
    write_frames(tmp_path, poses, **lens)
    scene = load_scene(tmp_path, downscale=2)
    assert scene.kind == "inside-out" and not any("check the cameras" in note for note in scene.notes)
    write_scene(tmp_path / "scene.json", scene)
    for read in (scene, read_scene(tmp_path / "scene.json")):
        cameras = read.train.cameras
        rays = cameras.image_rays(0)
        assert (cameras.width, cameras.height, cameras.models.tolist()) == (32, 16, [3, 3])
        torch.testing.assert_close(rays.directions, Cameras.all_around(cameras.poses, 16).image_rays(0).directions)


@pytest.mark.parametrize(("binary", "height"), [(True, 40), (False, 32)])
def test_pictures_all_around_of_a_model(tmp_path, binary, height):
    """Equirectangular COLMAP cameras load: their two parameters are the image size, and point depths are distances."""
    poses = orbit_cameras(9, radius=4, elevation=20, width=1, height=1, focal=1).poses
    points = torch.nn.functional.normalize(torch.randn(60, 3, generator=torch.Generator().manual_seed(0)), dim=-1) * 20
    lens = ("EQUIRECTANGULAR", (64.0, float(height)))
    write_images(tmp_path, [(64, height)] * 9)
    write_colmap(tmp_path, poses, [(64, height)] * 9, points.numpy(), binary=binary, lenses=[lens] * 9)
    scene = load_scene(tmp_path, normalise=False)
    assert scene.kind == "inside-out" and scene.near == pytest.approx(0.75 * 16, rel=0.05)
    x, y, z = ((points - poses[1, :3, 3]) @ poses[1, :3, :3]).unbind(-1)
    right, down = torch.atan2(x, -z), torch.atan2(-y, torch.hypot(x, z))
    expected = torch.stack(((right / math.tau + 0.5) * 64, (down / math.pi + 0.5) * height), dim=-1)
    pixels, _ = scene.train.cameras.project(points, scene.train.names.index("01"))
    torch.testing.assert_close(pixels, expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("tag", [1, 3, 6])
def test_a_picture_all_around_stands_upright_or_on_its_head(tmp_path, tag):
    poses = orbit_cameras(3, radius=4, elevation=20, width=1, height=1, focal=1).poses
    write_images(tmp_path, [(64, 32)] * 3, exif=oriented(tag))
    write_colmap(tmp_path, poses, [(64, 32)] * 3, [], lenses=[("EQUIRECTANGULAR", (64, 32))] * 3)
    if tag == 6:
        refuses("must have no orientation tag of a quarter turn", load_scene, tmp_path, error=SceneError)
        return
    rays = load_scene(tmp_path, normalise=False).test.cameras.image_rays(0).directions.view(32, 64, 3)
    expected = Cameras.all_around(poses[:1], 32).image_rays(0).directions.view(32, 64, 3)
    torch.testing.assert_close(rays, expected.rot90(2) if tag == 3 else expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("terms", "model", "radius"),
    [
        ({"k1": -0.25}, PERSPECTIVE, 2 / 3**0.5),
        ({"k1": -0.25, "k2": 1e-20, "k3": -1e-18}, PERSPECTIVE, 2 / 3**0.5),
        ({"k1": 0.1, "k2": 0.2}, PERSPECTIVE, math.inf),
        ({"k4": -0.25}, PERSPECTIVE, 2.0),  # the denominator is 0 at 2
        ({"k1": -0.1}, FISHEYE, (10 / 3) ** 0.5),
        ({"k4": -1e-4}, FISHEYE, (1e4 / 9) ** 0.125),
        ({}, EQUIRECTANGULAR, math.inf),
    ],
)
def test_where_a_lens_folds_over(terms, model, radius):
    terms = [terms.get(name, 0.0) for name in COEFFICIENTS[FISHEYE if model == FISHEYE else PERSPECTIVE]]
    assert fold(terms, model) == pytest.approx(radius)
    if radius < 100:
        u = torch.tensor([0.99, 1.01], dtype=torch.float64) * radius
        assert distort(u, 0 * u, torch.tensor(terms), model)[0].isnan().tolist() == [False, True]


def test_refuses_unknown_models():
    for name in OTHER_MODELS.values():
        refuses(f"camera model {name} is not supported (colmap image_undistorter makes", colmap_lens, name, [1.0])
    refuses("RADIAL must have 5 parameters, got 4", colmap_lens, "RADIAL", [1.0] * 4)
