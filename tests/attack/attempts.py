"""Runs attempts to break the library: each has a seed and runs in a forked process, so that a crash is a failure.

A part of the attack is a function of a random generator and an empty folder. It returns the outcome of the attempt, and
raises :class:`Failed` if the library broke a promise. The parent process must not run autograd before it forks, because
torch would then fail in the child.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import resource
import selectors
import shutil
import signal
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import torch

REFUSED, RIGHT, FAILED = "refused", "right", "failed"
#: The memory limit in bytes for hostile input, which the library must refuse before it exceeds the limit.
MEMORY = 2 << 30


class Failed(Exception):
    """Raised when the library broke a promise; the message says which."""


@dataclass(frozen=True)
class Part:
    """One part of the attack.

    Attributes:
        name: The name in the table and on the command line.
        attempt: The function of an attempt; returns REFUSED or RIGHT, or a count of each.
        seconds: The time limit of an attempt.
        memory: The bytes that an attempt may allocate; None if its programs need more address space.
        batch: The number of attempts in a process.
        peak: The limit of the process's peak memory in bytes.
        prepare: A function that writes the input files of the attempts; it runs in a separate process.
    """

    name: str
    attempt: Callable[[random.Random, Path, Path], str | Counter[str]]
    seconds: int
    batch: int = 1
    memory: int | None = None
    peak: int = MEMORY
    prepare: Callable[[Path], None] | None = None


@dataclass
class Tally:
    """The outcomes of the attempts of a part."""

    counts: Counter[str] = field(default_factory=Counter)
    failures: list[tuple[int, str]] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def tried(self) -> int:
        return self.counts.total()


def prepare(part: Part, inputs: Path) -> None:
    """Writes the input files of a part's attempts into a new folder."""
    inputs.mkdir()
    if part.prepare is not None:
        status, _ = _finish(_fork(lambda: part.prepare(inputs)))
        if status != 0:
            raise RuntimeError(f"{part.name} could not be prepared")


def run_part(part: Part, seeds: Iterable[int], inputs: Path, *, jobs: int, until: float = float("inf")) -> Tally:
    """Runs the attempts of some seeds, ``jobs`` at a time; no attempt begins after the time ``until``.

    ``inputs`` is the folder of their input files.
    """
    tally, started = Tally(), time.monotonic()
    waiting = list(seeds)[::-1]
    with tempfile.TemporaryDirectory(prefix="attack-") as scratch:
        running = selectors.DefaultSelector()
        while running.get_map() or (waiting and time.monotonic() < until):
            while waiting and len(running.get_map()) < jobs and time.monotonic() < until:
                batch = [waiting.pop() for _ in range(min(part.batch, len(waiting)))]
                worker = _Worker(part, batch, inputs, Path(tempfile.mkdtemp(dir=scratch)))
                running.register(worker.pipe, selectors.EVENT_READ, worker)
            for key, _ in running.select():
                worker = key.data
                if worker.read():
                    continue
                running.unregister(worker.pipe)
                waiting.extend(worker.end(tally)[::-1])
    tally.seconds = time.monotonic() - started
    return tally


class _Worker:
    """A process that runs some attempts and writes their outcomes to a pipe."""

    def __init__(self, part: Part, seeds: list[int], inputs: Path, folder: Path) -> None:
        self.part, self.seeds, self.folder, self._text = part, seeds, folder, b""
        self.pipe, write = os.pipe()
        self.pid = _fork(lambda: _attempts(part, seeds, inputs, folder, write))
        os.close(write)

    def read(self) -> bool:
        text = os.read(self.pipe, 1 << 16)
        self._text += text
        return bool(text)

    def end(self, tally: Tally) -> list[int]:
        """Adds the outcomes to the tally; returns the remaining seeds if an attempt ended the process."""
        os.close(self.pipe)
        status, peak = _finish(self.pid)
        _stop_children(self.folder)
        shutil.rmtree(self.folder, ignore_errors=True)
        found = [json.loads(line) for line in self._text.splitlines() if line.endswith(b"}")]
        failures = [(one["seed"], one["failure"]) for one in found if "failure" in one]
        for one in found:
            tally.counts.update(one["counts"])
        done = len(found)
        if done < len(self.seeds):
            ended = f"ended by {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"
            failures.append((self.seeds[done], ended if status != -signal.SIGALRM else f"took {self.part.seconds} s"))
            tally.counts[FAILED] += 1
            done += 1
        elif peak > self.part.peak:
            failures.append((self.seeds[0], f"took {peak / 2**30:.1f} GiB of memory"))
            tally.counts[FAILED] += 1
        tally.failures.extend(failures)
        return self.seeds[done:]


def _attempts(part: Part, seeds: list[int], inputs: Path, folder: Path, pipe: int) -> None:
    (folder / "group").write_text(str(os.getpid()))
    os.environ["VORONERF_CACHE"] = str(folder / "cache")  # cached images are removed with the attempts
    for seed in seeds:
        place = folder / str(seed)
        place.mkdir()
        torch.manual_seed(seed)
        signal.alarm(part.seconds)
        if part.memory is not None:
            taken = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
            resource.setrlimit(resource.RLIMIT_AS, (taken + part.memory, resource.RLIM_INFINITY))
        result: dict[str, object] = {"seed": seed}
        try:
            found = part.attempt(random.Random(seed), place, inputs)
            result["counts"] = found if isinstance(found, Counter) else {found: 1}
        except Exception as error:
            where = "" if isinstance(error, Failed) else f" ({traceback.format_exc().splitlines()[-3].strip()})"
            result |= {"counts": {FAILED: 1}, "failure": f"{type(error).__name__}: {error}{where}"}
        signal.alarm(0)
        os.write(pipe, json.dumps(result).encode() + b"\n")
        shutil.rmtree(place, ignore_errors=True)


def _fork(run: Callable[[], object]) -> int:
    """Forks a process that runs a function and leads a process group; returns the process id."""
    pid = os.fork()
    if pid:
        return pid
    try:
        os.setpgid(0, 0)
        torch.set_num_threads(1)
        run()
        os._exit(0)
    except BaseException:
        traceback.print_exc()
        os._exit(70)


def fork_command(run: Callable[[], int]) -> int:
    """Forks a process in the same group, which exits with the function's result; returns the process id."""
    pid = os.fork()
    if pid:
        return pid
    try:
        signal.alarm(120)  # the process holds the attempt's pipe open
        os._exit(run())
    except BaseException:
        os._exit(70)


def _finish(pid: int) -> tuple[int, int]:
    """Waits for a process; returns its exit status (negative for a signal) and its peak memory in bytes."""
    _, status, usage = os.wait4(pid, 0)
    return os.waitstatus_to_exitcode(status), usage.ru_maxrss * 1024


def _stop_children(folder: Path) -> None:
    """Kills the processes that an attempt has left running."""
    with contextlib.suppress(OSError, ValueError):
        os.killpg(int((folder / "group").read_text()), signal.SIGKILL)
