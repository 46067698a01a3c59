"""Parts of ``gpu_check.py`` that are programs of their own: ``gpu_parts.py PART [OUT] [DATA] [--case-seconds S]``.

    machine    what a build and the tests need, each with what is missing
    small      every operation once, forward and backward, against float64: each case for itself
    captured   steps of the route in CUDA graphs
    tests      tests/ops on CUDA, a process for each file
    roofs      the kernels at full size, beside the machine's own copy and products
    training   a short training, and one whose steps are replayed from a CUDA graph

Each leaves what it has found in OUT/PART.json as well, after every case, and ``gpu_check.py`` takes it from there.
"""

from __future__ import annotations

import argparse
import functools
import importlib.util
import itertools
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), *(str(ROOT / place) for place in ("benchmarks/gpu", "benchmarks", "tests/cuda_emulation"))]

from gpu_cases import captured_steps, has_wgmma, small_cases  # noqa: E402
from gpu_journal import CASE_SECONDS, Again, Case, Journal, one_by_one  # noqa: E402

N = 1 << 22
"""Samples of the timings, as the targets have them."""
CALLS = 8
"""Of a timing, in one graph."""
SETS = 4
"""Of the points of look-ups, and a quarter of those of sorts: with the results more than the caches of a GPU hold."""
FILE_SECONDS = 60.0
"""For one file of the tests."""
OTHER_TESTS = ("training/test_graphs.py", "training/test_trainer.py", "rendering/test_rays_and_sampling.py")
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


def settling(device: str) -> Callable[[], None]:
    """What waits for all that a device has been given."""
    import torch

    return torch.cuda.synchronize if device == "cuda" else lambda: None


def small(again: Again, journal: Journal) -> int:
    """Every operation, forward and backward."""
    import torch

    def seeded(run: Callable[[], None]) -> None:
        torch.manual_seed(0)
        run()

    cases: list[Case] = [(name, functools.partial(seeded, run)) for name, run in small_cases("cuda")]
    return one_by_one(cases, again, settling("cuda"), journal)


def captured(again: Again, journal: Journal) -> int:
    """Steps captured once and replayed: nearest centre, sort, networks and their gradients."""
    cases: list[Case] = [(name, functools.partial(capture, step)) for name, step in captured_steps("cuda")]
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


def clock(run: Callable[[], Any], stopwatch: Any, repeats: int = 7) -> dict[str, Any]:
    """Seconds of a call on the device, several replayed as one graph, and of one that the host launches.

    A kernel of some microseconds waits longer for the host than it takes. Where calls cannot be captured, the reason is
    kept, and both are seconds of a call that is launched.
    """
    import torch

    def middle(work: Callable[[], Any], calls: int) -> float:
        times = [stopwatch(lambda _: work(), 0, 1) / calls for _ in range(repeats + 2)]
        return sorted(times[2:])[repeats // 2]

    launched = middle(run, 1)
    found = {"seconds": launched, "launched": launched, "graph": "not on CUDA"}
    if not stopwatch.cuda:
        return found
    try:
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            run()
        torch.cuda.current_stream().wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            for _ in range(CALLS):
                run()
        return {"seconds": middle(graph.replay, CALLS), "launched": launched, "graph": "captured"}
    except Exception as error:
        return {**found, "graph": f"{type(error).__name__}: {error}"[:200]}


def roofs(out: Path, again: Again, device: str = "cuda", n: int = N) -> int:
    """Milliseconds at full size, what that is of the machine's own limit, and what was aimed at."""
    import torch
    from harness import Stopwatch, _cuda_peak
    from ops.case import BACKWARD
    from ops.networks import NETS, cost, make_batch

    import voronerf
    from voronerf.native.cell_sort import sort as sort_cells
    from voronerf.native.grouped_mlp import using_way

    where = torch.device(device)
    journal = Journal(out, "roofs", begun=again.start > 0)
    if not again.start:
        journal.put("limits", {kind: _cuda_peak(kind, where) for kind in ("bfloat16", "float32", "copy")})
        told = (f"{kind} {value / 1e12:.2f} T/s" for kind, value in journal.found["limits"].items())
        print("limits: " + ", ".join(told), flush=True)
    stopwatch = Stopwatch(where)
    cases: list[Case] = []

    def row(name: str, prepare: Callable[[], Callable[[], Any]], limit: str, work: float, aim: float | None) -> None:
        """Times what ``prepare()`` returns."""

        def case() -> str:
            times = clock(prepare(), stopwatch)
            share = work / times["seconds"] / journal.found["limits"][limit]
            journal.add("rows", {"name": name, **times, "limit": limit, "share": share, "aim": aim})
            aimed = "" if aim is None else f", aimed at {100 * aim:.0f} %: {'reached' if share >= aim else 'MISSED'}"
            alone = f"({1e3 * times['launched']:.3f} launched, {times['graph']})"
            return f"{1e3 * times['seconds']:.3f} ms {alone}, {100 * share:.1f} % of {limit}{aimed}"

        cases.append((name, case))

    def find(k: int) -> Callable[[], Any]:
        centres = torch.rand(k, 3, device=where)
        sets = itertools.cycle([torch.rand(n, 3, device=where) for _ in range(SETS)])
        return lambda: voronerf.nearest_centre(next(sets), centres, backend="native")

    def sort(k: int, way: str) -> Callable[[], Any]:
        sets = [torch.randint(0, k, (n,), dtype=torch.int32, device=where) for _ in range(4 * SETS)]
        if way == "torch.sort":
            kind = torch.uint8 if k <= 256 else torch.int16 if k <= 1 << 15 else torch.int32
            keys = itertools.cycle([cells.to(kind) for cells in sets])
            return lambda: torch.sort(next(keys), stable=True)
        order, offsets = torch.empty_like(sets[0]), sets[0].new_empty(k + 1)
        given = itertools.cycle(sets)
        return lambda: sort_cells(next(given), order, offsets, "cell_sort", way)

    def network(name: str, k: int, backward: bool, way: str = "auto") -> Callable[[], Any]:
        if where.type == "cuda":
            torch.cuda.empty_cache()
        batch = make_batch(NETS[name], n, k, torch.bfloat16, BACKWARD, where)
        options = {"layers": batch.net, "directions": batch.directions, "direction_index": batch.direction_index}
        given = batch.positions[0], batch.offsets, batch.weights, batch.biases

        def run() -> None:
            with torch.set_grad_enabled(backward), using_way(way):
                result = voronerf.grouped_mlp(*given, **options, backend="native")
                if backward:
                    torch.autograd.grad(result, [*batch.weights, *batch.biases], batch.gradients[1])

        return run

    for k, limit, work, aim in ((16, "copy", 16.0 * n, 0.6), (512, "float32", 8.0 * 512 * n, 0.5)):
        row(f"nearest_centre k={k}", functools.partial(find, k), limit, work, aim)
    # Which way is the faster where; beside it torch's sort of the shortest keys, with numbers of rows in 64 bits.
    for k in (16, 256, 1022, 4096, 65_536):
        for way in (*(("counting", "radix") if k <= 1022 else ("radix",)), "torch.sort"):
            row(f"cell_sort k={k} by {way}", functools.partial(sort, k, way), "copy", 8.0 * n, None)
    aims = {"w64d4": 0.4, "nerf64": 0.4, "mlp32": 0.25}
    for name, k in (("w64d4", 16), ("nerf64", 16), ("mlp32", 256), ("nerf128", 16), ("nerf256", 16)):
        price = cost(NETS[name])
        forward, both = (functools.partial(network, name, k, backward) for backward in (False, True))
        both_work, both_aim = (price.forward + price.backward) * n, 0.25 if name == "nerf64" else None
        row(f"{name} k={k} forward", forward, "bfloat16", price.forward * n, aims.get(name))
        if name != "nerf256":
            # Which is the fastest: values in registers, as above, in shared memory, or in registers with products of
            # four warps, which are to become the way by themselves where this shows that they pay.
            for way in ("tiles", "wgmma") if has_wgmma(device) else ("tiles",):
                other = functools.partial(network, name, k, False, way)
                row(f"{name} k={k} forward by {way}", other, "bfloat16", price.forward * n, None)
        row(f"{name} k={k} forward + backward", both, "bfloat16", both_work, both_aim)
    return one_by_one(cases, again, settling(device), journal)


def training(out: Path, data: str, device: str = "cuda", seconds: float = 12.0) -> int:
    """Steps and PSNR of short trainings of the same number of seconds."""
    from voronerf.data import load_scene
    from voronerf.training.config import TrainConfig
    from voronerf.training.trainer import Trainer

    journal = Journal(out, "training")
    scene, failed = load_scene(data, downscale=1 if data == "builtin" else 2), 0
    common: dict[str, Any] = {"data": data, "device": device, "budget": seconds, "cells": (12,), "rays": 4096}
    common |= {"field": "nerf", "occupancy": False, "evaluations": 1, "eval_views": 2, "final_views": 5, "panels": 0}
    for name, options in TRAININGS.items():
        if device == "cpu" and options.get("cuda_graph"):
            continue
        begin = time.perf_counter()
        try:
            trainer = Trainer(TrainConfig(**common, **options, out=out / name), scene)
            summary = trainer.run()
            rate = summary["rays_per_second"] / 1e3
            print(
                f"{name}: {summary['steps']} steps, {rate:.0f} k rays/s, PSNR {summary['psnr']:.2f} on 5 views, "
                f"{time.perf_counter() - begin:.0f} s in all",
                flush=True,
            )
            journal.add("trainings", {"name": name, "settings": options, "right": True, **summary})
        except Exception as error:
            failed += 1
            print(f"FAILED {name}:")
            traceback.print_exc(file=sys.stdout)
            journal.add("trainings", {"name": name, "settings": options, "right": False, "said": str(error)})
    return failed


TRAININGS: dict[str, dict[str, Any]] = {
    "plain": {},
    "bf16": {"precision": "bf16"},
    "bf16 in a graph": {"precision": "bf16", "cuda_graph": True},
    "fp16 in a graph": {"precision": "fp16", "cuda_graph": True},
}
"""What each training sets."""


def main(arguments: list[str]) -> int:
    """Run one part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("machine", "small", "captured", "roofs", "training", "tests"))
    parser.add_argument("out", nargs="?", type=Path, default=ROOT / "build" / "gpu-check")
    parser.add_argument("data", nargs="?", default="builtin")
    parser.add_argument("--case-seconds", type=float, help="for one case, after which it is said to hang")
    parser.add_argument("--start", type=int, default=0, help="the first case")
    parser.add_argument("--failed", type=int, default=0, help="cases before it that failed")
    given = parser.parse_args(arguments)
    # A case of the timings makes a batch as well.
    seconds = given.case_seconds or (2 * CASE_SECONDS if given.part == "roofs" else CASE_SECONDS)
    again = Again((given.part, str(given.out)), given.start, given.failed, seconds)
    runs: dict[str, Callable[[], int]] = {
        "machine": lambda: machine(given.out),
        "small": lambda: small(again, Journal(given.out, "small", begun=given.start > 0)),
        "captured": lambda: captured(again, Journal(given.out, "captured", begun=given.start > 0)),
        "roofs": lambda: roofs(given.out, again),
        "training": lambda: training(given.out, given.data),
        "tests": lambda: tests(given.out),
    }
    return runs[given.part]()


if __name__ == "__main__":
    sys.exit(min(main(sys.argv[1:]), 100))
