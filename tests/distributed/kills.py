"""Kills random ranks at random moments, goes on each time, and compares the end with that of a run nothing happened to.

python tests/distributed/kills.py [KILLS] [SEED]
"""

import random
import signal
import sys
import tempfile
import time
from pathlib import Path

from ranks import on_ranks
from test_faults import command

from voronerf.cli import main
from voronerf.training.checkpoint import checkpoint_path, checkpoint_paths, load_checkpoint

#: Seconds of an undisturbed run in which the kills fall.
LONGEST = 40.0


def kills(count, seed):
    draw, folder = random.Random(seed), Path(tempfile.mkdtemp())
    more = ["--steps", "200", "--split-at-steps", "20", "--checkpoint-every", "0.1"]
    assert on_ranks(main, command(folder / "whole", *more), folder=folder)[0] == [0, 0]
    out, done, tries = folder / "run", 0, 0

    def watch(ranks):
        time.sleep(draw.uniform(0, LONGEST))
        draw.choice(ranks).kill()

    while done < count:
        codes, _ = on_ranks(main, command(out, *more), folder=folder, restarts=tries, watch=watch)
        tries += 1
        if codes == [0, 0]:  # it ended before: from the start again
            print(f"{done} kills so far, and the run is at its end")
            compare(folder)
            for path in checkpoint_paths(out):
                path.unlink()
            continue
        assert sorted(codes) in ([-signal.SIGKILL, 1], [-signal.SIGKILL, 0], [-signal.SIGKILL, -signal.SIGKILL]), codes
        done += 1
        step = load_checkpoint(checkpoint_path(out)).values["step"] if checkpoint_paths(out) else 0
        print(f"kill {done}: {codes}, the checkpoint is at step {step}", flush=True)
    assert on_ranks(main, command(out, *more), folder=folder, restarts=tries)[0] == [0, 0]
    compare(folder)
    print(f"{done} kills, {tries + 1} starts: the same parameters bit for bit")


def compare(folder):
    first, second = (load_checkpoint(checkpoint_path(folder / name)).tensors for name in ("whole", "run"))
    assert first.keys() == second.keys()
    different = [name for name in first if not first[name].equal(second[name])]
    assert not different, different


if __name__ == "__main__":
    kills(int((sys.argv[1:] or ["30"])[0]), int((sys.argv[2:] or ["0"])[0]))
