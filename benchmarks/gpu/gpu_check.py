"""Everything to be learnt from a machine with a GPU, in three calls of ten minutes: ``gpu_check.py CALL --out DIR``.

For a bare machine: torch with CUDA, nvcc and ninja, no network. The parts of a call run one after another, each for
itself: one that fails or runs into its limit is reported with its last lines, and the next one begins. The limits of a
call add up to less than its time, the most telling part first. ``--parts`` takes some of all parts, ``--data DIR``
is a Blender scene for the trainings.

    1   machine    versions, and what is missing
        build      the extension for this GPU alone
        small      every operation once against float64, each case for itself and with a time limit of its own
        large      networks at 2^22 samples against float64, with gradients
        captured   steps of the route in CUDA graphs, fused and layer by layer; steps of trainings, with times
        warp       every operation of Warp beside native, where Warp is installed
        memcheck   compute-sanitizer over the small cases, where it is installed
    2   roofs      networks, look-ups and sorts at full size, beside the machine's own limits
        sizes      a network at 2^13 to 2^22 samples, 1 to 4,096 cells, all precisions, beside torch's products
        step       what surrounds the networks in a step, and hash grids, beside the same in plain torch
        profile    a default step: launches, the share of the time that the device works, waits of the host
        rivals     a network by torch.compile, Triton and tiny-cuda-nn (VORONERF_TCNN names a benchmark of it), where
                   they are
    3   training   trainings on --data or the built-in scene, with PSNR over seconds
        tests      the tests of the operations on CUDA, a process for each file
        counters   ncu over eight kernels, where it is installed
        racecheck, synccheck, initcheck   compute-sanitizer over the small cases

DIR gets two files: summary-CALL.json, with the outcome of every part and all that it has found (each case, timing,
training and file of tests), and parts-CALL.tar.gz, with what each part said. The last lines printed are the verdict;
the exit status counts failures.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import tarfile
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

ROOT = Path(__file__).resolve().parents[2]
PYTHON = sys.executable
TAIL = 40
"""Lines of a failure that are printed."""
SPLIT = "--split-compile=0"
JUDGED = (
    *("small", "large", "captured", "warp", "roofs", "sizes", "step", "profile", "rivals", "training"),
    *("memcheck", "racecheck", "synccheck", "initcheck"),
)
"""Parts that have cases, each right or wrong."""
SHORTEST = 10.0
"""Seconds for which a part is not begun."""


@dataclass(frozen=True)
class Part:
    """One part: its command, or why it is left out, the seconds it may take, and the JSON that it leaves."""

    command: list[str] | str
    seconds: int
    environment: tuple[tuple[str, str], ...] = ()
    found: Path | None = None


CALLS = {
    "1": ("machine", "build", "small", "large", "captured", "warp", "memcheck"),
    "2": ("build", "roofs", "sizes", "step", "profile", "rivals"),
    "3": ("build", "training", "tests", "counters", "racecheck", "synccheck", "initcheck"),
}
"""Parts of each call. All begin with the build, which takes no time where an earlier call's is there."""
SECONDS = 575.0
"""Of a call."""


def main(arguments: list[str]) -> int:
    """Run the parts and return the number of those that failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("call", choices=tuple(CALLS), help="which of the three calls")
    parser.add_argument("--out", type=Path, required=True, help="folder for the summary and the archive")
    parser.add_argument("--parts", nargs="+", help="some of the parts, in this order")
    parser.add_argument("--data", type=Path, help="a Blender scene for the trainings, else the built-in one")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="for all parts together")
    given = parser.parse_args(arguments)
    given.out = given.out.resolve()  # the parts run elsewhere
    given.data = given.data and given.data.resolve()
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        known = parts(scratch, given.data)
        chosen = given.parts or list(CALLS[given.call])
        if unknown := [name for name in chosen if name not in known]:
            parser.error(f"--parts takes {', '.join(known)}, got {', '.join(unknown)}")
        given.out.mkdir(parents=True, exist_ok=True)
        results = {}
        end = time.perf_counter() + given.seconds
        for name in chosen:
            print(f"gpu-check: {name} ...", flush=True)
            results[name] = run(name, known[name], scratch, end - time.perf_counter())
            # Kept after every part, should this be stopped from outside.
            said = json.dumps({"device": device(), "parts": results}, indent=1) + "\n"
            (given.out / f"summary-{given.call}.json").write_text(said)
            pack(scratch, given.out / f"parts-{given.call}.tar.gz")
    print(f"\ngpu-check on {device()}:")
    for line in highlights({name: result.get("found") for name, result in results.items()}):
        print(f"  {line}")
    for name, result in results.items():
        print(f"  {name:10} {result['outcome']:8} {result['seconds']:6.1f} s  {result['last']}")
    return sum(result["outcome"] == "failed" for result in results.values())


def pack(folder: Path, archive: Path) -> None:
    """What the parts have said and found, but not the runs of trainings."""
    with tarfile.open(archive, "w:gz") as tar:
        for path in sorted(folder.rglob("*")):
            if path.suffix in (".txt", ".json", ".csv", ".jsonl"):
                tar.add(path, path.relative_to(folder))


def parts(out: Path, data: Path | None) -> dict[str, Part]:
    """The parts by name; ``out`` is for what they leave."""
    places = os.environ.get("PATH", "") + ":/usr/local/cuda/bin"
    sanitizer, profiler = shutil.which("compute-sanitizer", path=places), shutil.which("ncu", path=places)
    architecture = capability()
    # nvcc optimises the kernels of a file in parallel, where it can.
    built = (("VORONERF_CUDA", "1"), ("VORONERF_CUDA_ARCHITECTURES", architecture or ""), ("NVCC_APPEND_FLAGS", SPLIT))
    own = [PYTHON, str(ROOT / "benchmarks" / "gpu" / "gpu_parts.py")]
    # Each allocation for itself, so that what reads or writes beyond one leaves all of them.
    apart = (("PYTORCH_NO_CUDA_MEMORY_CACHING", "1"),)

    def part(
        command: list[str], seconds: int, environment: tuple[tuple[str, str], ...] = (), found: Path | None = None
    ) -> Part:
        return Part(command, seconds, environment, found) if architecture else Part("torch sees no GPU", 0)

    def program(name: str, seconds: int, *rest: str) -> Part:
        return part([*own, name, str(out), *rest], seconds, (), out / f"{name}.json")

    def sanitized(tool: str, seconds: int, environment: tuple[tuple[str, str], ...] = ()) -> Part:
        if sanitizer is None:
            return Part("no compute-sanitizer", 0)
        command = [sanitizer, "--error-exitcode", "9", "--target-processes", "all", "--tool", tool, *own, "small"]
        found = out / tool
        return part([*command, str(found), "--case-seconds", "30"], seconds, environment, found / "small.json")

    counted = ["--launch-count", "8", "--set", "basic", "--csv", "--log-file", str(out / "counters.csv")]
    return {
        "machine": Part([*own, "machine", str(out)], 15, (), out / "machine.json"),
        "build": part([PYTHON, "setup.py", "build_ext", "--inplace"], 270, built),
        "small": program("small", 75),
        "large": program("large", 85),
        "captured": program("captured", 40),
        "warp": program("warp", 35) if importlib.util.find_spec("warp") else Part("no warp", 0),
        "roofs": program("roofs", 80),
        "sizes": program("sizes", 80),
        "step": program("step", 65),
        "rivals": program("rivals", 40),
        "profile": program("profile", 40),
        "training": program("training", 120, "builtin" if data is None else str(data)),
        "tests": program("tests", 75) if importlib.util.find_spec("pytest") else Part("no pytest", 0),
        "counters": part([profiler, *counted, *own, "profile", str(out / "counted")], 40)
        if profiler
        else Part("no ncu", 0),
        "memcheck": sanitized("memcheck", 55, apart),
        "racecheck": sanitized("racecheck", 30),
        "synccheck": sanitized("synccheck", 20),
        "initcheck": sanitized("initcheck", 20),
    }


def run(name: str, part: Part, out: Path, left: float) -> dict[str, Any]:
    """Outcome, seconds and the last line of one part, which has ``left`` at most; what it said goes to a file."""
    if isinstance(part.command, str):
        return {"outcome": "left out", "seconds": 0.0, "last": part.command}
    limit = min(part.seconds, left)
    if limit < SHORTEST:
        return {"outcome": "left out", "seconds": 0.0, "last": "no time left"}
    paths = os.pathsep.join(path for path in (str(ROOT), os.environ.get("PYTHONPATH")) if path)
    environment = {**os.environ, **dict(part.environment), "PYTHONPATH": paths}
    if part.found is not None:
        part.found.unlink(missing_ok=True)  # an earlier run's
    begin = time.perf_counter()
    with (out / f"{name}.txt").open("w+", errors="replace") as log:
        try:
            status = run_group(part.command, environment, log, limit)
        except OSError as error:
            status = str(error)
        log.seek(0)
        lines = [line for line in log.read().splitlines() if line.strip()]
    if status != 0:
        print("\n".join(f"    {line}" for line in lines[-TAIL:]))
    last = lines[-1][:160] if lines else ""
    return {
        "outcome": "passed" if status == 0 else "failed",
        "seconds": time.perf_counter() - begin,
        "last": last if isinstance(status, int) else f"{status}; {last}",
        "found": read(part.found),
    }


def read(path: Path | None) -> object:
    """What a part has left as JSON; the reason where that cannot be read, as after an end in the middle of a line."""
    if path is None or not path.exists():
        return None
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        return f"{path.name}: {error}"


def highlights(found: dict[str, Any]) -> list[str]:
    """What the parts have found, a line each: timings beside what was aimed at, trainings, and what is wrong."""

    def rows(part: str, kind: str) -> list[dict[str, Any]]:
        kept = found.get(part)
        return kept.get(kind, []) if isinstance(kept, dict) else []

    lines = []
    timed = [row for part in ("warp", "roofs", "sizes", "step", "rivals") for row in rows(part, "rows")]
    for row in timed:
        aim = row["aim"]
        verdict = "" if aim is None else f", {'reached' if row['share'] >= aim else 'MISSED'} {100 * aim:.0f} %"
        share = f"{100 * row['share']:5.1f} % of {row['limit']}"
        lines.append(f"{row['name']:32} {1e3 * row['seconds']:8.3f} ms {share}{verdict}")
    times = {row["name"]: row["seconds"] for row in timed}
    for name, seconds in times.items():
        radix = times.get(name.replace("by counting", "by radix"))
        if name.endswith("by counting") and radix is not None:
            lines.append(f"{name}: {seconds / radix:.2f} x the time of radix")
        for other, its in times.items():
            if other.startswith(f"{name} by "):
                lines.append(f"{name}: {seconds / its:.2f} x the time of {other.removeprefix(f'{name} by ')}")
    lines += [f"RULE {line}" for line in ruled(times)]
    lines += [f"left out: {row['name']}: {row['reason']}" for row in rows("rivals", "skipped")]
    for row in rows("profile", "steps"):
        said = f"{row['launches']} launches, {row['waits']} waits, busy {100 * row['busy']:.0f} %"
        lines.append(f"step {row['name']}: {said}, {row['nanoseconds']:.1f} ns a sample")
    for row in rows("training", "trainings"):
        said = f"{row['milliseconds']:.2f} ms a step, PSNR {row['psnr']:.2f} after {row['steps']} steps"
        lines.append(f"training {row['name']}: {said}")
    lines += [f"{row['name']}: {row['said']}" for row in rows("captured", "cases") if row["right"] and row["said"]]
    for part in JUDGED:
        lines += [f"WRONG in {part}: {row['name']}: {row['said']}" for row in rows(part, "cases") if not row["right"]]
    lines += [f"WRONG in tests: {row['name']}: {row['said']}" for row in rows("tests", "files") if not row["right"]]
    return lines


def ruled(times: dict[str, float]) -> list[str]:
    """What docs/cuda.md says is to be kept or deleted, by seconds of each row."""
    lines = []
    pairs = [
        (times.get(f"cell_sort k={k} by counting"), times.get(f"cell_sort k={k} by radix")) for k in (16, 256, 1022)
    ]
    known = [(counting, radix) for counting, radix in pairs if counting and radix]
    if known:
        slower = sum(counting > radix for counting, radix in known)
        lost = {0: "counting up to 1,022 cells stays", len(known): "delete sorting by counting"}
        lines.append(f"sort: {lost.get(slower, 'move the limit between counting and radix')}")
    return lines


def run_group(command: list[str], environment: dict[str, str], log: TextIO, limit: float) -> int | str:
    """Exit status of a command, or what became of it: past ``limit`` seconds, all that it started is ended with it."""
    process = subprocess.Popen(
        command, cwd=ROOT, env=environment, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
    )
    try:
        return process.wait(limit)
    except subprocess.TimeoutExpired:
        return f"stopped after {limit:.0f} s"
    finally:
        # Of a command that has ended, what it left behind; nothing more is to run beside the next part.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        # A process that waits inside of the driver may not end.
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(10)


def capability() -> str | None:
    """Compute capability of the GPU, such as "90"; None without one."""
    import torch

    if not torch.cuda.is_available():
        return None
    major, minor = torch.cuda.get_device_capability()
    return f"{major}{minor}"


def device() -> str:
    """The GPU and the versions that belong to it."""
    import torch

    name = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"
    return f"{name}, torch {torch.__version__}, CUDA {torch.version.cuda}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
