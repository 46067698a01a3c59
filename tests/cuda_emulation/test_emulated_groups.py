"""Products of a group of four warps (cuda_wgmma.h): descriptors, results, and the mistakes that are found."""

from __future__ import annotations

import random
import sys
from pathlib import Path

import pytest
from emulated import module
from group_cases import errors
from test_emulation import module as built
from test_emulation import run

HERE = Path(__file__).resolve().parent
BUGS = [
    (0, "none", "right"),
    (1, "none", "wrong"),
    (2, "none", "products of a group are not waited for"),
    (3, "none", "wrong"),
    (4, "none", "products of a group are not waited for"),
    (5, "none", "wgmma takes sums that have passed no fence"),
    (6, "none", "wgmma takes sums that have passed no fence"),
    (7, "none", "wgmma reads copies that were not published"),
    (9, "none", "the left operand of a product under way was changed"),
    (10, "none", "sums of a product under way were written"),
    (11, "none", "wrong"),
    (12, "none", "warps of a group do not agree on m64n32k16.bf16"),
    (13, "none", "warps of a group come to "),
    (14, "none", "wgmma reads outside of the dynamic shared memory"),
    (15, "none", "wgmma of an address that is not aligned"),
    (16, "none", "products of two shapes share sums without a fence"),
    (17, "none", "wgmma takes a left operand that has passed no fence"),
    (0, "address", "right"),
    (0, "thread", "right"),
    (8, "thread", "data race"),
]
"""Bug of group_product.cu, sanitizer, and what must come out."""


def test_descriptors_have_their_fields() -> None:
    """By the table "Matrix Descriptor Format" of the PTX manual: bits 0-13, 16-29 and 32-45, in units of 16 bytes."""
    draw = random.Random(0)
    for _ in range(200):
        address, leading, stride = (16 * draw.randrange(1 << 14) for _ in range(3))
        descriptor = module().group_descriptor(address, leading, stride)
        fields = {0: address, 16: leading, 32: stride}
        assert descriptor == sum(value // 16 << bit for bit, value in fields.items())
    # Addresses count from the window of shared memory on; bits above it do not reach the next field.
    assert module().group_descriptor(0x7F040010, 16, 16) == 1 | 1 << 16 | 1 << 32


@pytest.mark.parametrize("bfloat16", [False, True])
@pytest.mark.parametrize("tiles", [1, 2, 4, 8])
def test_products(tiles: int, bfloat16: bool) -> None:
    for seed, (steps, groups, order) in enumerate([(1, 1, "k"), (3, 2, "k"), (8, 1, "n")]):
        error = errors(module(), tiles=tiles, bfloat16=bfloat16, steps=steps, groups=groups, order=order, seed=seed)
        assert error < 1e-6


@pytest.mark.parametrize(("bug", "sanitizer", "expected"), BUGS)
def test_finds(bug: int, sanitizer: str, expected: str) -> None:
    found = run([sys.executable, str(HERE / "group_cases.py"), built(sanitizer), str(bug), "1"], sanitizer)
    if expected == "data race":
        assert "data race" in found.stdout
    else:
        assert found.stdout.splitlines()[-1].startswith(expected), found.stdout


def test_a_group_is_four_warps() -> None:
    with pytest.raises(RuntimeError, match="in a group of fewer than four warps"):
        errors(module(), tiles=1, bfloat16=True, groups=2, threads=192)
