"""Parts of ``gpu_check.py`` that are programs of their own: ``gpu_parts.py PART [OUT] [DATA] [--case-seconds S]``.

    machine    what a build and the tests need, each with what is missing
    small      every operation once, forward and backward, against float64: each case for itself
    large      networks at full size
    captured   steps of the route, and of trainings, in CUDA graphs
    tests      tests/ops on CUDA, a process for each file
    roofs      the networks, look-ups and sorts at full size, beside the machine's own copy and products
    sizes      a network at many sizes and precisions, beside torch's products
    rivals     a network by torch.compile, Triton and tiny-cuda-nn, where they are
    step       what surrounds the networks in a training step, beside the same in plain torch
    profile    launches and waits of a default step
    training   short trainings

Each leaves what it has found in OUT/PART.json as well, after every case, and ``gpu_check.py`` takes it from there.
"""

from __future__ import annotations

import argparse
import functools
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), *(str(ROOT / place) for place in ("benchmarks/gpu", "benchmarks", "tests/cuda_emulation"))]

from gpu_cases import captured_steps, captured_trainings, small_cases  # noqa: E402
from gpu_journal import CASE_SECONDS, Again, Case, Journal, one_by_one, settling  # noqa: E402
from gpu_large import large_cases  # noqa: E402
from gpu_timings import profile, rivals, roofs, sizes, step, warp  # noqa: E402, warp

FILE_SECONDS = 60.0
"""For one file of the tests."""
OTHER_TESTS = (
    "app/train/test_training.py",
    "diagram/test_diagram.py",
    "native/test_native.py",
    "nerf/test_rays_and_sampling.py",
)
"""Of tests/, beside those of the operations."""


def machine(out: Path) -> int:
    """Versions, and what is missing with what needs it."""
    import torch

    journal = Journal(out, "machine")

    needed = {"setuptools": "the build", "pytest": "the tests", "numpy": "everything", "PIL": "the data"}
    needed |= {"safetensors": "checkpoints", "matplotlib": "curves", "scipy": "some tests"}
    print(f"python {sys.version.split()[0]}, torch {torch.__version__}, CUDA {torch.version.cuda}")
    journal.put("python", sys.version.split()[0])
    journal.put("torch", torch.__version__)
    journal.put("cuda", torch.version.cuda)
    journal.put("cores", os.cpu_count())
    missing = []
    if torch.cuda.is_available():
        properties = torch.cuda.get_device_properties(0)
        print(f"{properties.name}: sm_{properties.major}{properties.minor}, {properties.multi_processor_count} SMs")
        journal.put("device", str(properties))
    else:
        missing.append("a GPU that torch sees (everything)")
    for name, use in needed.items():
        if importlib.util.find_spec(name) is None:
            missing.append(f"the package {name} ({use})")
    if importlib.util.find_spec("ninja") is None and shutil.which("ninja") is None:
        missing.append("ninja (the build)")
    if importlib.util.find_spec("pybind11") is None:
        headers = Path(torch.__file__).parent / "include" / "pybind11"
        print(f"pybind11: {'the headers in torch' if headers.exists() else 'none'}")
        if not headers.exists():
            missing.append("pybind11 (the build)")
    if not Path(sysconfig.get_path("include"), "Python.h").exists():
        missing.append(f"Python.h in {sysconfig.get_path('include')} (the build; a package such as python3-dev)")
    for program, places in (
        ("nvcc", ":/usr/local/cuda/bin"),
        ("c++", ""),
        ("compute-sanitizer", ":/usr/local/cuda/bin"),
    ):
        found = shutil.which(program, path=os.environ.get("PATH", "") + places)
        if found is None:
            missing.append(f"{program} ({'the sanitizer' if 'sanitizer' in program else 'the build'})")
            continue
        said = subprocess.run([found, "--version"], capture_output=True, text=True).stdout.splitlines()
        version = next((line for line in said if re.search("[0-9][.][0-9]", line)), "")
        print(f"{found}: {version}")
        journal.put(program, version)
    print(f"missing: {'; '.join(missing) or 'nothing'}")
    journal.put("missing", missing)
    return int(any("build" in name or "GPU" in name for name in missing))


def small(again: Again, journal: Journal) -> int:
    """Every operation, forward and backward."""
    import torch

    def seeded(run: Callable[[], None]) -> None:
        torch.manual_seed(0)
        run()

    cases: list[Case] = [(name, functools.partial(seeded, run)) for name, run in small_cases("cuda")]
    return one_by_one(cases, again, settling("cuda"), journal)


def large(again: Again, journal: Journal) -> int:
    """Networks at full size."""
    cases: list[Case] = list(large_cases("cuda"))
    return one_by_one(cases, again, settling("cuda"), journal)


def captured(again: Again, journal: Journal) -> int:
    """Steps captured once and replayed: nearest centre, sort, networks and their gradients; and whole trainings."""
    cases: list[Case] = [(name, functools.partial(capture, step)) for name, step in captured_steps("cuda")]
    cases += captured_trainings("cuda")
    return one_by_one(cases, again, settling("cuda"), journal)


def capture(step: Callable[[], list[Any]]) -> None:
    """Three replays of a step have the results of the step itself."""
    import torch

    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        expected = [part.clone() for part in step()]
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        found = step()
    for _ in range(3):
        for part in found:
            part.zero_()
        graph.replay()
        torch.cuda.synchronize()
        assert all(torch.equal(a, b) for a, b in zip(expected, found)), "a replay differs from the step itself"


def tests(out: Path, files: list[Path] | None = None, seconds: float = FILE_SECONDS) -> int:
    """Every file of tests/ops, and what else has tests for CUDA, in a process of its own, several at a time; its
    output goes to ``out``."""
    journal = Journal(out, "tests")
    files = files or [
        *sorted((ROOT / "tests" / "ops").glob("test_*.py")),
        *(ROOT / "tests" / name for name in OTHER_TESTS),
    ]
    options = ["-q", "-p", "no:cacheprovider", "--tb=short", "-k", "cuda", "--require", "native,cuda"]

    def run(file: Path) -> tuple[Path, int | str, list[str]]:
        command = [sys.executable, "-m", "pytest", *options, str(file)]
        with (out / f"{file.stem}.txt").open("w+", errors="replace") as log:
            status: int | str
            try:
                # gpu_check.py ends the whole group, of which this is a part, when the time of all is over.
                status = subprocess.run(command, cwd=ROOT, stdout=log, stderr=log, timeout=seconds).returncode
            except subprocess.TimeoutExpired:
                status = f"stopped after {seconds:g} s"
            log.seek(0)
            return file, status, log.read().splitlines()

    failed = 0
    # Most of a file's time goes into imports and compilers.
    with ThreadPoolExecutor(max(4, min(12, (os.cpu_count() or 4) // 2))) as pool:
        for done in as_completed([pool.submit(run, file) for file in files]):
            file, status, lines = done.result()
            # 5: no test of this file is for CUDA.
            failed += status not in (0, 5)
            said = "; ".join([status] * isinstance(status, str) + lines[-1:])
            print(f"{'passed' if status in (0, 5) else 'FAILED'}  {file.name}: {said}", flush=True)
            wrong = [line[:200] for line in lines if line.startswith(("FAILED", "ERROR", "E  "))]
            for line in wrong:
                print(f"    {line}", flush=True)
            journal.add("files", {"name": file.name, "right": status in (0, 5), "said": said, "wrong": wrong})
    print(f"{len(files) - failed} of {len(files)} files passed")
    return failed


def training(out: Path, data: str, again: Again, device: str = "cuda", seconds: float = 6.0) -> int:
    """Steps, milliseconds of one and PSNR of short trainings of the same number of seconds."""
    from voronerf.app.scenes import load_scene
    from voronerf.app.train import Scores, TrainConfig, build, run

    journal = Journal(out, "training", begun=again.start > 0)
    # Lego at 100 x 100 and at 400 x 400; the built-in scene has one size.
    scenes = {size: load_scene(data, downscale=by) for size, by in ([("", 1)] if data == "builtin" else SIZES)}
    common: dict[str, Any] = {"data": data, "device": device, "budget": seconds, "cells": (12,), "rays": 4096}
    common |= {"evaluations": 4, "eval_views": 5}

    def train(name: str, size: str, options: dict[str, Any]) -> str:
        scores = Scores(None)
        run(build(TrainConfig(**{**common, **options}), scenes[size]), [scores])
        summary = scores.summary
        milliseconds = 1e3 * summary["seconds"] / summary["steps"]
        over = [(row["seconds"], row["psnr"]) for row in scores.metrics]
        found = {"name": name, "settings": options, "milliseconds": milliseconds, "psnr over seconds": over}
        journal.add("trainings", {**found, **summary})
        return f"{summary['steps']} steps of {milliseconds:.2f} ms, PSNR {summary['psnr']:.2f} on 5 views"

    cases: list[Case] = [
        (name + size, functools.partial(train, name + size, size, options))
        for size in scenes
        for name, options in TRAININGS.items()
    ]
    return one_by_one(cases, again, settling(device), journal)


SIZES = ((" at 100", 8), (" at 400", 2))
"""Trainings on a Blender scene of 800 x 800: a name and the downscale of each."""
NERF: dict[str, Any] = {"field": "nerf", "occupancy": False}
TRAININGS: dict[str, dict[str, Any]] = {
    "default": {},
    "default, every sample": {"occupancy": False},
    "default, bf16": {"precision": "bf16"},
    "nerf": NERF,
    "nerf, bf16": {**NERF, "precision": "bf16"},
    "nerf, fp16": {**NERF, "precision": "fp16"},
}
"""What each training sets."""


def main(arguments: list[str]) -> int:
    """Run one part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=tuple(PARTS))
    parser.add_argument("out", nargs="?", type=Path, default=ROOT / "build" / "gpu-check")
    parser.add_argument("data", nargs="?", default="builtin")
    parser.add_argument("--case-seconds", type=float, help="for one case, after which it is said to hang")
    parser.add_argument("--start", type=int, default=0, help="the first case")
    parser.add_argument("--failed", type=int, default=0, help="cases before it that failed")
    given = parser.parse_args(arguments)
    seconds = given.case_seconds or PARTS[given.part] * CASE_SECONDS
    again = Again((given.part, str(given.out), given.data), given.start, given.failed, seconds)
    checks = {"small": small, "large": large, "captured": captured}
    timings = {"roofs": roofs, "sizes": sizes, "step": step, "profile": profile, "rivals": rivals, "warp": warp}
    if given.part in checks:
        return checks[given.part](again, Journal(given.out, given.part, begun=given.start > 0))
    if given.part in timings:
        return timings[given.part](given.out, again)
    if given.part == "training":
        return training(given.out, given.data, again)
    return {"machine": machine, "tests": tests}[given.part](given.out)


PARTS = {"machine": 1, "small": 1, "large": 3, "captured": 1, "roofs": 2, "sizes": 2, "step": 2, "profile": 3}
PARTS |= {"rivals": 2, "training": 4, "tests": 1, "warp": 3}
"""Times ``CASE_SECONDS`` that a case may take: a timing makes a batch as well, and a training is one."""


if __name__ == "__main__":
    sys.exit(min(main(sys.argv[1:]), 100))
