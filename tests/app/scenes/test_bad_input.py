"""Tests that every broken scene is refused with one clear line that names the file."""

import json
import math
import sys

import numpy as np
import pytest
from helpers import refuses
from PIL import Image
from scene_files import rewrite, write_deep

from voronerf.app import files
from voronerf.app.scenes import SceneError, load_scene
from voronerf.app.scenes.images import read_image

NO_LIMIT = not hasattr(sys, "get_int_max_str_digits")  # of the digits of an integer
POSE = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 4], [0, 0, 0, 1]]
NOISE = np.random.default_rng(0).integers(0, 255, (6, 8, 3), dtype=np.uint8)


def write_noise(folder, count=3, **entries):
    """Writes a capture of noise images from one camera pose."""
    folder.mkdir(exist_ok=True)
    for index in range(count):
        Image.fromarray(NOISE).save(folder / f"{index}.png")
    frames = [{"file_path": f"{index}.png", "transform_matrix": POSE} for index in range(count)]
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 9.0, **entries, "frames": frames}))


def fails(folder, *parts, downscale=1):
    for part in parts:
        refuses(part, load_scene, folder, downscale=downscale, error=SceneError)


def test_folder(tmp_path):
    fails(tmp_path / "nowhere", "nowhere: there is no such folder")
    fails(tmp_path, "is not a scene", "transforms_train.json", "transforms.json")
    (tmp_path / "file").write_text("")
    fails(tmp_path / "file", "file: is not a folder")


def test_downscale(tmp_path):
    for downscale in (0, -2):
        fails("builtin", f"downscale must be >= 1, got {downscale}", downscale=downscale)
    fails("builtin", "leaves no pixel of 100 x 100", downscale=101)
    for size in ("0", "1601", "00400", "4e2", "-4"):
        fails(f"builtin:{size}", "size must be 1 to 1600 pixels")
    write_noise(tmp_path)
    fails(tmp_path, "1.png", "downscaling by 7 leaves no pixel of 8 x 6", downscale=7)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("{", "is not JSON"),
        (b"\xff\xfe\x00", "is not JSON"),
        ("\ufeff{}".encode("utf-16-le"), "transforms.json: is not JSON in UTF-8 but UTF-16 text; save it as UTF-8"),
        ("{}".encode("utf-16-be"), "transforms.json: is not JSON in UTF-8 but UTF-16 text; save it as UTF-8"),
        ("", "is not JSON"),
        ("[]", "has no frames"),
        ("{}", "has no frames"),
        ('{"frames": []}', "has no frames"),
        ('{"frames": [1]}', "frame 0 has no file_path"),
        ('{"frames": [{"file_path": 3}]}', "frame 0 has no file_path"),
        ('{"frames": [{"file_path": "a\\u0000"}]}', "frame 0 has no file_path"),
        ('{"frames": [{"file_path": "\\ud800.png"}]}', r"file_path must be text without surrogates, got '\ud800"),
        ('{"frames": [{"file_path": "x.png"}]}', "frame 0 (x.png): transform_matrix"),
        ("[" * 100_000, "is not JSON: it is nested too deeply"),
        pytest.param("9" * 5000, "is not JSON", id="digits", marks=pytest.mark.skipif(NO_LIMIT, reason="no limit")),
    ],
)
def test_json(tmp_path, text, reason):
    (tmp_path / "transforms.json").write_bytes(text if isinstance(text, bytes) else text.encode())
    fails(tmp_path, "transforms.json", reason)


def test_json_of_any_size(tmp_path, monkeypatch):
    write_noise(tmp_path)
    monkeypatch.setattr(files, "JSON_LIMIT", (tmp_path / "transforms.json").stat().st_size)
    assert len(load_scene(tmp_path).train) == 2
    rewrite(tmp_path, lambda contents: contents.update(more=[0]))
    fails(tmp_path, "transforms.json: must be at most", "MiB of JSON, got")


def edited(row, column, value):
    matrix = [list(line) for line in POSE]
    matrix[row][column] = value
    return matrix


@pytest.mark.parametrize(
    ("matrix", "reason"),
    [
        (edited(0, 0, 2.0), "is not a rotation"),
        (edited(0, 0, -1.0), "determinant -1"),
        (edited(0, 1, 0.1), "is not a rotation"),
        (edited(3, 3, 2.0), "last row must be 0 0 0 1"),
        (edited(0, 0, "one"), "not a matrix of numbers"),
        (POSE[:2], "must be 4 x 4, got shape [2, 4]"),
        ([[1, 2], [3]], "not a matrix of numbers"),
        *[(edited(0, 0, value), "not a matrix of numbers") for value in ("1.0", True)],
        (edited(2, 3, 1e30), "are not finite, or above 1e+09"),
        *[(edited(*at, 10**400), "is not a matrix of numbers") for at in ((0, 0), (1, 3))],
        *[(edited(*at, 1e300), "are not finite") for at in ((0, 0), (1, 3))],
    ],
    ids=range(14),
)
def test_pose(tmp_path, matrix, reason):
    write_noise(tmp_path)
    rewrite(tmp_path, lambda contents: contents["frames"][1].update(transform_matrix=matrix))
    fails(tmp_path, "transforms.json: frame 1 (1.png)", reason)


@pytest.mark.parametrize(
    ("matrix", "reason"),
    [
        (None, "not a matrix of numbers"),
        ("absent", "not a matrix of numbers"),
        (edited(1, 3, math.nan), "not finite"),
        (edited(1, 1, math.inf), "not finite"),
        (edited(1, 3, None), "not a matrix of numbers"),
    ],
)
def test_a_frame_without_a_pose_is_left_out_but_not_all_frames(tmp_path, matrix, reason):
    write_noise(tmp_path, count=4)

    def change(contents, count):
        for frame in contents["frames"][:count]:
            frame["transform_matrix"] = matrix
            if matrix == "absent":
                del frame["transform_matrix"]

    rewrite(tmp_path, lambda contents: change(contents, 2))
    (tmp_path / "0.png").unlink()
    scene = load_scene(tmp_path)
    assert (scene.test.names, scene.train.names) == (("2",), ("3",))
    assert "2 of 4 frames have no pose and are left out: 0.png, 1.png" in scene.notes
    rewrite(tmp_path, lambda contents: change(contents, 4))
    fails(tmp_path, "transforms.json: frame 0 (0.png): transform_matrix", reason)


def test_what_is_sound_loads(tmp_path):
    write_noise(tmp_path)
    assert len(load_scene(tmp_path).train) == 2
    rewrite(tmp_path, lambda contents: contents["frames"][1].update(transform_matrix=POSE[:3]))
    load_scene(tmp_path)


def test_images(tmp_path):
    write_noise(tmp_path)
    path, whole = tmp_path / "2.png", (tmp_path / "2.png").read_bytes()
    for broken, reason in (
        (b"no image at all", "is not an image"),
        (b"", "is not an image"),
        (whole[: len(whole) // 2], "cannot be read"),
        (whole[:50] + bytes(40) + whole[90:], "cannot be read"),
    ):
        path.write_bytes(broken)
        fails(tmp_path, f"2.png: {reason}")
    deep = np.random.default_rng(0).integers(0, 2**16, (6, 8, 4))
    write_deep(path, deep[..., :1])
    fails(tmp_path, "2.png: has grey values of more than 8 bits; write it with 8 bits a channel")
    for channels in (2, 4, 3):  # grey with alpha, RGBA, RGB
        write_deep(path, deep[..., :channels])
        assert np.array_equal(read_image(path, 1)[..., [0, -1]], deep[..., [0, channels - 1]] >> 8)
    assert "1 images have 16 bits a channel, of which the upper 8 are read: 2.png" in load_scene(tmp_path).notes
    for kind in ("EPS", "GIF", "TIFF", "PPM"):  # for EPS, Pillow starts Ghostscript
        with open(path, "wb") as file:
            Image.fromarray(NOISE).save(file, kind)
        fails(tmp_path, "2.png: is not an image in PNG or JPEG format")
    for index in range(3):
        (tmp_path / f"{index}.png").unlink()
    fails(tmp_path, "transforms.json: none of its 3 images exists, the first is", "0.png")
    Image.fromarray(NOISE).save(tmp_path / "1.webp")
    fails(tmp_path, f"0.png; mogrify -format png {tmp_path}/*.webp writes PNG files, which are found")
    write_noise(tmp_path, count=1)
    fails(tmp_path, "needs at least two images")


@pytest.mark.parametrize(
    ("entries", "reason"),
    [
        ({"fl_x": None}, "has no focal length (fl_x or camera_angle_x)"),
        ({"fl_x": 0}, "fl_x must be positive, got 0"),
        ({"fl_x": "9"}, "fl_x must be a finite number up to 1e+09, got '9'"),
        ({"fl_x": math.nan}, "fl_x must be a finite number up to 1e+09, got nan"),
        ({"cx": True}, "cx must be a finite number up to 1e+09, got True"),
        ({"fl_x": None, "camera_angle_x": 3.5}, "camera_angle_x must be an angle between 0 and pi, got 3.5"),
        ({"w": 16}, "says w = 16"),
        ({"w": 6, "h": 8}, "is 8 x 6 pixels, but"),
        ({"w": 1920, "h": 1080}, "says w = 1920 and h = 1080: it was cropped or has another aspect ratio; use the"),
        ({"h": 8}, "says h = 8"),
        ({"k4": 0.1}, "lens distortion k4 is not supported, only k1, k2, k3, p1, p2"),
        ({"is_fisheye": True, "p1": 0.1}, "lens distortion p1 is not supported, only k1, k2, k3, k4 of a fisheye"),
        ({"camera_model": "EQUIRECTANGULAR"}, "an EQUIRECTANGULAR image must be 2 to 1, got 8 x 6 pixels"),
        ({"camera_model": "EQUIRECTANGULAR", "k1": 0.1}, "k1 is not supported, there is none of an EQUIRECTANGULAR"),
        ({"camera_model": "SPHERE"}, "camera model SPHERE is not supported, only PINHOLE"),
        ({"k1": -5.0}, "gives a ray to 8% of its pixels, at least 25% must have one; check its focal length"),
        ({"latlong": True}, "an EQUIRECTANGULAR image must be 2 to 1, got 8 x 6 pixels"),
        *[({key: True}, f"{key} is not supported, only") for key in ("orthographic", "from_mitsuba")],
        ({"ftheta_p0": 0.0, "ftheta_p1": 0.1}, "ftheta_p1 is not supported, only lenses that are PINHOLE"),
        ({"fisheye_crop_radius": "9"}, "fisheye_crop_radius must be a finite number up to 1e+09, got '9'"),
        ({"fisheye_crop_radius": 0.2}, "png: its mask and its lens exclude all pixels"),
        ({"applied_scale": 0}, "applied_scale must be positive, got 0"),
        ({"applied_scale": [1, 1, 1]}, "applied_scale must be a finite number up to 1e+09, got [1, 1, 1]"),
        ({"k1": math.inf}, "k1 must be a finite number up to 1e+09, got inf"),
        ({"k1": 10**400}, "k1 must be a finite number up to 1e+09, got 1000"),
        ({"fl_x": -(10**400)}, "fl_x must be a finite number up to 1e+09, got -1000"),
        ({"fl_x": 1e38}, "fl_x must be a finite number up to 1e+09, got 1e+38"),
        ({"fl_x": 1e7}, "fl_x must give a focal length of 0.001 to 1000 times the 8 pixels of the image, got 1e+07"),
        ({"fl_x": None, "camera_angle_x": 1e-300}, "camera_angle_x must be positive, got 1e-300"),
        ({"fl_x": None, "camera_angle_x": 1e-5}, "camera_angle_x must give a focal length of 0.001 to 1000 times"),
        ({"distortion_params": [0.1, 0, 0, 0]}, "_params must be six numbers, k1, k2, k3, k4, p1, p2, got [0.1"),
        ({"distortion_params": [0, 0, 0, 0.1, 0, 0]}, "lens distortion k4 is not supported"),
        ({"distortion_params": ["0"] * 6}, "k4 must be a finite number up to 1e+09, got '0'"),
        ({"test_filenames": "0.png"}, "test_filenames must be a list of file names, got '0.png'"),
        ({"test_filenames": ["9.png"]}, "test_filenames lists 9.png, but no frame has this file_path"),
        ({"train_filenames": ["0.png"], "test_filenames": ["./0.png"]}, "must differ, both have 0.png"),
        ({"train_filenames": ["0.png", "1.png", "2.png"]}, "leave no image for testing"),
        ({"test_filenames": ["0.png", "1.png", "2.png"]}, "leave no image for training"),
    ],
)
def test_intrinsics_and_lens(tmp_path, entries, reason):
    write_noise(tmp_path, **entries)
    fails(tmp_path, reason)


def test_blender(tmp_path):
    write_noise(tmp_path)
    contents = json.loads((tmp_path / "transforms.json").read_text())
    (tmp_path / "transforms.json").unlink()
    del contents["fl_x"]
    for entries, reason in (
        ({}, "transforms_train.json: camera_angle_x must be an angle between 0 and pi, got None"),
        ({"camera_angle_x": 0.7, "near": 9}, "near must be below far, got 9.0 and 6.0"),
        ({"camera_angle_x": 0.7, "far": 1e38}, "far must be a finite number up to 1e+09, got 1e+38"),
        ({"camera_angle_x": 1e-5}, "transforms_train.json: camera_angle_x must give a focal length of 0.001 to 1000"),
        ({"fl_x": 9.0, "k4": 0.1}, "lens distortion k4 is not supported"),
    ):
        for name in ("train", "test"):
            (tmp_path / f"transforms_{name}.json").write_text(json.dumps(contents | entries))
        fails(tmp_path, reason)


@pytest.mark.parametrize("suffix", ["webp", "tif", "BMP"])
def test_images_in_other_formats_have_a_remedy_that_works(tmp_path, suffix):
    """The error for a format that is not read names the command that converts the images, which are found then."""
    folder = tmp_path / "a scene"
    write_noise(folder)
    for index in range(3):
        Image.fromarray(NOISE).save(folder / f"{index}.{suffix}")
        (folder / f"{index}.png").unlink()

    def change(contents):
        for frame in contents["frames"]:
            frame["file_path"] = frame["file_path"].replace("png", suffix)

    rewrite(folder, change)
    fails(folder, f".{suffix}: is not an image in PNG or JPEG format; mogrify -format png '{folder}'/*.{suffix} writes")
    for index in range(3):
        Image.fromarray(NOISE).save(folder / f"{index}.png")
    assert load_scene(folder).train.names == ("1", "2")


@pytest.mark.parametrize("kind", ["above", "absolute", "link", "linked folder", "suffix", "backslash"])
def test_images_outside_of_the_folder(tmp_path, kind):
    scene, elsewhere = tmp_path / "scene", tmp_path / "elsewhere"
    write_noise(scene)
    elsewhere.mkdir()
    (scene / "1.png").rename(elsewhere / "1.png")
    if kind == "link":
        (scene / "1.png").symlink_to(elsewhere / "1.png")
    elif kind == "linked folder":
        (scene / "images").symlink_to(elsewhere)
    elif kind == "suffix":
        (scene / "1.JPG").symlink_to(elsewhere / "1.png")
    named = {"above": "a/../../elsewhere/1.png", "absolute": str(elsewhere / "1.png"), "linked folder": "images/1.png"}
    named |= {"backslash": "..\\elsewhere\\1.png", "suffix": "1"}
    name = named.get(kind, "1.png")
    (scene / "a").mkdir()
    rewrite(scene, lambda contents: contents["frames"][1].update(file_path=name))
    fails(scene, f"transforms.json: frame 1 ({name}): file_path: must lie in the folder of the scene")
    assert len(load_scene(scene, allow_outside=True).train.names) == 2
    (tmp_path / "link").symlink_to(scene)  # the scene folder itself may be a link
    (scene / "1.JPG").unlink(missing_ok=True)
    (scene / "1.png").unlink(missing_ok=True)
    (elsewhere / "1.png").rename(scene / "1.png")
    rewrite(scene, lambda contents: contents["frames"][1].update(file_path="1.png"))
    load_scene(tmp_path / "link")
