"""Tests of loading valid scenes: cameras match images, normalisation, splits."""

import functools
import json
import logging
import math
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers import refuses
from PIL import Image
from scene_files import needs, rewrite, write_blender, write_capture

from voronerf.app.scenes import SceneError, builtin_scene, load_scene
from voronerf.app.scenes.photographs import find_frame
from voronerf.nerf import Space, Stratified, render_rays
from voronerf.nerf.cameras import Cameras, focus_point, orbit_cameras


def test_blender_round_trip(tmp_path):
    original = builtin_scene(24, train_views=6, test_views=2)
    write_blender(tmp_path / "toys", original, 0.6911112)
    scene = load_scene(tmp_path / "toys")
    assert (scene.name, scene.near, scene.far, scene.spacing, scene.background) == ("toys", 2, 6, "linear", "white")
    assert scene.train.names == tuple(f"r_{index}" for index in range(6))
    assert torch.equal(scene.train.images, original.train.images)
    assert torch.equal(scene.test.images, original.test.images)
    torch.testing.assert_close(scene.train.cameras.poses, original.train.cameras.poses)
    torch.testing.assert_close(scene.train.cameras.intrinsics, original.train.cameras.intrinsics)
    half = load_scene(tmp_path / "toys", downscale=2)
    assert (half.train.cameras.width, half.train.images.shape[1:]) == (12, (12, 12, 4))
    torch.testing.assert_close(half.train.cameras.intrinsics, original.train.cameras.intrinsics / 2)
    white = torch.ones(3)
    averaged = original.train.truth(0, white).reshape(12, 2, 12, 2, 3).mean(dim=(1, 3))
    torch.testing.assert_close(half.train.truth(0, white), averaged, atol=1.01 / 255, rtol=0)


def test_names_of_blender_are_all_different(tmp_path):
    write_blender(tmp_path, builtin_scene(8, train_views=4, test_views=1), 0.69)

    def move(contents):
        for index, frame in enumerate(contents["frames"]):
            (folder := tmp_path / f"cam{index % 2}").mkdir(exist_ok=True)
            (tmp_path / f"{frame['file_path']}.png").rename(folder / f"{index // 2}.png")
            frame["file_path"] = f".\\cam{index % 2}\\{index // 2}"

    rewrite(tmp_path, move, "transforms_train")
    assert load_scene(tmp_path).train.names == ("cam0_0", "cam1_0", "cam0_1", "cam1_1")


def test_blender_without_alpha_has_no_box(tmp_path):
    original = builtin_scene(12, train_views=5, test_views=1)
    write_blender(tmp_path, original, 0.69)
    for path in tmp_path.glob("*/*.png"):
        Image.open(path).convert("RGB").save(path)
    scene = load_scene(tmp_path)
    assert scene.box is None and scene.train.images.shape[-1] == 3
    assert torch.equal(scene.train.truth(0, torch.ones(3)), scene.train.images[0] / 255)


def test_a_capture_that_others_split(tmp_path):
    """Scenes split by torch-ngp's scripts can be loaded: Blender's format with a principal point and distortion."""
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    rig = orbit_cameras(9, radius=2, elevation=5, width=12, height=10, focal=4)
    lens = {"camera_angle_x": 0.9, "fl_x": 20.0, "fl_y": 21.0, "cx": 5.0, "cy": 5.5, "k1": 0.02, "w": 12.6, "h": 10}
    for folder in (whole, parts):
        write_capture(folder, rig, **lens)
    contents = rewrite(parts, lambda contents: contents["frames"].reverse())
    (parts / "transforms.json").unlink()
    test_indices = [0, 8]
    for name, chosen in (("train", [i for i in range(9) if i not in test_indices]), ("test", test_indices)):
        frames = [contents["frames"][i] for i in chosen]
        (parts / f"transforms_{name}.json").write_text(json.dumps({**contents, "frames": frames}))
    ours, theirs = load_scene(whole), load_scene(parts)
    assert all(getattr(ours, name) == getattr(theirs, name) for name in ("near", "far", "spacing", "background"))
    for split in ("train", "test"):
        a, b = getattr(ours, split), getattr(theirs, split)
        assert a.names == b.names and torch.equal(a.images, b.images)
        torch.testing.assert_close(a.cameras.poses, b.cameras.poses)
        torch.testing.assert_close(a.cameras.intrinsics, b.cameras.intrinsics)
        assert b.cameras.distortion is not None and float(b.cameras.distortion[0, 0]) == pytest.approx(0.02)


built_in = functools.cache(builtin_scene)


def blender_nerf(folder, test, lens):
    """Writes a scene as BlenderNeRF exports it: test views, if any, are listed without images."""
    write_blender(folder, built_in(8, train_views=9, test_views=2), 0.69)
    if lens:
        more = {"fl_x": 11.1, "cx": 4.0, "k1": 0.0, "aabb_scale": 4}
        for name in ("train", "test"):
            rewrite(folder, lambda contents: contents.update(more), f"transforms_{name}")
    if test == "none":
        (folder / "transforms_test.json").unlink()
    elif test == "those for training":
        shutil.copyfile(folder / "transforms_train.json", folder / "transforms_test.json")
    elif test == "val":
        shutil.copytree(folder / "test", folder / "val")
        contents = (folder / "transforms_test.json").read_text()
        (folder / "transforms_val.json").write_text(contents.replace("./test", "./val"))
    if test != "those for training":
        shutil.rmtree(folder / "test")


@pytest.mark.parametrize(
    ("test", "lens"),
    [
        ("not rendered", True),
        ("none", False),
        ("those for training", False),
        ("val", True),
        ("val", False),
    ],
)
def test_without_pictures_for_testing_every_eighth_is_held_out(tmp_path, test, lens):
    blender_nerf(tmp_path, test, lens)
    scene = load_scene(tmp_path)
    held = any("every 8th image is held out" in note for note in scene.notes)
    assert (scene.background, scene.box is None, held) == ("white", False, test != "val")
    assert scene.test.names == (("r_0", "r_8") if held else ("val_r_0", "val_r_1") if lens else ("r_0", "r_1"))
    assert len(scene.train) == (7 if held else 9)
    if test == "val":
        (tmp_path / "transforms_test.json").unlink()
        assert load_scene(tmp_path).test.names == scene.test.names


@pytest.mark.parametrize("start", ["./", "/home/me/lego/", "E:\\lego\\"])
def test_a_picture_of_another_split_is_not_taken(tmp_path, start):
    """A missing test image never becomes a training image of the same name, on whatever machine they were listed."""
    blender_nerf(tmp_path, "not rendered", lens=False)

    def change(contents):
        for frame in contents["frames"]:
            frame["file_path"] = frame["file_path"].replace("./", start)

    for name in ("transforms_train", "transforms_test"):
        rewrite(tmp_path, change, name)
    scene = load_scene(tmp_path)
    assert scene.test.names == ("r_0", "r_8") and len(scene.train) == 7
    rewrite(tmp_path, lambda contents: [frame.update(time=0.25) for frame in contents["frames"]], "transforms_train")
    assert not any("times" in note for note in load_scene(tmp_path).notes)
    (tmp_path / "m.png").touch()
    rewrite(tmp_path, lambda contents: contents["frames"][3].update(mask_path="m.png"), "transforms_train")
    assert "its masks are not used, only the alpha channel" in load_scene(tmp_path).notes
    marked = {"encoding": "utf-8-sig"}  # with a byte order mark
    rewrite(tmp_path, lambda contents: contents["frames"][3].update(time=0.5), "transforms_train", **marked)
    assert "its times are not used: the scene is taken as still" in load_scene(tmp_path).notes
    (tmp_path / "train").rename(tmp_path / "test")
    refuses("transforms_train.json: none of its 9 images exists", load_scene, tmp_path, error=SceneError)


def test_flags_that_are_off_make_no_capture(tmp_path):
    write_blender(tmp_path, builtin_scene(8, train_views=4, test_views=2), 0.69)
    for name in ("transforms_train", "transforms_test"):
        rewrite(tmp_path, lambda contents: contents.update(latlong=False, from_mitsuba=False, ftheta_p1=0), name)
    assert load_scene(tmp_path).far == 6
    rewrite(tmp_path, lambda contents: contents.update(from_mitsuba=True), "transforms_train")
    refuses("from_mitsuba is not supported", load_scene, tmp_path, error=SceneError)


def test_a_picture_of_blender_that_is_listed_twice_is_not_also_held_out(tmp_path):
    blender_nerf(tmp_path, "none", lens=False)
    rewrite(tmp_path, lambda contents: contents["frames"].insert(0, contents["frames"][3]), "transforms_train")
    scene = load_scene(tmp_path)
    assert sorted(scene.train.names + scene.test.names) == [f"r_{index}" for index in range(9)]
    assert scene.test.names == ("r_0", "r_8")


@pytest.mark.parametrize("scale", [0.25, 3.0])
def test_blender_cameras_at_other_distances(tmp_path, scale):
    original = builtin_scene(12, train_views=5, test_views=1)
    cameras = original.train.cameras
    poses = torch.cat((cameras.poses[:, :3, :3], scale * cameras.poses[:, :3, 3:]), 2)
    train = replace(original.train, cameras=replace(cameras, poses=torch.cat((poses, cameras.poses[:, 3:]), 1)))
    write_blender(tmp_path, replace(original, train=train), 0.69)
    scene, distance = load_scene(tmp_path), scale * float(cameras.origins.norm(dim=-1).median())
    assert (scene.near, scene.far) == pytest.approx((distance / 2, 1.5 * distance), rel=0.01)
    write_blender(tmp_path / "usual", original, 0.69)
    torch.testing.assert_close(scene.box, scale * load_scene(tmp_path / "usual").box, rtol=0.1, atol=0.1 * scale)


def test_a_single_picture_of_blender_is_too_few(tmp_path):
    write_blender(tmp_path, builtin_scene(8, train_views=1, test_views=1), 0.69)
    (tmp_path / "transforms_test.json").unlink()
    refuses("transforms_train.json: needs at least two images", load_scene, tmp_path, error=SceneError)


def test_capture(tmp_path, caplog):
    orbit = orbit_cameras(20, radius=7, elevation=15, width=12, height=10, focal=20, centre=(5, -2, 3))
    write_capture(tmp_path / "room", orbit, cx=5.5, cy=6.5, k1=0.02, p2=-0.001)
    for index in (3, 4):
        (tmp_path / "room" / f"{index:02d}.png").unlink()
    with caplog.at_level(logging.WARNING):
        scene = load_scene(tmp_path / "room")
    (record,) = caplog.records
    assert record.getMessage().endswith(": 2 of 20 listed images are missing and are skipped")
    caplog.clear()
    write_capture(tmp_path / "whole", orbit)
    load_scene(tmp_path / "whole")
    assert not caplog.records
    assert scene.test.names == ("00", "10", "18")
    assert len(scene.train) == 15 and "10" not in scene.train.names
    # Images stay with their cameras through sorting and splitting.
    for split in (scene.train, scene.test):
        for name, image in zip(split.names, split.images):
            assert (image == int(name)).all()
    assert (scene.background, scene.box, scene.spacing) == (None, None, "disparity")
    assert 0 < scene.near < 1 < scene.far
    cameras = scene.train.cameras
    torch.testing.assert_close(cameras.intrinsics[0], torch.tensor((20.0, 20.0, 5.5, 6.5)))
    assert cameras.distortion is not None
    torch.testing.assert_close(cameras.distortion[0], torch.tensor((0.02, 0, 0, -0.001, 0, 0, 0, 0)))
    torch.testing.assert_close(cameras.origins.norm(dim=-1), torch.ones(15), atol=1e-4, rtol=0)
    # The normalisation is rigid: neighbours stay 18 degrees apart.
    by_name = dict(zip(scene.train.names, cameras.forward))
    assert float(by_name["01"] @ by_name["02"]) == pytest.approx(float(orbit.forward[1] @ orbit.forward[2]), abs=2e-4)


@pytest.mark.parametrize("rig", ["outward", "parallel", "one place"])
def test_rays_of_a_capture_without_a_common_focus_are_finite(tmp_path, rig):
    """All rays are finite, even for a camera at the origin; the near distance is measured from the origin."""
    poses = orbit_cameras(9, radius=2, elevation=0, width=4, height=4, focal=4).poses
    if rig == "outward":
        poses[:, :3, [0, 2]] *= -1
    else:
        poses[:, :3, :3] = torch.eye(3)
    poses[8, :3, 3] = poses[:8, :3, 3].mean(0)
    if rig == "one place":
        poses[:, :3, 3] = 0
    write_capture(tmp_path, Cameras(poses, torch.full((9, 4), 4.0), 4, 4, None))
    scene = load_scene(tmp_path)
    assert scene.spacing == "disparity" and scene.near == pytest.approx(0.05) and scene.far > 1
    origins = torch.cat([split.cameras.origins for split in (scene.train, scene.test)])
    assert float(origins.norm(dim=-1).min()) < 1e-6

    def field(positions, directions, ray_index):
        assert positions.isfinite().all()
        return torch.full_like(positions, 0.5), torch.ones(len(positions))

    rays = scene.test.cameras.image_rays(0)
    sampler = Stratified(8, space=Space(spacing=scene.spacing), backend="reference")
    for jitter in (False, True):
        rendered = render_rays(field, rays, scene.near, scene.far, jitter=jitter, samples=sampler)
        assert all(part.isfinite().all() for part in rendered[:-1])
        assert (rendered.depth > scene.near).all() and (rendered.depth < scene.far).all()


def test_names_of_a_capture_are_all_different(tmp_path):
    write_capture(tmp_path, orbit_cameras(8, radius=2, elevation=5, width=4, height=4, focal=4))
    path = tmp_path / "transforms.json"
    contents = json.loads(path.read_text())
    left_right = [f"{side}/{index:02d}.png" for side in ("left", "right") for index in range(4)]
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
    for frame, name in zip(contents["frames"], left_right):
        (tmp_path / frame["file_path"]).rename(tmp_path / name)
        frame["file_path"] = name
    path.write_text(json.dumps(contents))

    def names():
        scene = load_scene(tmp_path)
        return sorted(scene.train.names + scene.test.names)

    assert names() == [name.removesuffix(".png").replace("/", "_") for name in left_right]
    for frame, name in zip(contents["frames"], ("a", "b", "c", "d", "e", "f", "g", "h")):
        (tmp_path / frame["file_path"]).with_name(f"{name}.png").write_bytes((tmp_path / "left/00.png").read_bytes())
        frame["file_path"] = str(Path(frame["file_path"]).with_name(f"{name}.png"))
    path.write_text(json.dumps(contents))
    assert names() == list("abcdefgh")


def test_capture_intrinsics_per_frame_and_from_angles(tmp_path):
    write_capture(tmp_path, orbit_cameras(3, radius=2, elevation=5, width=12, height=10, focal=4))

    def change(contents):
        del contents["fl_x"]
        contents["camera_angle_x"] = 2 * math.atan(0.5)
        contents["frames"][0] |= {"fl_x": 30.0, "fl_y": 31.0, "cx": 1.0, "k1": 0.05}  # the last frame by name

    rewrite(tmp_path, change)
    train = load_scene(tmp_path).train
    torch.testing.assert_close(train.cameras.intrinsics, torch.tensor([[12.0, 12, 6, 5], [30, 31, 1, 5]]))
    assert train.cameras.distortion is not None
    assert train.cameras.distortion[:, 0].tolist() == pytest.approx([0, 0.05])


@pytest.mark.parametrize(
    ("lists", "train", "test"),
    [
        ({"train": (0, 1, 2), "test": (3, 4)}, (0, 1, 2), (3, 4)),
        ({"train": (0, 1, 2), "test": (3, 4), "val": (5,)}, (0, 1, 2), (3, 4)),
        ({"train": (0, 1), "val": (4,), "test": ()}, (0, 1), (4,)),
        ({"test": (4,)}, (0, 1, 2, 3, 5), (4,)),
        ({"test": (4,), "val": (3,)}, (0, 1, 2, 5), (4,)),
        ({"train": (1, 2)}, (1, 2), (0, 3, 4, 5)),
    ],
)
def test_lists_of_file_names_split_a_capture(tmp_path, lists, train, test):
    write_capture(tmp_path, orbit_cameras(6, radius=2, elevation=5, width=4, height=4, focal=4))
    named = {f"{name}_filenames": [f"./{index:02d}.png" for index in chosen] for name, chosen in lists.items()}
    rewrite(tmp_path, lambda contents: contents.update(named))
    scene = load_scene(tmp_path)
    for split, chosen in ((scene.train, train), (scene.test, test)):
        assert split.names == tuple(f"{index:02d}" for index in chosen)
        assert split.images[:, 0, 0, 0].tolist() == list(chosen)


def test_distortion_params_are_those_of_nerfstudio(tmp_path):
    for folder, lens in (
        ("named", {"k1": 0.02, "k2": -0.01, "p1": 0.001, "p2": 0.002}),
        ("listed", {"k1": 9, "distortion_params": [0.02, -0.01, 0, 0, 0.001, 0.002]}),
        ("fisheye", {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k2": -0.2, "k3": 0.03, "k4": -0.04}),
    ):
        write_capture(tmp_path / folder, orbit_cameras(3, radius=2, elevation=5, width=8, height=8, focal=8), **lens)
    named, listed, fisheye = (load_scene(tmp_path / name).train.cameras for name in ("named", "listed", "fisheye"))
    assert named.distortion is not None and torch.equal(named.distortion, listed.distortion) and named.models is None
    assert fisheye.models.tolist() == [1, 1]
    torch.testing.assert_close(fisheye.distortion[0], torch.tensor((0.1, -0.2, 0, 0, 0.03, -0.04, 0, 0)))
    rewrite(tmp_path / "fisheye", lambda contents: contents["frames"][0].update(camera_model="OPENCV", k4=0))
    mixed = load_scene(tmp_path / "fisheye").train.cameras
    assert mixed.models.tolist() == [1, 0] and mixed.distortion[:, 5].tolist() == [pytest.approx(-0.04), 0]


def test_normalise_poses():
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(2)))[0].double()
    turn *= torch.linalg.det(turn)
    poses = orbit_cameras(9, radius=6, elevation=30, width=1, height=1, focal=1, centre=(1, 2, 3)).poses.double()
    moved = poses.clone()
    moved[:, :3] = turn @ moved[:, :3]
    result = find_frame(moved, "unbounded").poses(moved)
    cameras = Cameras(result.float(), torch.ones(9, 4), 1, 1)
    focus = focus_point(cameras)
    assert focus is not None and float(focus.abs().max()) < 1e-3
    assert float(cameras.origins.norm(dim=-1).max()) == pytest.approx(1, abs=1e-4)
    torch.testing.assert_close(cameras.origins[:, 2], torch.full((9,), 0.5), atol=1e-3, rtol=0)  # z is up again
    rotation = result[:, :3, :3]
    torch.testing.assert_close(rotation.mT @ rotation, torch.eye(3).double().expand(9, 3, 3), atol=1e-5, rtol=0)


def test_normalise_degenerate_poses():
    one_place = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    assert find_frame(one_place, "unbounded").poses(one_place).isfinite().all()
    row = one_place.clone()
    row[:, 0, 3] = torch.arange(3)
    assert float(find_frame(row, "unbounded").poses(row)[:, :3, 3].norm(dim=-1).max()) == pytest.approx(1)


@pytest.mark.data
@pytest.mark.slow
def test_lego():
    scene = load_scene(needs("lego"), downscale=4)
    assert scene.train.images.shape == (100, 100, 100, 4) and scene.test.images.shape == (200, 100, 100, 4)
    assert scene.box is not None
    assert float(scene.box[0].max()) < -0.5 and float(scene.box[1].min()) > 0.7 and float(scene.box.abs().max()) < 1.4


@pytest.mark.data
def test_fox(caplog):
    with caplog.at_level(logging.WARNING):
        scene = load_scene(needs("fox"), downscale=8)
    assert "17 of 67 listed images are missing" in caplog.text
    assert scene.train.images.shape == (43, 240, 135, 3) and scene.test.images.shape == (7, 240, 135, 3)
    assert scene.train.cameras.distortion is not None
