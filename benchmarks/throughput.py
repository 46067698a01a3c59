"""Times every operation and the whole route, beside alternatives and the machine's peak rates.

    python benchmarks/throughput.py                                   everything, half an hour on two cores
    python benchmarks/throughput.py --quick                           every operation once, under a minute
    python benchmarks/throughput.py --filter '^grouped_mlp/w64d4.*bfloat16'
    python benchmarks/throughput.py --foreign --filter 'siren .*k=16'  the router with fields of other codebases
    python benchmarks/throughput.py --json benchmarks/results/throughput.json
    python benchmarks/table.py benchmarks/results/throughput.json     the JSON as Markdown

docs/performance.md explains the table. Rows appear as they are measured; progress goes to stderr.
"""

from __future__ import annotations

import argparse
import atexit
import functools
import importlib.metadata
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

# oneDNN caches compiled products by shape; its default capacity of 1,024 is too small for a loop over many cells.
os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "65536")

import harness
import torch
from harness import Others, Parser, Peaks, Stopwatch, Timing, measure, threads, write_results
from ops import cases_any, cases_foreign, cases_hash, cases_lookup, cases_network, cases_sampling, cases_step
from ops.case import Case, Contender, NotApplicable, Work, dtype_name

from voronerf.ops._core import backends

OPTIONAL = {
    "scipy": "scipy",
    "warp": "warp-lang",
    "numba": "numba",
    "pykdtree": "pykdtree",
    "faiss": "faiss-cpu",
}
"""Optional packages: module name -> package to install."""
LIMITS = {"ours": 0.8, "alternative": 0.5}
QUICK_LIMITS = {"ours": 0.3, "alternative": 0.15}
"""The time limits of a contender in seconds: LIMITS, or QUICK_LIMITS under --quick. A contender gets at least three
timings (see ``harness.measure``)."""
DISTURBED = 0.1
"""A row counts as disturbed if other processes keep more than this number of cores busy."""
SLOW = ("compile", "F.grouped_mm")
"""Parts of the names of slow alternatives, which --quick omits."""


def fail(message: str) -> NoReturn:
    sys.exit(f"throughput: error: {message}")


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Parses and checks the options."""
    parser = Parser("throughput", description=(__doc__ or "").split("\n\n")[0], allow_abbrev=False)
    parser.add_argument("--quick", action="store_true", help="every operation once, under a minute")
    parser.add_argument("--json", type=Path, metavar="FILE", help="a JSON file for the results")
    parser.add_argument("--filter", metavar="REGEX", help="a pattern of op/case/dtype/direction")
    parser.add_argument("--device", default="cpu", help="cpu or cuda; timings on cuda have not been run yet")
    parser.add_argument(
        "--backends", nargs="+", default=list(backends.BACKENDS), metavar="NAME", help="backends to measure"
    )
    parser.add_argument("--foreign", action="store_true", help="measure fields of other codebases instead")
    parser.add_argument("--list", action="store_true", help="print op/case/dtype/direction of the rows and stop")
    options = parser.parse_args(arguments)
    for name in options.backends:
        if name not in backends.BACKENDS:
            fail(f"--backends must be of {', '.join(backends.BACKENDS)}, got {name!r}")
    if options.device not in ("cpu", "cuda"):
        fail(f"--device must be cpu or cuda, got {options.device!r}")
    if options.device == "cuda" and not torch.cuda.is_available():
        fail("--device cuda: torch sees no CUDA device")
    if options.json is not None and options.json.is_dir():
        fail(f"--json must name a file, got the folder {options.json}")
    return options


def chosen_cases(options: argparse.Namespace) -> list[Case]:
    """Returns the cases that the options select."""
    parts = (cases_lookup, cases_network, cases_sampling, cases_hash, cases_step)
    every = [case for part in parts for case in part.cases()]
    every += cases_any.cases(every)
    if options.foreign:
        every = cases_foreign.cases()
    if options.filter is not None:
        try:
            pattern = re.compile(options.filter)
        except re.error as error:
            fail(f"--filter must be a regular expression, got {options.filter!r}: {error}")
        every = [case for case in every if pattern.search(case.key)]
    if options.quick:
        every = [case for case in every if case.quick]
    if not every:
        fail(f"--filter must leave a row, got {options.filter!r}; --list shows what there is")
    return every


def installed() -> tuple[dict[str, str], list[str]]:
    """Returns the versions of installed optional packages, and install hints for missing packages."""
    versions, missing = {}, []
    for module, package in OPTIONAL.items():
        try:
            versions[module] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            missing.append(f"{module} (pip install {package})")
    return versions, missing


class Bench:
    """A collector that measures cases and stores their rows.

    Args:
        device: The device of all cases.
        quick: Whether to use short limits and no compiled alternatives.
        wanted: The backends to measure.
    """

    def __init__(self, device: torch.device, *, quick: bool, wanted: list[str]) -> None:
        self.device, self.quick, self.wanted = device, quick, wanted
        self.limits = QUICK_LIMITS if quick else LIMITS
        self.clock, self.peaks = time.perf_counter, Peaks(device)
        self.rows: list[dict[str, Any]] = []

    def run(self, case: Case) -> list[dict[str, Any]]:
        """Measures a case; returns one row for each backend that can run it."""
        names = [
            name
            for name in case.backends
            if name in self.wanted
            and name in backends.implemented(case.needs or case.op)
            and backends.why_not(case.needs or case.op, name, self.device, case.dtype) is None
        ]
        if not names:
            return []
        self.clock = time.process_time if case.threads == 1 else time.perf_counter
        with threads(case.threads):
            rows = self._measure(case, names, case.build(self.device))
        self.rows += rows
        return rows

    def _measure(self, case: Case, names: list[str], work: Work) -> list[dict[str, Any]]:
        notes: dict[str, str] = {}
        errors: dict[str, float] = {}
        first: dict[str, float] = {}
        warm: dict[str, float] = {}
        contenders: dict[str, Contender] = {}
        for name in names:
            contenders[name] = work.ours(name)
            errors[name], first[name] = self._check(contenders[name], work)
        for name, set_up in work.alternatives.items():
            if self.quick and any(part in name for part in SLOW):
                continue
            try:
                contenders[name] = self._set_up(set_up, work, warm, name)
            except NotApplicable as reason:
                notes[name] = f"n/a: {reason}"
        before = self.peaks(work.bound) if work.bound else None
        limits = {name: self.limits["ours" if name in names else "alternative"] for name in contenders}
        runs = {name: contender.run for name, contender in contenders.items()}
        others = Others()
        timings = measure(runs, limits, Stopwatch(self.device, self.clock), warm)
        disturbed = others.cores()
        after = before if self.quick or not work.bound else self.peaks(work.bound)
        peak = max((found for found in (before, after) if found), key=lambda found: found[1], default=None)
        alternatives = {
            name: _milliseconds(timings.get(name)) for name in work.alternatives if name in (*timings, *notes)
        }
        notes.update({name: "capped" for name, timing in timings.items() if timing.capped})
        rows = [self._row(case, work, name, timings[name], alternatives, errors[name], peak, notes) for name in names]
        return [{**row, "other_load": disturbed, "first_call_ms": first[row["backend"]] * 1e3} for row in rows]

    def _check(self, contender: Contender, work: Work) -> tuple[float, float]:
        """Runs call 0 of a contender; returns its error and seconds."""
        start = self.clock()
        result = contender.run(0)
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        seconds = self.clock() - start
        return work.error(contender.adapt(result)), seconds

    def _set_up(self, set_up: Callable[[], Contender], work: Work, warm: dict[str, float], name: str) -> Contender:
        """Returns an alternative after a check of its result; stores the first call's seconds in ``warm``.

        Raises:
            NotApplicable: The alternative fails or is not exact enough.
        """
        try:
            contender = set_up()
            error, warm[name] = self._check(contender, work)
        except NotApplicable:
            raise
        except Exception as failure:  # any failure of an alternative is a result too
            first = (str(failure).strip().splitlines() or [""])[0]
            raise NotApplicable(f"{type(failure).__name__}: {first}"[:300]) from failure
        if not error <= work.tolerance:
            raise NotApplicable(f"its error of {error:.2g} is above {work.tolerance:.2g}")
        return contender

    def _row(
        self,
        case: Case,
        work: Work,
        backend: str,
        timing: Timing,
        alternatives: dict[str, float | None],
        error: float,
        peak: tuple[str, float] | None,
        notes: dict[str, str],
    ) -> dict[str, Any]:
        rate = work.amount / timing.median_ms * 1e3
        best = min((value for value in alternatives.values() if value is not None), default=None)
        executed = None if work.executed is None or peak is None else work.executed / timing.median_ms * 1e5 / peak[1]
        return {
            "op": case.op,
            "case": case.case,
            "backend": backend,
            "device": str(self.device),
            "dtype": dtype_name(case.dtype),
            "direction": case.direction,
            "n": case.n,
            "k": case.k,
            "threads": case.threads or torch.get_num_threads(),
            "median_ms": timing.median_ms,
            "iqr_ms": timing.iqr_ms,
            "throughput": rate * (1e-9 if work.bound else 1e-6),
            "unit": {"copy": "GB/s", "": "Msample/s"}.get(work.bound, "GFLOP/s"),
            "percent_of_peak": None if peak is None else 100 * rate / peak[1],
            "alternatives": alternatives,
            "speedup_over_best": None if best is None else best / timing.median_ms,
            "max_error": error,
            "bound": None if peak is None else peak[0],
            "executed_percent_of_peak": executed if backend == "native" else None,
            "notes": {name: note for name, note in notes.items() if name in alternatives or name == backend},
        }


def _milliseconds(timing: Timing | None) -> float | None:
    return None if timing is None else timing.median_ms


HEADER = (
    f"{'op':17} {'case':28} {'dtype':8} {'direction':16} {'backend':9} {'median':>10} {'iqr':>8} {'ns/sample':>10}"
    f" {'throughput':>15} {'of peak':>8} {'x best':>7} {'error':>8}"
)


def lines(row: dict[str, Any], *, last: bool) -> list[str]:
    """Returns the printed lines of a row; the last backend's row is followed by the alternatives."""
    percent = "-" if row["percent_of_peak"] is None else f"{row['percent_of_peak']:.1f} %"
    ahead = "-" if row["speedup_over_best"] is None else f"{row['speedup_over_best']:.2f}"
    spread = "-" if row["iqr_ms"] is None else f"{row['iqr_ms']:.3f}"
    printed = [
        f"{row['op']:17} {row['case']:28} {row['dtype']:8} {row['direction']:16} {row['backend']:9}"
        f" {row['median_ms']:7.3f} ms {spread:>8} {row['median_ms'] * 1e6 / row['n']:10.2f}"
        f" {row['throughput']:7.1f} {row['unit']:7} {percent:>8} {ahead:>7} {row['max_error']:8.1e}"
    ]
    if last:
        printed += [
            f"    {name:42} {'' if value is None else f'{value:10.3f} ms'} {row['notes'].get(name, '')}".rstrip()
            for name, value in row["alternatives"].items()
        ]
    return printed


def main(arguments: list[str] | None = None) -> None:
    """Measures the rows and prints them; writes the JSON after each row."""
    options = parse(arguments)
    cases = chosen_cases(options)
    if options.list:
        print("\n".join(case.key for case in cases))
        return
    if options.json is not None:
        try:
            options.json.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            fail(f"--json: {error}")
    if not options.quick:
        # The first call includes compilation, so it needs an empty cache.
        folder = tempfile.mkdtemp(prefix="voronerf-warp-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        os.environ["WARP_CACHE_PATH"] = folder
    start, load = time.perf_counter(), os.getloadavg()
    torch.manual_seed(0)
    bench = Bench(torch.device(options.device), quick=options.quick, wanted=options.backends)
    found, missing = installed()
    print(f"threads {torch.get_num_threads()}; missing: {', '.join(missing) or 'nothing'}", file=sys.stderr)
    print(f"{harness.processor()}\n")
    print(HEADER, flush=True)
    for number, case in enumerate(cases, 1):
        progress = functools.partial(print, file=sys.stderr, flush=True)
        progress(f"[{number}/{len(cases)}, {time.perf_counter() - start:.0f} s] {case.key}")
        rows = bench.run(case)
        if not rows:
            op = case.needs or case.op
            reasons = [backends.why_not(op, name, bench.device, case.dtype) for name in case.backends]
            progress(f"    left out: {'; '.join(filter(None, reasons)) or 'not among --backends'}")
        for row in rows:
            print("\n".join(lines(row, last=row is rows[-1])), flush=True)
        if rows and (rows[0]["other_load"] or 0.0) > DISTURBED:
            progress(f"    disturbed: other processes kept {rows[0]['other_load']:.1f} cores busy during this row")
        write_results(
            options.json,
            bench.rows,
            benchmark="throughput",
            quick=options.quick,
            cases=f"{number} of {len(cases)}",
            filter=options.filter,
            device=str(bench.device),
            seconds=round(time.perf_counter() - start),
            load=[round(value, 2) for value in load],
            peaks={name: round(value * 1e-9, 1) for name, value in bench.peaks.found.items()},
            installed=found,
            missing=missing,
            warp_cache="as it was" if options.quick else "empty",
        )


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit("throughput: interrupted")
