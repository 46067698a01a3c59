"""The command line as a user meets it: commands, files, and one line for everything that can go wrong."""

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import imageio_ffmpeg
import pytest
from PIL import Image

from voronerf.cli import main

TINY = [
    "--downscale", "6", "--steps", "16", "--cells", "3", "--split-at", "0.5", "--width", "8", "--depth", "2",
    "--rays", "64", "--samples", "8", "--evaluations", "2", "--eval-views", "2", "--final-views", "2", "--panels", "1",
]  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "tiny"
    assert main(["train", "--data", "builtin", "--out", str(out), *TINY]) == 0
    return out


def error_of(capsys, *args):
    """The single line that a failing command prints; its exit status must not be 0."""
    assert main(list(args)) != 0
    text = capsys.readouterr().err
    assert text.startswith("voronerf: error: ") and text.count("\n") == 1, text
    return text


def test_train_writes_the_run_directory(run):
    names = {str(p.relative_to(run)) for p in run.rglob("*") if p.is_file()}
    assert {"config.json", "metrics.jsonl", "summary.json", "checkpoints/last.safetensors", "plots/psnr.png"} <= names
    panels = list((run / "images").glob("*.png"))
    assert len(panels) == 1
    width, height = Image.open(panels[0]).size
    assert width >= 5 * 16 and height >= 16
    summary = json.loads((run / "summary.json").read_text())
    assert {"psnr", "ssim", "seconds", "steps", "rays_per_second", "parameters", "stages"} <= summary.keys()


def test_eval_scores_every_view(run, capsys):
    assert main(["eval", str(run), "--views", "3", "--panels", "2"]) == 0
    result = json.loads((run / "eval.json").read_text())
    assert len(result["views"]) == 3
    assert result["psnr"] == pytest.approx(sum(v["psnr"] for v in result["views"]) / 3)
    output = capsys.readouterr().out
    assert all(v["name"] in output for v in result["views"])
    assert result["lpips"] is None and result["psnr_of_mean_error"] <= result["psnr"]
    assert "LPIPS is not computed, images of 16 x 16 are below AlexNet's smallest, 31 x 31" in " ".join(output.split())
    assert "--lpips must be off or come with larger images" in error_of(capsys, "eval", str(run), "--lpips", str(run))
    assert "nowhere: there is no such file or folder" in error_of(capsys, "eval", str(run), "--lpips", "nowhere")


def test_render_makes_a_video(run, tmp_path):
    path = tmp_path / "turn.mp4"
    assert main(["render", str(run), "--frames", "3", "--samples", "4", "--out", str(path)]) == 0
    frames = imageio_ffmpeg.read_frames(str(path))
    assert next(frames)["size"] == (16, 16)
    assert len(list(frames)) == 3


def test_pictures_through_an_occupancy_grid(run, tmp_path):
    assert main(["eval", str(run), "--views", "1", "--panels", "0", "--occupancy"]) == 0
    path = tmp_path / "turn.mp4"
    assert main(["render", str(run), "--frames", "2", "--out", str(path), "--occupancy"]) == 0
    assert path.stat().st_size > 0


def test_pictures_of_blended_cells(run, capsys, tmp_path):
    found = []
    for blend in ("0", "0.3"):
        assert main(["eval", str(run), "--views", "1", "--panels", "1", "--blend", blend]) == 0
        found.append(json.loads((run / "eval.json").read_text())["psnr"])
    assert found[0] != found[1]
    path = tmp_path / "turn.mp4"
    assert main(["render", str(run), "--frames", "2", "--out", str(path), "--blend", "0.3"]) == 0
    assert path.stat().st_size > 0
    capsys.readouterr()
    assert "--blend must be a distance of 0 or more, got -1.0" in error_of(capsys, "eval", str(run), "--blend", "-1")


def test_info_names_every_backend(capsys):
    assert main(["info"]) == 0
    output = capsys.readouterr().out
    for word in ("torch", "reference", "native", "warp", "nearest_centre", "grouped_mlp", "resample"):
        assert word in output


@pytest.mark.warp
def test_preload_compiles_into_the_cache_of_ones_choice(tmp_path):
    # In a process of its own, since Warp reads the place once; one file of kernels, since all take a while.
    code = (
        "import pkgutil, sys; every = pkgutil.iter_modules; "
        "pkgutil.iter_modules = lambda path: [m for m in every(path) if m.name in ('update_occupancy', '_launch')]; "
        "from voronerf.cli import main; sys.exit(main(['preload']))"
    )
    environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path / "cache")}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert "update_occupancy" in done.stdout and "1 files in" in done.stdout and str(tmp_path) in done.stdout
    assert any("update_occupancy" in str(path) for path in (tmp_path / "cache").rglob("*"))


def test_preload_for_a_device_that_is_not_there_is_one_line(capsys):
    error = error_of(capsys, "preload", "--device", "cuda:99")
    assert "--device must name a device that is present, got 'cuda:99'" in error


def test_resume_needs_no_setting_again(run, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    assert main(["train", "--resume", "--out", str(copy), "--steps", "20"]) == 0
    assert json.loads((copy / "summary.json").read_text())["steps"] == 20
    assert json.loads((copy / "config.json").read_text())["width"] == 8
    assert main(["train", f"--out={copy}", "--resume", "--steps", "22"]) == 0
    assert json.loads((copy / "summary.json").read_text())["steps"] == 22
    # from a number of steps to a time, and back
    assert main(["train", f"--out={copy}", "--resume", "--budget=0.001"]) == 0
    config = json.loads((copy / "config.json").read_text())
    assert (config["budget"], config["steps"]) == (0.001, None)
    assert main(["train", f"--out={copy}", "--resume", "--steps", "24"]) == 0
    assert json.loads((copy / "summary.json").read_text())["steps"] == 24


def test_folders_with_brackets_and_spaces_are_told_as_they_are(run, tmp_path, capsys):
    copy = tmp_path / "toys[old] :dog: 2"
    shutil.copytree(run, copy)
    assert main(["eval", str(copy), "--views", "1", "--panels", "0"]) == 0
    assert f"wrote {copy / 'eval.json'}" in capsys.readouterr().out


def test_demo_compares_two_runs(tmp_path, capsys, monkeypatch):
    # A step takes ten milliseconds however busy the machine is.
    ticks = itertools.count()
    monkeypatch.setattr("voronerf.training.trainer.time", SimpleNamespace(perf_counter=lambda: 0.0101 * next(ticks)))
    command = ["demo", "--out", str(tmp_path), "--budget", "1", "--size", "16", "--cells", "3"]
    assert main(command) == 0
    assert main(command) == 0  # in the place of the first
    output = capsys.readouterr().out
    results = {name: json.loads((tmp_path / name / "summary.json").read_text()) for name in ("single", "voronoi")}
    assert (results["single"]["cells"], results["voronoi"]["cells"]) == (1, 3)
    for result in results.values():
        assert f"{result['psnr']:.2f}" in output
    assert (tmp_path / "psnr.png").stat().st_size > 1000
    config = json.loads((tmp_path / "voronoi" / "config.json").read_text())
    assert (config["data"], config["downscale"]) == ("builtin", 6)  # 100 // 6 = 16, for who resumes or scores it
    assert "--size must be 100 over a whole number" in error_of(capsys, "demo", "--size", "60")
    assert "--cells must be at least 2" in error_of(capsys, "demo", "--out", str(tmp_path / "x"), "--cells", "1")
    assert not (tmp_path / "x").exists()


def test_help_has_units(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["train", "--help"])
    assert stop.value.code == 0
    output = capsys.readouterr().out
    for flag in ("--data", "--downscale", "--budget", "--steps", "--out", "--seed", "--field", "--width", "--cells"):
        assert flag in output
    for flag in ("--split-at", "--backend", "--device"):
        assert flag in output
    assert "seconds" in output


def test_bad_input_is_one_line(run, tmp_path, capsys):
    out = str(tmp_path / "out")
    assert "there is no such folder" in error_of(capsys, "train", "--data", str(tmp_path / "none"), "--out", out)
    assert "is not a scene" in error_of(capsys, "train", "--data", str(tmp_path), "--out", out)
    assert "--cells must be at least 2" in error_of(capsys, "train", "--cells", "0", "--out", out)
    assert "--device must name a device" in error_of(capsys, "train", "--device", "gpu", "--out", out)
    assert "must not hold a run already" in error_of(capsys, "train", "--out", str(run))
    assert "--resume needs a checkpoint" in error_of(capsys, "train", "--resume", "--out", out)
    assert "--resume needs --out" in error_of(capsys, "train", "--resume")
    assert "there is no checkpoint" in error_of(capsys, "eval", str(tmp_path))
    assert "there is no checkpoint" in error_of(capsys, "render", out)
    assert "--frames must be at least 1, got 0" in error_of(capsys, "render", str(run), "--frames", "0")
    assert "a video must end in" in error_of(capsys, "render", str(run), "--out", str(tmp_path / "turn"))
    assert "--views must be at least 1, got 0" in error_of(capsys, "eval", str(run), "--views", "0")
    assert "--samples must be at least 1, got 0" in error_of(capsys, "eval", str(run), "--samples", "0")
    assert "--panels must not be negative" in error_of(capsys, "eval", str(run), "--panels", "-1")
    assert not Path(out).exists()


def test_a_failed_run_leaves_its_folder_usable(tmp_path, capsys):
    out = ["--out", str(tmp_path / "out")]
    many = ["400" if word == "3" else word for word in TINY]
    few = ["--reservoir", "400", "--reservoir-batches", "10"]
    assert "more cells than samples" in error_of(capsys, "train", "--data", "builtin", *out, *many, *few)
    (tmp_path / "out" / "checkpoints" / "last.safetensors").unlink()
    assert main(["train", "--data", "builtin", *out, *TINY]) == 0
    assert (tmp_path / "out" / "metrics.jsonl").read_text().count("\n") == 2


def test_another_configuration_is_one_line(run, capsys):
    args = ["train", "--data", "builtin", "--out", str(run), "--resume", *TINY, "--lr", "0.1"]
    assert "a checkpoint of another configuration: --lr " in error_of(capsys, *args)


def test_a_full_disk_is_one_line(run, monkeypatch, tmp_path, capsys):
    whole, calls = os.fsync, []

    def full(descriptor):
        calls.append(descriptor)
        if len(calls) > 3:
            raise OSError(28, "No space left on device")
        whole(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    args = ["train", "--data", "builtin", "--out", str(tmp_path / "x"), *TINY]
    assert "No space left on device" in error_of(capsys, *args)
    assert not list(tmp_path.rglob("*.partial"))
    monkeypatch.undo()
    assert main(args) == 0


@pytest.mark.skipif(not hasattr(signal, "SIGINT") or sys.platform == "win32", reason="needs POSIX signals")
def test_ctrl_c_leaves_a_usable_checkpoint(tmp_path):
    out = tmp_path / "run"
    endless = ["100000" if word == "16" else word for word in TINY]
    command = [sys.executable, "-m", "voronerf.cli.main", "train", "--data", "builtin", "--out", str(out), *endless]
    command += ["--checkpoint-every", "0.2"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    deadline = time.monotonic() + 600
    while not (out / "checkpoints" / "last.safetensors").exists():
        assert time.monotonic() < deadline and process.poll() is None, process.stdout and process.stdout.read()
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    output = process.communicate(timeout=600)[0].decode()
    assert process.returncode == 130, output
    assert "Traceback" not in output and "--resume" in output
    assert not json.loads((out / "summary.json").read_text())["complete"]
    assert main(["eval", str(out), "--views", "1", "--panels", "0"]) == 0
