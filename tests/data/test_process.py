"""`voronerf process`, with a COLMAP program that writes a known model."""

import shutil
import stat
import sys

import numpy as np
import pytest
import torch
from helpers import refuses
from scene_files import write_colmap, write_images

from voronerf.data import SceneError, load_scene
from voronerf.data.process import process
from voronerf.evaluation.video import write_video
from voronerf.rendering.cameras import orbit_cameras

POSES = orbit_cameras(5, radius=4, elevation=20, width=12, height=10, focal=20).poses


@pytest.fixture
def colmap(tmp_path, monkeypatch):
    """A program that notes how it is called, and as a mapper gives a model of one image and a model of five."""
    for name, count in (("small", 1), ("whole", 5)):
        points = np.random.default_rng(0).normal(size=(30, 3))
        write_colmap(tmp_path / name, POSES[:count], [(12, 10)] * count, points)
    program = tmp_path / "bin/colmap"
    program.parent.mkdir()
    program.write_text(f"""#!{sys.executable}
import shutil, sys
open({str(tmp_path / "calls")!r}, "a").write(" ".join(sys.argv[1:]) + "\\n")
if sys.argv[1] == "mapper":
    for number, name in enumerate(("small", "whole")):
        shutil.copytree(f"{tmp_path}/{{name}}/sparse/0", f"{{sys.argv[-1]}}/{{number}}")
""")
    program.chmod(program.stat().st_mode | stat.S_IEXEC)
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    monkeypatch.setenv("PATH", str(program.parent))
    return tmp_path / "calls"


def test_images_become_a_scene(tmp_path, colmap):
    write_images(tmp_path, [(12, 10)] * 5)
    said = []
    process(tmp_path / "images", tmp_path / "out", say=said.append)
    steps = [line.split()[0] for line in colmap.read_text().splitlines()]
    assert steps == ["feature_extractor", "exhaustive_matcher", "mapper"]
    assert "--ImageReader.camera_model OPENCV --ImageReader.single_camera 1" in colmap.read_text()
    assert "cameras of 5 of 5 images" in said[-1]
    assert len(load_scene(tmp_path / "out").train) == 4  # of the larger model
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["images", "sparse"]
    refuses("out: must not exist yet", process, tmp_path / "images", tmp_path / "out", error=SceneError)


def test_a_video_becomes_a_scene(tmp_path, colmap):
    shades = torch.arange(20, dtype=torch.uint8).mul(10)[:, None, None, None].expand(20, 10, 12, 3)
    write_video(tmp_path / "a.mp4", shades.repeat(1, 4, 4, 1), 10)
    process(tmp_path / "a.mp4", tmp_path / "out", frames=5, say=lambda line: None)
    assert len(list((tmp_path / "out/images").iterdir())) == 5
    assert "sequential_matcher" in colmap.read_text()


def test_what_cannot_become_a_scene_is_one_line_and_leaves_nothing(tmp_path, colmap, monkeypatch):
    write_images(tmp_path, [(12, 10)] * 2)
    (tmp_path / "text.mp4").write_text("no video")
    (tmp_path / "list.mp4").write_text(f"ffconcat version 1.0\nfile {tmp_path}/images/00.jpg\n")
    before = sorted(tmp_path.iterdir())
    for source, reason in (
        ("nowhere", "there is no such video or folder"),
        ("text.mp4", "text.mp4: is no video in a container that is read"),
        ("list.mp4", "list.mp4: is no video in a container that is read"),
        ("images", "must have at least 3 images, got 2"),
    ):
        refuses(reason, process, tmp_path / source, tmp_path / "out", error=SceneError)
    assert sorted(tmp_path.iterdir()) == before
    monkeypatch.setenv("PATH", str(tmp_path))
    assert shutil.which("colmap") is None
    refuses("pip install pycolmap", process, tmp_path / "images", tmp_path / "out", error=ImportError)
