"""Runs all GPU checks in fifteen minutes of a GPU, in two calls: ``gpu_check.py {first,second} --out DIR``.

It runs on a bare machine with torch for CUDA, nvcc and ninja, without network. The parts of a call run one after
another. If a part fails or times out, its last lines are reported, and the next part begins. Later parts inherit unused
time.

    first, 390 s    build      links the objects of --prebuilt (prebuilt.py), else compiles
                    cases      gpu_parts.py: every operation, networks at 2^22 samples, steps in CUDA graphs, rows of
                               timings, a step profiled by torch.profiler, two trainings
                    counters   ncu over six launches, if ncu is installed
                    memcheck   compute-sanitizer over 21 of the small cases, if it is installed
    second, 240 s   build      as above
                    cases      the cases of --cases, such as failed cases of the first call, and all rows again
                    tests      tests/ops on CUDA, a process for each file
                    racecheck, synccheck   compute-sanitizer over 14 of the small cases

DIR gets two files: summary-CALL.json with the command, the outcome and the findings of every part, and
parts-CALL.tar.gz with their outputs. The last printed lines are the verdict, fewer than 11,000 characters. The exit
status is the number of failures. ``--emulated`` tries the call with small cases on a machine without a GPU.

The program does not change the settings of the card; ncu does not lock the clocks.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import functools
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from gpu_journal import unfinished

ROOT = Path(__file__).resolve().parents[2]
PYTHON = sys.executable
TAIL = 30
"""The number of printed lines of a failed part."""
SHORTEST = 5.0
"""If fewer seconds are left, no further part begins."""
LINE, WRONG, VERDICT = 100, 160, 10_900
"""Maximum characters of a line of the verdict, of a line about a failure, and of the whole verdict."""
MOST_WRONG = 30
"""Maximum number of lines about failures."""
KERNELS = 10
"""The number of reported kernels of a profiled step."""
CALLS = ("first", "second")
SANITIZER_SAYS = (
    "Invalid ",
    "Misaligned ",
    "Race reported",
    "Barrier error",
    "Program hit",
    "Error: ",
    "ERROR SUMMARY",
)
WORDY = ("void ", "voronerf::", "(anonymous namespace)::", "<unnamed>::", "at::native::")
"""Parts that are removed from the names of kernels."""
COUNTED = {
    "ms": ("gpu__time_duration.sum", 1e-6),
    "M instructions": ("smsp__inst_executed.sum", 1e-6),
    "SM %": ("sm__throughput.avg.pct_of_peak_sustained_elapsed", 1.0),
    "memory %": ("gpu__compute_memory_throughput.avg.pct_of_peak_sustained_elapsed", 1.0),
    "issued %": ("smsp__issue_active.avg.per_cycle_active", 100.0),
    "warps %": ("sm__warps_active.avg.pct_of_peak_sustained_active", 1.0),
}
"""Reported metrics of ncu: label -> (name in ncu, factor)."""
STALLED = "smsp__average_warps_issue_stalled_", "_per_issue_active.ratio"
"""Prefix and suffix of the names of ncu's stall metrics; the reason of the stall stands between them."""
KEPT = (STALLED[0], "launch__", "l1tex__t_sector_hit", "lts__t_sector_hit", "dram__bytes.sum")
"""Prefixes of the names of further metrics that are stored; ncu reports 700 metrics per launch."""
SECTIONS = (
    *("SpeedOfLight", "WarpStateStats", "SchedulerStats", "MemoryWorkloadAnalysis", "ComputeWorkloadAnalysis"),
    *("InstructionStats", "Occupancy", "LaunchStats"),
)


@dataclass(frozen=True)
class Part:
    """One part of a call.

    The commands are alternatives: if one fails, the next one runs. A string instead of commands is the reason why the
    part is omitted. The part is stopped ``until`` seconds after the start of the call, and writes its findings into the
    file ``found``.
    """

    commands: list[list[str]] | str
    until: float
    environment: tuple[tuple[str, str], ...] = ()
    found: Path | None = None


def main(arguments: list[str]) -> int:
    """Runs the parts; returns the number of failed parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("call", choices=CALLS, help="which of the two calls")
    parser.add_argument("--out", type=Path, required=True, help="folder for the summary and the archive")
    parser.add_argument("--cases", nargs="+", default=[], help="cases of the second call, with * as a wildcard")
    parser.add_argument("--parts", nargs="+", help="some of the parts, in this order")
    parser.add_argument("--prebuilt", type=Path, default=ROOT / "build/prebuilt", help="objects that are carried")
    parser.add_argument("--emulated", action="store_true", help="small cases on the emulated device of the tests")
    options = parser.parse_args(arguments)
    options.out = options.out.resolve()  # parts run in other folders
    options.out.mkdir(parents=True, exist_ok=True)
    begin = time.perf_counter()
    device()  # a hanging kernel may block the driver later
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        scratch = Path(folder)
        available = parts(options.call, scratch, options.prebuilt.resolve(), options.cases, emulated=options.emulated)
        chosen = options.parts or list(available)
        if unknown := [name for name in chosen if name not in available]:
            parser.error(f"--parts takes {', '.join(available)}, got {', '.join(unknown)}")
        results: dict[str, Any] = {}
        for name in chosen:
            results[name] = run(name, available[name], scratch, available[name].until - time.perf_counter() + begin)
            # Written after every part, in case the process is killed.
            said = json.dumps({"device": device(), "call": arguments, "parts": results}, indent=1) + "\n"
            (options.out / f"summary-{options.call}.json").write_text(said)
            pack(scratch, options.out / f"parts-{options.call}.tar.gz")
    print(verdict(options.call, results))
    return sum(result["outcome"] == "failed" for result in results.values())


def pack(folder: Path, archive: Path) -> None:
    """Packs the outputs and findings of the parts, without the run directories of trainings."""
    with tarfile.open(archive, "w:gz") as tar:
        for path in sorted(folder.rglob("*")):
            if path.suffix in (".txt", ".json", ".csv"):
                tar.add(path, path.relative_to(folder))


def parts(call: str, out: Path, prebuilt: Path, cases: list[str], *, emulated: bool) -> dict[str, Part]:
    """Makes the parts of a call, by name; ``out`` is the folder of their files."""
    places = os.environ.get("PATH", "") + ":/usr/local/cuda/bin"
    places += "".join(f":{path.parent}" for path in Path("/opt/nvidia/nsight-compute").glob("*/ncu"))
    sanitizer, profiler = shutil.which("compute-sanitizer", path=places), shutil.which("ncu", path=places)
    # nvcc optimises the kernels of a file in parallel, if it can.
    built = (("VORONERF_CUDA", "1"), ("NVCC_APPEND_FLAGS", "--split-compile=0"))
    built += (("VORONERF_CUDA_ARCHITECTURES", capability() or "90"),)
    program, small = [PYTHON, str(ROOT / "benchmarks/gpu/gpu_parts.py")], ["--emulated", "--patience", "10"] * emulated

    def tried(until: float, *rest: str) -> Part:
        return Part([[*program, "cases", str(out), *rest, *small]], until, (), out / "cases.json")

    def on_gpu(until: float, command: list[str] | None, found: Path, **environment: str) -> Part:
        """Makes a part that needs a GPU and an optional program; ``command`` is None if the program is missing."""
        if emulated or command is None:
            return Part("no GPU" if emulated else "not installed", until)
        return Part([command], until, tuple(environment.items()), found)

    def sanitized(tool: str, until: float, names: str, **environment: str) -> Part:
        # torch's kernels are not checked, because their instrumentation would take minutes.
        options = ["--tool", tool, "--kernel-name", "kns=voronerf", "--error-exitcode", "9", "--print-limit", "20"]
        # An error ends only its kernel; failed driver calls of torch are not errors.
        options += ["--destroy-on-device-error", "kernel", "--report-api-errors", "no", "--show-backtrace", "device"]
        checked = [*program, "cases", str(out / tool), "--parts", "small", "--names", names, "--patience", "4"]
        command = None if sanitizer is None else [sanitizer, *options, *checked]
        return on_gpu(until, command, out / tool / "cases.json", **environment)

    linked = [PYTHON, str(ROOT / "benchmarks/gpu/prebuilt.py"), "try" if emulated else "link", str(prebuilt)]
    compiled = [[PYTHON, "setup.py", "build_ext", "--inplace"]] if not emulated else []
    first = call == "first"
    # Linking takes about ten seconds; compiling takes longer, at the expense of later parts.
    common = {"build": Part([linked, *compiled], 150 if first else 100, built)}
    if first:
        # By default ncu locks the clocks of the card, which may be shared.
        options = ["--clock-control", "none", "--profile-from-start", "off", "--launch-count", "6"]
        options += ["--kernel-name-base", "function", "--kernel-name", "regex:program_kernel|hash_encode"]
        options += [each for section in SECTIONS for each in ("--section", section)]
        options += ["--csv", "--page", "raw", "--print-units", "base", "--log-file", str(out / "counters.csv")]
        counted = None if profiler is None else [profiler, *options, *program, "counted", str(out)]
        # Tensors have separate allocations, so that an access out of bounds does not hit another tensor.
        return common | {
            "cases": tried(285),
            "counters": on_gpu(330, counted, out / "counters.csv"),
            "memcheck": sanitized("memcheck", 390, "@checked", PYTORCH_NO_CUDA_MEMORY_CACHING="1"),
        }
    return common | {
        "cases": tried(110, "--parts", "small", "large", "captured", "rows", "training", "--names", "rows", *cases),
        "tests": on_gpu(170, [*program, "tests", str(out)], out / "tests.json"),
        "racecheck": sanitized("racecheck", 210, "@racing"),
        "synccheck": sanitized("synccheck", 240, "@racing"),
    }


def run(name: str, part: Part, out: Path, limit: float) -> dict[str, Any]:
    """Runs a part with its output in a file; returns its outcome, seconds and last line."""
    if isinstance(part.commands, str):
        return {"outcome": "left out", "seconds": 0.0, "last": part.commands}
    if limit < SHORTEST:
        return {"outcome": "left out", "seconds": 0.0, "last": "no time left"}
    print(f"gpu-check: {name}, {limit:.0f} s at most: {' || '.join(map(' '.join, part.commands))}", flush=True)
    paths = os.pathsep.join(path for path in (str(ROOT), os.environ.get("PYTHONPATH")) if path)
    environment = {**os.environ, **dict(part.environment), "PYTHONPATH": paths}
    if part.found is not None:
        part.found.unlink(missing_ok=True)  # of an earlier run
    begin = time.perf_counter()
    with (out / f"{name}.txt").open("w+", errors="replace") as log:
        status: int | str = 0
        for command in part.commands:
            status = run_group(command, environment, log, limit - time.perf_counter() + begin)
            if part.found is not None and part.found.name == "cases.json":
                status = go_on(command, status, part.found, environment, log, limit - time.perf_counter() + begin)
            if status == 0 or isinstance(status, str):
                break
        log.seek(0)
        lines = [line for line in log.read().splitlines() if line.strip()]
    if status != 0:
        print("\n".join(f"    {line[:200]}" for line in lines[-TAIL:]))
    last = lines[-1][:160] if lines else ""
    return {
        "outcome": "passed" if status == 0 else "failed",
        "seconds": time.perf_counter() - begin,
        "last": last if isinstance(status, int) else f"{status}; {last}",
        "commands": part.commands,
        "found": read(part.found),
        "counted": [line.removeprefix("counted: ") for line in lines if line.startswith("counted: ")],
        "sanitizer": sanitizer_says(lines),
    }


def go_on(
    command: list[str], status: int | str, found: Path, environment: dict[str, str], log: TextIO, limit: float
) -> int | str:
    """Restarts the cases whenever a case ends their process; returns the last status."""
    end, before = time.perf_counter() + limit, -1
    while isinstance(status, int):
        number = unfinished(found, status)
        if number is None or number == before:  # no case was reached, for example without a device
            break
        before = number
        status = run_group([*command, "--start", str(number)], environment, log, end - time.perf_counter())
    return status


def sanitizer_says(lines: list[str]) -> list[str]:
    """Selects a sanitizer's lines about errors, each with the following line that names the place in a kernel."""
    own, selected = [line.removeprefix("========= ") for line in lines if line.startswith("=========")], list[str]()
    for line, after in itertools.pairwise([*own, ""]):
        if any(each in line for each in SANITIZER_SAYS):
            selected.append(f"{line}, {after.strip()}" if after.strip().startswith("at ") else line)
    return selected[:20]


def read(path: Path | None) -> Any:
    """Reads the findings of a part; returns a text with the reason if the file is missing or damaged."""
    if path is None or not path.exists():
        return None
    text = path.read_text()
    if path.suffix == ".csv":
        said = [line for line in text.splitlines() if "==" in line]
        return counters(text) or f"{path.name}: {said[-1] if said else 'empty'}"
    try:
        return json.loads(text)
    except ValueError as error:
        return f"{path.name}: {error}"


def counters(text: str) -> dict[str, Any] | None:
    """Parses ncu's raw page (names, units, and a line of values per launch); returns None without launches."""
    rows = [row for row in csv.reader(text.splitlines()) if len(row) > 20]  # skips ncu's messages
    launches, told = [], {name for name, _ in COUNTED.values()}
    for row in rows[2:]:
        values = {}
        for name, value in zip(rows[0], row, strict=False):
            if name.startswith(KEPT) or name in told:
                with contextlib.suppress(ValueError):
                    values[name] = float(value.replace(",", ""))
        kernel = dict(zip(rows[0], row, strict=False)).get("Kernel Name", "")
        launches.append({"kernel": kernel, "values": values})
    return {"launches": launches} if launches else None


def verdict(call: str, results: dict[str, Any]) -> str:
    """Returns the findings, the most important first, within ``VERDICT`` characters."""
    findings = {name: result.get("found") for name, result in results.items()}
    lines = [f"gpu-check {call} on {device()}:"]
    for name, result in results.items():
        lines.append(f"  {name:10} {result['outcome']:8} {result['seconds']:6.1f} s  {result['last']}")
    if took := _took(findings):
        lines.append(f"  of cases: {', '.join(f'{part} {seconds:.1f} s' for part, seconds in took.items())}")
    for part, value in findings.items():
        lines += [f"TORN {part}: {value}"] * isinstance(value, str)
    lines += _wrong(findings)
    for name, result in results.items():
        lines += [f"{name}: {line}" for line in result.get("sanitizer", ())[:6] if "SUMMARY: 0" not in line]
    cases = _cases(findings)
    told = [row for row in cases if row["part"] in ("captured", "training") and row["said"]]
    lines += [f"{row['part']} {row['name']}: {row['said']}" for row in told]
    for row in cases:
        if "share" in row:
            most = f", by count {100 * row['most']:.0f}" if row["most"] else ""
            share = f"{100 * row['share']:5.1f} % of {row['limit']}{most}"
            lines.append(f"{row['name']:50} {1e3 * row['seconds']:9.3f} ms {share}")
        elif row["part"] == "rows":
            lines.append(f"{row['name']}: {row['said']}")
    lines += _beside(cases)
    lines += _counted(results.get("counters", {}))
    for row in cases:
        if row["part"] == "profile" and row["right"]:
            lines.append(f"step {row['name']}: {row['said']}")
            for kernel in row["kernels"][:KERNELS]:
                lines.append(
                    f"  {kernel['microseconds']:8.1f} us in {kernel['launches']:4.1f} x {brief(kernel['name'])}"
                )
    return cut(lines)


def cut(lines: Iterable[str]) -> str:
    """Truncates each line to its maximum length, and drops the lines that exceed the length of the report."""
    kept, size = list[str](), 0
    for line in lines:
        kept.append(line[: WRONG if line.startswith(("WRONG", "memcheck", "racecheck", "synccheck")) else LINE])
        size += len(kept[-1]) + 1
        if size > VERDICT - 40:
            return "\n".join([*kept[:-1], "and more, in the summary"])
    return "\n".join(kept)


def brief(kernel: str) -> str:
    """Returns a kernel's name without common parts."""
    for word in WORDY:
        kernel = kernel.replace(word, "")
    return kernel


def _cases(findings: dict[str, Any]) -> list[dict[str, Any]]:
    cases = findings.get("cases")
    kept = cases.get("cases", []) if isinstance(cases, dict) else []
    return [row for row in kept if row["right"]]


def _took(findings: dict[str, Any]) -> dict[str, float]:
    """Returns the seconds that each part of the cases took."""
    cases, seconds = findings.get("cases"), dict[str, float]()
    for row in cases.get("cases", ()) if isinstance(cases, dict) else ():
        seconds[row["part"]] = seconds.get(row["part"], 0.0) + row.get("took", 0.0)
    return seconds


def _wrong(findings: dict[str, Any]) -> list[str]:
    """Lists wrong cases, and the number of omitted cases."""
    lines, left_out = [], 0
    for part, value in findings.items():
        if isinstance(value, dict):
            for row in value.get("cases", ()):
                if not row["right"]:
                    where = row["part"] if part == "cases" else part
                    lines.append(f"WRONG {where}: {row['name']}: {row['said']}")
                    lines += [f"  {line}" for line in row.get("wrong", ())[:3]]
            left_out += len(value.get("left out", ()))
    rest = [f"and {len(lines) - MOST_WRONG} more that are wrong"] * (len(lines) > MOST_WRONG)
    return [*lines[:MOST_WRONG], *rest, *[f"left out for want of time: {left_out} cases"] * (left_out > 0)]


def _beside(cases: list[dict[str, Any]]) -> list[str]:
    """Returns lines that compare rows "NAME" with the rows "NAME by ALTERNATIVE"."""
    times = {row["name"]: row["seconds"] for row in cases if "share" in row}
    lines = []
    for name, seconds in times.items():
        own, _, other = name.partition(" by ")
        if other == "radix" and f"{own} by counting" in times:
            lines.append(f"{own}: counting takes {times[f'{own} by counting'] / seconds:.2f} x the time of radix")
        elif other and own in times:
            lines.append(f"{own}: {times[own] / seconds:.2f} x the time of {other}")
    return lines


def _counted(result: dict[str, Any]) -> list[str]:
    """Describes a launch in two lines: its name, and its counters with the two main stall reasons."""
    findings, (before, after), lines = result.get("found"), STALLED, []
    launches = findings["launches"] if isinstance(findings, dict) else []
    names = [*result.get("counted", ()), *["?"] * len(launches)]
    for name, launch in zip(names, launches, strict=False):
        values = launch["values"]
        told = [f"{values[key] * by:.3g} {what}" for what, (key, by) in COUNTED.items() if key in values]
        stalls = {
            key.removeprefix(before).removesuffix(after): value
            for key, value in values.items()
            if key.startswith(before) and key.endswith(after) and "not_issued" not in key
        }
        told += [f"{reason} {stalls[reason]:.1f}" for reason in sorted(stalls, key=lambda key: -stalls[key])[:2]]
        lines += [f"ncu {name}: {brief(launch['kernel'])}", f"  {', '.join(told)}"]
    return lines


def run_group(command: list[str], environment: dict[str, str], log: TextIO, limit: float) -> int | str:
    """Runs a command; returns its exit status or a text. After ``limit`` seconds its process group is killed."""
    try:
        process = subprocess.Popen(
            command, cwd=ROOT, env=environment, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
        )
    except OSError as error:
        return str(error)
    try:
        return process.wait(max(limit, 0.1))
    except subprocess.TimeoutExpired:
        return f"stopped after {limit:.0f} s"
    finally:
        # Also kills processes that an ended command left running, so that nothing disturbs the next part.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        # A process that waits inside the driver may never end.
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(10)


@functools.cache
def asked_of_the_driver(what: str) -> str | None:
    """Queries nvidia-smi about the first GPU and caches the answer; None without a GPU. Importing torch is slower."""
    try:
        command = ["nvidia-smi", f"--query-gpu={what}", "--format=csv,noheader"]
        said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout
    except (OSError, subprocess.SubprocessError):
        return None
    return said.strip().splitlines()[0] if said.strip() else None


def capability() -> str | None:
    """Returns the compute capability of the GPU, such as "90"; None without a GPU."""
    said = asked_of_the_driver("compute_cap")
    return said.replace(".", "") if said else None


def device() -> str:
    """Returns the names of the GPU and its driver."""
    return asked_of_the_driver("name,driver_version") or "no GPU"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
