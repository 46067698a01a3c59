"""Hash grids: tables of features at the corners of grids of several resolutions.

Müller et al. 2022, "Instant Neural Graphics Primitives". A grid describes the layout of a table [entries, features];
the table itself is a tensor.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch

CONVENTIONS = ("tiny-cuda-nn", "torch-ngp", "nerfstudio")
UNIT_CUBE = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


class GridLevel(NamedTuple):
    """One level of a hash grid, as the numbers that an implementation needs.

    A point x in 0..1 lies at ``x * scale + shift``, between integer corners. The index of the corner (i, j, k) is
    ``i + side * j + side**2 * k`` modulo ``entries``. In a hashed level the index is the lowest bits of
    ``i ^ 2654435761 j ^ 805459861 k`` in unsigned 32-bit arithmetic."""

    scale: float  # the box's side in voxels
    shift: float  # the offset of a position, in voxels
    side: int  # stride of the second axis
    entries: int  # the level's entries; a power of two if hashed
    offset: int  # the level's first entry in the table
    hashed: bool  # whether corners share entries


@dataclass(frozen=True)
class HashGrid:
    """The levels of a hash grid, for ``hash_encode``.

    Level l has the resolution ``base * (finest / base) ** (l / (levels - 1))``, equations 2 and 3 of the paper. A level
    whose corners fit into its entries has one entry for each corner; in a finer level corners share entries by a hash.

    Attributes:
        levels: the number of levels, 1 to 24.
        features: the features of each level: 1, 2, 4 or 8.
        log2_entries: the base-2 logarithm of the largest number of entries of a level, 10 to 24.
        base: the resolution of the coarsest level, at least 1.
        finest: the resolution of the finest level, at least ``base``.
        box: the smallest and the largest corner of the space, three numbers each. A point outside the box has the
            features of the nearest point inside.
        convention: the library whose table layout is used. "tiny-cuda-nn" (and instant-ngp): corners are shifted by
            half a voxel, and a level of resolution N has N corners along an axis. "torch-ngp" (its gridencoder, with
            ``align_corners=False``): the same shift with N + 1 corners. "nerfstudio" (``HashEncoding`` in PyTorch, and
            HashNeRF): no shift, integer resolutions, and hashes on every level.
        text: the grid as JSON; :meth:`parse` reads it.

    Raises:
        ValueError: a number is out of range, the box has no volume, or the convention is unknown.

    Examples:
        >>> from voronerf import HashGrid
        >>> grid = HashGrid(levels=8, features=2, log2_entries=15, base=16, finest=256)
        >>> grid.out_features, grid.table_shape
        (16, (214528, 2))
        >>> [level.hashed for level in grid.rows]  # the first two resolutions, 16 and 23.8, fit into 2^15 entries
        [False, False, True, True, True, True, True, True]
    """

    levels: int = 8
    features: int = 2
    log2_entries: int = 15
    base: float = 16
    finest: float = 256
    box: tuple[tuple[float, float, float], tuple[float, float, float]] = UNIT_CUBE
    convention: str = "tiny-cuda-nn"
    text: str = dataclasses.field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name, least, most in (("levels", 1, 24), ("log2_entries", 10, 24)):
            value = getattr(self, name)
            if type(value) is not int or not least <= value <= most:
                raise ValueError(f"HashGrid: {name} must be an integer from {least} to {most}, got {value!r:.60}")
        if type(self.features) is not int or self.features not in (1, 2, 4, 8):
            raise ValueError(f"HashGrid: features must be 1, 2, 4 or 8, got {self.features!r:.60}")
        numbers = [type(value) in (int, float) for value in (self.base, self.finest)]
        if not all(numbers) or not 1 <= self.base <= self.finest <= 2**20:
            raise ValueError(
                "HashGrid: base and finest must be 1 <= base <= finest <= 2^20, got "
                f"{self.base!r:.60} and {self.finest!r:.60}"
            )
        try:
            low, high = (tuple(map(float, corner)) for corner in self.box)
            valid = len(low) == len(high) == 3 and all(0 < b - a < math.inf for a, b in zip(low, high))
        except (TypeError, ValueError, OverflowError):
            valid = False
        if not valid:
            raise ValueError(f"HashGrid: box must be two corners, the second larger on each axis, got {self.box!r:.60}")
        object.__setattr__(self, "box", (low, high))
        if not isinstance(self.convention, str) or self.convention not in CONVENTIONS:
            raise ValueError(
                f"HashGrid: convention must be one of {', '.join(CONVENTIONS)}, got {self.convention!r:.60}"
            )
        settings = {entry.name: getattr(self, entry.name) for entry in dataclasses.fields(self) if entry.init}
        # Not a cached property, because torch.compile cannot trace its lock.
        object.__setattr__(self, "text", json.dumps(settings))

    @functools.cached_property
    def rows(self) -> tuple[GridLevel, ...]:
        """The levels, coarsest first."""
        max_entries, levels, offset = 2**self.log2_entries, [], 0
        # Computed in float32 like the libraries in CONVENTIONS, because rounding may change the number of corners.
        growth = math.exp((math.log(self.finest) - math.log(self.base)) / max(self.levels - 1, 1))
        index = torch.arange(self.levels, dtype=torch.float32, device="cpu")
        if self.convention == "nerfstudio":
            scales, shift, extra = torch.floor(self.base * growth**index), 0.0, None
        else:
            scales, shift = torch.exp2(index * math.log2(growth)) * self.base - 1, 0.5
            extra = 2 if self.convention == "torch-ngp" else 1
        for scale in scales.tolist():
            side = 0 if extra is None else math.ceil(scale) + extra
            hashed = extra is None or side**3 > max_entries
            entries = max_entries if hashed else -(-(side**3) // 8) * 8
            levels.append(GridLevel(scale, shift, side, entries, offset, hashed))
            offset += entries
        return tuple(levels)

    @property
    def out_features(self) -> int:
        """The number of features of an encoded point."""
        return self.levels * self.features

    @property
    def table_shape(self) -> tuple[int, int]:
        """The shape [entries of all levels, features] of the table."""
        last = self.rows[-1]
        return last.offset + last.entries, self.features

    @staticmethod
    @functools.lru_cache(maxsize=256)
    def parse(text: str) -> HashGrid:
        """Parses a grid from its ``text``."""
        settings: dict[str, Any] = json.loads(text)
        low, high = settings.pop("box")
        return HashGrid(box=(tuple(low), tuple(high)), **settings)
