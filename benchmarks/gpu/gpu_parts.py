"""The programs of ``gpu_check.py``: ``gpu_parts.py PROGRAM OUT``.

    cases     the parts of --parts in one process, one case after another
                  small      every operation, forward and backward, against float64
                  large      networks at 2^22 samples, with gradients
                  captured   routed steps (lookup, sort, networks) and training steps, in CUDA graphs
                  rows       networks, lookups and sorts at full size, compared with the machine's peak rates and
                             torch's matrix products
                  training   short trainings, with PSNR
                  profile    a default step: launches, host waits, the slowest kernels
    counted   six launches between cudaProfilerStart and cudaProfilerStop, for ncu
    tests     tests/ops on CUDA, a process for each file

Findings are written to OUT/PROGRAM.json after every case. After a case that ends the process, ``--start`` continues
with a later case. ``--emulated`` runs small versions of the cases on the emulated device of the tests, to find mistakes
in the cases without a GPU.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import faulthandler
import fnmatch
import functools
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any
from unittest import mock

ROOT = Path(__file__).resolve().parents[2]
for place in ("tests/ops", "tests/cuda_emulation", "benchmarks", "benchmarks/gpu", ""):
    sys.path.insert(0, str(ROOT / place))

from gpu_cases import CHECKED, RACING, captured_steps, captured_trainings, small_cases  # noqa: E402
from gpu_journal import Case, Journal, one_by_one, settling  # noqa: E402
from gpu_large import large_cases  # noqa: E402
from gpu_timings import counted, profile, rows  # noqa: E402

BUDGETS = {"small": 60.0, "large": 25.0, "captured": 35.0, "rows": 65.0, "training": 35.0, "profile": 30.0}
"""Seconds of each part, in the order of the parts. Later parts inherit unused time."""
TRAININGS: dict[str, dict[str, Any]] = {"default": {}, "4,096 rays, bf16": {"rays": 4096, "precision": "bf16"}}
FILE_SECONDS = 90.0
"""The time limit of one test file."""
PROCESSES = 12
"""The number of simultaneous test processes; imports and CUDA contexts take most of their time."""
CHOICE = "cuda and not reference-cuda and not compiles and not opcheck"
"""The selected tests (``pytest -k``): only tests of kernels, since torch traces in the same way on every device."""
LISTS = {"@checked": CHECKED, "@racing": RACING}
"""Lists of cases, by name."""
STEP: dict[str, Any] = {"width": 16, "samples": (8,), "rays": 16, "cells": (), "split_at": ()}
LITTLE: dict[str, dict[str, Any]] = {
    "large": {"n": 150},
    "captured": {"n": 16, "replays": 1},
    "trainings": {"count": 1, **STEP},
    "rows": {"n": 128, "fewer": 64, "seconds": 0.1},
    "profile": {"seconds": 0.05, **STEP},
    "training": {"budget": 0.1, **STEP},
}
"""Options of each part that are small enough for the emulated device."""


def cases_of(parts: list[str], device: str, journal: Journal, *, emulated: bool = False) -> list[Case]:
    """Returns the cases of some parts."""
    import torch

    from voronerf.app.scenes import builtin_scene, load_scene

    def seeded(run: Callable[[], Any]) -> Any:
        torch.manual_seed(0)
        return run()

    if {"profile", "training"}.intersection(parts):
        scene = builtin_scene(12) if emulated else load_scene("builtin")
    small: dict[str, dict[str, Any]] = LITTLE if emulated else {}
    cases: list[Case] = []
    for part in parts:
        options = small.get(part, {})
        if part == "small":
            cases += [Case(part, *case) for case in small_cases(device)]
        elif part == "large":
            cases += [Case(part, *case, 20.0) for case in large_cases(device, **options)]
        elif part == "captured":
            cases += [Case(part, *case) for case in captured_steps(device, **options)]
            cases += [Case(part, *case, 30.0) for case in captured_trainings(device, **small.get("trainings", {}))]
        elif part == "rows":
            cases += rows(device, journal, **options)
        elif part == "profile":
            cases += profile(scene, device, **options)
        else:
            for name, settings in TRAININGS.items():
                run = functools.partial(train, scene, device, {**settings, **options})
                cases.append(Case(part, name, run, 60.0))
    return [dataclasses.replace(case, run=functools.partial(seeded, case.run)) for case in cases]


def chosen(cases: list[Case], names: list[str]) -> list[Case]:
    """Returns the cases whose name or part matches one of ``names`` (* is a wildcard), and a failing case for each name
    without a match."""

    def absent() -> None:
        raise LookupError("there is no case of this name")

    selected = [case for case in cases if any(fnmatch.filter((case.name, case.part), name) for name in names)]
    matched = {name for case in selected for name in names if fnmatch.filter((case.name, case.part), name)}
    return [*(Case(cases[0].part, name, absent) for name in names if name not in matched), *selected]


def train(scene: Any, device: str, options: dict[str, Any]) -> dict[str, Any]:
    """Trains for 12 seconds; returns milliseconds per step, and PSNR."""
    from voronerf.app.train import Scores, TrainConfig, build, run

    settings: dict[str, Any] = {"budget": 12.0, "cells": (12,), "evaluations": 4, "eval_views": 5, **options}
    scores = Scores(None)
    run(build(TrainConfig(device=device, **settings), scene), [scores])
    summary = scores.summary
    milliseconds = 1e3 * summary["seconds"] / summary["steps"]
    said = f"{summary['steps']} steps of {milliseconds:.2f} ms, PSNR {summary['psnr']:.2f}"
    over = [(row["seconds"], row["psnr"]) for row in scores.metrics]
    return {"settings": options, "milliseconds": milliseconds, "psnr over seconds": over, **summary, "said": said}


def about() -> dict[str, Any]:
    """Returns the machine, its versions, and the library's description of its backends."""
    import torch

    from voronerf.ops._core import backends

    properties = str(torch.cuda.get_device_properties(0)) if torch.cuda.is_available() else "no GPU"
    return {"device": properties, "cuda": torch.version.cuda, **backends.describe()}


def run_counted(device: str) -> None:
    """Runs every launch of `counted`, after a warm-up."""
    import torch

    settle = settling(device)
    launches = counted(device, **({} if device == "cuda" else {"n": 256}))
    for name, before, launch in launches:
        before()
        launch()
        before()
        settle()
        print(f"counted: {name}", flush=True)
        with torch.cuda.profiler.profile() if device == "cuda" else contextlib.nullcontext():
            launch()
            settle()


def tests(out: Path, files: list[Path] | None = None, seconds: float = FILE_SECONDS) -> int:
    """Runs the files of tests/ops, several at a time, with their output in ``out``; returns the number of failures."""
    journal = Journal(out / "tests.json")
    files = files or sorted((ROOT / "tests" / "ops").glob("test_*.py"))
    options = ["-q", "-p", "no:cacheprovider", "--tb=short", "-k", CHOICE, "--require", "native,cuda"]

    def run(file: Path) -> tuple[Path, int | str, list[str]]:
        command = [sys.executable, "-m", "pytest", *options, str(file)]
        with (out / f"{file.stem}.txt").open("w+", errors="replace") as log:
            status: int | str
            try:
                # When the total time is over, gpu_check.py kills this process group.
                status = subprocess.run(command, cwd=ROOT, stdout=log, stderr=log, timeout=seconds).returncode
            except subprocess.TimeoutExpired:
                status = f"stopped after {seconds:g} s"
            log.seek(0)
            return file, status, log.read().splitlines()

    failed = 0
    with ThreadPoolExecutor(PROCESSES) as pool:
        for done in as_completed([pool.submit(run, file) for file in files]):
            file, status, lines = done.result()
            # Status 5: the file has no test for CUDA.
            failed += status not in (0, 5)
            said = "; ".join([status] * isinstance(status, str) + lines[-1:])
            print(f"{'passed' if status in (0, 5) else 'FAILED'}  {file.name}: {said}", flush=True)
            wrong = [line[:200] for line in lines if line.startswith(("FAILED", "ERROR", "E  "))]
            found = {"part": "tests", "name": file.name, "right": status in (0, 5), "said": said, "wrong": wrong}
            journal.add("cases", found)
    print(f"{len(files) - failed} of {len(files)} files passed")
    return min(failed, 100)


@contextlib.contextmanager
def on_the_emulated_device() -> Iterator[None]:
    """Runs the block on the emulated GPU: tensors on the CPU report a CUDA device."""
    import torch
    from emulated import emulated
    from graphs import graphs

    with emulated(), graphs(), mock.patch.multiple(torch.Tensor, is_cpu=False, is_cuda=True):
        yield


def main(arguments: list[str]) -> int:
    """Runs one program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", choices=("cases", "counted", "tests"))
    parser.add_argument("out", type=Path, help="folder for what it finds")
    parser.add_argument("--parts", nargs="+", choices=tuple(BUDGETS), default=list(BUDGETS))
    parser.add_argument("--names", nargs="+", help="cases to run: names (* is a wildcard), parts, @checked, @racing")
    parser.add_argument("--patience", type=float, default=1.0, help="times the seconds of a case")
    parser.add_argument("--emulated", action="store_true")
    parser.add_argument("--start", type=int, default=0, help="the case to go on with")
    options = parser.parse_args(arguments)
    faulthandler.enable()
    device = "cpu" if options.emulated else "cuda"
    with on_the_emulated_device() if options.emulated else contextlib.nullcontext():
        if options.program == "counted":
            run_counted(device)
            return 0
        if options.program == "tests":
            return tests(options.out)
        journal = Journal(options.out / "cases.json", begun=options.start > 0)
        if not options.start:
            journal.put("about", about())
        cases = cases_of(options.parts, device, journal, emulated=options.emulated)
        if options.names:
            cases = chosen(cases, [name for each in options.names for name in LISTS.get(each, (each,))])
        cases = [dataclasses.replace(case, seconds=options.patience * case.seconds) for case in cases]
        budgets, settle = {part: BUDGETS[part] for part in options.parts}, settling(device)
        settle()  # creates the CUDA context outside the time of any case
        return one_by_one(cases, budgets, settle, journal, options.start)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
