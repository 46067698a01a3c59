"""Joint trainings whose ranks are killed, stopped and paused, find no room, read damage, or are given other data."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

from attempts import REFUSED, RIGHT, Failed
from given import FIELDS, TINY
from training_attacks import same_runs, same_tensors

from voronerf.training.checkpoint import checkpoint_path, checkpoint_paths, load_checkpoint, network_files

#: The networks of a joint training, which has four territories.
VARIANTS = (
    *FIELDS.values(),
    [*FIELDS["hashgrid"], "--contraction", "sphere"],
    [*FIELDS["nerf"], "--cells", "2", "2", "--split-at", "0.3", "0.6"],
)
#: Of a chain: ranks that are killed, stopped for good, and stopped for as many seconds.
FAULTS = {"kill": 6, "stop": 6, "pause": 2}
PAUSE = 1.5
#: Seconds that ranks of an attack wait for each other (50 in a training), and in which the fault is to be told.
PATIENCE, TOLD = 10, 60


class Ranks:
    """A training by torchrun.

    Args:
        out: The run directory; what is printed goes beside it.
        size: How many ranks.
        options: Of ``voronerf train``.
        restarts: How often torchrun starts the ranks again.
        harm: What is wrong with a rank, see ``rank.py``.
    """

    def __init__(self, out: Path, size: int, options: list[str], restarts: int = 0, **harm: object) -> None:
        self.size, self.said = size, out.with_suffix(".txt")
        script, given = Path(__file__).with_name("rank.py"), {"patience": PATIENCE, **harm}
        torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(size)]
        command = [*torchrun, "--max-restarts", str(restarts), str(script), "train", "--out", str(out), *options]
        with self.said.open("wb") as said:
            environment = {**os.environ, "HARM": json.dumps(given), "OMP_NUM_THREADS": "1"}
            self.process = subprocess.Popen([sys.executable, *command], stdout=said, stderr=said, env=environment)

    def started(self, old: set[int]) -> set[int]:
        """The processes of all ranks when torchrun has started others than the old ones; none when it has ended."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        while self.process.poll() is None:
            with contextlib.suppress(OSError):
                ranks = {int(number) for number in children.read_text().split()} - old
                if len(ranks) == self.size:
                    return ranks
            time.sleep(0.05)
        return set()

    @property
    def complaints(self) -> list[str]:
        """The lines that tell of an error."""
        lines = self.said.read_text(errors="replace").splitlines()
        return [line for line in lines if line.startswith("voronerf: error: ")]

    def ends_well(self) -> None:
        if self.process.wait() != 0:
            raise Failed(f"torchrun ended with status {self.process.returncode}: {self.complaints}")

    def is_refused(self, sign: str) -> None:
        """All ranks end, and one of them says why in a line."""
        began = time.monotonic()
        status, lines = self.process.wait(), self.complaints
        if status == 0 or len(lines) != 1 or sign not in lines[0] or time.monotonic() - began > TOLD:
            raise Failed(f"ranks that are to say {sign!r} ended with status {status}: {lines}")


def harmed_ranks(rng: random.Random, folder: Path, _given: Path) -> Counter[str]:
    """Whatever happens to a rank, one line tells of it, and the run ends, to the bit, as that of one process."""
    options = [*("--data", "builtin", "--downscale", "8"), *TINY, *rng.choice(VARIANTS), "--territories", "4"]
    options += ["--steps", "300", "--checkpoint-every", rng.choice(("1e-9", "0.1"))]
    whole, began = folder / "whole", time.monotonic()
    Ranks(whole, 1, options).ends_well()
    count = Counter({RIGHT: _ended_ranks(rng, folder, whole, options, time.monotonic() - began)})
    part = folder / "part"
    Ranks(part, 2, [*options, "--panels", "1"], rank=1, file_size=20_000).is_refused("File too large")
    size = rng.choice((2, 3, 4))
    Ranks(part, size, [*options, *_again(part)], rank=size - 1, options=["--data", "builtin-rich"]).is_refused(
        "the scene"
    )
    Ranks(part, size, [*options, *_again(part)], rank=1, options=["--seed", "1"]).is_refused("--seed must be the same")
    harmed = _damage(rng, part)
    ranks = Ranks(part, size, [*options, *_again(part)])
    ranks.ends_well()
    if harmed and "takes its place" not in ranks.said.read_text():
        raise Failed(f"nothing was said of the damage to {harmed}")
    _same_runs(whole, part)
    return count + Counter({REFUSED: 3, RIGHT: 1})


def _ended_ranks(rng: random.Random, folder: Path, whole: Path, options: list[str], length: float) -> int:
    """Ends ranks at random moments of a start, which takes ``length``, and torchrun starts again; how many."""
    faults = list(Counter(FAULTS).elements())
    rng.shuffle(faults)
    done, runs = 0, 0
    while faults:  # a run may end before all of them
        part, runs = folder / f"part-{runs}", runs + 1
        ranks = Ranks(part, rng.choice((2, 3, 4)), options, restarts=3 * len(faults))
        numbers = ranks.started(set())
        while numbers and faults:
            time.sleep(rng.uniform(0, length))
            fault, chosen, before = faults[-1], rng.choice(sorted(numbers)), len(ranks.complaints)
            began = time.monotonic()
            try:
                os.kill(chosen, signal.SIGKILL if fault == "kill" else signal.SIGSTOP)
                if fault == "pause":  # which is none
                    time.sleep(PAUSE)
                    os.kill(chosen, signal.SIGCONT)
                    faults.pop()
                    done += 1
                    continue
                while fault == "stop" and time.monotonic() < began + TOLD and len(ranks.complaints) == before:
                    time.sleep(0.1)
                if fault == "stop":  # what else torchrun would do after 30 s
                    os.kill(chosen, signal.SIGKILL)
            except ProcessLookupError:  # they have ended
                numbers = ranks.started(numbers)
                continue
            took, numbers = time.monotonic() - began, ranks.started(numbers)
            told = len(ranks.complaints) - before
            print(f"{fault}: {took:.1f} s, {told} lines", *ranks.complaints[before:], flush=True)
            if told > 1 or took > TOLD:
                raise Failed(f"{fault}: {told} lines after {took:.0f} s: {ranks.complaints[before:]}")
            if numbers:
                faults.pop()
                done += 1
        ranks.ends_well()
        _same_runs(whole, part)
    return done


def _same_runs(whole: Path, part: Path) -> None:
    """Compares the files of all territories, too; which rank has them may differ."""
    same_runs(whole, part, {"joint.owner"})
    found = []
    for run in (whole, part):
        index = load_checkpoint(checkpoint_path(run), keep=lambda name: not name.startswith("part-"))
        files = network_files(index.values)
        found.append([load_checkpoint(checkpoint_path(run).with_name(file)) for file in files])
    for first, second in zip(*found, strict=True):
        same_tensors(first, second)


def _again(out: Path) -> list[str]:
    return ["--resume"] if checkpoint_paths(out) else []


def _damage(rng: random.Random, run: Path) -> Path | None:
    """Changes a bit of a territory's file of the last checkpoint, where there is another to go back to."""
    paths = checkpoint_paths(run)
    if len(paths) < 2:
        return None
    files = network_files(load_checkpoint(paths[0], keep=lambda name: not name.startswith("part-")).values)
    path = paths[0].with_name(rng.choice(files))
    data = bytearray(path.read_bytes())
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    path.write_bytes(data)
    return path
