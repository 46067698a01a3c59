"""Plants faults in a copy of the tree, one at a time, and runs the tests that are to find them.

The copy has a build folder of its own, in which a fault compiles what it has changed and no more. A fault is found
where a test fails that passes without it, which is looked at in the end.
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
SECONDS = 900  # of a fault's tests
PYTEST = ("-m", "pytest", "-q", "-x", "-n", "0", "-p", "no:cacheprovider")


def plant(words: Sequence[str], results: Path | None = None) -> int:
    """Plants the faults whose description has one of the words, or all of them; prints what became of each.

    Args:
        words: Of the faults.
        results: A JSON file, for the outcome of each; those of other faults in it stay.

    Returns:
        The status of the command: 0 if at most one in fifteen was missed.
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
        metadata = {"machine": platform.machine(), "python": platform.python_version(), "tests": "make test"}
        known = json.loads(results.read_text())["results"] if results.exists() else []
        others = {fault.what for fault in FAULTS} - {row["fault"] for row in rows}
        rows = [row for row in known if row["fault"] in others] + rows
        results.write_text(json.dumps({"metadata": metadata, "results": rows}, indent=1) + "\n")
    return status


def copied(tree: Path) -> Path:
    """A copy of what git knows of this tree, with the compiled objects and the times of files."""
    listed = ["git", "-C", str(ROOT), "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(listed, check=True, capture_output=True, text=True).stdout.split("\0"):
        if name and (ROOT / name).is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tree / name, follow_symlinks=False)
    shutil.copytree(ROOT / "build", tree / "build", ignore=shutil.ignore_patterns("site", "lib*"))
    return tree


def build(tree: Path) -> None:
    """Compiles in a copy what has changed."""
    command = [sys.executable, "setup.py", "--quiet", "build_ext", "--inplace"]
    done = subprocess.run(command, cwd=tree, env=environment(tree), capture_output=True, text=True)
    if done.returncode != 0:
        raise SystemExit(f"mutate: the copy cannot be built: {done.stdout[-2000:]}{done.stderr[-2000:]}")


def environment(tree: Path) -> dict[str, str]:
    """Of a process that imports the copy."""
    return {**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1", "VORONERF_CUDA": "0"}


def tried(tree: Path, fault: Fault) -> str | None:
    """The test that finds a fault, "the compiler", or None; the file is as before afterwards."""
    file = tree / fault.file
    text = file.read_text()
    if text.count(fault.line) != 1:
        raise SystemExit(f"mutate: {fault.file} must have the line once, got {text.count(fault.line)}: {fault.line}")
    file.write_text(text.replace(fault.line, fault.wrong))
    try:
        build(tree)  # and what the fault before has left
        return first_failure(tree, fault.tests)
    finally:
        file.write_text(text)


def first_failure(tree: Path, tests: Sequence[str]) -> str | None:
    """The name of the first test that fails, or how the process ended; None if all pass."""
    command = [sys.executable, *PYTEST, "-m", "not slow", *tests]
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
