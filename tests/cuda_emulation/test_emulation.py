"""Tests that the emulation finds every planted bug: by wrong results, by its checks, or by a sanitizer."""

import os
import pickle
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from bugs import verdict
from emulated import module
from emulation_build import build
from recorded import record_calls

from voronerf.ops._core import backends

HERE = Path(__file__).resolve().parent
BUGS = [
    ("0", "none", "right"),
    ("1", "none", "wrong"),
    ("2", "none", "wrong"),
    ("3", "none", "__syncthreads is not reached by every thread of the block"),
    ("4", "none", "an operation of a warp is not reached by all of its lanes"),
    ("7", "none", "wrong"),
    ("10", "none", "wrong"),
    ("12", "none", "wrong"),
    ("0", "address", "right"),
    ("5", "address", "heap-buffer-overflow"),
    ("6", "address", "heap-buffer-overflow"),
    ("0", "thread", "right"),
    ("1", "thread", "data race"),
    ("11", "thread", "data race"),
    ("8", "thread", "data race"),
    ("9", "thread", "data race"),
    ("10", "thread", "data race"),
    ("12", "thread", "data race"),
]
"""The number of a bug in planted.cu, the sanitizer, and the expected verdict."""


def run(command, sanitizer=None):
    environment = {**os.environ, "PYTHONMALLOC": "malloc"}
    if sanitizer is not None:
        name = {"address": "libasan.so", "thread": "libtsan.so"}[sanitizer]
        library = subprocess.run(["g++", f"-print-file-name={name}"], capture_output=True, text=True, check=True).stdout
        if not os.path.isabs(library.strip()):
            pytest.skip(f"{name} is not installed")
        environment |= {"LD_PRELOAD": library.strip(), "ASAN_OPTIONS": "detect_leaks=0"}
        environment["TSAN_OPTIONS"] = "ignore_noninstrumented_modules=1"
    command = [sys.executable, *command]
    return subprocess.run(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def script(name, sanitizer, *arguments):
    """Runs a script of this folder on the module under a sanitizer; returns its output."""
    return run([str(HERE / name), str(build(sanitizer)), *arguments], sanitizer).stdout


@pytest.mark.parametrize(
    ("bug", "sanitizer", "expected"),
    [pytest.param(*row, marks=() if row[1] == "none" else pytest.mark.slow) for row in BUGS],
)
def test_finds(bug, sanitizer, expected):
    found = verdict(module(), bug, 1) if sanitizer == "none" else script("bugs.py", sanitizer, bug, "1")
    if expected in ("data race", "heap-buffer-overflow"):
        assert expected in found
    else:
        assert found.splitlines()[-1].startswith(expected), found


def test_a_watcher_gets_the_arguments_of_a_launch():
    seen, memory = [], np.zeros(256, np.float32)
    module().watch(lambda *launch: seen.append(launch))
    module().planted(memory.ctypes.data, memory[64:].ctypes.data, memory[192:].ctypes.data, 2, 64, 0)
    module().watch(None)
    module().planted(memory.ctypes.data, memory[64:].ctypes.data, memory[192:].ctypes.data, 2, 64, 0)
    arguments = struct.pack("<QQQi", *(memory[at:].ctypes.data for at in (0, 64, 192)), 0)
    assert seen == [("planted_kernel", 2, 64, 256, arguments)]


@pytest.fixture(scope="module")
def calls(tmp_path_factory):
    path = tmp_path_factory.mktemp("recorded") / "calls"
    path.write_bytes(pickle.dumps(record_calls()))
    return str(path)


@pytest.mark.slow
@pytest.mark.parametrize("given", [["address"], ["thread"], ["address", "hostile"]], ids=" ".join)
def test_kernels_touch_nothing_outside_and_race_with_nobody(given, calls):
    """Runs the recorded calls of the ops' cases, and hostile calls, under sanitizers."""
    found = script("sanitize.py", given[0], calls, *given[1:])
    assert found.splitlines() == ["clean"], found


@pytest.mark.slow
def test_operations_pass_their_tests_on_the_emulated_device():
    """Runs the tests of the operations; ``make emulate-cuda`` runs more seeds."""
    command = ["-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "--emulate-cuda", "1", "-W", "ignore"]
    folders = dict.fromkeys(backends.folder(op) for op in backends.ops("native", "cuda"))
    files = [HERE.parent / "ops" / f"test_{folder}.py" for folder in (*folders, "every_op")]
    found = run(
        [*command, "-k", "native-cpu and not compile and not opcheck", *(str(file) for file in files if file.exists())]
    )
    assert found.returncode == 0 and " passed" in found.stdout, found.stdout
