"""Tests of `voronerf train` on pictures without cameras: cameras, training, video and page in one command."""

import shutil
import sys

import pytest
from cli_commands import TINY, words
from PIL import Image
from scene_files import write_walls

from voronerf.app.cli import main, process
from voronerf.app.files import read_json
from voronerf.nerf import orbit_cameras

SMALL = f"{TINY.replace('--downscale 6', '--downscale 8')} --process-max-features 300"


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures") / "walls"
    folder.mkdir()
    write_walls(folder, orbit_cameras(40, radius=4.0, elevation=35.0, width=240, height=180, focal=200.0)[:8])
    return folder


def trains(*parts):
    return main(words("train", *parts, SMALL))


def test_pictures_become_a_run_with_a_video_and_a_page(tmp_path, monkeypatch, capsys, pictures, fails):
    pytest.importorskip("pycolmap", reason="voronerf process needs pycolmap")
    monkeypatch.chdir(tmp_path)
    shutil.copytree(pictures, "walls/inner")
    stages, make = [], process.make_scene

    def stopped(*sources, progress, **options):
        def stop(stage, *now):
            stages.append(stage)
            if stage == "matches":
                raise KeyboardInterrupt
            progress(stage, *now)

        make(*sources, progress=stop, **options)

    monkeypatch.setattr(process, "make_scene", stopped)
    assert trains("--data walls") == 130
    assert "stopped; continue with the same command" in capsys.readouterr().out
    assert not list((tmp_path / "runs/walls").rglob("checkpoints"))
    monkeypatch.setattr(process, "make_scene", make)
    assert trains("--data walls") == 0  # continues in the same run
    said = " ".join(capsys.readouterr().out.split())
    assert said.startswith("8 images with one camera; runs/walls/capture/colmap keeps COLMAP's results")
    assert "wrote runs/walls/capture: cameras of 8 of 8 images" in said
    run = tmp_path / "runs/walls"
    assert {path.name for path in run.iterdir()} >= {"capture", "checkpoints", "video.mp4", "scene.html", "images"}
    assert read_json(run / "config.json")["data"] == "runs/walls/capture"
    assert read_json(run / "scene.json")["name"] == "walls"
    assert trains("--data walls --steps 1") == 0 and (tmp_path / "runs/walls-2/video.mp4").is_file()  # a new run
    fails(
        "--out must not hold a run already, got runs/walls: continue it with --resume",
        "train --data walls --out runs/walls",
    )


def test_a_capture_of_other_pictures_is_not_trained(tmp_path, monkeypatch, pictures, fails):
    pytest.importorskip("pycolmap", reason="voronerf process needs pycolmap")
    monkeypatch.chdir(tmp_path)
    shutil.copytree(pictures, "first")
    # A training that fails after its cameras are found.
    fails("leaves no pixel", "train --data first --out run --downscale 1000 --process-max-features 300")
    shutil.copytree(pictures, "second")
    fails("was started with --source", "train --data second --out run --explain --process-max-features 300")
    fails(
        "was started with --process-max-features 300, got 400",
        "train --data first --out run --explain --process-max-features 400",
    )
    for content in ("{", "{}"):  # the record of another run
        (tmp_path / "runs/first/capture/colmap").mkdir(parents=True, exist_ok=True)
        (tmp_path / "runs/first/capture/colmap/settings.json").write_text(content)
        fails("leaves no pixel", "train --data first --downscale 1000 --process-max-features 300")
    fails("did you mean run/capture?", "train --data run/capture/images")


def test_without_cameras_nothing_is_left(tmp_path, monkeypatch, fails):
    pytest.importorskip("pycolmap", reason="voronerf process needs pycolmap")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    Image.new("RGB", (32, 32)).save("photos/0.jpg")
    fails("photos: must have at least 3 images, got 1", "train --data photos")
    (tmp_path / "walk.mp4").write_bytes(b"no video")
    fails("walk.mp4: must be a video in a supported container", "train --data walk.mp4 --out walk")
    assert not list((tmp_path / "runs").iterdir()) and not (tmp_path / "walk").exists()
    fails(
        "--process-matching must be auto, exhaustive or sequential, got 'all'",
        "train --data photos --process-matching all",
    )
    fails("did you mean --process-frames?", "train --data photos --process-frame 3")


def test_lines_name_the_options_of_the_command():
    with process.prefixed_options(process.AS_IN_PROCESS) as renamed:
        assert renamed("fewer than --frames 150 (--budget)") == "fewer than --process-frames 150 (--budget)"
    with process.prefixed_options(process.ProcessSettings()) as renamed:
        assert renamed("fewer than --frames 150") == "fewer than --frames 150"


def test_one_line_names_what_is_missing(tmp_path, monkeypatch, pictures, fails):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    fails("finding cameras needs pycolmap: pip install 'voronerf[colmap]'", "train --out run --data", pictures)
