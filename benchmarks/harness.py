"""Shared code of the benchmarks: the metadata of a result, and comparable timings.

Every file under results/ says where it was measured. Timings of one table row come from one call of :func:`measure`:
contenders take turns in one process, consecutive calls read different inputs, and medians are reported.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import platform
import re
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import torch

from voronerf import __version__
from voronerf.app.cli import keep_freed_memory
from voronerf.app.files import json_text, write_text
from voronerf.ops._core import backends

keep_freed_memory()  # benchmarks are programs, as the command line is

Run = Callable[[int], Any]
"""A contender: a function of the call's number, which selects the inputs. Call 0 is the warm-up."""

FEWEST = 3
"""The number of timings below which a row is reported as capped."""
MOST = 200
DISTURBED_PEAK = 0.9
"""A measured peak below this fraction of the best one counts as disturbed and is replaced by the best one."""
SLOW = 2
"""If a single call takes longer than this multiple of its contender's time limit, the contender gets one timing instead
of ``FEWEST``."""
TOO_SLOW = 5
"""If a contender's warm-up takes longer than this multiple of its time limit, the contender is not called again."""
BATCH_SECONDS = 5e-3
"""Calls shorter than this are timed in batches. An untimed call precedes each batch, because the previous contender
left its code and data in the caches, and its threads spinning."""


FAMILIES = {
    ("AuthenticAMD", 25, range(0x10, 0x20)): "Zen 4",
    ("AuthenticAMD", 25, range(0x60, 0xB0)): "Zen 4",
    ("AuthenticAMD", 25, range(0x100)): "Zen 3",
    ("AuthenticAMD", 26, range(0x100)): "Zen 5",
    ("GenuineIntel", 6, (0x6A, 0x6C)): "Ice Lake",
    ("GenuineIntel", 6, (0x8F,)): "Sapphire Rapids",
    ("GenuineIntel", 6, (0xCF,)): "Emerald Rapids",
    ("GenuineIntel", 6, (0xAD, 0xAE)): "Granite Rapids",
}
"""Names of processor families by vendor, family and models; the first match counts. Virtual machines omit the family
from the processor's name."""


def processor() -> str:
    """Returns the processor's name, with its family's name or numbers if the system reports them."""
    path = Path("/proc/cpuinfo")
    text = path.read_text() if path.is_file() else ""
    matches = {name: re.search(rf"^{name}\s*: (.*)$", text, re.MULTILINE) for name in ("model name", *_NUMBERS)}
    name = matches["model name"][1] if matches["model name"] else platform.processor() or platform.machine()
    if not all(matches[number] for number in _NUMBERS):
        return name
    vendor, family, model = (match[1] for number in _NUMBERS if (match := matches[number]))
    families = [n for (v, f, models), n in FAMILIES.items() if (v, f) == (vendor, int(family)) and int(model) in models]
    return f"{name} ({families[0]})" if families else f"{name} (family {family}, model {model})"


_NUMBERS = ("vendor_id", "cpu family", "model")


def metadata(**extra: Any) -> dict[str, Any]:
    """Returns the benchmark's entries, followed by the versions and the machine; ready for JSON."""
    return {
        **extra,
        "voronerf": __version__,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "threads": torch.get_num_threads(),
        "machine": processor(),
        "native": backends.describe()["native"],
    }


def write_results(path: Path | None, results: Any, **extra: Any) -> None:
    """Writes {metadata, results} as JSON, with the benchmark's entries in the metadata; None: writes nothing."""
    if path is not None:
        write_text(path, json_text({"metadata": metadata(**extra), "results": results}, indent=1) + "\n")


class Parser(argparse.ArgumentParser):
    """A parser that reports errors in one line: "PROG: error: MESSAGE"."""

    def error(self, message: str) -> NoReturn:
        sys.exit(f"{self.prog}: error: {message}")


@dataclass
class Timing:
    """The timings of one contender.

    Attributes:
        seconds: Seconds of single calls, or mean seconds of a batch of short calls.
        capped: Whether the time limit allowed fewer than ``FEWEST`` timings.
    """

    seconds: list[float] = field(default_factory=list)
    capped: bool = False

    @property
    def median_ms(self) -> float:
        """The median milliseconds of a call."""
        return statistics.median(self.seconds) * 1e3

    @property
    def iqr_ms(self) -> float | None:
        """The interquartile range in milliseconds; None for fewer than two timings."""
        if len(self.seconds) < 2:
            return None
        low, _, high = statistics.quantiles(self.seconds, n=4, method="inclusive")
        return (high - low) * 1e3


class Stopwatch:
    """A function that times calls: by ``clock`` on the CPU, by stream events on CUDA."""

    def __init__(self, device: torch.device, clock: Callable[[], float] = time.perf_counter) -> None:
        self.cuda, self.clock = device.type == "cuda", clock

    def __call__(self, run: Run, first: int, count: int) -> float:
        """Returns the total seconds of calls ``first`` to ``first + count - 1``."""
        if not self.cuda:
            start = self.clock()
            for call in range(first, first + count):
                run(call)
            return self.clock() - start
        begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        torch.cuda.synchronize()
        begin.record()
        for call in range(first, first + count):
            run(call)
        end.record()
        end.synchronize()
        return float(begin.elapsed_time(end)) * 1e-3


def measure(
    contenders: dict[str, Run],
    limits: dict[str, float],
    stopwatch: Callable[[Run, int, int], float],
    warm: dict[str, float] | None = None,
) -> dict[str, Timing]:
    """Times contenders in turns. The caller must have run call 0 of each contender.

    A contender stops when its timings add up to its limit, but not before ``FEWEST`` timings. If a single call takes
    longer than ``SLOW`` times the limit, it is the only timing, and the result is capped.

    Args:
        contenders: The functions to run, by name, in the order of their turns.
        limits: The time limit of each contender in seconds.
        stopwatch: A function of (contender, first call, number of calls) that returns seconds; a :class:`Stopwatch`.
        warm: The seconds of call 0 by contender, if known. If they exceed ``TOO_SLOW`` times the limit, they become the
            contender's only timing.

    Returns:
        A timing for each contender.
    """
    timings: dict[str, Timing] = {}
    batch: dict[str, int] = {}
    following = dict.fromkeys(contenders, 2)
    collecting = gc.isenabled()
    gc.disable()
    try:
        for name, run in contenders.items():
            seconds = (warm or {}).get(name, 0.0)
            if seconds <= TOO_SLOW * limits[name]:
                seconds = stopwatch(run, 1, 1)
            slow = seconds > SLOW * limits[name]
            timings[name] = Timing([seconds] if slow else [], slow)
            batch[name] = max(1, round(BATCH_SECONDS / max(seconds, 1e-7)))
        active = [name for name, timing in timings.items() if not timing.capped]
        while active:
            for name in active:
                run, count = contenders[name], batch[name]
                if count > 1:
                    run(following[name])
                seconds = stopwatch(run, following[name] + 1, count)
                following[name] += count + 1
                timings[name].seconds.append(seconds / count)
            # In alternating order, so that no contender always follows the same one.
            active = [name for name in active[::-1] if not _done(timings[name].seconds, batch[name], limits[name])]
    finally:
        if collecting:
            gc.enable()
    return timings


def _done(seconds: list[float], batch: int, limit: float) -> bool:
    return len(seconds) >= MOST or (len(seconds) >= FEWEST and sum(seconds) * batch >= limit)


class Others:
    """The load of all other processes since the object's construction; timings mean little on a busy machine."""

    def __init__(self) -> None:
        self.start = self._now()

    def cores(self) -> float | None:
        """Returns the mean number of cores that other processes or other guests of the host used; None if unknown."""
        now = self._now()
        if now is None or self.start is None or now[0] <= self.start[0]:
            return None
        wall, everything, own = (after - before for after, before in zip(now, self.start))
        return max(everything - own, 0.0) / wall

    @staticmethod
    def _now() -> tuple[float, float, float] | None:
        """Returns wall seconds, busy seconds of all cores, and processor seconds of this process."""
        try:
            fields = [int(field) for field in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]]
        except (OSError, ValueError):
            return None
        # user, nice, system, idle, iowait, irq, softirq, steal: in hundredths of a second on every Linux.
        return time.perf_counter(), (sum(fields) - fields[3] - fields[4]) / 100, sum(os.times()[:4])


class Peaks:
    """The peak rates of the machine, measured at every query because the processor's clock rate changes.

    The CPU is measured by ``voronerf.ops._core.native.measure_peak``. CUDA is measured by torch's product of large
    matrices and by a large copy: rates that a user can reach rather than the hardware limit.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.found: dict[str, float] = {}

    def __call__(self, kind: str) -> tuple[str, float] | None:
        """Returns (name, operations or bytes a second) for "float32", "bfloat16" or "copy"; None if unknown.

        A processor without bfloat16 products computes float32 products, so its float32 limit is returned.
        """
        if self.device.type == "cuda":
            return self._keep(f"{kind}, torch", _cuda_peak(kind, self.device))
        if backends.missing("native", self.device) is not None:
            return None
        from voronerf.ops._core import native

        isa = native.describe()["instruction set"]
        try:
            return self._keep(f"{kind}, {isa}" if kind != "copy" else "copy", native.measure_peak(kind))
        except ValueError:
            return None if kind != "bfloat16" else self("float32")

    def _keep(self, name: str, value: float) -> tuple[str, float]:
        best = self.found[name] = max(value, self.found.get(name, 0.0))
        return name, value if value > DISTURBED_PEAK * best else best


def _cuda_peak(kind: str, device: torch.device) -> float:
    stopwatch = Stopwatch(device)
    if kind == "copy":
        source = torch.rand(1 << 28, device=device)  # zeros may be moved faster
        target, work = torch.empty_like(source), 2.0 * source.numel() * source.element_size()
        seconds = [stopwatch(lambda _: target.copy_(source), 0, 1) for _ in range(8)]
    else:
        a = torch.randn(8192, 8192, device=device, dtype=getattr(torch, kind))
        work = 2.0 * 8192**3
        seconds = [stopwatch(lambda _: a @ a, 0, 1) for _ in range(8)]
    return work / min(seconds[1:])


@contextlib.contextmanager
def threads(count: int | None) -> Iterator[None]:
    """Sets the number of threads inside the block; None does not change it."""
    before = torch.get_num_threads()
    torch.set_num_threads(before if count is None else count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
