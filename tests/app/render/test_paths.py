"""Tests of camera paths: their files, smooth paths through keyframes, and paths along the cameras of a capture."""

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers import all_pairs, read_json, refuses
from PIL import Image

from voronerf.app.export.video import video_cameras
from voronerf.app.render.paths import (
    CameraPath,
    capture_path,
    lists_cameras,
    panoramas,
    read_camera_path,
    read_cameras,
    resized,
    smooth_path,
    write_camera_path,
)
from voronerf.app.scenes import builtin_scene, load_scene
from voronerf.app.scenes.colmap import read_model
from voronerf.app.scenes.transforms import Shot, write_transforms
from voronerf.nerf import Cameras, focus_point, orbit_cameras, turntable_cameras
from voronerf.nerf.cameras import look_at, shared_focus

sys.path.append(str(Path(__file__).parents[1] / "scenes"))
from scene_files import COUNT, POSES, SIZE, oriented, rewrite, write_both, write_capture, write_frames

LEVEL = [1, 0, 0, 4, 0, 0, -1, -5, 0, 1, 0, 6, 0, 0, 0, 1]  # at (4, -5, 6), looks along +y, z is up


def by_hand(**changes):
    """Returns a path with only the entries that nerfstudio's reader requires."""
    frame = {"camera_to_world": LEVEL, "fov": 90, "aspect": 2}
    return {"render_width": 80, "render_height": 40, "camera_path": [frame, frame], **changes}


def columns(matrix):
    """Returns a pose in column-major order, as in three.js and in keyframes of nerfstudio's first viewer."""
    return [number for column in range(4) for number in matrix[column::4]]


def scaled(matrix, factor):
    """Returns a pose (a row-major list) with its axes multiplied by the factor."""
    return [number * factor if place % 4 < 3 and place < 12 else number for place, number in enumerate(matrix)]


def nerfstudio_rays(kind, pose, width, height, fov):
    """Computes the world ray directions [h, w, 3] of a path's frame with the formulas of nerfstudio's `Cameras`."""
    focal = height / 2 / math.tan(math.radians(fov) / 2)
    fx, fy = (width / 2, height) if kind == "equirectangular" else (focal, focal)
    y, x = torch.meshgrid(*(torch.arange(side, dtype=torch.float64) + 0.5 for side in (height, width)), indexing="ij")
    u, v = (x - width / 2) / fx, -(y - height / 2) / fy
    if kind == "fisheye":
        angle = torch.hypot(u, v)
        local = torch.stack((u * angle.sin() / angle, v * angle.sin() / angle, -angle.cos()), -1)
    elif kind == "equirectangular":
        theta, phi = -math.pi * u, math.pi * (0.5 - v)
        local = torch.stack((-theta.sin() * phi.sin(), phi.cos(), -theta.cos() * phi.sin()), -1)
    else:
        local = torch.stack((u, v, -torch.ones_like(u)), -1)
    return torch.nn.functional.normalize(local, dim=-1) @ pose[:3, :3].T, torch.stack((x, y), -1)


@pytest.mark.parametrize(
    ("kind", "size"),
    [(kind, (96, 54)) for kind in ("perspective", "fisheye", "equirectangular")] + [("Equirectangular", (50, 80))],
)
def test_frames_have_the_rays_of_nerfstudio(tmp_path, kind, size):
    pose = look_at(torch.tensor([[1.0, 2, 0.5]]), torch.tensor([0.1, 0.2, 0.3]), torch.tensor([0.0, 0, 1]))[0].double()
    frame = {"camera_to_world": pose.tolist(), "fov": 62.5, "aspect": 1}
    entries = by_hand(camera_type=kind, camera_path=[frame], render_width=float(size[0]), render_height=size[1])
    (tmp_path / "path.json").write_text(json.dumps(entries))
    frames = read_camera_path(tmp_path / "path.json").frames
    directions, pixels = nerfstudio_rays(kind.lower(), pose, *size, 62.5)
    rays = frames.image_rays(0)
    torch.testing.assert_close(rays.directions, directions.view(-1, 3).float(), atol=1e-6, rtol=0)
    seen, _ = frames.project(rays.origins + 3 * directions.view(-1, 3).float(), 0)
    torch.testing.assert_close(seen, pixels.view(-1, 2).float(), atol=1e-3, rtol=0)
    write_camera_path(tmp_path / "again.json", CameraPath(frames, fps=5))
    again = read_camera_path(tmp_path / "again.json").frames.image_rays(0)
    torch.testing.assert_close(again.directions, rays.directions, atol=1e-6, rtol=0)


ROWS = [LEVEL[row : row + 4] for row in (0, 4, 8, 12)]


@pytest.mark.parametrize(
    "frame",
    [
        {"camera_to_world": ROWS},
        {"camera_to_world": ROWS[:3]},
        {"camera_to_world": LEVEL[:12]},
        {"camera_to_world": scaled(LEVEL, 0.125)},  # from Blender, with a mesh eight times as large
        {"camera_to_world": [*LEVEL[:15], 1.0000001], "render_time": 0.5},
    ],
    ids=["4 x 4", "3 x 4", "12", "scaled", "rounded"],
)
def test_poses_in_every_form(tmp_path, frame):
    file = tmp_path / "path.json"
    file.write_text(json.dumps(by_hand(camera_path=[frame], default_fov=90)))
    read = read_camera_path(file).frames
    torch.testing.assert_close(read.poses[0], torch.tensor(ROWS, dtype=torch.float32))
    assert read.intrinsics[0].tolist() == pytest.approx([20, 20, 40, 20])  # from default_fov


@pytest.mark.parametrize(
    ("changes", "fps"),
    [({"fps": 12.5, "seconds": 9}, 12.5), ({"seconds": 4.0}, 0.5), ({"fps": None, "seconds": 4}, 0.5), ({}, 24)],
)
def test_the_rate_of_a_file(tmp_path, changes, fps):
    (tmp_path / "path.json").write_text(json.dumps(by_hand(**changes)))
    assert read_camera_path(tmp_path / "path.json").fps == fps


@pytest.mark.parametrize(
    ("matrix", "there"),
    [
        (LEVEL, True),
        (ROWS, True),
        (json.dumps([float(x) for x in columns(LEVEL)]), True),  # from nerfstudio's viewer before 1.0, or add-ons
        (json.dumps(LEVEL), False),
        ("[1, 2", False),
        ("7", False),
        ("[" * 100_000, False),
        (None, False),
    ],
    ids=["numbers", "rows", "columns in a string", "rows in a string", "cut", "number", "deep", "none"],
)
def test_keyframes_of_every_viewer(tmp_path, matrix, there):
    keyframe = {"matrix": matrix, "fov": 90, "aspect": 2, "properties": '[["FOV",90],["NAME","Camera 0"],["TIME",0]]'}
    (tmp_path / "path.json").write_text(json.dumps(by_hand(keyframes=[keyframe])))
    path = read_camera_path(tmp_path / "path.json")
    assert len(path.frames) == 2 and (path.keyframes is not None) == there  # broken keyframes are left out
    if there:
        assert torch.equal(path.keyframes.poses[0], path.frames.poses[0])


def test_a_file_of_nerfstudio(tmp_path):
    file = tmp_path / "path.json"
    keyframe = {"matrix": [float(x) for x in LEVEL], "fov": 60.0, "aspect": 2.0, "override_transition_sec": None}
    extra = {"camera_type": "perspective", "fps": 30, "seconds": 4.0, "is_cycle": True, "crop": {"crop_scale": [1] * 3}}
    file.write_text(json.dumps(by_hand(keyframes=[keyframe], **extra)))
    path = read_camera_path(file)
    assert (len(path.frames), path.fps, path.closed, path.frames.width, path.frames.height) == (2, 30, True, 80, 40)
    assert path.frames.origins[1].tolist() == [4, -5, 6] and path.frames.forward[1].tolist() == [0, 1, 0]
    torch.testing.assert_close(path.frames.intrinsics[0], torch.tensor([20.0, 20, 40, 20]))  # fov 90 is vertical
    assert path.keyframes.intrinsics[0, 1] == pytest.approx(20 / math.tan(math.radians(30)))
    file.write_text(json.dumps(by_hand(keyframes=[])))
    assert read_camera_path(file).keyframes is None


def test_frames_that_show_all_around(tmp_path):
    file = tmp_path / "path.json"
    file.write_text(json.dumps(by_hand(camera_type="equirectangular")))
    frames = read_camera_path(file).frames
    pixels, _ = frames.project(torch.tensor([[4.0, 5, 6], [14.0, -5, 6]]), 1)
    assert pixels[:, 0].tolist() == pytest.approx([40, 60])
    assert torch.equal(panoramas(frames, (80, 40)).poses, frames.poses)
    down = look_at(torch.tensor([[1.0, 2, 3], [0.0, 0, 3]]), torch.zeros(3), torch.tensor([0.0, 0, 1]))
    tilted = Cameras(down, torch.ones(2, 4), 6, 4)
    level = panoramas(tilted, (20, 10))
    assert torch.equal(level.origins, tilted.origins) and level.width == 20
    torch.testing.assert_close(level.poses[:, 2, 1], torch.ones(2))  # level, also for a camera that looks down
    refuses("must be 2 to 1, got 20 x 11", panoramas, tilted, (20, 11))


def test_what_is_written_is_read(tmp_path):
    keyframes = orbit_cameras(3, radius=2, elevation=30, width=640, height=480, focal=500)
    path = CameraPath(smooth_path(keyframes, 7, closed=True), 12.5, keyframes, closed=True)
    write_camera_path(tmp_path / "new" / "path.json", path)
    read = read_camera_path(tmp_path / "new" / "path.json")
    assert (read.fps, read.closed, read.frames.width, read.frames.height) == (12.5, True, 640, 480)
    for ours, theirs in ((path.frames, read.frames), (keyframes, read.keyframes)):
        assert torch.equal(ours.poses, theirs.poses)
        torch.testing.assert_close(ours.intrinsics, theirs.intrinsics)
    entries = read_json(tmp_path / "new" / "path.json")
    assert entries["seconds"] == 7 / 12.5 and entries["camera_path"][0].keys() == {"camera_to_world", "fov", "aspect"}


def one(pose, fov=50):
    """Returns the entries of a path with one frame."""
    return {"camera_path": [{"camera_to_world": pose, "fov": fov}]}


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"camera_path": 3}, "is not a camera path: it must have a list camera_path"),
        ({"camera_path": []}, "camera_path must be a list of 1 to 100000 frames, got 0 of them"),
        ({"camera_path": [7]}, "camera_path[0].camera_to_world must be 4 x 4 or 3 x 4 numbers, got None"),
        (one(LEVEL[:11]), "must be 4 x 4 or 3 x 4 numbers, got [1"),
        (one(str(LEVEL)), "must be 4 x 4 or 3 x 4 numbers, got '[1"),
        (one(columns(LEVEL)), "must be a rotation and a position"),
        (one(LEVEL, None), "camera_path[0].fov must be a number of 0.01 to 179.9, got None"),
        (one([math.nan] * 16), "1e+09, got nan"),
        (one([10**400] * 16), "must be a number of -1e+09 to 1e+09, got 1"),
        (one([2.0, *LEVEL[1:]]), "[0].camera_to_world must be a rotation"),
        (one([-1.0, *LEVEL[1:]]), "must be a rotation and a position"),
        (one(LEVEL, 180), "[0].fov must be a number of 0.01 to 179.9, got 180"),
        ({"render_width": 10**9}, "render_width must be an integer of 1 to 8192, got 1000000000"),
        ({"render_width": 1920.5}, "render_width must be an integer of 1 to 8192, got 1920.5"),
        ({"render_height": True}, "render_height must be an integer of 1 to 8192, got True"),
        ({"fps": "fast"}, "fps must be a number of 0.01 to 1000, got 'fast'"),
        ({"seconds": 0}, "seconds must be a number of 0.001 to 1e+09, got 0"),
        ({"camera_type": "cube"}, "camera_type must be perspective, fisheye or equirectangular, got 'cube'"),
    ],
)
def test_files_that_are_no_paths(tmp_path, changes, rule):
    file = tmp_path / "path.json"
    file.write_text(json.dumps(by_hand(**changes)))
    refuses(f"{file}: ", read_camera_path, file)
    refuses(rule, read_camera_path, file)


@pytest.mark.parametrize("closed", [False, True])
def test_smooth_paths_pass_their_keyframes_evenly(closed):
    keyframes = orbit_cameras(6, radius=2, elevation=20, width=64, height=48, focal=70)
    keyframes.intrinsics[3, :2] = 140
    steps, count = 10, 60 if closed else 51
    frames = smooth_path(keyframes, count, closed=closed)
    torch.testing.assert_close(frames.poses[::steps], keyframes.poses, atol=1e-5, rtol=0)
    torch.testing.assert_close(frames.intrinsics[::steps], keyframes.intrinsics)
    turns = frames.poses[:, :3, :3]
    torch.testing.assert_close(turns @ turns.mT, torch.eye(3).expand(count, 3, 3), atol=1e-5, rtol=0)
    moves = (frames.poses.roll(-1, 0) - frames.poses).flatten(1).norm(dim=-1)[: count - (not closed)]
    assert moves.max() < 2 * moves.min()  # no jump, not even from the last frame to the first
    assert smooth_path(keyframes[:1], 3).poses.sub(keyframes.poses[0]).abs().max() < 1e-5
    refuses("keyframes and count must be at least 1, got 6 and 0", smooth_path, keyframes, 0)


def ring(degrees, radius=3.0, climb=20.0):
    """Returns cameras around (1, 0, 0) at the angles in degrees, at two alternating heights."""
    angles = torch.tensor(degrees, dtype=torch.float32).deg2rad()
    target = torch.tensor([1.0, 0, 0])
    climbs = torch.where(torch.arange(len(angles)) % 2 == 0, climb, climb + 30).deg2rad()
    around = torch.stack((angles.cos() * climbs.cos(), angles.sin() * climbs.cos(), climbs.sin()), -1)
    poses = look_at(target + radius * around, target, torch.tensor([0.0, 0, 1]))
    return Cameras(poses, torch.tensor([[40.0, 40, 16, 12]]).repeat(len(angles), 1), 32, 24)


def test_a_path_around_something_is_as_far_and_as_high_as_the_cameras_near_it():
    seen = ring(range(0, 360, 10))
    far = torch.arange(36) >= 18  # the far half is at twice the distance
    seen.poses[far, :3, 3] = 2 * (seen.origins[far] - torch.tensor([1.0, 0, 0])) + torch.tensor([1.0, 0, 0])
    frames = capture_path(seen, 40, near=1, far=9)
    offset = frames.origins - focus_point(seen)
    reach = offset.norm(dim=-1)
    assert 2.5 < reach[10] < 3.2 and 5.0 < reach[30] < 6.2  # the middles of both halves
    assert reach.min() > 2.5 and reach.max() < 6.2 and (offset[:, 2] / reach).asin().rad2deg().sub(35).abs().max() < 5
    pixels, depth = zip(*(frames.project(focus_point(seen)[None], index) for index in range(40)))
    torch.testing.assert_close(torch.cat(pixels), torch.tensor([[16.0, 12]]).expand(40, 2), atol=1e-2, rtol=0)
    assert min(torch.cat(depth)) > 0 and (frames.width, frames.height) == (32, 24)
    moves = (frames.origins.roll(-1, 0) - frames.origins).norm(dim=-1)
    assert moves.max() < 4 * moves.min()  # a closed path without a jump


def test_a_path_does_not_cross_a_gap_between_cameras():
    frames = capture_path(ring(range(60, 301, 8)), 50, near=1, far=9)
    angles = torch.atan2(frames.origins[:, 1], frames.origins[:, 0] - 1).rad2deg() % 360
    assert angles.min() > 57 and angles.max() < 303 and angles.max() - angles.min() > 230
    moves = (frames.origins.roll(-1, 0) - frames.origins).norm(dim=-1)
    assert moves.max() < 0.8  # back and forth: the last frame is near the first


def test_a_path_of_cameras_that_look_outwards_goes_through_them_in_order():
    angles = torch.arange(12) * torch.pi / 6
    outward = torch.stack((angles.cos(), angles.sin(), 0 * angles), -1)
    poses = torch.cat([look_at(place[None], 2 * place, torch.tensor([0.0, 0, 1])) for place in outward])
    seen = Cameras(poses, torch.tensor([[40.0, 40, 16, 12]]).repeat(12, 1), 32, 24)
    assert focus_point(seen) is None
    frames = capture_path(seen, 48, near=1, far=9)
    assert torch.cdist(frames.origins, seen.origins).amin(1).max() < 0.3
    torch.testing.assert_close(frames.poses[[0, 47]], seen.poses[[0, 11]], atol=1e-5, rtol=0)
    assert len(capture_path(seen, 1, near=1, far=9)) == 1


def test_a_path_of_people_who_walk_and_look_around_is_theirs():
    """The path follows the walk instead of a circle around a focus.

    The point closest to all optical axes happens to lie in front of most cameras, as for cameras around an object.
    """
    torch.manual_seed(0)
    along = torch.linspace(-2, 2, 12)
    origins = torch.stack((along, 0.3 * torch.rand(12), torch.full((12,), 1.5)), 1)
    turn = along + 2 * math.pi * torch.rand(()) + torch.rand(12)
    targets = origins + torch.stack((turn.cos(), turn.sin(), torch.full((12,), -0.1)), 1)
    poses = look_at(origins, targets, torch.tensor([0.0, 0, 1]))
    cameras = Cameras(poses, torch.tensor([[20.0, 20, 16, 12]]).expand(12, 4), 32, 24)
    assert focus_point(cameras) is not None and shared_focus(cameras) is None
    path = capture_path(cameras, 60, near=0.5, far=8)
    apart = torch.cdist(path.origins, origins).amin(1)
    assert float(apart.max()) < 0.3


def test_frames_have_the_size_of_most_images_or_another():
    seen = ring(range(0, 360, 10))
    upright = torch.arange(36) % 5 == 0
    sizes = torch.where(upright[:, None], torch.tensor([24, 32]), torch.tensor([32, 24]))
    seen = Cameras.of_images(seen.poses, seen.intrinsics, sizes)
    assert (seen.width, seen.height) == (32, 32)
    frames = capture_path(seen, 5, near=1, far=9)
    assert (frames.width, frames.height) == (32, 24) and frames.intrinsics[0].tolist() == [40, 40, 16, 12]
    wide = resized(frames, (128, 72))  # the top and the bottom are cut off
    assert (wide.width, wide.height) == (128, 72) and wide.intrinsics[0].tolist() == [160, 160, 64, 36]
    assert resized(wide, (32, 24)).intrinsics[0].tolist() == pytest.approx([160 / 3, 160 / 3, 16, 12])
    around = resized(replace(frames, distortion=torch.zeros(5, 8), models=torch.ones(5, dtype=torch.int32)), (128, 72))
    assert around.models.tolist() == [1] * 5 and torch.equal(around.intrinsics, wide.intrinsics)  # still fisheye


def test_a_turntable_has_the_size_and_the_lens_of_most_images():
    scene, options = builtin_scene(8), {"radius": 4.0, "elevation": 20.0}
    small = orbit_cameras(2, width=100, height=100, focal=120, **options)
    large = orbit_cameras(4, width=400, height=400, focal=480, **options)
    sizes = torch.tensor([[100, 100]] * 2 + [[400, 400]] * 4)
    both = (torch.cat(pair) for pair in ((small.poses, large.poses), (small.intrinsics, large.intrinsics)))
    cameras = video_cameras(replace(scene, train=replace(scene.train, cameras=Cameras.of_images(*both, sizes))), 3)
    assert (cameras.width, cameras.height) == (400, 400) and cameras.intrinsics[0, 0] == 480


@pytest.mark.parametrize("towards", [0.0, 4.0])  # parallel, or aimed at a point
def test_a_spiral_before_a_scene_looks_where_its_cameras_do(towards):
    x, z = torch.meshgrid(torch.linspace(-0.5, 0.5, 4), torch.linspace(-0.3, 0.3, 3), indexing="ij")
    origins = torch.stack((x, torch.full_like(x, -4), z), -1).reshape(-1, 3)
    target = torch.zeros(3) if towards else origins + torch.tensor([0.0, 4, 0])
    poses = look_at(origins, target, torch.tensor([0.0, 0, 1]))
    seen = Cameras(poses, torch.tensor([[40.0, 40, 16, 12]]).repeat(12, 1), 32, 24)
    frames = capture_path(seen, 30, near=2, far=1e6)
    offset = frames.origins - torch.tensor([0.0, -4, 0])
    assert (offset.abs().amax(0) <= torch.tensor([0.51, 0.2, 0.31])).all() and offset[:, 0].abs().max() > 0.45
    assert frames.forward[:, 1].min() > 0.97
    middle = torch.tensor([[0.0, 0 if towards else 4, 0]])  # the focus, or depth 1 / (0.25 / near)
    pixels = torch.cat([frames.project(middle, index)[0] for index in range(30)])
    torch.testing.assert_close(pixels, torch.tensor([[16.0, 12]]).expand(30, 2), atol=0.05, rtol=0)
    assert len(turntable_cameras(seen, 5)) == 5
    refuses("count must be at least 1, got 0", capture_path, seen, 0, near=1, far=2)


#: Entries of a transforms file for 12 x 10 images of three lenses.
LENSES = {
    "perspective": {"fl_x": 20.0, "fl_y": 19.0, "cx": 6.5, "cy": 4.5},
    "distorted": {"fl_x": 20.0, "k1": 0.05, "p1": 0.01, "w": 12, "h": 10},
    "fisheye": {"fl_x": 8.0, "camera_model": "OPENCV_FISHEYE", "k1": 0.02, "w": 12, "h": 10},
}


def check_same_cameras(file, scene, downscale=1):
    """Checks that the cameras in a file have the rays of the scene's cameras, which are sorted by name."""
    names = [Path(frame["file_path"]).stem for frame in read_json(file)["frames"]]
    cameras = read_cameras(file, scene, downscale)
    for split in (scene.train, scene.test):
        for index, name in enumerate(split.names):
            number = names.index(name)
            assert cameras.size(number) == split.cameras.size(index)
            ours, theirs = cameras.image_rays(number), split.cameras.image_rays(index)
            torch.testing.assert_close(ours.origins, theirs.origins, atol=1e-6, rtol=0)
            torch.testing.assert_close(ours.directions, theirs.directions, atol=1e-6, rtol=0, equal_nan=True)
    return cameras


@pytest.mark.parametrize(*all_pairs({"lens": list(LENSES), "normalise": (True, False), "applied": (False, True)}))
def test_cameras_of_a_capture_are_in_the_coordinates_of_its_files(tmp_path, lens, normalise, applied):
    moved = {"applied_transform": [[0, 0, 1, 0], [1, 0, 0, 1], [0, 1, 0, 3]], "applied_scale": 2.5} if applied else {}
    views = Cameras(POSES, torch.tensor([[20.0, 20, 6, 5]]).repeat(COUNT, 1), *SIZE)
    write_capture(tmp_path / "capture", views, **LENSES[lens], **moved)
    scene = load_scene(tmp_path / "capture", normalise=normalise)
    file = tmp_path / "capture/transforms.json"
    assert lists_cameras(file)
    check_same_cameras(file, scene)
    check_same_cameras(file, load_scene(tmp_path / "capture", normalise=normalise, downscale=2), 2)
    if "w" in LENSES[lens]:  # images need not exist, and another file may have other coordinates
        (tmp_path / "elsewhere").mkdir()
        other = tmp_path / "elsewhere/path.json"
        other.write_text(file.read_text())
        rewrite(other.parent, lambda entries: entries.update(applied_scale=5.0), "path")
        far = read_cameras(other, scene)
        moved = scene.transform @ torch.diag(torch.tensor([0.2, 0.2, 0.2, 1], dtype=torch.float64))
        if not applied:
            place = torch.tensor(read_json(file)["frames"][0]["transform_matrix"], dtype=torch.float64)[:, 3]
            torch.testing.assert_close(far.origins[0], (moved @ place)[:3].float(), atol=1e-5, rtol=0)
        rotation = far.poses[:, :3, :3]
        torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).expand(COUNT, 3, 3), atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("tags", "lens"),
    [
        ([3], LENSES["distorted"]),
        ([6], LENSES["distorted"]),
        ([6], {"fl_x": None, "camera_angle_x": 0.9}),
        ([3, 6], {**LENSES["distorted"], "w": 10, "h": 12}),  # cameras of the upright pictures
    ],
)
def test_cameras_of_photographs_that_their_tags_turn(tmp_path, tags, lens):
    write_frames(tmp_path, POSES, "{:02d}.jpg".format, **lens)
    for index in range(COUNT):
        tag = tags[index % len(tags)]
        size = SIZE if tags == [3] or tag == 6 else SIZE[::-1]
        Image.new("RGB", size).save(tmp_path / f"{index:02d}.jpg", exif=oriented(tag))
    cameras = check_same_cameras(tmp_path / "transforms.json", load_scene(tmp_path))
    assert (cameras.width, cameras.height) == (SIZE if tags == [3] else SIZE[::-1])


@pytest.mark.parametrize("normalise", [True, False])
def test_cameras_beside_a_colmap_model(tmp_path, normalise):
    write_both(tmp_path)
    scene = load_scene(tmp_path, format="colmap", normalise=normalise)
    images = read_model(tmp_path / "sparse/0").images
    shots = [Shot(f"images/{i.name}", torch.as_tensor(i.pose), i.camera.lens, *SIZE) for i in images]
    write_transforms(tmp_path / "transforms.json", shots)
    check_same_cameras(tmp_path / "transforms.json", scene)


def test_cameras_of_blender_and_of_several_sizes(tmp_path):
    scene, file = builtin_scene(8, train_views=1, test_views=5), tmp_path / "transforms_test.json"
    poses = scene.test.cameras.poses
    focal = float(scene.test.cameras.intrinsics[0, 0])
    write_frames(tmp_path, poses, "r_{}".format, fl_x=None, camera_angle_x=2 * math.atan(4 / focal))
    entries = read_json((tmp_path / "transforms.json").rename(file))
    cameras = read_cameras(file, scene, 2)
    assert (len(cameras), cameras.width, cameras.height, cameras.distortion) == (len(poses), 8, 8, None)
    torch.testing.assert_close(cameras.intrinsics, scene.test.cameras.intrinsics, atol=1e-4, rtol=0)
    assert torch.equal(cameras.poses, poses)
    entries["frames"][1] |= {"w": 32, "h": 24}
    file.write_text(json.dumps(entries))
    cameras = read_cameras(file, scene)
    assert cameras.sizes is None and cameras.width == cameras.height == 8
    fx, _, cx, cy = cameras.intrinsics[1].tolist()
    assert (fx, cx, cy) == pytest.approx((focal / 8 * 32 / 3, 4, 4), rel=1e-4)
    entries["camera_path"] = []
    file.write_text(json.dumps(entries))
    assert not lists_cameras(file)


@pytest.mark.parametrize(
    ("frames", "rule"),
    [
        ([], "frames must be a list of 1 to 100000 frames, got 0 of them"),
        ([7], "frame 0 must be an object, got 7"),
        ([{"file_path": "a"}], "frame 0: transform_matrix is not a matrix of numbers"),
        ([{"transform_matrix": torch.eye(4).tolist(), "fl_x": 9}], "must state w and h, or cx and cy, since its lens"),
        ([{"transform_matrix": torch.eye(4).tolist()}], "has no focal length (fl_x or camera_angle_x)"),
        ([{"transform_matrix": torch.eye(4).tolist(), "fl_x": 9e3, "w": 9e3, "h": 10}], "at most 8192 pixels a side"),
    ],
)
def test_cameras_that_cannot_be_read(tmp_path, frames, rule):
    file, scene = tmp_path / "transforms.json", builtin_scene(2, train_views=1, test_views=1)
    file.write_text(json.dumps({"frames": frames}))
    refuses(rule, read_cameras, file, scene)
