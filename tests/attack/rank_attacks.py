"""Attacks on trainings in territories: ranks are killed or paused, disks are full, files are damaged, data differ."""

from __future__ import annotations

import os
import random
import resource
import shutil
import signal
import sys
import time
from collections import Counter
from pathlib import Path

from attempts import REFUSED, RIGHT, Failed
from input_files import FIELDS, TINY

from voronerf.app.cli import main
from voronerf.app.train.checkpoint import checkpoint_paths
from voronerf.town import group

sys.path.append(str(Path(__file__).parents[1] / "town"))
from ranks import complaints, network_files, said_by, start_ranks, town_tensors

#: Options for the networks of a training in four territories.
VARIANTS = (
    ["--field", "nerf"],
    FIELDS["hashgrid"],
    [*FIELDS["hashgrid"], "--contraction", "sphere"],
    ["--field", "nerf", "--cells", "2", "2", "--split-at", "0.3", "0.6"],
)
#: The weights of faults (ranks are killed, stopped for good, or paused), and the number of faults in an attempt.
FAULTS, COUNT = {"kill": 10, "stop": 10, "pause": 2}, 4
PAUSE = 1.5
#: The fraction of faults after which a bit of the last checkpoint is flipped.
DAMAGED = 0.25
#: Seconds that ranks of an attack wait for each other (50 in a training), and seconds until the fault must be reported.
PATIENCE, TOLD = 8, 60


def rank(args: list[str], file_size: int | None = None) -> int:
    """Runs a rank; ``file_size`` limits the bytes of its files, like a full disk."""
    group.PATIENCE = PATIENCE
    if file_size is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (file_size, file_size))
    return main(args)


class Ranks:
    """A training on several ranks, which continues from its last checkpoint.

    Args:
        out: The run directory; the output of the ranks is written beside it.
        size: The number of ranks.
        options: Options of ``voronerf train-territories``.
        also: Additional options of the last rank.
        file_size: The maximum size in bytes of a file of the last rank.
    """

    def __init__(
        self, out: Path, size: int, options: list[str], also: tuple[str, ...] = (), file_size: int | None = None
    ) -> None:
        again = ["--resume"] if checkpoint_paths(out) else []
        args = ["train-territories", "--out", str(out), *options, *again]
        last = ([*args, *also], file_size)
        self.said = out.with_name(f"{out.name}-said")
        shutil.rmtree(self.said, ignore_errors=True)
        self.said.mkdir()
        self.processes = start_ranks(rank, [(args,)] * (size - 1) + [last], self.said)

    def end(self, but: int = -1) -> list[int | None]:
        """Waits for all ranks except number ``but``; returns the exit status of each rank."""
        until = time.monotonic() + TOLD
        for number, process in enumerate(self.processes):
            if number != but:
                process.join(max(0.0, until - time.monotonic()))
                if process.is_alive():
                    raise Failed(f"a rank has not ended after {TOLD} s")
        return [process.exitcode for process in self.processes]

    @property
    def complaints(self) -> list[str]:
        """The printed lines about errors."""
        return complaints(said_by(self.processes, self.said))

    def ends_well(self) -> None:
        for process in self.processes:
            process.join()
        if any(process.exitcode for process in self.processes):
            raise Failed(f"ranks that were left alone ended with {self.end()}: {self.complaints}")

    def is_refused(self, sign: str) -> None:
        """Checks that all ranks end with an error, and that they print one line, which contains `sign`."""
        codes, lines = self.end(), self.complaints
        if not all(codes) or len(lines) != 1 or sign not in lines[0]:
            raise Failed(f"ranks that are to say {sign!r} ended with {codes}: {lines}")


def harmed_ranks(rng: random.Random, folder: Path, _inputs: Path) -> Counter[str]:
    """Harms ranks: one line must report each fault, and the resumed run must equal a single-process run bit for bit."""
    options = [*("--data", "builtin", "--downscale", "8"), *TINY, *rng.choice(VARIANTS), "--territories", "4"]
    options += ["--steps", "100", "--checkpoint-every", rng.choice(("1e-9", "0.1"))]
    whole, part = folder / "whole", folder / "part"
    Ranks(whole, 1, options).ends_well()
    Ranks(part, 2, options, file_size=20_000).is_refused("File too large")
    done = _ended_ranks(rng, folder, whole, options)
    size = rng.choice((2, 3, 4))
    Ranks(part, size, options, ("--data", "builtin-city")).is_refused("the scene must be")
    Ranks(part, size, options, ("--seed", "1")).is_refused("--seed must be")
    Ranks(part, size, options).ends_well()
    _same_runs(whole, part)
    return Counter({REFUSED: 3, RIGHT: done})


def _ended_ranks(rng: random.Random, folder: Path, whole: Path, options: list[str]) -> int:
    """Kills or stops ranks at random moments and resumes the run; returns the number of faults."""
    faults = rng.choices([*FAULTS], [*FAULTS.values()], k=COUNT)
    done, runs, length = 0, 0, 4.0
    while faults:  # a run may end before all faults occurred
        part, ended = folder / f"part-{runs}", False
        while not ended:
            ranks, began = Ranks(part, rng.choice((2, 3, 4)), options), time.monotonic()
            if not faults:
                ranks.ends_well()
                break
            time.sleep(rng.uniform(0, length))
            chosen = rng.randrange(len(ranks.processes))
            number, at = ranks.processes[chosen].pid, time.monotonic()
            assert number is not None
            if any(process.exitcode is not None for process in ranks.processes):  # the run has ended
                ranks.ends_well()
                ended, length = True, max(2.0, 0.8 * (time.monotonic() - began))
                continue
            fault = faults.pop()
            os.kill(number, signal.SIGKILL if fault == "kill" else signal.SIGSTOP)
            if fault == "pause":  # ranks must survive a pause
                time.sleep(PAUSE)
                os.kill(number, signal.SIGCONT)
                ranks.ends_well()
                ended = True
            else:
                codes = ranks.end(but=chosen)
                took = time.monotonic() - at
                if fault == "stop":
                    os.kill(number, signal.SIGKILL)
                ranks.end()
                told = ranks.complaints
                print(f"{fault} {at - began:.1f} s after the start, told after {took:.1f} s:", *told, flush=True)
                left = [code for other, code in enumerate(codes) if other != chosen]
                ended = not any(left) and bool(checkpoint_paths(part))  # the run was already complete
                if len(told) != (0 if ended else 1):
                    raise Failed(f"{fault}: ranks ended with {codes} and said {told}")
                if len(checkpoint_paths(part)) > 1 and rng.random() < DAMAGED:
                    _damage(rng, part)
            done += 1
        _same_runs(whole, part)
        runs += 1
    return done


def _same_runs(whole: Path, part: Path) -> None:
    """Compares the tensors of all territories of two runs."""
    first, second = town_tensors(whole), town_tensors(part)
    other = [name for name in first.keys() | second.keys() if name not in first or not first[name].equal(second[name])]
    if other:
        raise Failed(f"{part} has other tensors than {whole}: {other[:5]}")


def _damage(rng: random.Random, run: Path) -> None:
    """Flips a bit in a territory's file of the last checkpoint."""
    path = rng.choice(network_files(run))
    data = bytearray(path.read_bytes())
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    path.write_bytes(data)
