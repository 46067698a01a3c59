"""Row counts near the sizes of the kernels' blocks, tiles and tasks, which are read from the C++ constants."""

from __future__ import annotations

import functools
import re
from pathlib import Path

CSRC = Path(__file__).resolve().parents[2] / "csrc"
DECLARED = re.compile(r"constexpr (?:int|int32_t|int64_t) (k[A-Z][^;]*);")
VALUE = re.compile(r"k\w+ = (?:int64_t\{(\d+)\}|(\d+))(?: << (\d+))?(?=,|$)")
SMALL, MOST = 5, 1 << 20
#: For blocks of at least this size, ``3 * size + 1`` is the only row count near three blocks: three full blocks and a
#: block of one row.
LARGE = 1 << 14


@functools.cache
def blocks() -> tuple[int, ...]:
    """Returns the sizes of all CPU kernels, in ascending order; an op may also run another op's kernels."""
    constants = set()
    for file in (*CSRC.rglob("*.cpp"), *CSRC.rglob("*.h")):
        for line in DECLARED.findall(file.read_text()):
            constants |= {int(one or other) << int(shift or 0) for one, other, shift in VALUE.findall(line)}
    return tuple(sorted(value for value in constants if SMALL <= value <= MOST))


@functools.cache
def sizes(most: int) -> tuple[int, ...]:
    """Returns row counts up to ``most``: one and three blocks of each size, exactly or with one row less or more."""
    about = {count * block + more for block in blocks() for count in (1, 3) for more in (-1, 0, 1)}
    about -= {3 * block - less for block in blocks() if block >= LARGE for less in (0, 1)}
    return tuple(sorted(size for size in about if size <= most))
