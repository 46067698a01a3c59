"""Parts of ``gpu_check.py`` that are programs of their own: ``gpu_parts.py PART [OUT] [DATA]``.

    machine    what a build and the tests need, each with what is missing
    small      every operation once, forward and backward, against float64: each case for itself
    captured   a step of the route in a CUDA graph
    tests      tests/ops on CUDA, a process for each file
    roofs      the kernels at full size, beside the machine's own copy and products
    training   a short training, and one whose steps are replayed from a CUDA graph

A CUDA error of a kernel ends all that its process could still do: ``small`` then starts itself anew after that case.
"""

from __future__ import annotations

import functools
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks"), str(ROOT / "tests" / "cuda_emulation")]

N = 1 << 22
"""Samples of the timings, as the targets have them."""


def machine() -> int:
    """Versions, and what is missing with what needs it."""
    import torch

    needed = {"setuptools": "the build", "pytest": "the tests", "numpy": "everything", "PIL": "the data"}
    needed |= {"safetensors": "checkpoints", "matplotlib": "curves", "scipy": "some tests"}
    print(f"python {sys.version.split()[0]}, torch {torch.__version__}, CUDA {torch.version.cuda}")
    missing = []
    if torch.cuda.is_available():
        properties = torch.cuda.get_device_properties(0)
        print(f"{properties.name}: sm_{properties.major}{properties.minor}, {properties.multi_processor_count} SMs")
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
        print(f"{found}: {next((line for line in said if re.search('[0-9][.][0-9]', line)), '')}")
    print(f"missing: {'; '.join(missing) or 'nothing'}")
    return int(any("build" in name or "GPU" in name for name in missing))


def small(start: int = 0, failed: int = 0) -> int:
    """Every case; after one that leaves the device unusable, the rest in a new process."""
    import torch

    cases = small_cases("cuda")
    for number in range(start, len(cases)):
        name, run = cases[number]
        try:
            torch.manual_seed(0)
            run()
            torch.cuda.synchronize()
            print(f"right  {name}", flush=True)
        except Exception as error:
            failed += 1
            print(
                f"WRONG  {name}: {type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}", flush=True
            )
            traceback.print_exc(file=sys.stdout)
            sys.stdout.flush()
            try:
                torch.cuda.synchronize()
            except Exception:
                arguments = [sys.executable, __file__, "small", str(number + 1), str(failed)]
                os.execv(sys.executable, arguments)
    print(f"{len(cases) - failed} of {len(cases)} cases are right")
    return failed


def small_cases(device: str) -> list[tuple[str, Callable[[], None]]]:
    """Names and checks, which raise."""
    import torch
    from emulated_networks import ALLOWED, BRANCHED, GAUSSIANS, WIDE, check
    from test_emulated_layers import BROAD, DENSE

    import voronerf

    where = torch.device(device)

    def lookup(op: str, n: int, k: int, dtype: Any) -> None:
        points = torch.randint(-3, 4, (n, 3), device=where).to(dtype)
        centres = torch.randint(-3, 4, (k, 3), device=where).to(dtype)
        if op == "nearest_centre":
            found, expected = (voronerf.nearest_centre(points, centres, backend=b) for b in ("native", "reference"))
        else:
            diagram = voronerf.VoronoiDiagram(torch.rand(4, 3)).refine({1: torch.rand(k, 3)})[0]
            tables = [x.to(where) for x in (diagram.centres, diagram.child_offsets, diagram.child)]
            points = points.float() / 8 + 0.5
            found, expected = (
                voronerf.locate_cell(points, *tables, depth=diagram.depth, backend=b) for b in ("native", "reference")
            )
        assert torch.equal(found, expected)

    def sort(n: int, k: int) -> None:
        cells = torch.randint(0, k, (n,), dtype=torch.int32, device=where)
        found, expected = (voronerf.cell_sort(cells, k, backend=b) for b in ("native", "reference"))
        assert all(torch.equal(a, b) for a, b in zip(found, expected))

    def close(run: Callable[..., Any], leaves: list[Any]) -> None:
        """Results and gradients against the reference in float64."""
        outcomes = []
        for backend, dtype in (("native", torch.float32), ("reference", torch.float64)):
            given = [leaf.to(where, dtype).requires_grad_() for leaf in leaves]
            out = run(given, backend)
            parts = [part for part in (out if isinstance(out, tuple) else (out,)) if part.is_floating_point()]
            total = sum(
                (part * torch.linspace(0.5, 1.5, part.numel(), device=where).view_as(part)).sum() for part in parts
            )
            outcomes.append([*parts, *torch.autograd.grad(total, given, allow_unused=True, materialize_grads=True)])
        for part, exact in zip(*outcomes):
            assert (part.double() - exact).norm() <= 1e-5 * exact.norm() + 1e-6, (
                list(part.shape),
                part.isfinite().all(),
            )

    def composite() -> None:
        offsets = torch.tensor([0, 0, 1, 71, 180], dtype=torch.int32, device=where)
        close(
            lambda x, b: tuple(voronerf.composite(*x, ray_offsets=offsets, backend=b)),
            [torch.rand(180), torch.rand(180, 3), torch.rand(180).cumsum(0), torch.rand(180)],
        )

    def resample() -> None:
        weights, edges = torch.rand(6, 45), torch.rand(6, 46).cumsum(1)
        found = voronerf.resample(weights.to(where), edges.to(where), 70, backend="native")
        torch.testing.assert_close(found.cpu(), voronerf.resample(weights, edges, 70, backend="reference"))

    def route() -> None:
        layers = WIDE
        shapes = layers.weight_shapes(3)
        centres = torch.rand(5, 3)

        def run(x: list[Any], backend: str) -> Any:
            options: dict[str, Any] = {"centres": centres.to(where), "layers": layers, "backend": backend}
            return voronerf.routed_mlp(x[0], x[1:], [None] * len(shapes), **options)[0]

        close(run, [torch.rand(300, 3), *(torch.randn(5, o, i) / i**0.5 for o, i in shapes)])

    def network(layers: Any, counts: list[int], d: int, precision: str) -> None:
        with where:
            check(layers, counts, d, precision)

    networks = {"branched": (BRANCHED, 3), "wide": (WIDE, 7), "gaussians": (GAUSSIANS, 6), "broad": (BROAD, 3)}
    cases: list[tuple[str, Callable[[], None]]] = [
        *(
            (f"nearest_centre {k} {d}", functools.partial(lookup, "nearest_centre", 300, k, d))
            for k, d in ((17, torch.float32), (700, torch.float32), (17, torch.float64))
        ),
        ("locate_cell", functools.partial(lookup, "locate_cell", 300, 3, torch.float32)),
        *((f"cell_sort {n} {k}", functools.partial(sort, n, k)) for n, k in ((5000, 3), (4200, 600), (20_000, 4096))),
        (
            "frequency_encode",
            lambda: close(lambda x, b: voronerf.frequency_encode(x[0], 10, backend=b), [torch.rand(90, 3)]),
        ),
        (
            "integrated_encode",
            lambda: close(
                lambda x, b: voronerf.integrated_encode(x[0], x[1], 4, backend=b),
                [torch.rand(90, 3), torch.rand(90, 3)],
            ),
        ),
        ("composite", composite),
        ("resample", resample),
        *(
            (f"grouped_mlp {name} {precision}", functools.partial(network, layers, [70, 0, 1, 40], d, precision))
            for name, (layers, d) in networks.items()
            for precision in ALLOWED
        ),
        ("grouped_mlp dense float32", functools.partial(network, DENSE, [37, 3], 3, "float32")),
        ("routed_mlp", route),
    ]
    return cases


def captured() -> int:
    """Nearest centre, sort, networks and their gradients, captured once and replayed."""
    import torch

    import voronerf
    from voronerf.layers import MLP, POSITIONS, Layer

    layers = MLP((Layer((POSITIONS,), 64, "relu"), Layer((0,), 64, "relu"), Layer((1,), 4)), (2,), 10)
    shapes = layers.weight_shapes(3)
    weights = [(torch.randn(8, o, i, device="cuda") / i**0.5).requires_grad_() for o, i in shapes]
    biases = [torch.zeros(8, o, device="cuda", requires_grad=True) for o, _ in shapes]
    points, centres = torch.rand(4096, 3, device="cuda"), torch.rand(8, 3, device="cuda")

    def step() -> Any:
        out, _ = voronerf.routed_mlp(points, weights, biases, layers=layers, centres=centres, backend="native")
        return torch.autograd.grad(out.square().mean(), [*weights, *biases])

    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        expected = [part.clone() for part in step()]
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        found = step()
    for _ in range(3):
        graph.replay()
    torch.cuda.synchronize()
    assert all(torch.equal(a, b) for a, b in zip(expected, found)), "a replay differs from the step itself"
    print("a step was captured and replays with the same gradients")
    return 0


def tests(out: Path) -> int:
    """Every file of tests/ops in a process of its own, four at a time; its output goes to ``out``."""
    out.mkdir(parents=True, exist_ok=True)
    files = sorted((ROOT / "tests" / "ops").glob("test_*.py"))

    def run(file: Path) -> tuple[Path, int, list[str]]:
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-p",
            "no:cacheprovider",
            "--tb=short",
            "-k",
            "cuda",
            str(file),
        ]
        with (out / f"{file.stem}.txt").open("w+") as log:
            status = subprocess.run([*command, "--require", "cuda"], cwd=ROOT, stdout=log, stderr=log).returncode
            log.seek(0)
            return file, status, log.read().splitlines()

    failed = 0
    with ThreadPoolExecutor(4) as pool:
        for file, status, lines in pool.map(run, files):
            # 5: no test of this file is for CUDA.
            failed += status not in (0, 5)
            print(
                f"{'passed' if status in (0, 5) else 'FAILED'}  {file.name}: {lines[-1] if lines else ''}", flush=True
            )
            for line in lines:
                if line.startswith(("FAILED", "ERROR", "E  ")):
                    print(f"    {line[:200]}", flush=True)
    print(f"{len(files) - failed} of {len(files)} files passed")
    return failed


def roofs(out: Path, device: str = "cuda", n: int = N) -> int:
    """Milliseconds at full size, what that is of the machine's own limit, and what was aimed at."""
    import torch
    from case import BACKWARD
    from harness import Stopwatch, _cuda_peak
    from networks import NETS, cost, make_batch

    import voronerf
    from voronerf.backends import BackendUnavailable

    where, rows, failed = torch.device(device), [], 0
    limits = {kind: _cuda_peak(kind, where) for kind in ("bfloat16", "float32", "copy")}
    print("limits: " + ", ".join(f"{kind} {value / 1e12:.2f} T/s" for kind, value in limits.items()), flush=True)

    stopwatch = Stopwatch(where)

    def timed(run: Callable[[], Any], repeats: int = 7) -> float:
        times = [stopwatch(lambda _: run(), 0, 1) for _ in range(repeats + 2)]
        return sorted(times[2:])[repeats // 2]

    def row(name: str, run: Callable[[], Any], limit: str, work: float, aim: float | None) -> None:
        nonlocal failed
        try:
            seconds = timed(run)
        except (RuntimeError, ValueError, BackendUnavailable) as error:
            failed += 1
            print(f"FAILED {name}: {error}", flush=True)
            return
        share = work / seconds / limits[limit]
        rows.append({"name": name, "seconds": seconds, "limit": limit, "share": share, "aim": aim})
        aimed = "" if aim is None else f", aimed at {100 * aim:.0f} %: {'reached' if share >= aim else 'MISSED'}"
        print(f"{name:36} {1e3 * seconds:9.3f} ms  {100 * share:6.1f} % of {limit}{aimed}", flush=True)
        (out / "roofs.json").write_text(json.dumps({"limits": limits, "rows": rows}, indent=1) + "\n")

    out.mkdir(parents=True, exist_ok=True)
    points = torch.rand(n, 3, device=where)
    for k, limit, work, aim in ((16, "copy", 16.0 * n, 0.6), (512, "float32", 8.0 * 512 * n, 0.5)):
        centres = torch.rand(k, 3, device=where)
        find = functools.partial(voronerf.nearest_centre, points, centres, backend="native")
        row(f"nearest_centre k={k}", find, limit, work, aim)
    for k in (16, 256, 4096):
        cells = torch.randint(0, k, (n,), dtype=torch.int32, device=where)
        row(
            f"cell_sort k={k}", functools.partial(voronerf.cell_sort, cells, k, backend="native"), "copy", 8.0 * n, None
        )
        short = cells.to(torch.uint8 if k <= 256 else torch.int16)
        row(
            f"  torch.sort {short.dtype} k={k}",
            functools.partial(torch.sort, short, stable=True),
            "copy",
            8.0 * n,
            None,
        )
    forward_aims = {"w64d4": 0.4, "nerf64": 0.4, "mlp32": 0.25}
    for name, k in (("w64d4", 16), ("nerf64", 16), ("mlp32", 256), ("nerf128", 16), ("nerf256", 16)):
        net = NETS[name]
        batch = make_batch(net, n, k, torch.bfloat16, BACKWARD, where)
        options = {"layers": net, "directions": batch.directions, "direction_index": batch.direction_index}
        given = batch.positions[0], batch.offsets, batch.weights, batch.biases
        run = functools.partial(voronerf.grouped_mlp, *given, **options, backend="native")
        price = cost(net)

        def forward(run: Callable[[], Any] = run) -> None:
            with torch.no_grad():
                run()

        def both(run: Callable[[], Any] = run, batch: Any = batch) -> None:
            torch.autograd.grad(run(), [*batch.weights, *batch.biases], batch.gradients[1])

        row(f"{name} k={k} forward", forward, "bfloat16", price.forward * n, forward_aims.get(name))
        both_aim = 0.25 if name == "nerf64" else None
        row(f"{name} k={k} forward + backward", both, "bfloat16", (price.forward + price.backward) * n, both_aim)
        del batch, given, run
        if where.type == "cuda":
            torch.cuda.empty_cache()
    return failed


def training(out: Path, data: str, device: str = "cuda", seconds: float = 15.0) -> int:
    """Steps and PSNR of short trainings of the same number of seconds."""
    from voronerf.data import load_scene
    from voronerf.training.config import TrainConfig
    from voronerf.training.trainer import Trainer

    scene, failed = load_scene(data, downscale=1 if data == "builtin" else 2), 0
    common: dict[str, Any] = {"data": data, "device": device, "budget": seconds, "cells": (12,), "rays": 4096}
    common |= {"evaluations": 1, "eval_views": 2, "final_views": 5, "panels": 0}
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
        except Exception:
            failed += 1
            print(f"FAILED {name}:")
            traceback.print_exc(file=sys.stdout)
    return failed


TRAININGS: dict[str, dict[str, Any]] = {
    "plain": {},
    "bf16": {"precision": "bf16"},
    "bf16 in a graph": {"precision": "bf16", "cuda_graph": True},
}
"""What each training sets."""


def main(part: str, *arguments: str) -> int:
    """Run one part."""
    if part == "small":
        return small(*(int(argument) for argument in arguments))
    if part in ("tests", "roofs"):
        return (tests if part == "tests" else roofs)(Path(arguments[0]))
    if part == "training":
        return training(Path(arguments[0]), arguments[1])
    return {"machine": machine, "captured": captured}[part]()


if __name__ == "__main__":
    sys.exit(min(main(*sys.argv[1:]), 100))
