"""Results of neighbouring cells mixed near their borders, see `voronerf.diagram.blending`.

n samples, m further entries: a sample together with a cell that is not its own.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from voronerf.diagram import VoronoiDiagram
from voronerf.diagram.blending import blend_cells
from voronerf.router.arguments import Layout, map_result
from voronerf.router.calls import Call, run_entries
from voronerf.router.grouping import Entries
from voronerf.router.memory import Memory


class Mixture:
    """What is to be evaluated beside each sample in its own cell, and how much of it goes into the result.

    Attributes:
        rows: int64 [m], the sample of each entry; m is never 1.
        cells: int32 [m], the cell to evaluate it in.
        weights: floating [m].
        kept: floating [n], the share of a sample's own cell; 1 outside of all margins.
    """

    def __init__(self, rows: Tensor, cells: Tensor, weights: Tensor, kept: Tensor) -> None:
        self.rows, self.cells, self.weights, self.kept = rows, cells, weights, kept

    @classmethod
    def of(cls, diagram: VoronoiDiagram, positions: Tensor, margin: float, backend: str) -> Mixture | None:
        """The mixture at positions [n, 3]; None where no sample lies in a margin."""
        positions = positions.detach().reshape(-1, 3)
        blend = blend_cells(diagram, positions, margin)
        if blend.rows.numel() == 0:
            return None
        own = blend.cells == diagram.locate(positions[blend.rows], backend=backend)
        kept = torch.ones(positions.shape[0], dtype=blend.weights.dtype, device=positions.device)
        kept[blend.rows] = 0
        kept[blend.rows[own]] = blend.weights[own]
        rows, cells, weights = (part[~own] for part in blend)
        if rows.numel() == 0:
            return None
        if rows.shape[0] == 1:  # one row leaves open what is a row: the second counts for nothing
            rows, cells, weights = rows.repeat(2), cells.repeat(2), torch.cat([weights, torch.zeros_like(weights)])
        return cls(rows, cells, weights, kept)

    def mix(self, own: Tensor, others: Tensor) -> Tensor:
        """Weighted means; what is not floating stays that of a sample's own cell.

        Args:
            own: [n, ...] in whatever leading dimensions, the results in the samples' own cells.
            others: [m, ...], those of the entries.
        """
        if not own.is_floating_point():
            return own
        dtype = torch.promote_types(torch.promote_types(own.dtype, torch.float32), self.kept.dtype)
        n, m = self.kept.shape[0], self.rows.shape[0]
        total = own.reshape(n, -1).to(dtype) * self.kept[:, None]
        total = total.index_add(0, self.rows, others.reshape(m, -1).to(dtype) * self.weights[:, None].to(dtype))
        return total.to(own.dtype).reshape(own.shape)


class _Rows:
    """A tensor of a result that has rows [m, ...], one or more for each entry."""

    def __init__(self, tensor: Tensor) -> None:
        self.tensor = tensor


def mix_call(
    own: Any, module: nn.Module, call: Call, layout: Layout, mixture: Mixture, k: int, backend: str, memory: Memory
) -> Any:
    """The blended results of a call.

    Args:
        own: what the call returned for all samples in their own cells.
        module: with stacked parameters.
        call: of a method of it.
        layout: of its arguments.
        mixture: of its samples.
        k: cells.
        backend: of the operations.
        memory: of the router.
    """
    entries = Entries(mixture.rows, mixture.cells, k, backend)
    others: list[Any] = []
    result = run_entries(module, call, layout, entries, memory, _Rows)

    def gather(leaf: Any) -> Any:
        others.append(leaf)
        return leaf

    map_result(result, gather, leaf=(Tensor, _Rows))
    following = iter(others)

    def change(tensor: Tensor) -> Tensor:
        other = next(following)
        return mixture.mix(tensor, other.tensor) if isinstance(other, _Rows) else tensor

    return map_result(own, change)
