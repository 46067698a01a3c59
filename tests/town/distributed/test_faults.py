"""What goes wrong on one rank ends all of them, with one line from one of them; runs go on from their checkpoint."""

import json
import os
import shutil
import signal
import subprocess
from unittest import mock

import pytest
from ranks import complaints, joint_tensors, new_store, on_ranks

from voronerf.app.cli import main
from voronerf.app.train.checkpoint import checkpoint_path, load_checkpoint, network_files
from voronerf.town.distributed import group
from voronerf.town.joint import JointTrainer

ARGUMENTS = """
train --data builtin --downscale 8 --field nerf --no-occupancy --samples 8 --width 8 --depth 2 --rays 16 --cells 2
--split-at-steps 6 --steps 12 --reservoir-batches 5 --evaluations 1 --final-views 1 --panels 0
"""


def command(out, *more):
    return [*ARGUMENTS.split(), "--out", str(out), *more]


def dies(args, step):
    """Ends rank 1 by SIGKILL in a step."""
    real = JointTrainer.train_step

    def train_step(self):
        if self.step == step and os.environ["RANK"] == "1":
            os.kill(os.getpid(), signal.SIGKILL)
        return real(self)

    with mock.patch.object(JointTrainer, "train_step", train_step):
        return main(args)


def stops(args, answered):
    """Stops rank 1, in a step for a second, and later until it is killed; ranks wait for each other ``answered`` s."""
    real = JointTrainer.train_step

    def train_step(self):
        later = {5: "sleep 1; kill -CONT", 19: f"sleep {answered + 4}; kill -KILL"}.get(self.step)
        if later and os.environ["RANK"] == "1":
            subprocess.Popen(["sh", "-c", f"{later} {os.getpid()}"])
            os.kill(os.getpid(), signal.SIGSTOP)
        return real(self)

    with mock.patch.object(JointTrainer, "train_step", train_step), mock.patch.object(group, "PATIENCE", answered):
        return main(args)


def has_no_room(args):
    """Rank 0 cannot write its checkpoint."""
    full = OSError(28, "No space left on device")
    with mock.patch("voronerf.app.train.checkpoint.save_checkpoint", side_effect=full):
        return main(args)


def test_settings_that_ranks_cannot_use(tmp_path):
    """One says so at every start: what ranks of an earlier start have left in torchrun's store is not theirs."""
    expected, store = (
        "voronerf: error: --sampling must take one pass with several territories, as stratified: no territory sees "
        "whole rays, where a second looks, got 'proposal'",
        new_store(),
    )
    for restarts in range(2):
        given = command(tmp_path / "run", "--sampling", "proposal")
        codes, texts = on_ranks(main, given, folder=tmp_path, restarts=restarts, store=store)
        assert codes == [1, 1] and not (tmp_path / "run").exists()
        assert complaints(texts) == [expected]


def test_an_option_that_does_not_exist(tmp_path):
    codes, texts = on_ranks(main, command(tmp_path / "run", "--nonsense"), folder=tmp_path)
    assert codes == [2, 2] and "--nonsense" in texts[0] and texts[1] == ""


def test_ranks_that_differ(tmp_path):
    each = [(command(tmp_path / "run"),), (command(tmp_path / "run", "--seed", "1"),)]
    codes, texts = on_ranks(main, folder=tmp_path, each=each)
    assert codes == [1, 1]
    assert complaints(texts) == ["voronerf: error: --seed must be the same on all ranks, got 0 on 0 and 1 on 1"]
    assert not (tmp_path / "run").exists()


def test_more_ranks_than_territories(tmp_path):
    codes, texts = on_ranks(main, command(tmp_path / "run", "--territories", "2"), folder=tmp_path, size=3)
    assert codes == [1] * 3
    assert complaints(texts) == ["voronerf: error: --territories must be at least the 3 ranks, got 2"]


def test_a_full_disk(tmp_path):
    codes, texts = on_ranks(has_no_room, command(tmp_path / "run"), folder=tmp_path)
    assert codes == [1, 1]
    assert len(complaints(texts)) == 1 and "No space left on device" in complaints(texts)[0]


def test_a_rank_that_is_killed(tmp_path):
    """The other says so; started again as by torchrun, the run ends bit for bit as one that nothing happened to."""
    whole = command(tmp_path / "whole", "--steps", "24")
    out = command(tmp_path / "run", "--checkpoint-every", "1e-6", "--steps", "24")
    assert on_ranks(main, whole, folder=tmp_path)[0] == [0, 0]
    codes, texts = on_ranks(dies, out, 19, folder=tmp_path)
    assert codes == [1, -signal.SIGKILL] and len(complaints(texts)) == 1
    assert "another rank has ended" in complaints(texts)[0]
    assert load_checkpoint(checkpoint_path(tmp_path / "run")).values["step"] in (8, 16)
    assert on_ranks(main, out, folder=tmp_path, restarts=1)[0] == [0, 0]
    first, second = (joint_tensors(tmp_path / run) for run in ("whole", "run"))
    assert first.keys() == second.keys() and all(first[name].equal(second[name]) for name in first)
    metrics = [json.loads((tmp_path / run / "summary.json").read_text())["psnr"] for run in ("whole", "run")]
    assert metrics[0] == metrics[1]


@pytest.mark.slow
def test_a_rank_that_is_stopped(tmp_path):
    """For a second, which is no fault; and for good, which the other tells when it has waited long enough."""
    out = command(tmp_path / "run", "--checkpoint-every", "1e-6", "--steps", "24")
    codes, texts = on_ranks(stops, out, 8, folder=tmp_path)
    assert codes == [1, -signal.SIGKILL]
    assert len(complaints(texts)) == 1 and "has not answered for 8 s" in complaints(texts)[0]
    assert load_checkpoint(checkpoint_path(tmp_path / "run")).values["step"] in (8, 16)


@pytest.fixture(scope="module")
def resumed(tmp_path_factory):
    """A run that was resumed, so that it has two checkpoints."""
    folder = tmp_path_factory.mktemp("resumed")
    for more in ([], ["--resume", "--steps", "20"]):
        assert on_ranks(main, command(folder / "run", *more), folder=folder)[0] == [0, 0]
    return folder / "run"


@pytest.mark.parametrize("harm", ["cut short", "changed", "missing"])
def test_a_damaged_part(tmp_path, resumed, harm):
    """All ranks take the checkpoint before, and say which file was no good."""
    shutil.copytree(resumed, tmp_path / "run")
    last = checkpoint_path(tmp_path / "run")
    part = last.with_name(network_files(load_checkpoint(last).values)[1])
    data = bytearray(part.read_bytes())
    if harm == "missing":
        part.unlink()
    else:
        data[-5] ^= 1
        part.write_bytes(data[: len(data) // (1 if harm == "changed" else 2)])
    again = command(tmp_path / "run", "--resume", "--steps", "22")
    codes, texts = on_ranks(main, again, folder=tmp_path)
    assert codes == [0, 0]
    assert "takes its place" in texts[0]


def test_no_checkpoint_is_left(tmp_path, resumed):
    shutil.copytree(resumed, tmp_path / "run")
    for file in checkpoint_path(tmp_path / "run").parent.glob("*"):
        file.write_bytes(b"")
    codes, texts = on_ranks(main, command(tmp_path / "run", "--resume", "--steps", "28"), folder=tmp_path)
    assert codes == [1, 1] and len(complaints(texts)) == 1 and "not a readable checkpoint" in complaints(texts)[0]
