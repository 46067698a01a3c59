"""Tests of `voronerf process` that continues in a folder that is damaged or another person's."""

import contextlib
import io
import json
import os
import shutil
import sqlite3
import sys

import numpy as np
import pytest
from helpers import refuses
from PIL import Image
from scene_files import write_walls

from voronerf.app.scenes import SceneError, process
from voronerf.app.scenes.results import read_pairs
from voronerf.nerf.cameras import orbit_cameras

pycolmap = pytest.importorskip("pycolmap", reason="voronerf process needs pycolmap")
OPTIONS = {"max_features": 300, "mapper": "global"}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Photographs in `walls`, and the folder `out` of a process that stopped before it wrote `sparse`."""
    folder = tmp_path_factory.mktemp("process")
    write_walls(folder / "walls", orbit_cameras(40, radius=4, elevation=35, width=240, height=180, focal=200)[:8])
    (folder / "walls/masks").mkdir()
    Image.new("L", (240, 180), 255).save(folder / "walls/masks/00 a.png")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(process, "FEW_IMAGES", 4)  # pairs are chosen by the largest features
        process.process(folder / "walls", folder / "out", **OPTIONS)
    shutil.rmtree(folder / "out/sparse")
    return folder


@pytest.fixture
def stopped(finished, tmp_path):
    """A copy of the folder, which a test may change."""
    return shutil.copytree(finished / "out", tmp_path / "out")


@pytest.fixture
def resumed(finished, stopped, monkeypatch):
    """Returns a function that continues the process, and returns what it says."""
    monkeypatch.setattr(process, "FEW_IMAGES", 4)

    def resume():
        said = []
        process.process(finished / "walls", stopped, say=said.append, **OPTIONS)
        return said

    return resume


@pytest.mark.skipif(sys.platform == "win32", reason="links need a privilege")
@pytest.mark.parametrize(
    "name",
    ["colmap", "colmap/database.db", "colmap/tried.db", "colmap/global", "images", "masks", "sparse", ".images_2"],
)
def test_links_out_of_the_folder_are_not_followed(stopped, resumed, tmp_path, name):
    outside, there = tmp_path / "outside", stopped / name
    if there.exists():
        there.rename(outside)
    there.symlink_to(outside)
    before = {path: path.lstat().st_mtime_ns for path in tmp_path.rglob("*")}
    refuses(f"{there}: must be a file or a folder in {stopped}, got a link", resumed, error=SceneError)
    assert before == {path: path.lstat().st_mtime_ns for path in tmp_path.rglob("*")}


@pytest.mark.skipif(sys.platform == "win32", reason="has no named pipes")
def test_pipes_are_not_read(stopped, resumed):
    os.mkfifo(stopped / "colmap/log.pipe")
    refuses("log.pipe: must be a file or a folder in", resumed, error=SceneError)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[]", "must be an object, got []"),
        ("7", "must be an object, got 7"),
        ("[" * 100_000, "is not JSON: it is nested too deeply"),
        ("\0", "is not JSON: "),
        ("{}", "was started with --source None, got "),
        (json.dumps({"source": "x" * 10_000}), f"was started with --source {60 * 'x'}, got "),
    ],
    ids=range(6),
)
def test_settings(stopped, resumed, content, message):
    (stopped / "colmap/settings.json").write_text(content)
    refuses(message, resumed, error=SceneError)


def test_pairs(stopped, resumed):
    path, names = stopped / "colmap/pairs.json", [path.name for path in (stopped / "images").iterdir()]
    assert len(read_pairs(path, names)) > 8
    for content in ('{"a": 1}', "[3]", '[["00_a.png"]]', '[["00_a.png", 3]]', '[["00_a.png", []]]', "["):
        path.write_text(content)
        refuses(f"{path}: ", read_pairs, path, names, error=SceneError)
    path.write_text('[["00_a.png", "../x"]]')
    refuses(f"{path}: must have pairs of names of images, got ['00_a.png', '../x']", resumed, error=SceneError)


#: Changes of the database by SQL, and the error messages. Without checks, some of them end COLMAP by a signal.
CHANGES = {
    "DELETE FROM two_view_geometries; UPDATE matches SET data = randomblob(8 * rows) WHERE rows": "matches must be of",
    "UPDATE two_view_geometries SET data = randomblob(8 * rows) WHERE rows": "matches must be of features of two",
    "UPDATE two_view_geometries SET pair_id = pair_id + 777777777777": "matches must be of features of two images",
    "UPDATE two_view_geometries SET rows = -5": "two_view_geometries must have whole matrices, got (-5, 2) rows and",
    "UPDATE matches SET rows = -9223372036854775808": "matches must have whole matrices, got (-9223372036854775808, 2)",
    "UPDATE matches SET rows = rows + 1000": "matches must have whole matrices, got",
    "UPDATE matches SET cols = 0": "matches must have whole matrices, got",
    "UPDATE two_view_geometries SET cols = 1": "two_view_geometries must have whole matrices, got",
    "UPDATE keypoints SET data = randomblob(4 * rows * cols)": "must have finite features in the image",
    "UPDATE keypoints SET data = NULL": "keypoints must have whole matrices, got",
    "UPDATE keypoints SET rows = 'text'": "keypoints must have whole matrices, got ('text', 6)",
    "UPDATE keypoints SET rows = 5, data = substr(data, 1, 5 * 4 * cols)": "must have a descriptor of each feature",
    "UPDATE descriptors SET cols = 64, data = substr(data, 1, 64 * rows)": "descriptors must have whole matrices, got",
    "UPDATE images SET name = '../x' WHERE image_id = 1": "image '../x' must be in the folder of images",
    "UPDATE images SET camera_id = 77": "must have a camera in a rig",
    "DELETE FROM rigs": "must have a camera in a rig",
    "DELETE FROM frame_data": "must have a camera in a rig",
    "UPDATE frames SET rig_id = 4294967295": "database.db: ",
    "UPDATE cameras SET model = 99": "database.db: ",
}


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [("database", *change) for change in CHANGES.items()] + [("few", *list(CHANGES.items())[n]) for n in (1, -1)],
    ids=range(len(CHANGES) + 2),
)
def test_databases(stopped, resumed, name, change, message):
    shutil.rmtree(stopped / "colmap/global")
    (stopped / "colmap/pairs.json").unlink()
    with contextlib.closing(sqlite3.connect(stopped / f"colmap/{name}.db")) as opened:
        opened.executescript(change)
    refuses(f"{name}.db: " if message == "database.db: " else message, resumed, error=SceneError)


@pytest.mark.parametrize("size", [0, 5000, 40_000])
def test_damaged_databases(stopped, resumed, size):
    path = stopped / "colmap/database.db"
    data = path.read_bytes()
    path.write_bytes(np.random.default_rng(0).bytes(size) if size < 9000 else data[:size] + bytes(4096) + data[size:])
    if size:
        refuses(f"{path}: ", resumed, error=SceneError)
    else:  # an empty file is an empty database
        assert resumed()[-1].startswith("wrote ")


def test_files_of_rigs_are_not_read(stopped, resumed):
    for name in ("rigs", "frames"):
        (stopped / f"colmap/global/0/{name}.bin").write_bytes(b"\xff" * 999)
    assert resumed()[-1].startswith(f"wrote {stopped}: cameras of 8 of 8 images")


@pytest.mark.parametrize(
    ("file", "change"),
    [
        ("images", lambda data: data.replace(b"01_a.png", b"02_a.png")),
        ("images", lambda data: data.replace(b"01_a.png", b"../../xy")),
        ("points3D", lambda data: data[: 8 + 51] + b"\x77" * 4 + data[8 + 55 :]),  # the image of an observation
    ],
)
def test_a_model_of_other_images_is_no_model(stopped, resumed, file, change):
    path = stopped / f"colmap/global/0/{file}.bin"
    path.write_bytes(change(path.read_bytes()))
    refuses("finds no model", resumed, error=SceneError)


def test_masks(stopped, resumed):
    eps = io.BytesIO()
    Image.new("L", (240, 180)).save(eps, "EPS")
    stored, ours = stopped / "colmap/masks/00_a.png.png", stopped / "masks/00_a.png.png"
    whole = stored.read_bytes()
    stored.write_bytes(eps.getvalue())  # Pillow would start a program to read it
    refuses(f"{stored}: is not an image in PNG or JPEG format", resumed, error=SceneError)
    Image.new("L", (9, 9)).save(stored)
    refuses(f"{stored}: must have as many pixels as 00_a.png", resumed, error=SceneError)
    shutil.rmtree(stored.parent)
    ours.write_bytes(eps.getvalue())
    refuses(f"{ours}: cannot be read", resumed, error=SceneError)
    Image.new("L", (9, 9)).save(ours)
    refuses(f"{ours}: is 9 x 9 pixels, 00_a.png is 240 x 180", resumed, error=SceneError)
    ours.write_bytes(whole)
    assert resumed()[-1].startswith("wrote ")
