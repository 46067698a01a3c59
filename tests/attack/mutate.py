"""Plants faults in a copy of the tree, one at a time, and runs the tests that should detect them.

The copy has its own build folder, so that a fault recompiles only the changed files. A fault is detected if a test
fails; at the end, these tests must pass without a fault.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from faults import FAULTS, Fault

ROOT = Path(__file__).resolve().parents[2]
SECONDS = 900  # time limit of a fault's tests
PYTEST = ("-m", "pytest", "-q", "-x", "-n", "0", "-p", "no:cacheprovider")


def plant(words: Sequence[str], results: Path | None = None) -> int:
    """Plants the faults whose description has one of the words, or all faults; prints the outcome of each.

    Args:
        words: Words in the descriptions of the faults; empty for all faults.
        results: A JSON file for the outcomes; outcomes of other faults in the file stay.

    Returns:
        The exit status of the command: 0 if at most one in fifteen faults was not detected.
    """
    chosen = [fault for fault in FAULTS if not words or any(word in fault.what for word in words)]
    rows = []
    with tempfile.TemporaryDirectory(prefix="attack-") as scratch:
        tree = copied(Path(scratch) / "tree")
        for fault in chosen:
            began = time.monotonic()
            found = tried(tree, fault)
            rows.append({"fault": fault.what, "file": fault.file, "found_by": found})
            print(f"{fault.what} ({time.monotonic() - began:.0f} s)\n    {found or 'MISSED'}", flush=True)
        build(tree)
        tests = sorted({str(row["found_by"]) for row in rows if "::" in str(row["found_by"])})
        if tests and (failed := first_failure(tree, tests)):
            raise SystemExit(f"mutate: {failed} must pass without a fault")
    missed = sum(row["found_by"] is None for row in rows)
    print(f"{len(rows) - missed} of {len(rows)} faults are found")
    status = int(15 * missed > len(rows))
    if results is not None:
        metadata = {"machine": platform.machine(), "python": platform.python_version(), "tests": "make test-all"}
        stored = json.loads(results.read_text())["results"] if results.exists() else []
        others = {fault.what for fault in FAULTS} - {row["fault"] for row in rows}
        rows = [row for row in stored if row["fault"] in others] + rows
        results.write_text(json.dumps({"metadata": metadata, "results": rows}, indent=1) + "\n")
    return status


def copied(tree: Path) -> Path:
    """Copies this tree's files, except ignored ones, and its compiled objects; keeps file times."""
    listed = ["git", "-C", str(ROOT), "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(listed, check=True, capture_output=True, text=True).stdout.split("\0"):
        if name and (ROOT / name).is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tree / name, follow_symlinks=False)
    shutil.copytree(ROOT / "build", tree / "build", ignore=shutil.ignore_patterns("site", "lib*"))
    return tree


def build(tree: Path) -> None:
    """Compiles the changed files of a copy."""
    command = [sys.executable, "setup.py", "--quiet", "build_ext", "--inplace"]
    done = subprocess.run(command, cwd=tree, env=environment(tree), capture_output=True, text=True)
    if done.returncode != 0:
        raise SystemExit(f"mutate: the copy cannot be built: {done.stdout[-2000:]}{done.stderr[-2000:]}")


def environment(tree: Path) -> dict[str, str]:
    """Returns the environment of a process that imports the copy."""
    return {**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1", "VORONERF_CUDA": "0"}


def tried(tree: Path, fault: Fault) -> str | None:
    """Plants a fault; returns the test that detects it, "the compiler", or None. Restores the file afterwards."""
    file = tree / fault.file
    text = file.read_text()
    if text.count(fault.line) != 1:
        raise SystemExit(f"mutate: {fault.file} must have the line once, got {text.count(fault.line)}: {fault.line}")
    file.write_text(text.replace(fault.line, fault.wrong))
    try:
        build(tree)  # also recompiles the file of the last fault
        return first_failure(tree, fault.tests)
    finally:
        file.write_text(text)


def first_failure(tree: Path, tests: Sequence[str]) -> str | None:
    """Returns the name of the first failing test, or how the process ended; None if all tests pass."""
    command = [sys.executable, *PYTEST, *tests]
    try:
        done = subprocess.run(command, cwd=tree, env=environment(tree), capture_output=True, text=True, timeout=SECONDS)
    except subprocess.TimeoutExpired:
        return f"{SECONDS} s"
    if done.returncode == 0:
        return None
    lines = (line.partition(" ") for line in done.stdout.splitlines())
    failed = [name.partition(" - ")[0] for word, _, name in lines if word in ("FAILED", "ERROR")]
    if not failed and done.returncode > 0:
        raise SystemExit(f"mutate: {' '.join(command)} ended with {done.returncode}: {done.stdout[-2000:]}")
    return failed[0] if failed else f"signal {-done.returncode}"
