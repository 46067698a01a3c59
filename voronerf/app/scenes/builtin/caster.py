"""The first solid on each of many rays, for solids that say how they look. r rays, m solids."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from voronerf.app.scenes.builtin.solids import Array, Rows, Solid
from voronerf.ops.first_solid import first_solid
from voronerf.ops.first_solid.reference import KINDS, Solids


class Caster:
    """Finds the first of some solids on rays, see :func:`voronerf.ops.first_solid`.

    Args:
        groups: of solids that stand together.
    """

    def __init__(self, groups: Sequence[Sequence[Solid]]) -> None:
        self.solids = [solid for group in groups for solid in group]
        kinds = [KINDS.index(type(solid).__name__.lower()) for solid in self.solids]
        measures = [(*solid.measures(), 0.0, 0.0)[:3] for solid in self.solids]
        turns = [np.eye(3, dtype=np.float32) if solid.turn is None else solid.turn for solid in self.solids]
        self._packed = Solids(
            torch.tensor(kinds, dtype=torch.int32),
            torch.tensor([solid.centre for solid in self.solids]),
            torch.from_numpy(np.stack(turns)),
            torch.tensor(measures),
        )

    def __call__(self, origins: Array, directions: Array) -> tuple[Array, Rows]:
        """The first solid on each ray; of several at one distance, the one with the lowest number.

        Args:
            origins: [r, 3], or [1, 3] where all rays start from the same point.
            directions: [r, 3] unit, or [1, 3] where all rays are parallel.

        Returns:
            (distance [r], infinite for a miss; number of the solid [r], 0 for a miss).
        """
        depth, number = first_solid(torch.from_numpy(origins), torch.from_numpy(directions), self._packed)
        return depth.numpy(), number.numpy().astype(np.int64)
