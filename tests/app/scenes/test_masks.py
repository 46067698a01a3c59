"""Tests of the masks of valid pixels: from mask files, from alpha, and from the image circle of a lens."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import all_pairs, refuses, seeded, trained
from PIL import Image
from scene_files import (
    COUNT,
    POINTS,
    POSES,
    SIZE,
    oriented,
    rewrite,
    write_capture,
    write_colmap,
    write_frames,
    write_images,
    write_llff,
)

from voronerf.app.scenes import SceneError, load_scene
from voronerf.app.train import TrainConfig
from voronerf.app.train.build import make_batches, make_grid, space_before
from voronerf.app.train.defaults import resolve
from voronerf.nerf.cameras import Cameras, orbit_cameras


def test_masks_leave_pixels_out_of_training_and_scores(tmp_path):
    write_capture(tmp_path, orbit_cameras(9, radius=2, elevation=5, width=12, height=10, focal=12))
    mask = np.full((10, 12), 255, np.uint8)
    mask[:, :6] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    rewrite(tmp_path, lambda contents: [frame.update(mask_path="mask.png") for frame in contents["frames"]])
    scene = load_scene(tmp_path)
    assert len(make_batches(TrainConfig(), scene)) == 7 * 60
    assert torch.equal(scene.test.mask(0), torch.from_numpy(mask > 0))
    assert int(load_scene(tmp_path, downscale=4).train.masks[0].sum()) == 2  # a block with a black pixel is left out
    for change, reason in (
        ({"mask_path": "../mask.png"}, "mask_path: must lie in the folder of the scene"),
        ({"mask_path": "none.png"}, "does not exist"),
        ({"mask_path": 3}, "mask_path must be a file name, got 3"),
        ({"mask_path": "small.png"}, "small.png: is 3 x 2 pixels"),
        ({"mask_path": "black.png"}, "black.png: excludes all pixels"),
    ):
        Image.new("L", (12, 10)).save(tmp_path / "black.png")
        Image.new("L", (3, 2), 255).save(tmp_path / "small.png")
        rewrite(tmp_path, lambda contents, change=change: contents["frames"][1].update(change))
        refuses(reason, load_scene, tmp_path, error=SceneError)


def disc(side, radius, columns=0):
    """Returns a bool image [side, side] of a disc about the middle, shifted to the right by `columns`."""
    x = torch.arange(side) + 0.5 - side / 2
    return torch.hypot(x - columns, x[:, None]) < radius


@pytest.mark.parametrize(
    ("clear", "kind", "keep"),
    [
        # one pixel of one image
        (lambda index: (torch.arange(400).view(20, 20) == 57) & (index == 3), "unbounded", "memory"),
        (lambda index: disc(20, 4, columns=index), "unbounded", "disk"),  # a person walks through
        (lambda index: disc(20, 9) & (index in (1, 2)), "unbounded", "memory"),  # a person comes near in two images
        (lambda index: ~disc(20, 12.5), "unbounded", "memory"),  # empty corners after undistortion
        (lambda index: torch.arange(20)[:, None].expand(20, 20) >= 15, "unbounded", "memory"),  # a car's bonnet
        (lambda index: ~disc(20, 6, columns=index - 4), "object", "disk"),
        (lambda index: ~disc(20, 6) if index else ~disc(20, 14), "object", "memory"),  # an object that fills one image
    ],
)
def test_alpha_cuts_out_an_object_or_masks(tmp_path, monkeypatch, clear, kind, keep):
    monkeypatch.setenv("VORONERF_CACHE", str(tmp_path / "cache"))
    write_capture(tmp_path / "scene", orbit_cameras(9, radius=2, elevation=5, width=20, height=20, focal=20))
    shown = [~clear(index) for index in range(9)]
    for index, opaque in enumerate(shown):
        pixels = np.full((20, 20, 4), index, np.uint8)
        pixels[..., 3] = np.where(opaque, 254 if index == 5 else 255, 0)
        Image.fromarray(pixels).save(tmp_path / f"scene/{index:02d}.png")
    scene = load_scene(tmp_path / "scene", images=keep)
    line = f"transparent pixels, in {sum(not bool(each.all()) for each in shown)} of 9 images, are masked"
    masked = any(line in note for note in scene.notes)  # an alpha of 254 is opaque
    assert (scene.kind, scene.background is None, masked) == (kind, kind != "object", kind != "object")
    for asked in ("unbounded", "object"):
        scene = load_scene(tmp_path / "scene", images=keep, kind=asked)
        assert scene.train.images.shape[-1] == (4 if asked == "object" else 3)
        for split in (scene.train, scene.test):
            assert split.masks is None or split.masks.shape == split.images.shape[:3]
            for index, name in enumerate(split.names):
                mask = split.mask(index)
                assert mask is None if asked == "object" else torch.equal(mask, shown[int(name)])
                assert (split.images[index, ..., :3][shown[int(name)]] == int(name)).all()


def test_what_surrounds_the_circle_of_a_fisheye_is_no_background(tmp_path):
    rig = orbit_cameras(9, radius=2, elevation=5, width=20, height=20, focal=6)
    write_capture(tmp_path, rig, fl_x=6.0, is_fisheye=True)
    for index in range(9):
        pixels = np.full((20, 20, 4), 255, np.uint8)
        pixels[..., 3] = 255 * disc(20, 8).numpy()
        Image.fromarray(pixels).save(tmp_path / f"{index:02d}.png")
    scene = load_scene(tmp_path)
    assert scene.kind == "unbounded" and torch.equal(scene.train.mask(3), disc(20, 8))


def test_alpha_and_masks_count_together_upright_and_reduced(tmp_path):
    write_capture(tmp_path, orbit_cameras(9, radius=2, elevation=5, width=12, height=10, focal=12))
    Image.fromarray(np.arange(12)[None].repeat(10, 0) >= 2).save(tmp_path / "mask.png")
    pixels = np.full((10, 12, 4), 255, np.uint8)
    pixels[0, 11, 3] = 0
    Image.fromarray(pixels).save(tmp_path / "01.png")
    rewrite(tmp_path, lambda contents: [frame.update(mask_path="mask.png") for frame in contents["frames"]])
    scene = load_scene(tmp_path)
    assert [int((~scene.train.mask(index)).sum()) for index in range(7)] == [21, *[20] * 6]
    half = load_scene(tmp_path, downscale=2)
    assert [int((~half.train.mask(index)).sum()) for index in range(7)] == [6, *[5] * 6]
    pixels[..., 3] = 0
    Image.fromarray(pixels).save(tmp_path / "02.png")
    refuses("mask.png: excludes all pixels", load_scene, tmp_path, error=SceneError)
    rewrite(tmp_path, lambda contents: [frame.pop("mask_path") for frame in contents["frames"]])
    refuses("02.png: its alpha excludes all pixels", load_scene, tmp_path, error=SceneError)


@pytest.mark.parametrize(*all_pairs({"tag": (1, 3, 6, 8), "upright": (False, True), "transparent": (False, True)}))
def test_a_mask_lies_as_its_image_is_stored_or_as_it_is_seen(tmp_path, tag, upright, transparent):
    write_capture(tmp_path, orbit_cameras(9, radius=2, elevation=5, width=12, height=10, focal=12))
    seen = torch.rand((10, 12), generator=seeded()) > 0.5
    stored = torch.rot90(seen, -{1: 0, 3: 2, 6: 3, 8: 1}[tag])
    lies = stored if tag == 3 or not upright else seen
    for index in range(9):
        Image.new("RGB", stored.shape[::-1]).save(tmp_path / f"{index:02d}.jpg", exif=oriented(tag))
    mask = Image.fromarray(lies.numpy()).convert("L")
    if transparent:
        white = Image.new("RGBA", mask.size, "white")
        white.putalpha(mask)
        mask = white
    mask.save(tmp_path / "mask.png")

    def change(contents):
        for frame in contents["frames"]:
            frame.update(mask_path="mask.png", file_path=frame["file_path"].replace("png", "jpg"))

    rewrite(tmp_path, change)
    assert torch.equal(load_scene(tmp_path).train.mask(0), seen)


@pytest.mark.parametrize("format", ["transforms", "colmap", "llff"])
@pytest.mark.parametrize("tag", [1, 6])
def test_masks_of_instant_ngp_leave_out_what_is_not_black(tmp_path, format, tag):
    """Masks beside the images, upright or as stored, are found in every format, and are not read as images."""
    white, turns = torch.rand(SIZE[::-1], generator=seeded()) > 0.7, {1: 0, 6: 3}[tag]
    write_images(tmp_path, [SIZE] * COUNT, exif=oriented(tag))
    for index in range(5):
        lies = torch.rot90(white, turns) if index % 2 else white
        Image.fromarray(lies.numpy()).save(tmp_path / f"images/dynamic_mask_{index:02d}.png")
    if format == "colmap":
        write_colmap(tmp_path, POSES, [SIZE] * COUNT, POINTS)
    elif format == "llff":
        write_llff(tmp_path, POSES, SIZE, 20.0, (2.5, 5.5))
    else:
        write_frames(tmp_path, POSES, "images/{:02d}".format)
    for downscale in (1, 2):
        scene = load_scene(tmp_path, downscale=downscale)
        line = "5 of 9 images have a mask dynamic_mask_NAME.png, whose pixels that are not black do not count"
        assert line in scene.notes and len(scene.train) + len(scene.test) == 9
        blocks = white.view(10 // downscale, downscale, 12 // downscale, downscale).any(3).any(1)
        for split in (scene.train, scene.test):
            for index, name in enumerate(split.names):
                kept = ~blocks if int(name) < 5 else torch.ones_like(blocks)
                assert torch.equal(split.mask(index), torch.rot90(kept, turns))
    if format == "colmap":
        (tmp_path / "masks").mkdir()
        Image.new("L", SIZE, 255).save(tmp_path / "masks/01.png")
        notes = load_scene(tmp_path).notes
        assert "1 masks dynamic_mask_NAME.png are not used, since their images have other masks" in notes
    (tmp_path / "images/dynamic_mask_00.png").unlink()
    (tmp_path / "images/dynamic_mask_00.png").symlink_to("/etc/passwd")
    refuses("dynamic_mask_00.png: must lie in the folder of the scene", load_scene, tmp_path, error=SceneError)


def test_a_jpeg_may_be_a_mask(tmp_path):
    """A JPEG mask works although its black pixels are not exactly black."""
    write_capture(tmp_path, orbit_cameras(9, radius=2, elevation=5, width=48, height=48, focal=12))
    Image.fromarray(255 * disc(48, 15).numpy().astype(np.uint8)).save(tmp_path / "mask.jpg", quality=70)
    rewrite(tmp_path, lambda contents: [frame.update(mask_path="mask.jpg") for frame in contents["frames"]])
    wrong = load_scene(tmp_path).train.mask(0) != disc(48, 15)
    assert not wrong[disc(48, 14) | ~disc(48, 16)].any()


@pytest.mark.parametrize(
    ("focal", "lens", "limit"),
    [
        (10.0, {"k1": -0.25}, 10 * 2 / 3 / 0.75**0.5),  # an action camera: r (1 - r^2 / 4) is at most 0.77
        (12.0, {"k1": -0.3, "k2": 0.02}, None),
        (9.0, {"k1": -0.28, "k2": 0.05, "k3": -0.002}, None),
        (11.0, {"k1": -0.2, "p1": 0.004, "p2": -0.003}, None),
        (10.0, {"k1": -0.25, "fl_y": 9.0, "cx": 9.0, "cy": 11.5}, None),
        (6.0, {"k1": -0.1, "is_fisheye": True}, 7.3),  # angle t maps to 6 (t - 0.1 t^3) <= 7.3
    ],
)
def test_corners_without_a_ray_are_masked(tmp_path, focal, lens, limit):
    """Unmasked rays project to their own pixels, and points beyond the lens's limit project to no unmasked pixel."""
    rig = orbit_cameras(9, radius=2, elevation=5, width=20, height=20, focal=6)
    write_capture(tmp_path, rig, fl_x=focal, **lens)
    scene = load_scene(tmp_path, normalise=False)
    cameras, mask = scene.train.cameras, scene.train.mask(0)
    assert any(scene.train.names[0] in note.partition("are masked: ")[2] for note in scene.notes)
    assert 0.4 < float(mask.float().mean()) < 1
    if limit:
        assert torch.equal(mask, disc(20, limit))
    rays = cameras.image_rays(0)
    y, x = torch.meshgrid(torch.arange(20) + 0.5, torch.arange(20) + 0.5, indexing="ij")
    pixels, _ = cameras.project(rays.origins + 3 * rays.directions, 0)
    apart = (pixels.view(20, 20, 2) - torch.stack((x, y), -1)).norm(dim=-1)
    assert float(apart[mask].max()) < 1e-3
    directions = torch.nn.functional.normalize(torch.randn(5000, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    pixels, depth = cameras.project(cameras.origins[0] + 3 * directions, 0)
    seen = ((pixels >= 0) & (pixels < 20)).all(-1) & ((depth > 0) | (cameras.models is not None))
    inner = torch.nn.functional.max_pool2d((~mask).float()[None], 3, 1, 1)[0] == 0  # leaves out the steep border
    seen[seen.clone()] &= inner[tuple(pixels[seen].long().flip(-1).T)]
    back = cameras.rays(0, *pixels[seen].unbind(-1)).directions
    assert seen.sum() > 100 and float((back - directions[seen]).norm(dim=-1).max()) < 1e-3


def test_corners_without_a_ray_are_neither_trained_nor_scored(tmp_path):
    rig = orbit_cameras(9, radius=2, elevation=5, width=20, height=20, focal=6)
    write_capture(tmp_path, rig, fl_x=6.0, k1=-0.1, is_fisheye=True)
    short = {"steps": 4, "cells": (), "width": 8, "rays": 32, "samples": (8,), "evaluations": 1}
    summary = trained(TrainConfig(out=tmp_path / "run", **short), load_scene(tmp_path))
    assert 0 < summary["psnr"] < 100 and 0 < summary["ssim"] < 1


@pytest.mark.parametrize("lens", [{"k1": -0.25}, {"k1": -0.28, "k2": 0.02, "p1": 0.002}])
def test_rays_that_are_none_change_nothing(tmp_path, lens):
    """Pixels without a ray change neither the space of a forward-facing scene nor the region its cameras see."""
    poses = torch.eye(4).repeat(9, 1, 1)
    poses[:, 0, 3] = torch.arange(9) / 20
    write_capture(tmp_path, Cameras(poses, torch.full((9, 4), 10.0), 20, 16), fl_x=10.0, **lens)
    scene = load_scene(tmp_path)
    assert scene.kind == "forward" and scene.train.masks is not None
    space, cameras = scene.space("ndc").contraction, scene.train.cameras
    mask, rays = scene.train.mask(0), cameras.image_rays(0)
    for depth in (scene.near, 2 * scene.near, scene.far):
        places = space.points(rays.origins + depth * rays.directions)[mask.view(-1)]
        assert float(places[:, :2].abs().max()) < 1.001
    around = replace(load_scene(tmp_path, kind="unbounded"), near=0.5)
    grid = make_grid(resolve(TrainConfig(), around), around)
    looked_through = torch.zeros(grid.occupied.numel(), dtype=torch.bool)
    for index in range(len(around.train)):
        rays = around.train.cameras.image_rays(index)
        depths = torch.linspace(0, around.near, 400)[:, None, None]
        points = rays.origins[mask.view(-1)] + depths * rays.directions[mask.view(-1)]
        looked_through[grid.voxels(grid.contraction.points(points.view(-1, 3))).long()] = True
    empty = space_before(around, grid, grid.contraction).view(-1)
    assert int(empty.sum()) > 100 and not (empty & ~looked_through).any()


@pytest.mark.parametrize(*all_pairs({"fisheye": (False, True), "radius": (6.2, 9.0, 14.0), "downscale": (1, 2, 3)}))
def test_the_circle_of_a_fisheye_is_what_counts(tmp_path, fisheye, radius, downscale):
    rig = orbit_cameras(9, radius=2, elevation=5, width=20, height=16, focal=10)
    write_capture(tmp_path, rig, fl_x=10.0, fisheye_crop_radius=radius, is_fisheye=fisheye)
    Image.new("RGB", (20, 16)).save(tmp_path / "03.jpg", exif=oriented(6))
    rewrite(tmp_path, lambda contents: contents["frames"][5].update(file_path="03.jpg"))
    split = load_scene(tmp_path, downscale=downscale).train
    x, y = (downscale * (torch.arange(side // downscale) + 0.5) - side / 2 for side in (20, 16))
    expected = torch.hypot(x, y[:, None]) <= radius
    for index, name in enumerate(split.names):
        mask = split.mask(index)
        assert expected.all() if mask is None else torch.equal(mask, expected.rot90(3) if name == "03" else expected)
