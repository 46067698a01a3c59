"""Tests that untrusted runs are refused before they cost memory or time, or lead to files outside their folders."""

import json
import os
import shutil
import sys
import threading

import matplotlib
import pytest
import torch
from cli_commands import TINY, words
from helpers import python

from voronerf.app.cli import main
from voronerf.app.train.checkpoint import load_checkpoint, save_checkpoint


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "tiny"
    assert main(words("train --data builtin --field nerf --no-occupancy --out", out, TINY)) == 0
    return out


@pytest.fixture
def copied(trained, tmp_path):
    """A copy of a run, which a test may change."""
    shutil.copytree(trained, tmp_path / "run")
    return tmp_path / "run"


def test_folders_that_lead_out_of_a_run(copied, tmp_path, fails):
    for name in ("checkpoints", "images", "plots", "samples"):
        outside = tmp_path / name
        (copied / name).rename(outside)
        (copied / name).symlink_to(outside)
        before = {path: path.stat().st_mtime_ns for path in outside.iterdir()}
        for command in ("eval --views 1", "render --frames 1", "train --resume --steps 18 --out"):
            fails(f"{name} must be in the run directory, got a link to {outside}", command, copied)
        assert before == {path: path.stat().st_mtime_ns for path in outside.iterdir()}
        (copied / name).unlink()
        outside.rename(copied / f"other {name}")
        (copied / name).symlink_to(f"other {name}")
    assert main(words("eval --views 1", copied)) == 0  # links within the run


def test_files_that_are_links_are_replaced_and_not_followed(copied, tmp_path):
    mine = tmp_path / "mine"
    mine.write_text("mine")
    partial = f".{os.getpid()}-{threading.get_native_id()}.partial"
    for name in ("eval.json", partial, f"images/{partial}", f".video.{os.getpid()}.mp4", "video.mp4"):
        (copied / name).unlink(missing_ok=True)
        (copied / name).symlink_to(mine)
    assert main(words("eval --views 1 --panels 1", copied)) == main(words("render --frames 1", copied)) == 0
    assert mine.read_text() == "mine" and not (copied / "eval.json").is_symlink()


def test_a_warning_is_one_line_however_long(copied, capsys):
    path = copied / "checkpoints" / "last.safetensors"
    shutil.copy(path, path.with_name("last-1.safetensors"))
    path.write_bytes(path.read_bytes()[:-1])
    assert main(words("eval --views 1 --panels 0", copied)) == 0
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and f"{path}: not a readable checkpoint" in lines[0], lines


@pytest.mark.parametrize("option", ["data", "lpips"])
def test_paths_in_the_settings_of_a_run(copied, tmp_path, fails, monkeypatch, option):
    outside = tmp_path / "outside"
    outside.mkdir()
    path = copied / "checkpoints" / "last.safetensors"
    checkpoint = load_checkpoint(path)
    for value in (outside, copied / ".." / "outside", copied / "link"):
        (copied / "link").unlink(missing_ok=True)
        (copied / "link").symlink_to(outside)
        settings(**{option: str(value)})(copied, checkpoint)
        save_checkpoint(path, checkpoint)
        for command in ("eval --views 1", "train --resume --steps 18 --out"):
            fails(f"--{option} must be given", command, copied)
    arguments = {"data": "--data builtin", "lpips": "--lpips off"}[option]
    assert main(words("eval --views 1", copied, arguments)) == 0
    settings(**{option: str(outside)})(copied, checkpoint)
    save_checkpoint(path, checkpoint)
    monkeypatch.chdir(tmp_path)
    used = {"data": "outside: is not a scene", "lpips": "--lpips must be off or come with larger images"}[option]
    fails(used, "eval --views 1", copied)


def test_settings_that_a_terminal_would_obey(copied, fails):
    config = json.loads((copied / "config.json").read_text()) | {"data": "\x1b]0;owned\x07"}
    (copied / "config.json").write_text(json.dumps(config))
    fails(r"data must be printable text, got '\x1b]0;owned\x07'", "train --resume --help --out", copied)


def settings(**changes):
    """Returns a function that changes settings in the checkpoint and in config.json."""

    def change(run, checkpoint):
        checkpoint.values["config"].update(changes)
        (run / "config.json").write_text(json.dumps(checkpoint.values["config"]))

    return change


def many_centres(run, checkpoint):
    centres = torch.rand(2_000_000, 3)
    checkpoint.tensors["router.diagram.centres"] = centres
    checkpoint.tensors["router.diagram.child_offsets"] = torch.tensor([0, len(centres)], dtype=torch.int32)
    checkpoint.tensors["router.diagram.child"] = -1 - torch.arange(len(centres), dtype=torch.int32)


def flat_average(run, checkpoint):
    checkpoint.tensors["optimizer.0.average"] = checkpoint.tensors["optimizer.0.average"].flatten()


#: Changes to a run, and the error messages that they cause.
OVERSIZED = {
    "width": (settings(width=18_000), "trunk.0.weight must be float32 [3, 18000, 39], got float32 [3, 8, 39]"),
    "depth": (settings(depth=1_000_000), "--depth must be at least 1 and at most 1000, got 1000000"),
    "octaves": (
        settings(field_options=("position_octaves=1000000000",)),
        "MLP: position_octaves must be None or 0 to 127, got 1000000000",
    ),
    "average": (flat_average, "optimizer.0.average must have shape [3, 8, 39], got [936]"),
    "centres": (many_centres, "trunk.0.weight must be float32 [2000000, 8, 39], got float32 [3, 8, 39]"),
}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="units of ru_maxrss")
def test_shapes_are_compared_before_memory_is_taken(trained, tmp_path):
    for name, (change, _) in OVERSIZED.items():
        run = tmp_path / name
        shutil.copytree(trained, run)
        path = run / "checkpoints" / "last.safetensors"
        checkpoint = load_checkpoint(path)
        change(run, checkpoint)
        save_checkpoint(path, checkpoint)
    code = (
        "import resource, sys, time, voronerf.app.train; from voronerf.app.cli import main; "
        "most = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss; "
        "before, start, sys.stderr = most(), time.process_time(), sys.stdout; "
        "[main(command) for run in sys.argv[1:] for command in (['eval', run], ['train', '--resume', '--out', run])];"
        "print(most() - before, time.process_time() - start)"
    )
    *lines, used = python("-c", code, *(tmp_path / name for name in OVERSIZED)).splitlines()
    memory, seconds = map(float, used.split())
    assert memory < 500_000 and seconds < 20
    for (name, (_, message)), said in zip(OVERSIZED.items(), zip(lines[::2], lines[1::2]), strict=True):
        assert message in said[0] and f"/{name}/" in said[0]
        assert message in said[1] or "needs" in said[1]  # more memory than the machine has


NOBODY = """
import os, pwd, sys, tempfile
def unknown(uid): raise KeyError(f"getpwuid(): uid not found: {uid}")
pwd.getpwuid = unknown
for name in ("HOME", "USER", "LOGNAME", "LNAME", "USERNAME", "VORONERF_CACHE", "XDG_CACHE_HOME"):
    os.environ.pop(name, None)
tempfile.tempdir = os.getcwd()
from voronerf.app.cli.program import run
sys.exit(any([run(command.split()) for command in sys.argv[1:]]))
"""


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="needs POSIX users")
def test_a_user_without_a_home(tmp_path):
    """A container's user may have no entry in passwd and no HOME."""
    cache = tmp_path / f"voronerf-{os.getuid()}"
    commands = f"train --data builtin --out run {TINY}", "render run --frames 1"
    fonts = {"MPLCONFIGDIR": matplotlib.get_cachedir()}  # matplotlib would list all fonts again, which takes seconds
    python("-c", NOBODY, *commands, cwd=tmp_path, env=os.environ | fonts)
    assert cache.stat().st_mode & 0o777 == 0o700 and (cache / "chosen").is_dir()


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="needs POSIX users")
def test_the_cache_of_another_user_is_not_used(tmp_path, monkeypatch, fails):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("VORONERF_CACHE", "~unknown/cache")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / f"voronerf-{os.getuid()}").symlink_to(tmp_path / "elsewhere")
    fails("must be a folder of your own; set VORONERF_CACHE to another", "train --data builtin-city --images disk")
    assert not list((tmp_path / "elsewhere").iterdir())
