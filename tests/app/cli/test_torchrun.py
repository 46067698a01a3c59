"""Tests of trainings of several processes that ``torchrun`` starts, and of regions."""

import os
import signal
import subprocess
import sys
import time

import pytest
import torch
from cli_commands import TINY, words
from helpers import read_json

from voronerf import editing
from voronerf.app import open_run
from voronerf.app.cli import main, train
from voronerf.app.files import read_json_lines
from voronerf.app.scenes import load_scene
from voronerf.app.scenes.regions import tiles
from voronerf.app.train import TrainConfig, build
from voronerf.app.train.build import make_batches
from voronerf.app.train.checkpoint import load_checkpoint
from voronerf.app.train.config import ConfigError
from voronerf.nerf import Ranks

several = pytest.mark.skipif(
    sys.platform == "win32" or not torch.distributed.is_available(), reason="needs torch.distributed with libuv"
)


def torchrun(*parts, processes=2):
    command = [sys.executable, *words(f"-m torch.distributed.run --standalone --nproc-per-node {processes}")]
    return subprocess.Popen(
        command + words(*parts), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )


def finished(process):
    try:
        output = process.communicate(timeout=300)[0]
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    return output


def children(process):
    """Returns the process numbers of the trainings, in the order of their ranks."""
    listed = subprocess.run(["ps", "-o", "pid=", "--ppid", str(process.pid)], capture_output=True, text=True)
    return [int(line) for line in listed.stdout.split()]


@pytest.mark.slow
@several
def test_another_number_of_processes_continues_a_run(tmp_path):
    assert main(words("train --data builtin --out", tmp_path, TINY)) == 0
    process = torchrun("-m voronerf train --resume --steps 40 --out", tmp_path)
    output = finished(process)
    assert process.returncode == 0 and output.count("wrote") == 1, output
    summary = read_json(tmp_path / "summary.json")
    assert summary["complete"] and summary["steps"] == 40 and summary["cells"] == 3
    checkpoint = load_checkpoint(tmp_path / "checkpoints" / "last.safetensors")
    assert checkpoint.values["rays_done"] == (16 + 2 * 24) * 64
    assert main(words("train --resume --steps 48 --out", tmp_path)) == 0
    assert read_json(tmp_path / "summary.json")["steps"] == 48


@pytest.mark.slow
@several
def test_a_killed_process_ends_all_and_a_restart_goes_on(tmp_path):
    endless = TINY.replace("--steps 16", "--steps 1600 --checkpoint-every 0.2 --panels 0")
    last = tmp_path / "checkpoints" / "last.safetensors"
    process = torchrun("--max-restarts 1 -m voronerf train --resume --data builtin --out", tmp_path, endless)
    deadline = time.monotonic() + 200
    while not last.exists():
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.05)
    os.kill(children(process)[1], signal.SIGKILL)
    output = finished(process)
    assert process.returncode == 0 and "another process of this training has ended" in output, output
    summary = read_json(tmp_path / "summary.json")
    assert summary["complete"] and summary["steps"] == 1600
    assert [line["step"] for line in read_json_lines(tmp_path / "metrics.jsonl")] == [800, 1600]


def test_settings_that_several_processes_refuse(tmp_path, monkeypatch, fails):
    monkeypatch.setattr(Ranks, "join", lambda device: Ranks(0, 2))
    fails("--out must be given with several processes", "train --data builtin")
    monkeypatch.setattr(train, "present_device", torch.device)
    fails("--device must be cuda, without a number, with several processes", "train --device cuda:1 --out", tmp_path)
    with pytest.raises(ConfigError, match="--assignment must be nearest with several processes, got stochastic"):
        build(TrainConfig(assignment="stochastic", steps=8), load_scene("builtin", downscale=20), ranks=Ranks(0, 2))


@pytest.mark.parametrize("source", ["builtin", "builtin-city:2x2"])
def test_regions_fill_the_box(source):
    """The cameras of the first scene are outside of its box."""
    scene = load_scene(source, downscale=20)
    sides = torch.stack([box[1] - box[0] for box in tiles(scene, 5)])
    assert sides.amin() > 0
    torch.testing.assert_close(sides.prod(1).sum(), (scene.box[1] - scene.box[0]).prod())


@pytest.mark.slow
def test_regions_are_trained_and_joined(tmp_path, capsys):
    assert main(words("regions builtin-city:2x1 --count 2 --out", tmp_path)) == 0
    *jobs, join = (line.split()[1:] for line in capsys.readouterr().out.splitlines())
    boxes = [[float(word) for word in job[job.index("--region") + 1 :][:6]] for job in jobs]
    assert boxes[0][3] == boxes[1][0] and boxes[0][:3] == [-1, -0.5, -0.03]
    whole, region = (load_scene("builtin-city:2x1", downscale=5, region=box) for box in (None, boxes[0]))
    assert region.pixel(region.space()) < whole.pixel(whole.space())
    rays = make_batches(TrainConfig(data="builtin-city:2x1"), region).draw(500, torch.Generator().manual_seed(0)).rays
    ends = (region.region[:, None] - rays.origins) / rays.directions  # where a ray meets the planes of the sides
    assert (ends.amin(0).amax(1).clamp_min(0) <= ends.amax(0).amin(1) + 1e-4).all()
    for job in jobs:
        assert main(words(*job, "--downscale 5 --steps 60 --panels 0")) == 0
    assert main(join) == 0
    run = editing.open_run(tmp_path / "joined")
    part = open_run(tmp_path / "region-0")
    assert run.scene.test.masks is None and len(part.scene.test) < len(run.scene.test)
    names = list(run.scene.test.names)  # views that both regions see count once
    assert len(set(names)) == len(names) and set(part.scene.test.names) <= set(names) <= set(whole.test.names)
    assert part.scene.test.masks.float().mean() < 1
    assert torch.equal(run.router[0].network.voxels[1], part.renderer.occupancy.occupied)
    torch.testing.assert_close(run.scene.box, torch.tensor(boxes[0][:3] + boxes[1][3:]).view(2, 3), atol=0.1, rtol=0)
    assert torch.isfinite(run.render(0).colour).all()


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (
            "train --region 0 0 0 -1 1 1",
            "region must be x y z of a corner and of a larger one, got [[0.0, 0.0, 0.0], [-1",
        ),
        ("train --region 90 90 90 91 91 91", "region must be seen by a test view, got [[90.0, 90.0, 90.0], [91"),
        ("regions builtin-city --count 0", "count must be 1 to 40, the number of points, got 0"),
        ("regions builtin-city --count 41", "count must be 1 to 40, the number of points, got 41"),
    ],
)
def test_bad_regions_are_one_line(tmp_path, parts, message, fails, monkeypatch):
    monkeypatch.setattr("voronerf.app.cli.regions.load_scene", lambda data: load_scene(data, downscale=10))
    scene = "--data builtin-city --downscale 10 --steps 8" if parts.startswith("train") else ""
    fails(message, parts, scene, "--out", tmp_path / "out")
