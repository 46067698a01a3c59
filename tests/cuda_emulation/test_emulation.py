"""What the emulation finds: every planted bug, by results, by its own checks, or by a sanitizer."""

import os
import pickle
import random
import subprocess
import sys
from pathlib import Path

import pytest
from bugs import group_error, verdict
from emulated import module
from emulation_build import build
from recorded import recorded

from voronerf.ops._core import backends

HERE = Path(__file__).resolve().parent
BUGS = [
    ("p0", "none", "right"),
    ("p1", "none", "wrong"),
    ("p2", "none", "wrong"),
    ("p3", "none", "__syncthreads is not reached by every thread of the block"),
    ("p4", "none", "an operation of a warp is not reached by all of its lanes"),
    ("p7", "none", "wrong"),
    ("p10", "none", "wrong"),
    ("p0", "address", "right"),
    ("p5", "address", "heap-buffer-overflow"),
    ("p6", "address", "heap-buffer-overflow"),
    ("p0", "thread", "right"),
    ("p1", "thread", "data race"),
    ("p11", "thread", "data race"),
    ("p8", "thread", "data race"),
    ("p9", "thread", "data race"),
    ("p10", "thread", "data race"),
    ("0", "none", "right"),
    ("1", "none", "wrong"),
    ("2", "none", "products of a group are not waited for"),
    ("3", "none", "wrong"),
    ("4", "none", "products of a group are not waited for"),
    ("5", "none", "wgmma takes sums that have passed no fence"),
    ("6", "none", "wgmma takes sums that have passed no fence"),
    ("7", "none", "wgmma reads copies that were not published"),
    ("9", "none", "the left operand of a product under way was changed"),
    ("10", "none", "sums of a product under way were written"),
    ("11", "none", "wrong"),
    ("12", "none", "warps of a group do not agree on m64n32k16.bf16"),
    ("13", "none", "warps of a group come to "),
    ("14", "none", "wgmma reads outside of the dynamic shared memory"),
    ("15", "none", "wgmma of an address that is not aligned"),
    ("16", "none", "products of two shapes share sums without a fence"),
    ("17", "none", "wgmma takes a left operand that has passed no fence"),
    ("0", "address", "right"),
    ("0", "thread", "right"),
    ("8", "thread", "data race"),
]
"""Bug of planted.cu (p) or of group_product.cu, sanitizer, and what must come out."""


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
    """What a script of this folder says of the module under a sanitizer."""
    return run([str(HERE / name), str(build(sanitizer)), *arguments], sanitizer).stdout


@pytest.mark.parametrize(("bug", "sanitizer", "expected"), BUGS)
def test_finds(bug, sanitizer, expected):
    found = verdict(module(), bug, 1) if sanitizer == "none" else script("bugs.py", sanitizer, bug, "1")
    if expected in ("data race", "heap-buffer-overflow"):
        assert expected in found
    else:
        assert found.splitlines()[-1].startswith(expected), found


@pytest.fixture(scope="module")
def calls(tmp_path_factory):
    path = tmp_path_factory.mktemp("recorded") / "calls"
    path.write_bytes(pickle.dumps(recorded()))
    return str(path)


@pytest.mark.parametrize("given", [["address"], ["thread"], ["address", "hostile"]], ids=" ".join)
def test_kernels_touch_nothing_outside_and_race_with_nobody(given, calls):
    """On the arguments of the ops' cases, and on hostile ones whatever the offsets say."""
    found = script("sanitize.py", given[0], calls, *given[1:])
    assert found.splitlines() == ["clean"], found


def test_operations_pass_their_tests_on_the_emulated_device():
    """The tests of the operations themselves; ``make emulate-cuda`` takes more seeds."""
    command = ["-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "--emulate-cuda", "1", "-W", "ignore"]
    folders = dict.fromkeys(backends.folder(op) for op in backends.ops("native", "cuda"))
    files = [HERE.parent / "ops" / f"test_{folder}.py" for folder in (*folders, "every_op")]
    found = run(
        [*command, "-k", "native-cpu and not compile and not opcheck", *(str(file) for file in files if file.exists())]
    )
    assert found.returncode == 0 and " passed" in found.stdout, found.stdout


def test_descriptors_have_their_fields():
    """By the table "Matrix Descriptor Format" of the PTX manual: bits 0-13, 16-29 and 32-45, in units of 16 bytes."""
    draw = random.Random(0)
    for _ in range(200):
        address, leading, stride = (16 * draw.randrange(1 << 14) for _ in range(3))
        fields = {0: address, 16: leading, 32: stride}
        found = module().group_descriptor(address, leading, stride)
        assert found == sum(value // 16 << bit for bit, value in fields.items())
    # Addresses count from the window of shared memory on; bits above it do not reach the next field.
    assert module().group_descriptor(0x7F040010, 16, 16) == 1 | 1 << 16 | 1 << 32


@pytest.mark.parametrize("bfloat16", [False, True])
@pytest.mark.parametrize("tiles", [1, 2, 4, 8])
def test_products_of_groups_of_four_warps(tiles, bfloat16):
    for seed, (steps, groups, order) in enumerate([(1, 1, "k"), (3, 2, "k"), (8, 1, "n")]):
        options = {"tiles": tiles, "bfloat16": bfloat16, "steps": steps, "groups": groups, "order": order}
        assert group_error(module(), seed=seed, **options) < 1e-6
    with pytest.raises(RuntimeError, match="in a group of fewer than four warps"):
        group_error(module(), tiles=tiles, bfloat16=bfloat16, groups=2, threads=192)
