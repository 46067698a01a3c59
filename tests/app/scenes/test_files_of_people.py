"""Regression tests on captures and camera paths from other programs: each file is read correctly, or refused with one
line that says what to do."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from helpers import refuses
from PIL import Image
from scene_files import DATA

from voronerf.app.render.paths import read_camera_path
from voronerf.app.scenes import SceneError, load_scene
from voronerf.app.scenes.colmap import read_model
from voronerf.app.scenes.folders import listed_images
from voronerf.app.scenes.gather import _take_frames as gather_frames
from voronerf.app.scenes.gather import cameras_of, emptied, gather

CASES = DATA.parent / "cases"


def gathered(source, out):
    """Returns (names, messages): the images that `process` takes from a source, and its messages."""
    said = []
    gather(source, emptied(out / "images"), out / "masks", 150, say=said.append, progress=lambda *_: None)
    return listed_images(out / "images"), " ".join(said)


def case(name):
    """Returns the folder of a test case; skips the test if the folder is absent."""
    if not (CASES / name).is_dir():
        pytest.skip(f"{CASES / name} is not there; set VORONERF_DATA to a folder beside it")
    return CASES / name


def size_of(scene):
    return scene.train.cameras.width, scene.train.cameras.height


def test_alpha_that_is_not_an_object():
    scene = load_scene(case("alpha_not_an_object"))
    assert (scene.kind, scene.background, scene.far) == ("unbounded", None, 4)
    assert scene.train.images.shape[-1] == 3 and scene.train.masks is None


def test_a_scale_that_was_applied():
    scene = load_scene(case("applied_scale"))
    original = torch.tensor([2.298, 1.928, 1.260, 1.0], dtype=torch.float64)
    moved = (scene.transform @ original)[:3].float()
    torch.testing.assert_close(moved, scene.train.cameras.origins[0], atol=1e-3, rtol=0)
    torch.testing.assert_close(moved, torch.tensor([-0.706, -0.593, 0.387]), atol=1e-3, rtol=0)


def test_the_default_export_of_blendernerf():
    scene = load_scene(case("blendernerf_default"))
    assert (len(scene.train), len(scene.test)) == (7, 2)
    assert any("every 8th image is held out" in note for note in scene.notes)


def test_flags_of_lenses():
    folder = case("lens_flags_ignored")
    assert load_scene(folder / "latlong").train.cameras.models.tolist() == [3] * 7
    refuses("ftheta_p1 is not supported, only lenses that are", load_scene, folder / "ftheta", error=SceneError)
    refuses("orthographic is not supported, only", load_scene, folder / "orthographic", error=SceneError)
    mask = load_scene(folder / "crop").train.mask(0)
    y, x = torch.meshgrid(torch.arange(60) - 29.5, torch.arange(80) - 39.5, indexing="ij")
    assert torch.equal(mask, torch.hypot(x, y) <= 28)


def test_jpegs_with_a_second_picture():
    scene = load_scene(case("mpo_orientation"))
    assert size_of(scene) == (60, 80)
    assert scene.train.cameras.intrinsics[0].tolist() == pytest.approx([62, 60, 60 - 29.6, 41])


def test_a_wide_angle():
    scene = load_scene(case("wide_angle_perspective"))
    mask = scene.train.mask(0)
    assert float(mask.float().mean()) == pytest.approx(0.811, abs=1e-3)
    y, x = torch.meshgrid(torch.arange(60) - 29.5, torch.arange(80) - 39.5, indexing="ij")
    assert torch.equal(mask, torch.hypot(x, y) / 48 < 2 / 3 / 0.75**0.5)


def test_models_of_another_size_than_their_pictures():
    folder = case("images_smaller_than_model")
    small, large = load_scene(folder), load_scene(folder / "big")
    assert size_of(small) == (504, 378) and size_of(large) == (400, 300)
    for scene in (small, large):  # the focal length is scaled from the model's
        model = read_model(folder / ("big" if scene is large else "") / "sparse/0").images[0].camera
        across = size_of(scene)[0] / model.width
        assert float(scene.train.cameras.intrinsics[0, 0]) == pytest.approx(model.lens.intrinsics[0] * across)


def test_the_larger_of_two_models():
    folder = case("sparse_1_larger")
    for data, count in (("", 44), ("sparse/1", 44), ("sparse/0", 3)):
        scene = load_scene(folder / data)
        assert len(scene.train) + len(scene.test) == count
    assert "sparse/0 of 3, sparse/1 of 44 images" in " ".join(load_scene(folder).notes)


@pytest.mark.parametrize(("name", "downscale"), [("a", None), ("b", None), ("b", 4), ("c", None), ("c", 4)])
def test_names_of_pictures(name, downscale):
    folder = case("colmap_names") / name
    scene = load_scene(folder, downscale=downscale)
    assert len(scene.train) + len(scene.test) == 9
    if downscale:  # images_4 has the reduced images, in the same order
        full = load_scene(folder, downscale=1)
        assert torch.equal(scene.train.cameras.poses, full.train.cameras.poses)


@pytest.mark.parametrize(
    ("name", "test", "files"),
    [
        ("gaussian", ("003", "005"), "sparse/0/test.txt"),
        ("lists", ("007", "008"), "train_list.txt and test_list.txt"),
    ],
)
def test_lists_of_test_images(name, test, files):
    scene = load_scene(case("test_lists") / name)
    assert scene.test.names == test and len(scene.train) == 7
    assert f"test images are those of {files}: 2 of 9" in scene.notes


def test_masks_of_instant_ngp():
    folder = case("dynamic_masks")
    scene = load_scene(folder)
    assert len(scene.train) == 5 and scene.test.names == ("000",)
    assert (
        "6 of 6 images have a mask dynamic_mask_NAME.png, whose pixels that are not black do not count" in scene.notes
    )
    for split in (scene.train, scene.test):
        for index, label in enumerate(split.names):
            white = np.asarray(Image.open(folder / f"images/dynamic_mask_{label}.png").convert("L")) > 0
            assert white.any() and torch.equal(split.mask(index), torch.from_numpy(~white))
    assert len(listed_images(folder / "images")) == 6


def test_times_are_not_used():
    scene = load_scene(case("time_of_frames"))
    assert "its times are not used: the scene is taken as still" in scene.notes


@pytest.mark.parametrize("name", ["case", "dexnerf", "nfd", "parent", "posix", "suffix", "windows"])
def test_paths_of_another_machine(name):
    scene = load_scene(folder := case("transforms_paths") / name, normalise=False)
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    for split in (scene.train, scene.test):
        for label, pose in zip(split.names, split.cameras.poses):
            expected = torch.tensor(frames[int(label[-1])]["transform_matrix"])
            torch.testing.assert_close(pose, expected, atol=1e-5, rtol=0)
    assert len(scene.train) + len(scene.test) == 6


@pytest.mark.parametrize(
    ("data", "name"),
    [
        ("dense0", "dense0"),
        ("dense0/dense/0", "0"),
        ("glomap", "glomap"),
        ("glomap/output/0", "glomap"),
        ("rgb", "rgb"),
        ("rgb/sparse/0", "rgb"),
    ],
)
def test_layouts_of_folders(data, name):
    scene = load_scene(case("layouts") / data)
    assert scene.name == name and len(scene.train) + len(scene.test) == 6
    line = "images are read from rgb, since there is no folder images"
    assert (line in scene.notes) == data.startswith("rgb")


def test_models_of_colmap_4():
    folder = case("colmap4_models")
    scene = load_scene(folder / "equirectangular")
    assert scene.train.cameras.models.tolist() == [3] * len(scene.train)
    refuses(
        "camera model SIMPLE_DIVISION is not supported (colmap image_undistorter",
        load_scene,
        folder / "division",
        error=SceneError,
    )


@pytest.mark.parametrize(
    ("name", "count", "line"),
    [
        ("subs", 5, "byte-identical copies of images are left out: camB_0.jpg"),
        ("webp", 5, ""),
        ("tif", 5, ""),
        ("mac", 5, ""),
        ("mixed", 5, "images in subfolders are left out"),
    ],
)
def test_sources_of_process(tmp_path, name, count, line):
    images, said = gathered(case("process_sources") / name, tmp_path)
    assert len(images) == count and line in said


@pytest.mark.parametrize("name", ["clip.mp4", "recorded_in_browser.webm"])
def test_short_videos(tmp_path, name):
    pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is not installed")
    images, said = gathered(case("short_video") / name, tmp_path)
    assert len(images) == len({path.read_bytes() for path in images}) == 40
    assert "all 40 frames are taken, fewer than --frames 150" in said


@pytest.mark.parametrize("name", ["legacy", "v1", "nested"])
def test_camera_paths(name):
    path = read_camera_path(case("camera_path_nerfstudio") / f"{name}.json")
    frames = json.loads((case("camera_path_nerfstudio") / f"{name}.json").read_text())["camera_path"]
    rows = torch.tensor([frame["camera_to_world"] for frame in frames]).view(-1, 4, 4)
    torch.testing.assert_close(path.frames.poses, rows, atol=1e-5, rtol=0)


def first_frame(path, out):
    """Returns (the first of two frames of a video, float [h, w, 3]; the lines about the video)."""
    pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is not installed")
    said = []
    gather_frames(path, out, 2, said.append)
    with Image.open(out / "00001.jpg") as image:
        return torch.from_numpy(np.array(image.convert("RGB"))).float(), " ".join(said)


def test_colours_of_hd_video(tmp_path):
    image, _ = first_frame(case("bt709_colours") / "clip.mp4", tmp_path / "frames")
    assert (image[90, 60] - torch.tensor([30.0, 200, 40])).abs().max() <= 3


@pytest.mark.parametrize(("name", "kind", "psnr"), [("hlg", "HLG", 21), ("pq", "PQ", 25.5)])
def test_hdr_video(tmp_path, name, kind, psnr):
    """The videos have no tag of their transfer function, and more saturated colours than the chart."""
    chart, _ = first_frame(case("bt709_colours") / "clip.mp4", tmp_path / "chart")
    image, said = first_frame(case("hdr_video") / f"{name}.mp4", tmp_path / "frames")
    assert f"is HDR ({kind}) and is tone-mapped to sRGB" in said
    assert 10 * (255**2 / (image - chart).square().mean()).log10() > psnr


def test_videos_that_cannot_be_read(tmp_path):
    pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is not installed")
    for name, line in (
        ("no_moov.mp4", "moov atom not found, as in a recording or a download that was cut off"),
        ("sound.m4a", "it has no moving pictures"),
    ):
        path = case("unreadable_videos") / name
        refuses(line, gather_frames, path, tmp_path, 5, print, error=SceneError)


def test_raw_folders_of_polycam(tmp_path):
    images, _ = gathered(case("polycam_raw"), tmp_path)
    assert [path.name for path in images] == [f"keyframes_corrected_images_{n}.jpg" for n in range(5)]
    images, _ = gathered(case("polycam_raw") / "keyframes", tmp_path)
    assert len(images) == 5


def test_masks_of_instant_ngp_in_process(tmp_path):
    images, said = gathered(case("dynamic_masks") / "images", tmp_path)
    assert [path.name for path in images] == [f"00{n}.jpg" for n in range(6)] and "6 of 6 images have a mask" in said
    for path in images:
        left_out = case("dynamic_masks") / f"images/dynamic_mask_{path.stem}.png"
        masks = [np.asarray(Image.open(file).convert("L")) for file in (tmp_path / f"masks/{path.name}.png", left_out)]
        assert ((masks[0] > 0) == (masks[1] == 0)).all() and masks[1].any()


def test_names_that_begin_like_comments(tmp_path):
    images, _ = gathered(case("hash_names"), tmp_path)
    assert [path.name for path in images] == [f"_{n}.jpg" for n in range(8)]


def test_images_of_16_bits():
    folder = case("png_16_bit")
    scene = load_scene(folder)
    with Image.open(folder / "images/001.png") as image:
        assert torch.equal(scene.train.images[0], torch.from_numpy(np.array(image.convert("RGB"))))
    assert any("6 images have 16 bits a channel, of which the upper 8 are read" in note for note in scene.notes)


def test_two_lenses_with_one_size(tmp_path):
    source = case("two_lenses_one_size")
    images = emptied(tmp_path / "images")
    places = gather(source, images, tmp_path / "masks", 150, say=print, progress=lambda *_: None)
    labels = cameras_of(listed_images(images), places)
    assert len(set(labels.values())) == 2
    assert all(("26 mm" in label) == name.startswith("wide") for name, label in labels.items())
