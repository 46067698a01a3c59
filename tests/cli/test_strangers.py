"""Runs that a stranger made: nothing in them takes memory or time, or leads outside, before it is refused."""

import json
import shutil
import sys

import pytest
import torch
from helpers import python
from test_cli import TINY, words

from voronerf.cli import main
from voronerf.training.checkpoint import load_checkpoint, save_checkpoint


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "tiny"
    assert main(words("train --data builtin --field nerf --no-occupancy --out", out, TINY)) == 0
    return out


def settings(**changes):
    """Other settings, in the checkpoint as in config.json."""

    def change(run, checkpoint):
        checkpoint.values["config"].update(changes)
        (run / "config.json").write_text(json.dumps(checkpoint.values["config"]))

    return change


def many_centres(run, checkpoint):
    centres = torch.rand(2_000_000, 3)
    checkpoint.tensors["router.diagram.centres"] = centres
    checkpoint.tensors["router.diagram.child_offsets"] = torch.tensor([0, len(centres)], dtype=torch.int32)
    checkpoint.tensors["router.diagram.child"] = -1 - torch.arange(len(centres), dtype=torch.int32)


#: Changes of a run, and what is said of it.
OVERSIZED = {
    "width": (settings(width=18_000), "router.module.trunk.0.weight must have shape [3, 18000, 39], got [3, 8, 39]"),
    "depth": (settings(depth=1_000_000), "--depth must be at least 1 and at most 1000, got 1000000"),
    "octaves": (settings(position_octaves=10**9), "router.module.trunk.0.weight must have shape [3, 8, 6000000003]"),
    "centres": (many_centres, "router.module.trunk.0.weight must have shape [2000000, 8, 39], got [3, 8, 39]"),
}


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
        "import resource, sys, time, voronerf.training.trainer; from voronerf.cli import main; "
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
        assert message in said[1] or "needs" in said[1]  # more than the machine has
