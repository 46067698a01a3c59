"""Tests of photograph folders: the readers of COLMAP, LLFF and nerfstudio, their shared code, and their errors."""

import itertools
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import refuses, trained
from PIL import Image
from scene_files import (
    COUNT,
    POINTS,
    POSES,
    SIZE,
    check_pairs,
    every,
    needs,
    oriented,
    rewrite,
    write_both,
    write_capture,
    write_colmap,
    write_frames,
    write_images,
    write_llff,
)

from voronerf.app import open_run
from voronerf.app.evaluate.panels import write_panels
from voronerf.app.scenes import SceneError, builtin_scene, images, load_scene, photographs
from voronerf.app.scenes.colmap import read_model
from voronerf.app.scenes.photographs import find_frame
from voronerf.app.scenes.regions import region_of
from voronerf.app.scenes.scene import KnownDepths
from voronerf.app.train import Callback, ConfigError, TrainConfig, train
from voronerf.app.train.build import ROBUST, build, make_batches, make_renderer, make_routers
from voronerf.app.train.defaults import BESIDE, COVERED, resolve
from voronerf.nerf.cameras import Cameras, focus_point, look_at, orbit_cameras


@pytest.mark.parametrize(("format", "binary"), [("colmap", True), ("colmap", False), ("llff", True)])
def test_a_folder_is_read_as_it_was_written(tmp_path, format, binary):
    write_both(tmp_path, binary=binary)
    scene = load_scene(tmp_path, format=format, normalise=False)
    names, poses = every(scene)
    assert names == [f"{index:02d}" for index in range(COUNT)] and scene.test.names == ("00", "08")
    torch.testing.assert_close(poses, POSES, atol=1e-5, rtol=0)
    for split in (scene.train, scene.test):
        assert [int(image[0, 0, 0]) for image in split.images] == [int(name) for name in split.names]
    lens = scene.train.cameras.intrinsics[0].tolist()
    assert lens == pytest.approx([20, 20, 6, 5])
    bent = scene.train.cameras.distortion
    assert (bent is None) == (format == "llff") and (bent is None or float(bent[0, 0]) == pytest.approx(0.02))
    depths = -(torch.from_numpy(POINTS)[None] - POSES[:, None, :3, 3].double()) @ POSES[:, :3, 2:3].double()
    near, far = (2.5, 5.5) if format == "llff" else (float(depths.min()), float(depths.max()))
    assert scene.near == pytest.approx(0.75 * near, rel=0.05)
    assert scene.far == pytest.approx(max(1.5 * far, 4 * scene.contraction.radius), rel=0.05)
    assert any(f"--format {'colmap' if format == 'llff' else 'llff'} would read" in note for note in scene.notes)


def test_the_scene_is_normalised_by_a_similarity_that_it_keeps(tmp_path):
    write_both(tmp_path)
    scene, plain = load_scene(tmp_path), load_scene(tmp_path, normalise=False)
    assert scene.kind == "unbounded" and scene.spacing == "disparity" and scene.box is None
    _, poses = every(scene)
    assert float(poses[:, :3, 3].norm(dim=-1).max()) == pytest.approx(1, abs=1e-5)
    assert float(poses[:, :3, 3].mean(0)[:2].norm()) < 1e-5 and float(poses[0, 2, 3]) > 0  # around z, above 0
    homogeneous = torch.cat((POSES[:, :3, 3], torch.ones(COUNT, 1)), dim=1).double()
    torch.testing.assert_close((homogeneous @ scene.transform.T)[:, :3].float(), poses[:, :3, 3])
    scale = float(torch.linalg.det(scene.transform[:3, :3])) ** (1 / 3)
    assert scene.near == pytest.approx(scale * plain.near) and scene.far == pytest.approx(max(scale * plain.far, 4))
    torch.testing.assert_close(plain.contraction.centre, torch.tensor([1.0, 2, 3]), atol=1e-3, rtol=0)
    assert plain.contraction.radius == pytest.approx(1 / scale) and scene.contraction.radius == 1


def test_points_of_a_model_are_learnt_from_where_images_show_them(tmp_path):
    """A quarter of the drawn rays end at points of the sparse model, for reduced images of two sizes."""
    write_both(tmp_path, [(48, 40) if index % 2 else (32, 56) for index in range(COUNT)])
    scene = load_scene(tmp_path, downscale=4)
    points = torch.from_numpy(POINTS) @ scene.transform[:3, :3].T + scene.transform[:3, 3]
    config = resolve(TrainConfig(), scene)
    space = make_renderer(config, scene, make_routers(config, "cpu")).sampler.space
    assert (config.sparse_depth, space.full_gradient) == (0.0015, 1.0)
    assert config.occupancy and config.samples == (384,)
    assert resolve(TrainConfig(budget=15), scene).samples == (128,)
    states = [build(config, state) for state in (scene, replace(scene, background="white"))]
    assert [state.ray_loss.robust for state in states] == [ROBUST, 0.0]  # robust for photographs only
    batch = make_batches(config, scene).draw(400, torch.Generator().manual_seed(0))
    assert len(batch.rays) == 400 and len(batch.sparse_depths) == 100
    assert batch.background.shape == (400, 3) and batch.background.unique().numel() > 1000  # a random colour per ray
    rays = batch.rays[:100]
    depths = batch.sparse_depths
    apart = torch.cdist(rays.origins + depths[:, None] * rays.directions, points.float()).amin(1)
    assert bool((apart <= 0.75 * depths / scene.train.cameras.intrinsics[:, :2].min()).all())  # within a pixel
    seen = sum(
        int(((places >= 0) & (places < torch.tensor(cameras.size(index)))).all(-1).sum())
        for cameras in [scene.train.cameras]
        for index in range(len(cameras))
        for places, _ in [cameras.project(points.float(), index)]
    )
    assert len(scene.train.sparse_depth.pixels) == seen > 100
    without = replace(scene, train=replace(scene.train, sparse_depth=None))
    assert resolve(TrainConfig(), without).sparse_depth == 0
    with pytest.raises(ConfigError, match="--sparse-depth needs a COLMAP model with points"):
        resolve(TrainConfig(sparse_depth=0.1), without)


def test_space_before_the_rays_of_cameras_stays_empty(tmp_path):
    """Only the space between a camera and its near distance stays empty, not the space behind or beyond."""
    write_both(tmp_path)
    scene = load_scene(tmp_path)
    state = build(TrainConfig(steps=20, rays=32, samples=(16,), cells=(), field_options=("log2_entries=10",)), scene)
    grid, cameras = state.sampler.grid, scene.train.cameras

    def occupied(part):
        points = cameras.origins + part * scene.near * cameras.forward
        return grid.occupied.view(-1)[grid.voxels(grid.contraction.points(points)).long()]

    for _ in range(2):
        assert not any(occupied(part).any() for part in (0.1, 0.5, 0.9)) and occupied(1.1).all()
        assert occupied(-0.5).all() and 0.002 < float((~grid.occupied).float().mean()) < 0.2
        train(state)
    assert not build(state.config, replace(scene, near=0.01)).sampler.empty.any()  # near is less than a voxel


def test_rays_from_elsewhere_end_the_sooner_the_more_points_there_are(tmp_path):
    """Batches have rays from unseen views in the first part of the training, which is shorter if there are more points.

    No such rays are drawn if the points of the sparse model cover enough of the images, if there are no points, or in
    other kinds of scenes.
    """
    write_both(tmp_path)
    scene = load_scene(tmp_path)  # each pixel is a tile
    pixels = torch.arange(len(scene.train) * 120)

    def known(share):
        points = pixels[: int(share * len(pixels))].repeat(2)
        return replace(scene, train=replace(scene.train, sparse_depth=KnownDepths(points, torch.ones(len(points)))))

    few, many = known(0.51 * COVERED), known(1.01 * COVERED)
    config, shares = TrainConfig(steps=64, rays=32, samples=(16,), cells=(), field_options=("log2_entries=10",)), []

    class Note(Callback):
        def after_step(self, state):
            shares.append((state.step <= 32, state.batches.unseen))

    train(build(config, few), [Note()])
    assert set(shares) == {(True, BESIDE), (False, 0.0)}
    states = [build(replace(config, steps=40), few) for _ in range(2)]  # unseen rays stop within a group of steps
    for state, callbacks in zip(states, ([Note()], [])):
        train(state, callbacks)
    assert torch.equal(*(state.router.module.features for state in states))
    without = replace(few, train=replace(few.train, sparse_depth=None))
    for other in (many, without, replace(few, background="white"), replace(few, kind="inside-out")):
        assert build(config, other).batches.unseen == 0


@pytest.mark.parametrize(("kind", "turn"), [("forward", 0.0), ("inside-out", 180.0), ("unbounded", 0.0)])
def test_the_kind_is_told_by_the_cameras_and_can_be_set(tmp_path, kind, turn):
    poses = POSES.clone()
    if kind == "forward":
        poses[:, :3, :3] = torch.eye(3)
        poses[:, :3, 3] *= 0.1
    elif kind == "inside-out":
        poses[:, :3, [0, 2]] *= -1
    write_images(tmp_path, [SIZE] * COUNT)
    write_llff(tmp_path, poses, SIZE, 20.0, (2.0, 6.0))
    scene = load_scene(tmp_path)
    assert scene.kind == kind and any("--kind" in note for note in scene.notes)
    if kind == "forward":  # looks along y, with the nearest depth at 1
        torch.testing.assert_close(scene.train.cameras.forward, torch.tensor([[0.0, 1, 0]]).expand(7, 3))
        assert scene.near == pytest.approx(0.75)
    assert load_scene(tmp_path, kind="inside-out").kind == "inside-out"
    refuses("--kind object needs images with transparent pixels", load_scene, tmp_path, kind="object", error=SceneError)


def looking(origins, targets):
    poses = look_at(origins, targets, torch.tensor((0.0, 0.0, 1.0)))
    return Cameras(poses, torch.ones(len(poses), 4), 1, 1)


def on_a_sphere(count, turn, climb, generator):
    """Returns unit vectors [count, 3] whose azimuth and elevation are drawn from 0 to `turn` and `climb` radians."""
    azimuth, height = turn * torch.rand(count, generator=generator), climb * torch.rand(count, generator=generator)
    return torch.stack((azimuth.cos() * height.cos(), azimuth.sin() * height.cos(), height.sin()), dim=1)


def test_people_who_walk_and_look_around_are_inside_out():
    """A walk is "inside-out" even if the point closest to all optical axes happens to lie in front of most cameras."""
    generator = torch.Generator().manual_seed(0)
    ahead = 0
    for _ in range(200):
        origins = torch.tensor((2.0, 2.0, 0.3)) * torch.randn(40, 3, generator=generator)
        cameras = looking(origins, origins + on_a_sphere(40, 2 * math.pi, 0.4, generator))
        ahead += focus_point(cameras) is not None
        assert photographs.kind_of(cameras) == "inside-out"
    assert 60 < ahead < 140


def test_cameras_around_something_are_unbounded():
    angles = (2.0, math.pi, 2 * math.pi), (0.2, 1.5)  # an arc or a dome; the aim may be noisy or off-centre
    for turn, climb, middle, noise in itertools.product(*angles, (0.0, 0.6), (0.0, 0.1, 0.2)):
        generator = torch.Generator().manual_seed(0)
        origins = on_a_sphere(60, turn, climb, generator)
        targets = torch.tensor((-middle, 0.0, 0.0)) + noise * torch.randn(60, 3, generator=generator)
        assert photographs.kind_of(looking(origins, targets)) == "unbounded", (turn, climb, middle, noise)


def outward(extent):
    """Returns poses that look outwards from a circle of radius `extent`, float64 [24, 4, 4]."""
    poses = orbit_cameras(24, radius=extent, elevation=0, width=1, height=1, focal=1).poses.double()
    poses[:, :3, [0, 2]] *= -1
    return poses


@pytest.mark.parametrize(("extent", "length"), [(30.0, 20.0), (1.5, 1.5), (1e-6, 0.5)])
def test_the_sphere_of_a_walk_goes_through_its_farthest_camera(extent, length):
    """The unit sphere reaches the farthest camera, but its radius is clamped to the range of the points' depths."""
    bounds = torch.tensor((0.5, 20.0), dtype=torch.float64).repeat(24, 1)
    frame = find_frame(outward(extent), "inside-out", bounds)
    assert 1 / frame.scale == pytest.approx(length)
    assert frame.near / frame.scale == pytest.approx(0.75 * 0.5) and frame.far / frame.scale > 29.99


@pytest.mark.parametrize("kind", ["inside-out", "unbounded"])
def test_near_is_before_what_some_views_see_but_not_before_noise(kind):
    poses = outward(1.0)
    if kind == "unbounded":
        poses[:, :3, [0, 2]] *= -1
    far = torch.full((24,), 1000.0, dtype=torch.float64)

    def near(close):
        close = torch.tensor(close, dtype=torch.float64)
        frame = find_frame(poses, kind, torch.stack((close, far), dim=1))
        return frame.near / frame.scale

    assert near([0.005] * 4 + [0.9] * 20) == pytest.approx(0.75 * 0.005)
    assert near([1e-7] * 2 + [0.9] * 22) == pytest.approx(photographs.LEAST_NEAR)
    assert near([0.5] * 24) == pytest.approx(0.75 * 0.5)


def test_silhouettes_that_do_not_fit_together_are_said(tmp_path):
    views = builtin_scene(40, train_views=24, test_views=1).train
    columns = torch.arange(40).expand(40, 40)
    apart = [(columns - middle) ** 2 + (columns.T - 20) ** 2 < 25 for middle in (11, 29)]
    for wrong in (False, True):
        fx, fy, cx, cy = views.cameras.intrinsics[0].tolist()
        write_capture(folder := tmp_path / str(wrong), views.cameras, fl_x=fx, fl_y=fy, cx=cx, cy=cy, w=40, h=40)
        for number, image in enumerate(views.images.clone()):
            if wrong:
                image[..., 3] = 255 * apart[number % 2]
            Image.fromarray(image.numpy()).save(folder / f"{number:02d}.png")
        scene = load_scene(folder)
        assert scene.kind == "object" and (scene.box is None) == wrong
        assert (scene.background, scene.spacing) == ("white", "linear")
        assert wrong or float(scene.box.abs().max()) < 1
        assert any("the silhouettes of the object give no box" in note for note in scene.notes) == wrong


def test_images_of_different_sizes_train_and_are_scored_as_they_are(tmp_path):
    sizes = [SIZE if index % 2 else (8, 14) for index in range(COUNT)]
    write_both(tmp_path, sizes)
    scene = load_scene(tmp_path)
    cameras = scene.train.cameras
    assert scene.train.images.shape == (7, 14, 12, 3) and (cameras.width, cameras.height) == (12, 14)
    for index, name in enumerate(scene.train.names):
        width, height = sizes[int(name)]
        assert cameras.size(index) == (width, height) and len(cameras.image_rays(index)) == width * height
        assert scene.train.truth(index, None).shape == (height, width, 3)
    batches = make_batches(TrainConfig(), scene)
    assert len(batches) == sum(w * h for number, (w, h) in enumerate(sizes) if number % 8)
    batch = batches.draw(500, torch.Generator().manual_seed(0))
    numbers = (batch.target * 255).round()
    assert (numbers[:, :1] == numbers).all() and set(numbers[:, 0].tolist()) == {1, 2, 3, 4, 5, 6, 7}
    for number in (1, 2):
        origin = cameras.origins[scene.train.names.index(f"{number:02d}")]
        torch.testing.assert_close(batch.rays.origins[numbers[:, 0] == number][0], origin)
    assert load_scene(tmp_path, downscale=2).train.cameras.size(1) == (4, 7)


@pytest.mark.parametrize(
    ("lens", "size", "w", "h"),
    [
        ({"cx": 230.0, "cy": 185.5}, (160, 120), 480, 360),
        ({"k1": 0.05, "p1": 0.003}, (61, 45), 487.0, 365.0),  # 1/8 of the lens's size is rounded
        ({"is_fisheye": True, "k1": 0.01, "fisheye_crop_radius": 170}, (60, 45), 480, 360),
        ({"fl_y": 210.0}, (520, 390), 260, 195),  # larger than the lens's size
    ],
)
def test_pictures_smaller_than_their_lens_says(tmp_path, lens, size, w, h):
    """If images differ in size from the size stated with their lens, points project to proportionally scaled pixels."""
    rig = orbit_cameras(9, radius=2, elevation=5, width=size[0], height=size[1], focal=10)
    for folder, stated in (("small", {"w": w, "h": h}), ("full", {})):
        write_capture(tmp_path / folder, rig, fl_x=0.9 * w, **lens, **stated)
    for picture in (tmp_path / "full").glob("*.png"):
        Image.new("RGB", (int(w), int(h))).save(picture)
    small, full = (load_scene(tmp_path / folder, downscale=1, normalise=False) for folder in ("small", "full"))
    assert f"{size[0]} x {size[1]} pixels, where transforms.json says" in " ".join(small.notes)
    assert small.train.images.shape[1:3] == size[::-1]
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    for index in range(7):
        (pixels, _), (expected, _) = (scene.train.cameras.project(points, index) for scene in (small, full))
        scale = torch.tensor((size[0] / int(w), size[1] / int(h)))
        torch.testing.assert_close(pixels, expected * scale, atol=1e-3, rtol=0)
    assert load_scene(tmp_path / "small").train.cameras.width == (260 if size[0] > 512 else size[0])


@pytest.mark.parametrize(("scale", "normalise"), [(None, True), (0.5, True), (2, False), (1e-3, True)])
def test_nerfstudio_files(tmp_path, scale, normalise):
    """applied_transform and applied_scale map the original coordinates to the file's; depth images are ignored."""
    applied = torch.tensor([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 2], [0, 0, 0, 1]])
    poses = applied @ POSES
    poses[:, :3, 3] *= scale or 1
    write_capture(tmp_path, Cameras(poses, torch.full((9, 4), 12.0), 12, 10))
    rewrite(tmp_path, lambda contents: contents.update(applied_transform=applied[:3].tolist(), applied_scale=scale))
    rewrite(tmp_path, lambda contents: [frame.update(depth_file_path="d.png") for frame in contents["frames"]])
    scene = load_scene(tmp_path, normalise=normalise)
    assert "its depth images are not used" in scene.notes
    original = torch.cat((POSES[1:8, :3, 3], torch.ones(7, 1)), dim=1).double()
    places = (original @ scene.transform.T)[:, :3].float()
    torch.testing.assert_close(places, scene.train.cameras.origins, atol=1e-5, rtol=1e-5)
    rewrite(tmp_path, lambda contents: contents.update(applied_transform=[[2, 0, 0, 0]] * 3))
    refuses("applied_transform is not a pose", load_scene, tmp_path, error=SceneError)


def test_a_picture_that_is_listed_twice_counts_once(tmp_path):
    write_capture(tmp_path, orbit_cameras(9, radius=2, elevation=5, width=12, height=10, focal=12))
    (tmp_path / "99.png").symlink_to("03.png")

    def change(contents):
        for name in ("./07.png", "99.png", "99.png"):
            contents["frames"].append({**contents["frames"][0], "file_path": name})

    rewrite(tmp_path, change)
    scene = load_scene(tmp_path)
    assert sorted(scene.train.names + scene.test.names) == [f"{index:02d}" for index in range(9)]
    assert "images are listed twice; only the first entry counts: 07.png, 99.png, 99.png" in scene.notes


#: The name of image {}, almost as long as a file's name may be.
LONG = f"{{}}{240 * 'n'}.png"


def write_listed(folder, name, file):
    """Writes a capture; ``name`` and ``file`` map an image's number, its grey value, to its name and to its file."""
    for index in range(COUNT):
        (folder / file(index)).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", SIZE, 3 * (index,)).save(folder / file(index))
    write_frames(folder, POSES, name)


def check_listed(folder, count=COUNT):
    """Checks that each of ``count`` images has the pose of its frame."""
    return check_pairs(load_scene(folder, normalise=False), count)


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("E:\\tmp\\scan\\images\\{:02d}.jpg", "images/{:02d}.png"),
        ("/home/me/scan/images/{:02d}.JPG", "images/{:02d}.jpg"),
        ("./scan/images/{:02d}.jpg", "images/{:02d}.jpg"),
        ("./..\\data\\scan\\rgb/{:02d}.png", "rgb/{:02d}.jpg"),
        ("../images/{:02d}.png", "images/{:02d}.png"),
        ("Images/{:02d}.JPG", "images/{:02d}.jfif"),
        ("images/{:02d}", "Images/{:02d}.jfif"),
        ("images/mu\u0308_{:02d}%20.jpg", "images/M\u00dc_{:02d}%20.png"),
        ("/home/me/{:02d}.jpg", "some pictures/{:02d}.jpg"),
        pytest.param(LONG, LONG, id="long"),
    ],
)
def test_images_of_transforms_are_found_where_they_are(tmp_path, name, file):
    """Names of another machine, suffix, case or spelling are found; copies, masks and depths beside them are not."""
    write_listed(tmp_path, name.format, file.format)
    for index in range(9):
        other = Path(file.format(index)).with_suffix(".png").name
        for folder in ("masks", "depth", "images_2", "old/images"):
            (tmp_path / folder).mkdir(parents=True, exist_ok=True)
            if folder != "old/images" or "mages" in file:
                Image.new("RGB", SIZE, (99, 99, 99)).save(tmp_path / folder / other)
    check_listed(tmp_path)
    (tmp_path / file.format(3)).unlink()
    contents = rewrite(tmp_path, lambda contents: contents["frames"].append({**contents["frames"][0]}))
    lists = {"test_filenames": [contents["frames"][index]["file_path"] for index in (1, 3, 5)]}
    rewrite(tmp_path, lambda contents: contents.update(lists))
    for folder in ("masks", "depth", "images_2", "old"):
        shutil.rmtree(tmp_path / folder)
    assert [int(image[0, 0, 0]) for image in check_listed(tmp_path, 8).test.images] == [1, 5]


@pytest.mark.parametrize("start", ["/home/me/scan/", "E:\\scan\\"])
def test_images_of_two_cameras_on_another_machine(tmp_path, start):
    """Images with equal base names are told apart by their folders; none is taken from the other camera's folder."""
    names = [f"{'left' if index % 2 else 'right'}/{index // 2:02d}.png" for index in range(9)]
    there = [start + name.replace("/", "\\" if "E" in start else "/") for name in names]
    write_listed(tmp_path, there.__getitem__, names.__getitem__)
    check_listed(tmp_path)
    (tmp_path / "left/01.png").unlink()
    check_listed(tmp_path, 8)
    rewrite(tmp_path, lambda contents: contents.update(frames=contents["frames"][1::2]))  # those of the left camera
    check_listed(tmp_path, 3)


def test_images_that_may_be_several_are_refused(tmp_path):
    write_listed(tmp_path, "/home/me/{:02d}.jpg".format, "a/{:02d}.jpg".format)
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    refuses("00.jpg may be a/00.jpg or b/00.jpg in", load_scene, tmp_path, error=SceneError)
    (tmp_path / "b").rename(tmp_path / "images_4")
    assert "no image exists as it is named: /home/me/00.jpg is a/00.jpg, and so on" in check_listed(tmp_path).notes
    shutil.rmtree(tmp_path / "a")
    (tmp_path / "images_4").rename(tmp_path / "masks")
    refuses("none of its 9 images exists, the first is /home/me/00.jpg", load_scene, tmp_path, error=SceneError)


def test_a_path_of_this_machine_that_leads_outside_is_read_only_inside(tmp_path):
    scene, elsewhere = tmp_path / "scene", tmp_path / "elsewhere/images"
    write_listed(scene, lambda index: f"{elsewhere}/{index:02d}.png", "images/{:02d}.png".format)
    shutil.copytree(scene / "images", elsewhere)
    check_listed(scene)  # the copies in the scene's folder
    shutil.rmtree(scene / "images")
    refuses("file_path: must lie in the folder of the scene", load_scene, scene, error=SceneError)
    assert len(load_scene(scene, allow_outside=True).train) == 7


def test_pictures_of_runs_and_depths_are_not_photographs(tmp_path):
    """Panels of a run in the scene's folder, normals and depths have the photographs' names, but are no photographs."""
    folder = tmp_path / "scan"
    write_listed(folder, "/home/me/scan/images/{:02d}.jpg".format, "rgb/{:02d}.jpg".format)
    for other in ("runs/scan/images", "normals", "depth_maps", "images_2"):
        (folder / other).mkdir(parents=True)
        for index in range(9 if other != "runs/scan/images" else 2):
            Image.new("RGB", SIZE, (250, 0, 0)).save(folder / other / f"{index:02d}.png")
    (folder / "runs/scan/checkpoints").mkdir()
    check_listed(folder)
    (folder / "images").mkdir()
    Image.new("RGB", SIZE).save(folder / "images/thumbnail.png")
    check_listed(folder)
    shutil.rmtree(folder / "images")
    (folder / "rgb").rename(folder / "images")
    check_listed(folder)


def test_a_mask_beside_the_pictures_is_no_missing_picture(tmp_path, caplog):
    write_listed(tmp_path, "{:02d}.jpg".format, "{:02d}.jpg".format)
    (tmp_path / "03.jpg").rename(tmp_path / "03.jpg.png")
    check_listed(tmp_path, 8)
    assert "1 of 9 listed images are missing" in caplog.text


def test_missing_masks_are_not_replaced_by_depths(tmp_path):
    write_listed(tmp_path, "images/{}.png".format, "images/{}.png".format)
    rewrite(
        tmp_path,
        lambda entries: [f.update(mask_path=f["file_path"].replace("images", "mask")) for f in entries["frames"]],
    )
    shutil.copytree(tmp_path / "images", tmp_path / "depths")
    refuses("frame 0 (images/0.png): its mask", load_scene, tmp_path, error=SceneError)
    (tmp_path / "depths").rename(tmp_path / "my_masks")
    Image.new("L", SIZE, 255).save(tmp_path / "my_masks/0.png")
    assert load_scene(tmp_path).train.masks is not None


def test_masks_of_another_machine(tmp_path):
    write_listed(tmp_path, "C:\\scan\\images\\{}.jpg".format, "images/{}.jpg".format)
    (tmp_path / "masks").mkdir()
    for index in range(9):
        pixels = np.full((10, 12), 255, np.uint8)
        pixels[0, index] = 0
        Image.fromarray(pixels).save(tmp_path / f"masks/{index}.png")

    def change(contents, start):
        for index, frame in enumerate(contents["frames"]):
            frame["mask_path"] = f"{start}{index}.jpg"

    for start in ("C:\\scan\\masks\\", "/home/me/", "Masks/"):
        rewrite(tmp_path, lambda contents, start=start: change(contents, start))
        scene = check_listed(tmp_path)
        for index, name in enumerate(scene.train.names):
            assert torch.nonzero(~scene.train.mask(index)).tolist() == [[0, int(name)]]
    (tmp_path / "masks/3.png").unlink()
    refuses("frame 3 (C:\\scan\\images\\3.jpg): its mask", load_scene, tmp_path, error=SceneError)


@pytest.mark.parametrize("scale", [[2.0], [0.01, 0.01, 3.0]])
def test_scaled_poses_are_normalised(tmp_path, scale):
    """Axes of one length other than 1, as of a scaled camera in Blender, are normalised; positions stay."""
    write_capture(tmp_path / "plain", Cameras(POSES, torch.full((9, 4), 12.0), 12, 10))
    write_capture(tmp_path / "scaled", Cameras(POSES, torch.full((9, 4), 12.0), 12, 10))

    def change(contents, factors):
        for index, frame in enumerate(contents["frames"]):
            rows = torch.tensor(frame["transform_matrix"], dtype=torch.float64)
            rows[:3, :3] *= torch.tensor(factors[index % len(factors)], dtype=torch.float64)
            frame["transform_matrix"] = rows.tolist()

    rewrite(tmp_path / "scaled", lambda contents: change(contents, scale))
    plain, scaled = (load_scene(tmp_path / name, normalise=False) for name in ("plain", "scaled"))
    torch.testing.assert_close(plain.train.cameras.poses, scaled.train.cameras.poses, atol=1e-6, rtol=0)
    length = "2" if len(scale) == 1 else "0.01 to 3"
    assert f"the axes of 9 of 9 poses have length {length}, and are scaled to 1" in scaled.notes
    for factors in ([1.0, 1.0, 1.1], [-1.0, 1.0, 1.0], [-2.0, -2.0, -2.0]):
        write_capture(tmp_path / "bad", Cameras(POSES, torch.full((9, 4), 12.0), 12, 10))
        rewrite(tmp_path / "bad", lambda contents, factors=factors: change(contents, [factors]))
        refuses("is not a rotation", load_scene, tmp_path / "bad", error=SceneError)


@pytest.mark.parametrize(("times", "said"), [((0.0, 0.5, 1), True), ((0.5, 0.5, None), False), ((0, 0.0, "a"), False)])
def test_times_that_differ_are_said(tmp_path, times, said):
    write_capture(tmp_path, orbit_cameras(3, radius=2, elevation=5, width=12, height=10, focal=12))
    rewrite(tmp_path, lambda contents: [frame.update(time=time) for frame, time in zip(contents["frames"], times)])
    assert ("its times are not used: the scene is taken as still" in load_scene(tmp_path).notes) == said


PRISM = (21, 19, 5, 6, 0.02, 0.01, 0.03, -0.02, 0.01, 0.002, 0.04, 0.03)


@pytest.mark.parametrize(
    ("tag", "model", "lens", "scale"),
    [
        (6, "OPENCV", PRISM[:8], 1),
        (8, "OPENCV", PRISM[:8], 2),
        (6, "THIN_PRISM_FISHEYE", PRISM, 2),
        (8, "THIN_PRISM_FISHEYE", PRISM, 1),
        (8, "FOV", (21, 19, 5, 6, 0.3), 1),
    ],
)
def test_cameras_of_upright_pictures(tmp_path, tag, model, lens, scale):
    """Pictures stored turned, with an orientation tag, have the same rays as upright pictures without a tag.

    COLMAP's cameras are of the upright pictures, which may have been larger.
    """
    generator, turns = np.random.default_rng(1), {6: -1, 8: 1}[tag]
    lossless = {"exif": oriented(tag), "quality": 100, "subsampling": 0}
    large = (model, tuple(value * scale if place < 4 else value for place, value in enumerate(lens)))
    for folder in ("plain", "tagged"):
        write_colmap(tmp_path / folder, POSES, [(10 * scale, 13 * scale)] * COUNT, POINTS, lenses=[large] * COUNT)
        (tmp_path / folder / "images").mkdir()
    for index in range(COUNT):
        stored = generator.integers(0, 255, (10, 13, 3), np.uint8)
        Image.fromarray(stored).save(tmp_path / f"tagged/images/{index:02}.jpg", **lossless)
        stored = np.asarray(Image.open(tmp_path / f"tagged/images/{index:02}.jpg"))
        Image.fromarray(np.rot90(stored, turns)).save(tmp_path / f"plain/images/{index:02}.png")
    plain, tagged = (load_scene(tmp_path / folder, downscale=1) for folder in ("plain", "tagged"))
    names = ", ".join([f"{index:02}.jpg" for index in range(8)])
    line = f"cameras are those of pictures turned upright by their orientation tags: {names}, 1 more"
    assert line in tagged.notes
    assert plain.test.names == tagged.test.names and torch.equal(plain.train.images, tagged.train.images)
    torch.testing.assert_close(plain.transform, tagged.transform, atol=1e-6, rtol=1e-6)
    for one, other in ((plain.train, tagged.train), (plain.test, tagged.test)):
        for index in range(len(one)):
            rays = [split.cameras.image_rays(index) for split in (one, other)]
            torch.testing.assert_close(rays[0].directions, rays[1].directions, atol=2e-6, rtol=0)
            torch.testing.assert_close(rays[0].origins, rays[1].origins, atol=1e-6, rtol=0)
    assert torch.equal(plain.train.sparse_depth.pixels, tagged.train.sparse_depth.pixels)
    other = tmp_path / "tagged/images/04.jpg"  # upside down: its camera counts as upright because the others are
    upright = np.asarray(Image.open(tmp_path / "plain/images/04.png"))
    Image.fromarray(np.rot90(upright, 2)).save(other, **{**lossless, "exif": oriented(3)})
    mixed = load_scene(tmp_path / "tagged", downscale=1).train
    rays = [split.cameras.image_rays(3) for split in (plain.train, mixed)]
    torch.testing.assert_close(rays[0].directions, rays[1].directions, atol=2e-6, rtol=0)
    Image.fromarray(np.rot90(upright, -turns)).save(other, **lossless)
    tagged = load_scene(tmp_path / "tagged", downscale=3).train.cameras  # drops a column of the stored pictures
    full = plain.train.cameras
    assert (tagged.width, tagged.height) == (3, 4)
    x, y = torch.tensor([0.5, 2.5]), torch.tensor([0.5, 3.5])
    left, top = (1, 0) if tag == 6 else (0, 1)  # the side of the dropped row or column
    down = full.rays(0, 3 * x + left, 3 * y + top)
    torch.testing.assert_close(tagged.rays(0, x, y).directions, down.directions, atol=1e-5, rtol=0)


UPRIGHT = {"fl_x": 21.0, "fl_y": 19.0, "cx": 5.0, "cy": 6.0, "k1": 0.02, "p1": 0.01, "p2": 0.03, "w": 10, "h": 13}
CIRCLE = {"fl_x": 21.0, "w": 10, "h": 13, "is_fisheye": True, "k1": 0.02, "fisheye_crop_radius": 6}
ANGLE = {"camera_angle_x": 0.7, "w": 10}


@pytest.mark.parametrize(("lens", "scale"), [(UPRIGHT, 1), (UPRIGHT, 3), (CIRCLE, 3), (ANGLE, 1)])
def test_transforms_of_upright_pictures(tmp_path, lens, scale):
    lengths = ("fl_x", "fl_y", "cx", "cy", "w", "h", "fisheye_crop_radius")
    lens = {key: value * scale if key in lengths else value for key, value in lens.items()}
    for folder in ("plain", "tagged"):
        write_capture(tmp_path / folder, Cameras(POSES, torch.full((9, 4), 12.0), 10, 13), **{"fl_x": None, **lens})
    for index in range(9):
        Image.new("RGB", (13, 10), 3 * (index,)).save(tmp_path / f"tagged/{index:02}.jpg", exif=oriented(6))
        (tmp_path / f"tagged/{index:02}.png").unlink()
    plain, tagged = (load_scene(tmp_path / folder) for folder in ("plain", "tagged"))
    for index in range(len(plain.train)):
        rays = [split.cameras.image_rays(index).directions for split in (plain.train, tagged.train)]
        torch.testing.assert_close(*rays, atol=2e-6, rtol=0)
        masks = [split.mask(index) for split in (plain.train, tagged.train)]
        assert masks[0] is None or torch.equal(*masks)
    assert ("their lenses are scaled" in " ".join(tagged.notes)) == (scale > 1)


@pytest.mark.parametrize(("tag", "model"), [(3, "THIN_PRISM_FISHEYE"), (6, "THIN_PRISM_FISHEYE"), (8, "OPENCV")])
def test_an_orientation_tag_turns_pixels_and_cameras_alike(tmp_path, tag, model):
    """The Exif rotation moves pixels, which keep their rays, colours and depths; COLMAP has read unrotated images."""
    generator, turns = np.random.default_rng(1), {3: 2, 6: -1, 8: 1}[tag]
    lens = model, PRISM[:8] if model == "OPENCV" else PRISM
    for folder in ("plain", "tagged"):
        write_colmap(tmp_path / folder, POSES, [(13, 10)] * COUNT, POINTS, lenses=[lens] * COUNT)
        (tmp_path / folder / "images").mkdir()
    for index in range(COUNT):
        picture = Image.fromarray(generator.integers(0, 255, (10, 13, 3), np.uint8))
        picture.save(tmp_path / f"plain/images/{index:02}.jpg")
        # The second image has no tag, so sizes differ.
        picture.save(tmp_path / f"tagged/images/{index:02}.jpg", **({} if index == 1 else {"exif": oriented(tag)}))
    for downscale in (1, 2):
        options = {"downscale": downscale, "normalise": False}
        plain, tagged = (load_scene(tmp_path / folder, **options) for folder in ("plain", "tagged"))
        for one, other in ((plain.train, tagged.train), (plain.test, tagged.test)):
            for index, name in enumerate(one.names):
                turned = 0 if name == "01" else turns
                width, height = one.cameras.size(index)
                rays = [split.cameras.image_rays(index).directions for split in (one, other)]
                rays = [rays[0].reshape(height, width, 3), rays[1].reshape(*other.truth(index, None).shape)]
                torch.testing.assert_close(torch.rot90(rays[0], turned), rays[1], atol=2e-6, rtol=0)
                assert torch.equal(torch.rot90(one.truth(index, None), turned), other.truth(index, None))
        depths = [sorted(split.sparse_depth.distances.tolist()) for split in (plain.train, tagged.train)]
        assert depths[0] == pytest.approx(depths[1], abs=1e-5)


@pytest.mark.parametrize("format", ["colmap", "llff", "transforms"])
def test_up_is_that_of_the_pictures_which_people_see(tmp_path, format):
    """Up is found in the images as the orientation tag rotates them; COLMAP sees the stored images, on their side."""
    on_side = POSES.clone()
    on_side[:, :3, 0], on_side[:, :3, 1] = -POSES[:, :3, 1], POSES[:, :3, 0]
    for folder, poses, save in (("upright", POSES, {}), ("tagged", on_side, {"exif": oriented(6)})):
        write_images(tmp_path / folder, [SIZE] * COUNT, **save)
        write_frames(tmp_path / folder, poses, w=12, h=10)
        write_colmap(tmp_path / folder, poses, [SIZE] * COUNT, POINTS)
        write_llff(tmp_path / folder, poses, SIZE, 20.0, (2.5, 5.5))
    upright, tagged = (load_scene(tmp_path / folder, format=format) for folder in ("upright", "tagged"))
    torch.testing.assert_close(upright.transform, tagged.transform, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(upright.train.cameras.poses, tagged.train.cameras.poses, atol=1e-5, rtol=0)
    assert upright.train.images.shape == (7, 10, 12, 3) and tagged.train.images.shape == (7, 12, 10, 3)


def test_which_folder_of_images_and_by_how_much_they_are_reduced(tmp_path, monkeypatch):
    write_images(tmp_path, [SIZE] * COUNT)
    write_llff(tmp_path, POSES, (48, 40), 80.0, (2.5, 5.5))
    (tmp_path / "images").rename(tmp_path / "images_4")
    for downscale, width in ((1, 12), (4, 12), (8, 6)):
        cameras = load_scene(tmp_path, downscale=downscale).train.cameras
        assert cameras.width == width and float(cameras.intrinsics[0, 0]) == pytest.approx(20 * width / 12)
    monkeypatch.setattr(photographs, "LONGEST_SIDE", 5)  # images have 12 pixels a side, images_4 implies 48
    scene = load_scene(tmp_path)
    assert scene.train.cameras.width == 4 and any("images are reduced by 3, to 4 x 3" in note for note in scene.notes)
    refuses("--downscale must be 1 or a multiple of 4, got 6", load_scene, tmp_path, downscale=6, error=SceneError)
    (tmp_path / "images_4/00.jpg").unlink()
    refuses("has poses of 9 images", load_scene, tmp_path, error=SceneError)


@pytest.mark.parametrize("format", ["colmap", "llff"])
@pytest.mark.parametrize(
    ("lens", "size", "downscale", "read"),
    [
        ((3966, 2974), (504, 378), None, (504, 378)),
        ((3966, 2974), (504, 378), 2, (252, 189)),
        ((400, 300), (1600, 1200), None, (400, 300)),
        ((400, 267), (1600, 1066), None, (400, 266)),  # e.g. from an original of 1602 x 1067
        ((4031, 3023), (1008, 756), None, (504, 378)),
    ],
)
def test_pictures_are_reduced_by_their_own_size(tmp_path, monkeypatch, format, lens, size, downscale, read):
    """The downscale factor follows the image files, not the model's camera size; each header is read once."""
    write_images(tmp_path, [size] * COUNT)
    focal = 1.5 * lens[0]
    pinhole = ("SIMPLE_PINHOLE", (focal, lens[0] / 2, lens[1] / 2))
    write_colmap(tmp_path, POSES, [lens] * COUNT, POINTS, lenses=[pinhole] * COUNT)
    write_llff(tmp_path, POSES, lens, focal, (2.5, 5.5))
    monkeypatch.setattr(images, "read_header", None)  # fails if a header is read again
    cameras = load_scene(tmp_path, format=format, downscale=downscale).train.cameras
    assert (cameras.width, cameras.height) == read
    factor = size[0] // read[0]
    across, down = (of / to / factor for of, to in zip(size, lens))
    expected = [focal * across, focal * down, lens[0] / 2 * across, lens[1] / 2 * down]
    assert cameras.intrinsics[0].tolist() == pytest.approx(expected, abs=1e-3)


def test_a_forward_facing_scene_fills_the_cube_of_its_contraction(tmp_path):
    poses = POSES.clone()
    poses[:, :3, :3] = torch.eye(3)
    poses[:, :3, 3] *= 0.1
    write_images(tmp_path, [SIZE] * COUNT)
    write_llff(tmp_path, poses, SIZE, 20.0, (2.0, 6.0))
    for normalise in (True, False):
        scene = load_scene(tmp_path, normalise=normalise)
        assert resolve(TrainConfig(), scene).contraction == "ndc"
        space = scene.space("ndc").contraction
        places = []
        for index in range(7):
            rays = scene.train.cameras.image_rays(index)
            ends = torch.linspace(scene.near * 1.2, scene.far, 5)[:, None, None]
            places.append(space.points(rays.origins + ends * rays.directions).reshape(-1, 3))
        low, high = torch.cat(places).aminmax(dim=0)
        assert (low > -1.001).all() and (high < 1.001).all() and (high - low > 1.4).all()
    again = load_scene(tmp_path, downscale=5)  # drops border pixels
    assert space.slopes == again.contraction.slopes
    unbounded = load_scene(tmp_path, kind="unbounded")
    refuses("contraction ndc needs forward-facing cameras", unbounded.space, "ndc", error=SceneError)


def test_a_folder_trains_is_scored_and_opened_again(tmp_path):
    rig = orbit_cameras(9, radius=2, elevation=5, width=12, height=14, focal=12)
    write_capture(tmp_path / "scene", rig)
    mask = np.full((14, 12), 255, np.uint8)
    mask[:7] = 0

    def change(contents):
        for frame in contents["frames"][::2]:
            Image.new("RGB", (16, 12), (40, 50, 60)).save(tmp_path / "scene" / frame["file_path"])
        Image.fromarray(mask).save(tmp_path / "scene/mask.png")
        contents["frames"][1]["mask_path"] = "mask.png"

    rewrite(tmp_path / "scene", change)
    short = {"steps": 6, "cells": (2,), "split_at": (0.5,), "width": 8, "rays": 32, "samples": (8,), "evaluations": 1}
    config = TrainConfig(str(tmp_path / "scene"), out=tmp_path / "run", kind="inside-out", normalise=False, **short)
    scene = load_scene(config.data, **config.reading)
    summary = trained(config, scene)
    run = open_run(config.out, data=config.data)
    (path, *_) = write_panels(run.renderer, run.diagram, scene, tmp_path, views=2)
    assert path.is_file()
    assert run.scene.kind == "inside-out" and run.scene.near == scene.near
    assert run.evaluate()["psnr"] == pytest.approx(summary["psnr"])
    assert run.render(0).colour.shape == scene.test.truth(0, None).shape


#: Parts of the header of an array, and what breaks it.
HEADERS = (b"}", b" "), (b"(9, 17)", b"(-9,17)"), (b"(9, 17), ", b"(True,17)")


@pytest.mark.parametrize(
    ("rows", "reason"),
    [
        (np.zeros((9, 16)), "must have 17 numbers for each image, got shape [9, 16]"),
        (np.full((9, 17), np.nan), "has values that are not finite"),
        (np.ones((9, 17)), "row 0 is not a pose"),
        (np.zeros((9, 17), dtype=object), "is not a readable NumPy array"),
        *[(part, "is not a readable NumPy array") for part in HEADERS],
    ],
)
def test_broken_llff_is_one_line(tmp_path, rows, reason):
    write_both(tmp_path)
    path = tmp_path / "poses_bounds.npy"
    if isinstance(rows, tuple):  # a part of the header, and another one
        assert rows[0] in path.read_bytes()
        path.write_bytes(path.read_bytes().replace(*rows, 1))
    else:
        np.save(path, rows, allow_pickle=True)
    refuses(reason, load_scene, tmp_path, format="llff", error=SceneError)


def test_formats_and_kinds_are_named(tmp_path):
    write_both(tmp_path)
    refuses("must be one that the folder has, colmap or llff, got blender", load_scene, tmp_path, format="blender")
    refuses("format must be auto, blender or", load_scene, tmp_path, format="nerf")
    refuses("kind must be auto, object or", load_scene, tmp_path, kind="outdoor")
    refuses("builtin: format must be auto and kind auto or object", load_scene, "builtin", kind="forward")


@pytest.mark.data
def test_colmap_and_llff_agree_on_beer():
    colmap, llff = (every(load_scene(needs("beer"), downscale=16, format=format)) for format in ("colmap", "llff"))
    assert colmap[0] == llff[0] and len(colmap[0]) == 71
    torch.testing.assert_close(colmap[1], llff[1], atol=1e-5, rtol=0)


@pytest.mark.data
def test_fern_faces_forward():
    scene = load_scene(needs("fern"), downscale=24)
    assert scene.kind == "forward" and scene.train.images.shape == (17, 126, 168, 3)
    assert scene.near == pytest.approx(0.75) and 5 < scene.far < 10


def test_points_that_two_images_see_are_left_out(tmp_path):
    write_colmap(tmp_path, POSES, [SIZE] * COUNT, POINTS, binary=False)
    path = tmp_path / "sparse/0/points3D.txt"
    lines = path.read_text().splitlines()
    for number, seen in ((0, 2), (1, 3)):
        lines[number] = " ".join(lines[number].split()[: 8 + 2 * seen])
    path.write_text("\n".join(lines) + "\n")
    assert read_model(tmp_path / "sparse/0").numbers.tolist() == list(range(1, len(POINTS)))


def test_a_small_view_within_a_region_is_kept():
    scene = builtin_scene(16, train_views=2, test_views=2)
    cameras = replace(scene.test.cameras, sizes=torch.tensor([[6, 6], [16, 16]]))
    box = torch.tensor([[-2.0] * 3, [2.0] * 3])
    assert len(region_of(replace(scene, test=replace(scene.test, cameras=cameras)), box).test) == 2
