"""Every broken scene is one clear line that names the file."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from voronerf.data import SceneError, load_scene

POSE = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 4], [0, 0, 0, 1]]


def frame(name: str, matrix: Any = POSE, **entries: Any) -> dict[str, Any]:
    return {"file_path": name, "transform_matrix": matrix, **entries}


def write_capture(folder: Path, count: int = 3, **entries: Any) -> dict[str, Any]:
    """A capture of noise images; returns the contents of its transforms.json."""
    folder.mkdir(exist_ok=True)
    noise = np.random.default_rng(0).integers(0, 255, (6, 8, 3), dtype=np.uint8)
    for index in range(count):
        Image.fromarray(noise).save(folder / f"{index}.png")
    contents = {"fl_x": 9.0, **entries, "frames": [frame(f"{index}.png") for index in range(count)]}
    (folder / "transforms.json").write_text(json.dumps(contents))
    return contents


def rewrite(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = folder / "transforms.json"
    contents = json.loads(path.read_text())
    change(contents)
    path.write_text(json.dumps(contents))


def fails(folder: Path | str, *parts: str, downscale: int = 1) -> None:
    with pytest.raises(SceneError) as caught:
        load_scene(folder, downscale=downscale)
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message, message


def test_a_good_capture_loads(tmp_path: Path) -> None:
    write_capture(tmp_path / "c")
    assert len(load_scene(tmp_path / "c").train) == 2


def test_folder(tmp_path: Path) -> None:
    fails(tmp_path / "nowhere", "nowhere: there is no such folder")
    fails(tmp_path, "is no scene", "transforms_train.json", "transforms.json")
    (tmp_path / "file").write_text("")
    fails(tmp_path / "file", "file: is no folder")


@pytest.mark.parametrize("downscale", [0, -2])
def test_downscale_below_one(downscale: int) -> None:
    fails("builtin", f"downscale must be >= 1, got {downscale}", downscale=downscale)


def test_downscale_leaves_no_pixel(tmp_path: Path) -> None:
    fails("builtin", "leaves no pixel of 100 x 100", downscale=101)
    write_capture(tmp_path)
    fails(tmp_path, "0.png", "downscaling by 7 leaves no pixel of 8 x 6", downscale=7)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("{", "is no JSON"),
        ("", "is no JSON"),
        ("[]", "has no frames"),
        ("{}", "has no frames"),
        ('{"frames": []}', "has no frames"),
        ('{"frames": [1]}', "frame 0 has no file_path"),
        ('{"frames": [{"file_path": 3}]}', "frame 0 has no file_path"),
        ('{"frames": [{"file_path": "a\\u0000"}]}', "frame 0 has no file_path"),
        ('{"frames": [{"file_path": "x.png"}]}', "frame 0 (x.png): transform_matrix"),
    ],
)
def test_json(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "transforms.json").write_text(text)
    fails(tmp_path, "transforms.json", reason)


def test_json_that_is_no_text(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_bytes(b"\xff\xfe\x00")
    fails(tmp_path, "transforms.json: is no JSON")


def edited(row: int, column: int, value: Any) -> list[list[Any]]:
    matrix = [list(line) for line in POSE]
    matrix[row][column] = value
    return matrix


@pytest.mark.parametrize(
    ("matrix", "reason"),
    [
        (edited(0, 0, 2.0), "is no rotation"),
        (edited(0, 0, -1.0), "determinant -1"),
        (edited(0, 1, 0.1), "is no rotation"),
        (edited(1, 3, math.nan), "not finite"),
        (edited(1, 1, math.inf), "not finite"),
        (edited(3, 3, 2.0), "last row must be 0 0 0 1"),
        (edited(0, 0, "one"), "no matrix of numbers"),
        (POSE[:2], "must be 4 x 4, got shape [2, 4]"),
        ([[1, 2], [3]], "no matrix of numbers"),
        (None, "must be 4 x 4"),
    ],
)
def test_pose(tmp_path: Path, matrix: Any, reason: str) -> None:
    write_capture(tmp_path)
    rewrite(tmp_path, lambda contents: contents["frames"][1].update(transform_matrix=matrix))
    fails(tmp_path, "transforms.json: frame 1 (1.png)", reason)


def test_pose_of_three_rows_is_fine(tmp_path: Path) -> None:
    write_capture(tmp_path)
    rewrite(tmp_path, lambda contents: contents["frames"][1].update(transform_matrix=POSE[:3]))
    load_scene(tmp_path)


def test_images(tmp_path: Path) -> None:
    write_capture(tmp_path)
    (tmp_path / "1.png").write_bytes(b"no image at all")
    fails(tmp_path, "1.png: is no image")
    write_capture(tmp_path)
    whole = (tmp_path / "2.png").read_bytes()
    (tmp_path / "2.png").write_bytes(whole[: len(whole) // 2])
    fails(tmp_path, "2.png: cannot be read")
    (tmp_path / "2.png").write_bytes(whole[:50] + bytes(40) + whole[90:])
    fails(tmp_path, "2.png: cannot be read")
    (tmp_path / "2.png").write_bytes(b"")
    fails(tmp_path, "2.png: is no image")
    Image.fromarray(np.zeros((5, 8, 3), dtype=np.uint8)).save(tmp_path / "2.png")
    fails(tmp_path, "2.png: is 8 x 5 pixels", "0.png is 8 x 6", "same size")
    Image.fromarray(np.zeros((6, 8), dtype=np.uint16)).save(tmp_path / "2.png")
    fails(tmp_path, "2.png: has more than 8 bits a channel")


def test_missing_images(tmp_path: Path) -> None:
    write_capture(tmp_path)
    for index in range(3):
        (tmp_path / f"{index}.png").unlink()
    fails(tmp_path, "transforms.json: none of its 3 images exists, the first is", "0.png")


def test_one_image_is_too_few(tmp_path: Path) -> None:
    write_capture(tmp_path, count=1)
    fails(tmp_path, "one image is too few")


@pytest.mark.parametrize(
    ("entries", "reason"),
    [
        ({"fl_x": None}, "has no focal length (fl_x or camera_angle_x)"),
        ({"fl_x": 0}, "fl_x must be positive, got 0"),
        ({"fl_x": "9"}, "fl_x must be a finite number, got '9'"),
        ({"fl_x": math.nan}, "fl_x must be a finite number, got nan"),
        ({"cx": True}, "cx must be a finite number, got True"),
        ({"fl_x": None, "camera_angle_x": 3.5}, "camera_angle_x must be an angle between 0 and pi, got 3.5"),
        ({"w": 16}, "says w = 16"),
        ({"h": 8}, "says h = 8"),
        ({"k3": 0.1}, "lens distortion k3 is not supported, only k1, k2, p1, p2"),
        ({"camera_model": "OPENCV_FISHEYE"}, "camera model OPENCV_FISHEYE is not supported"),
        ({"is_fisheye": True}, "camera model fisheye is not supported"),
        ({"k1": -5.0}, "cannot be inverted inside the image"),
        ({"k1": math.inf}, "k1 must be a finite number, got inf"),
        ({"k1": 10**400}, "k1 must be a finite number, got 1000"),
        ({"fl_x": -(10**400)}, "fl_x must be a finite number, got -1000"),
        ({"cy": 1e39}, "cy must be a finite number, got 1e+39"),
    ],
)
def test_intrinsics_and_lens(tmp_path: Path, entries: dict[str, Any], reason: str) -> None:
    write_capture(tmp_path, **entries)
    fails(tmp_path, reason)


@pytest.mark.parametrize(
    ("value", "reason"), [(10**400, "is no matrix of numbers"), (1e300, "are not finite")], ids=["int", "float"]
)
def test_poses_of_huge_numbers(tmp_path: Path, value: float, reason: str) -> None:
    write_capture(tmp_path)
    for row, column in ((0, 0), (1, 3)):
        matrix = [list(values) for values in POSE]
        matrix[row][column] = value
        rewrite(tmp_path, lambda c, matrix=matrix: c["frames"].__setitem__(1, frame("1.png", matrix)))
        fails(tmp_path, "frame 1 (1.png)", reason)


@pytest.mark.skipif(not hasattr(sys, "get_int_max_str_digits"), reason="this Python reads integers of any length")
def test_more_digits_than_python_reads(tmp_path: Path) -> None:
    write_capture(tmp_path, k1=0)
    path = tmp_path / "transforms.json"
    path.write_text(path.read_text().replace('"k1": 0', '"k1": 1' + "0" * sys.get_int_max_str_digits()))
    fails(tmp_path, "transforms.json: is no JSON")


def test_blender(tmp_path: Path) -> None:
    write_capture(tmp_path)
    contents = json.loads((tmp_path / "transforms.json").read_text())
    (tmp_path / "transforms.json").rename(tmp_path / "transforms_train.json")
    fails(tmp_path, "neither transforms_test.json nor transforms_val.json")
    del contents["fl_x"]
    for name in ("train", "test"):
        (tmp_path / f"transforms_{name}.json").write_text(json.dumps(contents))
    fails(tmp_path, "transforms_train.json: camera_angle_x must be an angle between 0 and pi, got None")
    for name in ("train", "test"):
        (tmp_path / f"transforms_{name}.json").write_text(json.dumps({**contents, "camera_angle_x": 0.7, "near": 9}))
    fails(tmp_path, "near must be below far, got 9.0 and 6.0")
    for name in ("train", "test"):
        (tmp_path / f"transforms_{name}.json").write_text(json.dumps({**contents, "fl_x": 9.0, "k4": 0.1}))
    fails(tmp_path, "lens distortion k4 is not supported")
