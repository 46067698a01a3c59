"""The arguments that route samples to cells: centres, perhaps with the tables of a tree, or the cells themselves.

n samples, k cells, m centres of all diagrams together, g diagrams.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core.checks import FLOATING, INDEX, Others, TensorRule, check_integer, to_common_dtype

_ROWS = {
    "cells": TensorRule("cells", INDEX, ("n",)),
    "centres": TensorRule("centres", FLOATING, ("k", 3)),
    "child_offsets": TensorRule("child_offsets", INDEX, ("g+1",)),
    "child": TensorRule("child", INDEX, ("m",)),
    "frozen": TensorRule("frozen", (torch.bool,), ("k",)),
    "rows": TensorRule("rows", INDEX, (1,)),
    "coords": TensorRule("coords", FLOATING, ("n", 3)),
    "centre_index": TensorRule("centre_index", INDEX, ("w",)),
}
_ROWS_OF_A_TREE = {**_ROWS, "centres": TensorRule("centres", FLOATING, ("m", 3))}


class Routing(NamedTuple):
    """The arguments of `routed_mlp` for the cells of samples, the frozen cells and the number of valid samples."""

    centres: Tensor | None = None
    child_offsets: Tensor | None = None
    child: Tensor | None = None
    depth: int = 1
    cells: Tensor | None = None
    coords: Tensor | None = None
    rows: Tensor | None = None
    frozen: Tensor | None = None
    centre_index: Tensor | None = None

    def to_check(self, op: str) -> Others:
        """Checks the combination of arguments; returns the rules for the tensors, and the tensors."""
        if self.centres is None:
            for name, tensor in (("child_offsets", self.child_offsets), ("child", self.child)):
                if tensor is not None:
                    raise ValueError(f"{op}: {name} must come with centres, got no centres")
            if self.coords is not None:
                raise ValueError(f"{op}: coords require centres, got no centres")
            if self.centre_index is not None:
                raise ValueError(f"{op}: centre_index requires centres, got no centres")
        else:
            if self.cells is not None:
                raise ValueError(f"{op}: centres must be None where cells are given, got both")
            if (self.child_offsets is None) != (self.child is None):
                missing = "child_offsets" if self.child_offsets is None else "child"
                raise ValueError(f"{op}: child_offsets and child must come together, got no {missing}")
            if self.child is not None and self.centre_index is not None:
                raise ValueError(f"{op}: centre_index must be None for the centres of a tree, got one")
            check_integer(op, "depth", self.depth, 1)
            if self.child is None and self.depth != 1:
                raise ValueError(f"{op}: depth must be 1 for a flat diagram, got {self.depth}")
        rows: dict[str, TensorRule] = _ROWS if self.child is None else _ROWS_OF_A_TREE
        names = [name for name in rows if getattr(self, name) is not None]
        return [rows[name] for name in names], [getattr(self, name) for name in names]

    def at(self, op: str, positions: Tensor, sizes: dict[str, int]) -> Routing:
        """Returns the routing with the coordinates of the samples, in a common dtype with the centres.

        Args:
            op: the name of the operation for error messages.
            positions: [n, p]; the first three columns are the coordinates, unless ``coords`` are given.
            sizes: the size of each letter in the checked shapes.
        """
        if self.centres is None:
            if self.cells is None and sizes["k"] != 1:
                raise ValueError(f"{op}: centres or cells must be given for {sizes['k']} cells, got neither")
            return self
        if self.child is not None and (sizes["m"] < 1 or sizes["g"] < 1):
            count = f"{sizes['m']} centres in {sizes['g']} diagrams"
            raise ValueError(f"{op}: centres must hold at least one centre of one diagram, got {count}")
        p = positions.shape[1]
        if self.coords is None and p < 3:
            raise ValueError(f"{op}: coords must be given for positions with fewer than 3 features, got {p}")
        coords, centres = to_common_dtype(positions[:, :3] if self.coords is None else self.coords, self.centres)
        index = self.centre_index if centres is self.centres else None
        return self._replace(coords=coords, centres=centres, centre_index=index)
