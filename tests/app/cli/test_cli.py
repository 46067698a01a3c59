"""Tests of the command line from outside: commands, files, and one-line error messages."""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import imageio_ffmpeg
import pytest
from cli_commands import TINY, words
from helpers import read_json
from PIL import Image
from scene_files import write_blender

from voronerf.app.cli import main
from voronerf.app.cli.demo import show
from voronerf.app.cli.display import TrainingDisplay
from voronerf.app.cli.program import COMMANDS
from voronerf.app.export import space
from voronerf.app.render.paths import CameraPath, write_camera_path
from voronerf.app.scenes import builtin_scene
from voronerf.app.train.checkpoint import load_checkpoint
from voronerf.nerf import orbit_cameras


def succeeds(*parts):
    assert main(words(*parts)) == 0


@pytest.fixture(scope="module")
def run(tmp_path_factory, tiny_run):
    return shutil.copytree(tiny_run, tmp_path_factory.mktemp("runs") / "tiny")


def test_train_writes_the_run_directory(run):
    assert (run / "checkpoints/last.safetensors").is_file() and (run / "plots/psnr.png").is_file()
    (panel,) = (run / "images").glob("*.png")
    width, height = Image.open(panel).size
    assert width >= 5 * 16 and height >= 16


def test_eval_scores_every_view(run, capsys, fails):
    succeeds("eval", run, "--views 3 --panels 2")
    result = read_json(run / "eval.json")
    assert len(result["views"]) == 3
    assert result["psnr"] == pytest.approx(sum(v["psnr"] for v in result["views"]) / 3)
    output = capsys.readouterr().out
    assert all(v["name"] in output and f"{v['angle']:.1f}" in output for v in result["views"])
    assert f"{result['far_views']} of 3 views are over 15 degrees from the training" in output
    assert result["lpips"] is None and result["psnr_of_mean_error"] <= result["psnr"]
    assert "LPIPS is not computed: docs/metrics.md tells what it needs\n" in output
    succeeds("eval", run, "--views 1 --panels 0 --lpips off")
    assert "not computed" not in capsys.readouterr().out
    fails("--lpips must be off or come with larger images", "eval", run, "--lpips", run)
    fails("nowhere: there is no such file or folder", "eval", run, "--lpips nowhere")


@pytest.mark.parametrize("options", ["--samples 4", "--occupancy"])
def test_pictures_and_videos(run, tmp_path, options):
    scores = []
    for extra in ("", options):
        succeeds("eval", run, "--views 1 --panels 1", extra)
        scores.append(read_json(run / "eval.json")["psnr"])
    assert scores[0] != scores[1] or options == "--occupancy"
    path = tmp_path / "turn.mp4"
    succeeds("render", run, "--frames 3 --out", path, options)
    frames = imageio_ffmpeg.read_frames(str(path))
    assert next(frames)["size"] == (16, 16) and len(list(frames)) == 3


@pytest.mark.slow
def test_videos_along_a_path(run, tmp_path, fails):
    succeeds("render", run, "--frames 2 --size 30x20")
    assert next(imageio_ffmpeg.read_frames(str(run / "video.mp4")))["size"] == (30, 20)
    for options, name in (("", "video"), ("--depth", "video_depth")):
        succeeds("render", run, "--frames 3 --images", options)
        pictures = [Image.open(path) for path in sorted((run / name).iterdir())]
        assert [path.filename.rpartition("/")[2] for path in pictures] == [f"{n:05}.png" for n in range(3)]
        colours = {len(picture.getcolors()) for picture in pictures}
        assert min(colours) > 20 and {picture.size for picture in pictures} == {(16, 16)}
    succeeds("render", run, "--frames 1 --images --panorama --size 40x20 --out", tmp_path / "around")
    assert Image.open(tmp_path / "around" / "00000.png").size == (40, 20)
    succeeds("render", run, "--frames 1 --images --panorama --depth --size 40x20")
    assert len(list((run / "panorama_depth").iterdir())) == 1
    fails("must be 2 to 1, got 40 x 30", "render", run, "--panorama --size 40x30")
    fails("video: must be a new or empty folder", "render", run, "--images")
    fails("--size must be WIDTHxHEIGHT, such as 1280x720, at most 8192 each, got '30'", "render", run, "--size 30")
    fails("--size must be WIDTHxHEIGHT", "render", run, "--size 9000x20")
    frames = orbit_cameras(3, radius=3, elevation=10, width=24, height=20, focal=25)
    file = tmp_path / "flight.json"
    write_camera_path(file, CameraPath(frames, fps=5))
    for options, size in (("", (24, 20)), ("--downscale 2", (12, 10))):
        succeeds("render", run, "--path", file, options)
        video = imageio_ffmpeg.read_frames(str(run / "flight.mp4"))
        described = next(video)
        assert (described["size"], described["fps"], len(list(video))) == (size, 5, 3)
    around = json.loads(file.read_text()) | {"camera_type": "equirectangular", "render_width": 24.0}
    (tmp_path / "around.json").write_text(json.dumps(around))
    for options, size in (("", (24, 20)), ("--size 48x24", (48, 24)), ("--panorama", (40, 20))):
        succeeds("render", run, "--path", tmp_path / "around.json", options)
        assert next(imageio_ffmpeg.read_frames(str(run / "around.mp4")))["size"] == size
    fails("flight.json", "render", run, "--path", tmp_path / "no" / "flight.json")
    fails("--fps must be 0.01 to 1000, got 0", "render", run, "--fps 0")
    file.write_text("{}")
    fails("flight.json: is not a camera path", "render", run, "--path", file)


def test_settings_of_a_file(run, tmp_path, capsys, fails):
    again = tmp_path / "again"
    succeeds("train --config", run / "config.json", "--seed 3 --out", again)
    assert "lpips" not in capsys.readouterr().out.lower() and read_json(again / "summary.json")["lpips"] is None
    first, second = (json.loads((folder / "config.json").read_text()) for folder in (run, again))
    assert {name for name in first if first[name] != second[name]} == {"seed", "out"}
    fails("there is no such file", "train --config", tmp_path / "none.json")
    fails("nowhere: there is no such file", "train --data builtin --lpips nowhere --out", tmp_path / "other", TINY)
    fails("--config must be left out with --resume", "train --resume --config", run / "config.json", "--out", run)


def test_exports_of_a_run(run, tmp_path, capsys, fails, monkeypatch):
    pytest.importorskip("trimesh", reason="trimesh is not installed")
    pytest.importorskip("skimage", reason="scikit-image is not installed")
    pytest.importorskip("fast_simplification", reason="fast-simplification is not installed")
    files = [tmp_path / name for name in ("mesh.glb", "cells.glb")]
    monkeypatch.setattr(space, "SOLID", 0.01)  # a run of a few steps has low densities
    succeeds("export", run, "--mesh", files[0], "--cells", files[1], "--resolution 8 --faces 50")
    assert all(file.stat().st_size for file in files)
    output = capsys.readouterr().out
    assert "3 of 3 cells" in output and re.search(r"\b[1-5]?\d triangles, closed", output)
    succeeds("export", run, "--web", tmp_path / "page.html", "--crop -1 -1 -1 1 1 1")
    assert (tmp_path / "page.html").stat().st_size > 10_000
    fails("the file must end in .html", "export", run, "--web page.htm")
    fails("no surface in the box", "export", run, "--crop 9 9 9 9.5 9.5 9.5 --points", tmp_path / "points.ply")
    fails("export needs a file: --points, --mesh, --cells or --web", "export", run)
    twice = f"must name different files, got {tmp_path.resolve() / 'a.glb'} twice"
    fails(twice, "export", run, "--points b.ply --mesh", tmp_path / "a.glb", "--cells", tmp_path / "./a.glb")
    fails("the file must end in .glb", "export", run, "--cells cells.stl")
    fails("--crop must be x y z of a corner and of", "export", run, "--crop 0 0 0 1 1 0 --mesh", files[0])


def test_info_names_every_backend(capsys):
    succeeds("info")
    output = capsys.readouterr().out
    for word in ("torch", "native", "warp", "extra export", "voronerf info --ops"):
        assert word in output
    assert "nearest_centre" not in output and len(output.splitlines()) <= 40  # fits on a screen
    succeeds("info --ops")
    output = capsys.readouterr().out
    for word in ("reference", "native", "warp", "nearest_centre", "grouped_mlp", "resample"):
        assert word in output


def test_resume_needs_no_setting_again(run, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    # The run is extended, then changed from a number of steps to a time budget, and back.
    for options, steps, budget in (
        (f"--out {copy} --steps 20", 20, None),
        (f"--out={copy} --budget=0.001", None, 0.001),
        (f"--out={copy} --steps 24", 24, None),
    ):
        succeeds("train --resume", options)
        config = read_json(copy / "config.json")
        assert (config["steps"], config["budget"], config["width"]) == (steps, budget, 8)
        assert steps is None or read_json(copy / "summary.json")["steps"] == steps


def test_defaults_follow_the_speed_of_the_machine_that_began(tmp_path, monkeypatch):
    """Defaults stay the same when a machine of another speed resumes the run."""
    out, tiny = tmp_path / "run", TINY.replace("--steps 16", "").replace("--samples 8", "").replace("--depth 2", "")
    monkeypatch.setattr("voronerf.app.cli.train.machine_speed", lambda: 1024.0)
    succeeds("train --data builtin --budget 0.02 --out", out, tiny)
    begun = read_json(out / "config.json")
    assert begun["samples"] == [96]
    monkeypatch.setattr("voronerf.app.cli.train.machine_speed", lambda: 1.0)
    succeeds("train --resume --budget 0.03 --out", out)
    assert read_json(out / "config.json") == begun | {"budget": 0.03}
    succeeds("train --data builtin --budget 0.02 --out", tmp_path / "slow", tiny)
    assert read_json(tmp_path / "slow" / "config.json")["samples"] == [48]


def test_a_stopped_run_goes_on_with_the_command_that_it_prints(tmp_path, monkeypatch, capsys, fails):
    """The run resumes although its scene is in another folder, which the command does not name."""
    data, out, elsewhere = tmp_path / "a scene", tmp_path / "a run", tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    monkeypatch.delenv("VORONERF_DATA", raising=False)
    write_blender(data, builtin_scene(16, train_views=4, test_views=2), 0.7)
    stop = lambda display, state: state.step == 3 and state.stop()  # noqa: E731
    with monkeypatch.context() as patched:
        patched.setattr(TrainingDisplay, "group", 1)
        patched.setattr(TrainingDisplay, "after_step", stop)
        assert main([*words("train --data"), str(data), "--out", str(out), *words(TINY), "--downscale", "1"]) == 130
    (said,) = re.findall("continue with: voronerf (.*)", capsys.readouterr().out)
    assert main(shlex.split(said)) == 0 and "--data" not in said
    assert read_json(out / "summary.json")["steps"] == 16
    assert main(["eval", str(out), "--panels", "0"]) == 0
    shutil.copytree(data, tmp_path / "never named")
    config = json.loads((out / "config.json").read_text()) | {"data": str(tmp_path / "never named")}
    (out / "config.json").write_text(json.dumps(config))
    assert main(["train", "--resume", "--out", str(out)]) == 1
    assert "--data must be given once" in capsys.readouterr().err


def test_folders_with_brackets_and_spaces_are_told_as_they_are(run, tmp_path, capsys):
    copy = tmp_path / "toys[old] :dog: 2"
    shutil.copytree(run, copy)
    succeeds("eval", copy, "--views 1 --panels 0")
    assert f"wrote {copy / 'eval.json'}" in capsys.readouterr().out


@pytest.mark.slow
def test_demo_shows_a_run_and_writes_over_none(tmp_path, capsys, monkeypatch, fails):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("voronerf.app.cli.demo.SIZE", 16)
    monkeypatch.setattr("voronerf.app.cli.demo.FRAMES", 3)
    succeeds("demo --budget 0.3")
    run, output = tmp_path / "runs" / "demo", capsys.readouterr().out
    psnr, config = read_json(run / "summary.json")["psnr"], read_json(run / "config.json")
    assert f"{psnr:.1f} dB after 0.3 s on 8 views" in output and config["data"] == "builtin:16"
    assert imageio_ffmpeg.count_frames_and_secs(str(run / "turn.mp4"))[0] == 3
    assert output.endswith("open runs/demo/scene.html\n") and "<!doctype html>" in (run / "scene.html").read_text()
    for picture in ("turn.png", "placed.png"):
        with Image.open(run / picture) as image:
            assert image.width >= 16
    # Running the printed `place` command produces the same run once more.
    (said,) = re.findall("voronerf (place .*), without", output)
    assert main([*shlex.split(said), "--out", "again"]) == 0
    files = [sorted((folder / "checkpoints").iterdir())[-1] for folder in (run / "placed", tmp_path / "again")]
    assert files[0].stat().st_size == files[1].stat().st_size
    assert len(list((run / "placed").rglob("networks-*.safetensors"))) == 1
    (following,) = re.findall("next: .*voronerf (.*)", output)
    assert following.split()[0] in COMMANDS
    fails("--out must not hold a run already", "demo --out runs/demo")
    fails("budget must be a positive number", "demo --budget 0")


def test_the_video_of_a_slow_field_has_fewer_frames(run, tmp_path, capsys, monkeypatch):
    for name, value in (("SIZE", 16), ("FRAMES", 12), ("LONGEST", 1e-9)):
        monkeypatch.setattr(f"voronerf.app.cli.demo.{name}", value)
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    show(copy, builtin_scene(16), read_json(copy / "summary.json"), 1.0)
    assert "the video has 8 frames instead of 12, since a frame takes" in capsys.readouterr().out
    reader = imageio_ffmpeg.read_frames(str(copy / "turn.mp4"))
    assert next(reader)["fps"] == pytest.approx(16 * 8 / 12, abs=0.01) and len(list(reader)) == 8


@pytest.mark.parametrize(("stop", "status"), [(KeyboardInterrupt(), 130), (SystemExit(143), 143)])
def test_an_interrupted_demo_says_where_its_run_is(tmp_path, capsys, monkeypatch, stop, status):
    def interrupt(*_):
        raise stop

    monkeypatch.setattr("voronerf.app.cli.demo.SIZE", 16)
    monkeypatch.setattr("voronerf.app.cli.demo.show", interrupt)
    assert main(words("demo --budget 0.02 --out", tmp_path / "run")) == status
    said = capsys.readouterr()
    assert said.err == "" and "psnr" in said.out  # training lines, since stdout is no terminal
    (command,) = re.findall("stopped; the trained run is in .*: voronerf (.*) makes a video of it\n$", said.out)
    assert shlex.split(command) == ["render", str(tmp_path / "run")]


def test_bad_input_is_one_line(run, tmp_path, fails):
    out = tmp_path / "out"
    small = "--downscale 20 --out", out
    fails("there is no such folder", "train --data", tmp_path / "none", *small)
    fails("is not a scene", "train --data", tmp_path, *small)
    fails("--cells must lie in 2..10000 on every level", "train --cells 0", *small)
    fails("must not hold a run already", "train --downscale 20 --out", run)
    fails(f"no run at {out}: there is nothing to resume", "train --resume", *small)
    fails("--resume needs --out", "train --resume")
    fails(f"no run at {tmp_path}: there is no checkpoint in it", "eval", tmp_path)
    fails(f"no run at {out}: there is no such folder", "render", out)
    fails("--frames must be at least 1, got 0", "render", run, "--frames 0")
    fails("a video must end in", "render", run, "--out", tmp_path / "turn")
    fails(f"got the run {run}; voronerf train --resume --out {run} continues it", "train --data", run, *small)
    fails("--views must be at least 1, got 0", "eval", run, "--views 0")
    for samples, got in (("0", "0"), ("8 8", "8 8"), ("", "none")):
        fails(f"--samples must be one number of at least 1, got {got}\n", "eval", run, "--samples", samples)
    fails("--panels must not be negative", "eval", run, "--panels -1")
    fails(
        "a checkpoint of another configuration: --lr ", "train --data builtin --out", run, "--resume", TINY, "--lr 0.1"
    )
    assert not out.exists()


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("\x1b]0;owned\x07", r"\x1b]0;owned\x07"),
        ("\x9b2Jx", r"\x9b2Jx"),
        ("a\u202egnp", r"a\u202egnp"),
        ("\udc80", r"\udc80"),
        ("x" * 10_000, "xxx ... xxx"),
        ("é", "é"),
    ],
)
def test_what_files_say_is_shown_and_not_obeyed(tmp_path, capsys, name, shown):
    frame = {"file_path": name, "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 9, "frames": [frame]}))
    assert main(["train", "--data", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert shown in said and str(tmp_path) in said and len(said) < 1000 and said[:-1].isprintable()


def test_arguments_that_a_terminal_would_obey(fails):
    fails("arguments must have no control characters, got \\x1b[2J", "train --centres \x1b[2J")


def test_a_failed_run_leaves_its_folder_usable(tmp_path, fails):
    train = "train --data builtin --out", tmp_path
    fails("10000 cells need at least 10000 samples", *train, TINY.replace("--cells 3", "--cells 10000"))
    assert not list(tmp_path.rglob("*.safetensors"))
    succeeds(*train, TINY)
    assert (tmp_path / "metrics.jsonl").read_text().count("\n") == 2


def test_a_full_disk_is_one_line(monkeypatch, tmp_path, fails):
    whole, calls = os.fsync, []

    def full(descriptor):
        calls.append(descriptor)
        if len(calls) > 3:
            raise OSError(28, "No space left on device")
        whole(descriptor)

    command = "train --data builtin --out", tmp_path / "x", TINY
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        fails("No space left on device", *command)
    assert not list(tmp_path.rglob("*.partial"))
    succeeds(*command)


def no_memory_to_import() -> int:
    raise SystemError("error return without exception set")


def test_what_does_not_fit_into_memory_is_one_line(tmp_path, monkeypatch, fails):
    monkeypatch.chdir(tmp_path)
    train = f"train --data builtin --device cpu {TINY}"
    for message, options in (
        ("--width 65536 with 3 cells needs", "--width 65536 --depth 1000"),
        ("--parameters 1000000000000 needs", f"--field kilonerf --parameters {10**12}"),
        ("--rays 1000000000 with 8 samples needs", "--rays 1000000000"),
        ("--rays 64 with 1000000000 samples needs", "--samples 1000000000"),
        ("samples needs 1180591620717411303424.0 GiB of memory or more", f"--samples {10**400}"),
    ):
        fails(message, train, options)
    monkeypatch.setattr(sys.modules["voronerf.app.train.build"], "SAMPLE_BYTES", 0)
    fails("count must be at most 134217728, got 8000000000000", train, "--rays 8000000000000")
    monkeypatch.setitem(COMMANDS, "info", no_memory_to_import)
    fails("not enough memory; try a smaller --width", "info")
    assert [path.name for path in tmp_path.iterdir()] in ([], ["runs"]) and not list(tmp_path.glob("runs/*"))


def test_image_names_that_are_too_long_for_panels(tmp_path, monkeypatch, fails):
    def scene(name):
        whole = builtin_scene(16, test_views=1)
        return lambda *_, **__: replace(whole, test=replace(whole.test, names=(name,)))

    monkeypatch.setattr("voronerf.app.cli.train.load_scene", scene("x" * 252))
    fails("--panels must be 0 with image names of more than 251 bytes, got xxx", "train --out", tmp_path / "a", TINY)
    assert not (tmp_path / "a").exists()
    monkeypatch.setattr("voronerf.app.cli.train.load_scene", scene("x" * 251))
    succeeds("train --out", tmp_path / "a", TINY)
    assert (tmp_path / "a" / "images" / f"{'x' * 251}.png").is_file()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
def test_signals_leave_a_usable_checkpoint(tmp_path, monkeypatch, capsys):
    """A run stopped by a signal can be resumed. SIGTERM goes to a child process, the other signals to this one."""
    last, steps = tmp_path / "checkpoints" / "last.safetensors", [0]

    def leaves_a_checkpoint(status, output):
        assert status == 130 and "Traceback" not in output and "--resume" in output, output
        summary = read_json(tmp_path / "summary.json")
        assert not summary["complete"] and load_checkpoint(last).values["step"] == summary["steps"] > steps[-1]
        steps.append(summary["steps"])

    endless = TINY.replace("--steps 16", "--steps 100000 --checkpoint-every 0.2")
    command = [sys.executable, "-m", "voronerf", *words("train --data builtin --out", tmp_path, endless)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    deadline = time.monotonic() + 600
    while not last.exists():
        assert time.monotonic() < deadline and process.poll() is None, process.stdout and process.stdout.read()
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    output = process.communicate(timeout=600)[0].decode()
    leaves_a_checkpoint(process.returncode, output)

    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGUSR1):
        monkeypatch.setattr(TrainingDisplay, "after_step", lambda *_, number=number: signal.raise_signal(number))
        before = signal.signal(number, signal.SIG_DFL)  # nohup and background jobs ignore some signals
        try:
            leaves_a_checkpoint(main(words("train --resume --out", tmp_path)), "".join(capsys.readouterr()))
        finally:
            signal.signal(number, before)
    succeeds("eval", tmp_path, "--views 1 --panels 0")


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
def test_a_second_signal_ends_at_once(tmp_path, monkeypatch, capsys):
    def interrupt(display, state):
        signal.raise_signal(signal.SIGUSR1)
        assert state.stopped
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(TrainingDisplay, "after_step", interrupt)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have disabled it
    try:
        assert main(words("train --data builtin --out", tmp_path, TINY)) == 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert "voronerf: interrupted" in capsys.readouterr().err
    assert not (tmp_path / "checkpoints").exists()
