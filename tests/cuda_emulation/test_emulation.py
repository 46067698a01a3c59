"""What the emulation finds: every planted bug, by results, by its own checks, or by a sanitizer."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
OPERATIONS = [
    str(HERE.parent / "ops" / f"test_{op}.py")
    for op in (
        "nearest_centre",
        "locate_cell",
        "draw_cell",
        "cell_sort",
        "composite",
        "frequency_encode",
        "integrated_encode",
        "resample",
        "grouped_linear",
        "grouped_mlp",
        "routed_mlp",
    )
]
"""Tests of the operations that have CUDA kernels."""
BUGS = [
    (0, "none", "right"),
    (1, "none", "wrong"),
    (2, "none", "wrong"),
    (3, "none", "__syncthreads is not reached by every thread of the block"),
    (4, "none", "an operation of a warp is not reached by all of its lanes"),
    (7, "none", "wrong"),
    (10, "none", "wrong"),
    (0, "address", "right"),
    (5, "address", "heap-buffer-overflow"),
    (6, "address", "heap-buffer-overflow"),
    (0, "thread", "right"),
    (1, "thread", "data race"),
    (2, "thread", "data race"),
    (8, "thread", "data race"),
    (9, "thread", "data race"),
    (10, "thread", "data race"),
]
"""Bug of planted.cu, sanitizer, and what must come out."""


@pytest.mark.parametrize(("bug", "sanitizer", "expected"), BUGS)
def test_finds(bug: int, sanitizer: str, expected: str) -> None:
    found = run([sys.executable, str(HERE / "planted.py"), module(sanitizer), str(bug), "1"], sanitizer)
    if expected in ("right", "wrong"):
        assert found.stdout.splitlines() == [expected]
    else:
        assert expected in found.stdout


@pytest.mark.parametrize("sanitizer", ["address", "thread"])
def test_kernels_are_clean(sanitizer: str) -> None:
    found = run([sys.executable, str(HERE / "sanitize.py"), module(sanitizer)], sanitizer)
    assert found.stdout.splitlines() == ["clean"], found.stdout


def test_nothing_outside_is_touched_whatever_the_offsets_say() -> None:
    found = run([sys.executable, str(HERE / "sanitize.py"), module("address"), "hostile"], "address")
    assert found.stdout.splitlines() == ["clean"], found.stdout


def test_operations_pass_their_tests_on_the_emulated_device() -> None:
    """The tests of the operations themselves; ``make emulate-cuda`` takes more seeds."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "--emulate-cuda", "1"]
    found = run([*command, "-k", "native-cpu and not compile", "-W", "ignore", *OPERATIONS])
    assert found.returncode == 0 and " passed" in found.stdout, found.stdout


def module(sanitizer: str) -> str:
    built = run([sys.executable, str(HERE / "build.py"), sanitizer])
    assert built.returncode == 0, built.stdout
    return built.stdout.splitlines()[-1]


def run(command: list[str], sanitizer: str = "none") -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONMALLOC": "malloc"}
    if sanitizer != "none":
        name = {"address": "libasan.so", "thread": "libtsan.so"}[sanitizer]
        library = subprocess.run(["g++", f"-print-file-name={name}"], capture_output=True, text=True, check=True).stdout
        if not os.path.isabs(library.strip()):
            pytest.skip(f"{name} is not installed")
        environment |= {
            "LD_PRELOAD": library.strip(),
            "ASAN_OPTIONS": "detect_leaks=0",
            "TSAN_OPTIONS": "ignore_noninstrumented_modules=1",
        }
    return subprocess.run(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
