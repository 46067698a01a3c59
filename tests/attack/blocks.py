"""Numbers of rows about the blocks, tiles and tasks of kernels, read from the constants of their C++."""

from __future__ import annotations

import functools
import re
from pathlib import Path

CSRC = Path(__file__).resolve().parents[2] / "csrc"
DECLARED = re.compile(r"constexpr (?:int|int32_t|int64_t) (k[A-Z][^;]*);")
VALUE = re.compile(r"k\w+ = (?:int64_t\{(\d+)\}|(\d+))(?: << (\d+))?(?=,|$)")
SMALL, MOST = 5, 1 << 20
#: Rows of a block from which on three have one row more only: whole blocks in the middle, and a short last one.
LARGE = 1 << 14


@functools.cache
def blocks() -> tuple[int, ...]:
    """The constants of all kernels of the CPU, rising: an operation may go through the kernels of another."""
    found = set()
    for file in (*CSRC.rglob("*.cpp"), *CSRC.rglob("*.h")):
        for line in DECLARED.findall(file.read_text()):
            found |= {int(one or other) << int(shift or 0) for one, other, shift in VALUE.findall(line)}
    return tuple(sorted(value for value in found if SMALL <= value <= MOST))


@functools.cache
def sizes(most: int) -> tuple[int, ...]:
    """At most so many rows: one and three blocks of each size, one row less and one more."""
    about = {count * block + more for block in blocks() for count in (1, 3) for more in (-1, 0, 1)}
    about -= {3 * block - less for block in blocks() if block >= LARGE for less in (0, 1)}
    return tuple(sorted(size for size in about if size <= most))
