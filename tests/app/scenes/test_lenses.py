"""Rays of every camera model of COLMAP, against pixels by pycolmap 4.2.

OpenCV 5.0 (`projectPoints`, `fisheye.projectPoints`) gives the same pixels to 1e-13 for all but FOV and
THIN_PRISM_FISHEYE, which it has not.
"""

import json
from pathlib import Path

import pytest
import torch
from helpers import refuses
from scene_files import write_colmap, write_images

from voronerf.app.scenes import load_scene
from voronerf.app.scenes.lenses import MODELS, colmap_lens
from voronerf.app.scenes.record import read_scene, write_scene
from voronerf.nerf import Cameras, orbit_cameras

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
    """And its own size: files are a tenth or a twentieth of what their lens is for."""
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
                found, _ = cameras.project(points @ poses[view, :3, :3].T + poses[view, :3, 3], index)
                torch.testing.assert_close(found, pixels, atol=1e-4, rtol=0)


def test_pictures_all_around(tmp_path):
    """As nerfstudio writes them: the focal length says nothing, and rays are reduced and kept with the images."""
    poses = orbit_cameras(3, radius=4, elevation=20, width=1, height=1, focal=1).poses
    write_images(tmp_path, [(64, 32)] * 3)
    frames = [
        {"file_path": f"images/{index:02d}.jpg", "transform_matrix": pose.tolist()} for index, pose in enumerate(poses)
    ]
    entries = {"camera_model": "EQUIRECTANGULAR", "w": 64, "h": 32, "fl_x": 32, "fl_y": 32, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(entries))
    scene = load_scene(tmp_path, downscale=2)
    assert scene.kind == "inside-out" and not any("check the cameras" in note for note in scene.notes)
    write_scene(tmp_path / "scene.json", scene)
    for read in (scene, read_scene(tmp_path / "scene.json")):
        cameras = read.train.cameras
        rays = cameras.image_rays(0)
        assert (cameras.width, cameras.height) == (32, 16)
        torch.testing.assert_close(rays.directions, Cameras.all_around(cameras.poses, 16).image_rays(0).directions)


def test_refuses_unknown_models():
    refuses("camera model DIVISION is not supported, only SIMPLE_PINHOLE, PINHOLE", colmap_lens, "DIVISION", [1.0])
    refuses("RADIAL must have 5 parameters, got 4", colmap_lens, "RADIAL", [1.0] * 4)
