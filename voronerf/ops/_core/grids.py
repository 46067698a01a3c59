"""Hash grids: tables of features at the corners of grids of several resolutions.

Müller et al. 2022, "Instant Neural Graphics Primitives". A grid describes where the features of a point lie in a table
[entries, features]; the table itself is a tensor.
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
INTERPOLATIONS = ("linear", "smoothstep")
UNIT_CUBE = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


class GridLevel(NamedTuple):
    """One level, in the numbers that an implementation needs.

    A point x in 0..1 lies at ``x * scale + shift``, between integer corners. The corner (i, j, k) has the entry
    ``i + side * j + side**2 * k`` modulo ``entries``; or, where the level is hashed, the lowest bits of ``i ^
    2654435761 j ^ 805459861 k`` in unsigned 32 bit numbers."""

    scale: float  # corners between the two sides of the box
    shift: float  # of the corners
    side: int  # stride of the second axis
    entries: int  # of this level; a power of two where it is hashed
    offset: int  # the level's first entry in the table
    hashed: bool  # whether corners share entries


@dataclass(frozen=True)
class HashGrid:
    """Levels of a hash grid, as ``hash_encode`` reads them.

    Level l has a resolution of ``base * (finest / base) ** (l / (levels - 1))``, equation 2 and 3 of the paper. A level
    whose corners all fit into its entries has one for each of them; in a finer one corners share entries by a hash.

    Attributes:
        levels: 1 to 24.
        features: 1, 2, 4 or 8 for each level.
        log2_entries: 10 to 24, the most entries of a level.
        base: resolution of the coarsest level, at least 1.
        finest: resolution of the finest one, at least ``base``.
        box: smallest and largest corner of the space, three numbers each. Points outside of it have the features of the
            nearest point inside.
        interpolation: "linear", or "smoothstep", whose first derivative is continuous.
        convention: whose tables are read. "tiny-cuda-nn" (and instant-ngp): corners are shifted by half, a level of
            resolution N has N corners along an axis. "torch-ngp" (its gridencoder, with ``align_corners=False``): as
            before, with one more corner. "nerfstudio" (``HashEncoding`` in PyTorch, and HashNeRF): no shift, whole
            resolutions, and hashes on every level.
        text: the grid as JSON, which :meth:`parse` reads.

    Raises:
        ValueError: a number out of its range, a box without a volume, or another word.

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
    interpolation: str = "linear"
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
            right = len(low) == len(high) == 3 and all(0 < b - a < math.inf for a, b in zip(low, high))
        except (TypeError, ValueError, OverflowError):
            right = False
        if not right:
            raise ValueError(
                f"HashGrid: box must be two corners of which the second is larger on each axis, got {self.box!r:.60}"
            )
        object.__setattr__(self, "box", (low, high))
        for name, words in (("interpolation", INTERPOLATIONS), ("convention", CONVENTIONS)):
            value = getattr(self, name)
            if not isinstance(value, str) or value not in words:
                raise ValueError(f"HashGrid: {name} must be one of {', '.join(words)}, got {value!r:.60}")
        said = {own.name: getattr(self, own.name) for own in dataclasses.fields(self) if own.init}
        # Not by a cached property, whose lock torch.compile does not enter.
        object.__setattr__(self, "text", json.dumps(said))

    @functools.cached_property
    def rows(self) -> tuple[GridLevel, ...]:
        """The levels, the coarsest first."""
        most, found, offset = 2**self.log2_entries, [], 0
        # In float32, as their libraries compute them: a rounding may decide how many corners there are.
        growth = math.exp((math.log(self.finest) - math.log(self.base)) / max(self.levels - 1, 1))
        index = torch.arange(self.levels, device="cpu")  # also where networks are made on the meta device
        if self.convention == "nerfstudio":
            scales, shift, extra = torch.floor(self.base * growth**index), 0.0, None
        else:
            scales, shift = torch.exp2(index * math.log2(growth)) * self.base - 1, 0.5
            extra = 2 if self.convention == "torch-ngp" else 1
        for scale in scales.tolist():
            side = 0 if extra is None else math.ceil(scale) + extra
            hashed = extra is None or side**3 > most
            entries = most if hashed else -(-(side**3) // 8) * 8
            found.append(GridLevel(scale, shift, side, entries, offset, hashed))
            offset += entries
        return tuple(found)

    @property
    def out_features(self) -> int:
        """Features of an encoded point."""
        return self.levels * self.features

    @property
    def table_shape(self) -> tuple[int, int]:
        """Shape [entries of all levels, features] of the table."""
        last = self.rows[-1]
        return last.offset + last.entries, self.features

    @staticmethod
    @functools.lru_cache(maxsize=256)
    def parse(text: str) -> HashGrid:
        """The grid whose ``text`` this is."""
        said: dict[str, Any] = json.loads(text)
        low, high = said.pop("box")
        return HashGrid(box=(tuple(low), tuple(high)), **said)
