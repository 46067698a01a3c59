"""Tests of cameras: rays of pixels, and projections of points to pixels, against the definitions."""

import math

import pytest
import torch
from helpers import refuses

from voronerf.nerf import lenses
from voronerf.nerf.cameras import Cameras, Rays, axis_misses, focus_point, look_at, orbit_cameras, turntable_cameras
from voronerf.nerf.lenses import distort, undistort

FOX = (0.0578421, -0.0805099, -0.000980296, 0.00015575, 0, 0, 0, 0)
STRONG = (-0.28, 0.09, 0.001, -0.002, 0, 0, 0, 0)


def cameras(count=3, distortion=None):
    base = orbit_cameras(count, radius=3, elevation=20, width=30, height=20, focal=25)
    bent = None if distortion is None else torch.tensor(distortion).repeat(count, 1)
    intrinsics = torch.tensor((25.0, 27.0, 14.2, 10.7)).repeat(count, 1)
    return Cameras(base.poses, intrinsics, 30, 20, bent)


def test_axes_are_opengl():
    one = Cameras(torch.eye(4)[None], torch.tensor([[10.0, 10.0, 2.0, 1.0]]), 4, 2)
    middle = one.rays(torch.tensor([0, 0, 0]), torch.tensor([2.0, 4.0, 2.0]), torch.tensor([1.0, 1.0, 0.0]))
    expected = torch.nn.functional.normalize(torch.tensor([[0, 0, -1.0], [0.2, 0, -1], [0, 0.1, -1]]), dim=-1)
    torch.testing.assert_close(middle.directions, expected)
    assert torch.equal(middle.origins, torch.zeros(3, 3))


@pytest.mark.parametrize("distortion", [None, FOX, STRONG])
def test_image_rays_are_row_major_unit_and_agree_with_rays(distortion):
    some = cameras(distortion=distortion)
    rays = some.image_rays(1)
    assert len(rays) == 600
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(600))
    pixel = some.rays(torch.tensor([1]), torch.tensor([7]), torch.tensor([3]))
    torch.testing.assert_close(rays[3 * 30 + 7 : 3 * 30 + 8].directions, pixel.directions)


@pytest.mark.parametrize("distortion", [None, FOX, STRONG])
def test_project_inverts_rays(distortion):
    some = cameras(distortion=distortion)
    rays = some.image_rays(2)
    distance = torch.linspace(0.5, 9, 600)[:, None]
    pixels, depth = some.project(rays.origins + distance * rays.directions, 2)
    x, y = torch.meshgrid(torch.arange(30) + 0.5, torch.arange(20) + 0.5, indexing="xy")
    torch.testing.assert_close(pixels, torch.stack((x.reshape(-1), y.reshape(-1)), -1), atol=2e-4, rtol=0)
    torch.testing.assert_close(depth, distance[:, 0] * (rays.directions @ some.forward[2]), rtol=1e-4, atol=1e-5)


def test_a_camera_that_sees_all_around():
    """The middle looks ahead, a quarter of the width is 90 degrees, and the upper edge looks up, as in nerfstudio."""
    some = Cameras.all_around(orbit_cameras(3, radius=3, elevation=20, width=1, height=1, focal=1).poses, 40)
    one = Cameras.all_around(torch.eye(4)[None], 40)
    seen = one.rays(0, torch.tensor([40.0, 60, 20, 0, 40, 50]), torch.tensor([20.0, 20, 20, 20, 0, 30]))
    half = math.sqrt(0.5)
    expected = [[0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 1, 0], [0.5, -half, -0.5]]
    torch.testing.assert_close(seen.directions, torch.tensor(expected), atol=1e-6, rtol=0)
    rays = some.image_rays(2, cones=True)
    distance = torch.linspace(0.5, 9, 3200)
    pixels, depth = some.project(rays.origins + distance[:, None] * rays.directions, 2)
    x, y = torch.meshgrid(torch.arange(80) + 0.5, torch.arange(40) + 0.5, indexing="xy")
    torch.testing.assert_close(pixels, torch.stack((x.reshape(-1), y.reshape(-1)), -1), atol=1e-3, rtol=0)
    torch.testing.assert_close(depth, distance)
    width = torch.tensor(math.pi / 40 * 2 / math.sqrt(12))
    torch.testing.assert_close(rays.radii, width.expand(3200))
    ahead = some[:2].perspective()
    assert (ahead.width, ahead.height, ahead.distortion) == (20, 20, None)
    corners = ahead.rays(0, torch.tensor([0.0, 20.0]), torch.tensor([10.0, 10.0])).directions
    assert abs(float(corners[0] @ corners[1])) < 1e-6  # 90 degrees


def test_points_behind_have_negative_depth():
    one = cameras(1)
    _, depth = one.project(one.origins - 2 * one.forward, 0)
    torch.testing.assert_close(depth, torch.tensor([-2.0]), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("coefficients", [FOX, STRONG, (0.0, 0.0, 0.01, -0.02, 0, 0, 0, 0)])
def test_undistort_to_a_millionth_of_a_pixel(coefficients):
    focal = 1375.0
    sides = (torch.linspace(-end, end, 41, dtype=torch.float64) for end in (0.4, 0.7))
    u, v = torch.meshgrid(*sides, indexing="ij")
    k = torch.tensor(coefficients, dtype=torch.float64)
    a, b = undistort(u, v, k)
    again = distort(a, b, k)
    assert float((again[0] - u).abs().max()) * focal < 1e-6
    assert float((again[1] - v).abs().max()) * focal < 1e-6
    assert float((a - u).abs().max()) * focal > 0.1  # the lens bends visibly


def test_distort_follows_opencv():
    x, y, k1, k2, p1, p2 = 0.3, -0.2, 0.1, -0.05, 0.01, 0.02
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    expected = (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )
    actual = distort(torch.tensor(x), torch.tensor(y), torch.tensor((k1, k2, p1, p2, 0, 0, 0, 0)))
    assert [float(value) for value in actual] == pytest.approx(expected, abs=1e-6)


def mixed():
    """Returns cameras with a fisheye, an FOV lens, no distortion, the fisheye again, and a perspective lens."""
    models = torch.tensor([1, 2, 0, 1, 0], dtype=torch.int32)
    bent = torch.tensor([FOX, (0.9, *7 * (0.0,)), 8 * (0.0,), FOX, STRONG])
    base = cameras(5)
    return Cameras(base.poses, base.intrinsics, 30, 20, bent, models)


def test_tables_of_lenses_have_the_rays_of_pixels():
    some = mixed()
    lens, tables = some.lenses
    assert lens[2] == -1 and lens[0] == lens[3] and tables.on(lens.device).shape == (3, 20, 30, 2)
    y, x = torch.meshgrid(torch.arange(20), torch.arange(30), indexing="ij")
    for index in range(5):
        expected = some.rays(index, x.reshape(-1), y.reshape(-1)).directions
        torch.testing.assert_close(some.image_rays(index).directions, expected, atol=2e-7, rtol=0)


def test_cameras_that_come_of_others_share_their_tables():
    some = mixed()
    tables = some.lenses[1]
    for other in (some[1:3], some.to("cpu"), some.moved(2 * torch.eye(4)), some[[4]]):
        assert other.lenses[1] is tables
    assert some[[4, 1]].lenses[0].tolist() == some.lenses[0][[4, 1]].tolist()
    assert some.downscaled(2).lenses[1] is not tables


def test_tables_are_bounded(monkeypatch):
    monkeypatch.setattr(lenses, "MOST_BYTES", 3 * 30 * 20 * 8 - 1)
    message = "the ray tables of 3 lenses of 30 x 20 pixels take 0.0 GiB, the limit is 0 GiB; reduce"
    refuses(message, getattr, mixed(), "lenses")


def test_downscaled_keeps_directions():
    some = cameras(distortion=FOX)
    small = some.downscaled(4)
    assert (small.width, small.height) == (7, 5)
    fine = some.rays(torch.tensor([0]), torch.tensor([12.0]), torch.tensor([8.0]))
    coarse = small.rays(torch.tensor([0]), torch.tensor([3.0]), torch.tensor([2.0]))
    torch.testing.assert_close(fine.directions, coarse.directions)


@pytest.mark.parametrize("factor", [0, -1, 21])
def test_downscaled_rejects(factor):
    refuses("downscaled: factor", cameras().downscaled, factor)


def test_indexing_and_no_rays():
    some = cameras(5, FOX)
    assert len(some[1:4]) == 3
    chosen = some[torch.tensor([True, False, False, True, False])]
    assert torch.equal(chosen.poses, some.poses[[0, 3]])
    assert chosen.distortion is not None and len(chosen.distortion) == 2
    none = some.rays(torch.zeros(0, dtype=torch.long), torch.zeros(0), torch.zeros(0))
    assert none.directions.shape == (0, 3)
    assert len(Rays(torch.zeros(4, 3), torch.ones(4, 3))[torch.tensor([1, 2])]) == 2


@pytest.mark.parametrize(
    ("poses", "intrinsics", "distortion", "models", "size", "message"),
    [
        ((2, 3, 4), (2, 4), None, None, 1, "poses must have shape [c, 4, 4], got [2, 3, 4]"),
        ((2, 4, 4), (1, 4), None, None, 1, "intrinsics must have shape [2, 4], got [1, 4]"),
        ((2, 4, 4), (2, 4), (2, 5), None, 1, "distortion must have shape [2, 8], got [2, 5]"),
        ((2, 4, 4), (2, 4), (2, 8), (3,), 1, "models must have shape [2], got [3]"),
        ((2, 4, 4), (2, 4), None, (2,), 1, "distortion must be given with models, got None"),
        ((2, 4, 4), (2, 4), None, None, 0, "width and height must be >= 1, got 0 x 1"),
    ],
)
def test_cameras_reject(poses, intrinsics, distortion, models, size, message):
    bent, kinds = (None if shape is None else torch.zeros(shape) for shape in (distortion, models))
    refuses(message, Cameras, torch.zeros(poses), torch.zeros(intrinsics), size, 1, bent, kinds)


def test_look_at_is_a_rotation_that_looks_there():
    origins = torch.tensor([[3.0, 1, 2], [0, 0, 4], [0, 0, -2], [1e-3, 0, 3]], dtype=torch.float64)
    poses = look_at(origins, torch.zeros(3, dtype=torch.float64), torch.tensor((0, 0, 1.0), dtype=torch.float64))
    rotation = poses[:, :3, :3]
    torch.testing.assert_close(rotation.mT @ rotation, torch.eye(3, dtype=torch.float64).expand(4, 3, 3))
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(4, dtype=torch.float64))
    torch.testing.assert_close(-rotation[:, :, 2] * origins.norm(dim=-1, keepdim=True), -origins)
    assert float(poses[0, 2, 1]) > 0  # up in the image is up in the world


def test_orbit_and_turntable():
    orbit = orbit_cameras(8, radius=2.5, elevation=30, width=9, height=9, focal=9, centre=(1, 2, 3), start=10)
    offset = orbit.origins - torch.tensor((1.0, 2.0, 3.0))
    torch.testing.assert_close(offset.norm(dim=-1), torch.full((8,), 2.5))
    torch.testing.assert_close(offset[:, 2], torch.full((8,), 1.25))
    assert math.degrees(math.atan2(offset[0, 1], offset[0, 0])) == pytest.approx(10, abs=1e-3)
    focus = focus_point(orbit)
    assert focus is not None
    torch.testing.assert_close(focus, torch.tensor((1.0, 2.0, 3.0)), atol=1e-4, rtol=0)
    again = turntable_cameras(orbit, 4)
    assert len(again) == 4
    torch.testing.assert_close((again.origins - focus).norm(dim=-1), torch.full((4,), 2.5), atol=1e-3, rtol=0)
    options = {"radius": 1, "elevation": 0, "width": 1, "height": 1, "focal": 1}
    refuses("count must be >= 1, got 0", orbit_cameras, 0, **options)


def test_how_far_axes_pass_from_a_point():
    cameras = Cameras(torch.eye(4)[None], torch.ones(1, 4), 1, 1)  # looks along -z
    points = torch.tensor([[0.0, 0, -2], [3.0, 0, -4], [0.0, 1, 0], [0.0, 1, 5], [0.0, 0, 0]])
    result = torch.cat([axis_misses(cameras, point) for point in points])
    torch.testing.assert_close(result, torch.tensor((0.0, 0.6, 1.0, 1.0, 1.0)))


def test_no_focus_of_parallel_or_outward_axes():
    parallel = torch.eye(4).repeat(3, 1, 1)
    parallel[:, 0, 3] = torch.arange(3.0)
    assert focus_point(Cameras(parallel, torch.ones(3, 4), 1, 1)) is None
    inward = orbit_cameras(6, radius=1, elevation=10, width=1, height=1, focal=1)
    outward = inward.poses.clone()
    outward[:, :3, 0] *= -1
    outward[:, :3, 2] *= -1
    assert focus_point(Cameras(outward, torch.ones(6, 4), 1, 1)) is None
