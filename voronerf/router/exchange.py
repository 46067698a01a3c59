"""Rows that travel between the ranks of a router, with gradients, and which rank has which cells.

Cells are dealt in order: rank r has the cells ``bounds[r]`` to ``bounds[r + 1]``.

n samples of this rank, m samples that it evaluates, k cells.
"""

from __future__ import annotations

import functools
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

_OP = "VoronoiRouter"


def _exchange(group: Any, there: Sequence[int], came: Sequence[int], tensors: Sequence[Tensor]) -> list[Tensor]:
    """Sends the first ``there[0]`` rows of each tensor to rank 0, the next to rank 1; ``came`` rows come from each.

    All tensors go in one message to each rank, whatever their dtypes.
    """
    parts = [tensor.split(list(there)) for tensor in tensors]
    message = torch.cat([part[rank].reshape(-1).view(torch.uint8) for rank in range(len(there)) for part in parts])
    row = [math.prod(tensor.shape[1:]) * tensor.element_size() for tensor in tensors]
    found, (take, send) = message.new_empty(sum(row) * sum(came)), ([sum(row) * n for n in c] for c in (came, there))
    dist.all_to_all_single(found, message, take, send, group=group)
    pieces = found.split([n * size for n in came for size in row])
    return [
        torch.cat(pieces[i :: len(tensors)]).view(tensor.dtype).view(sum(came), *tensor.shape[1:])
        for i, tensor in enumerate(tensors)
    ]


class _Exchange(torch.autograd.Function):
    """One node of the graph for all tensors of a message, so that the ranks meet in the same order in the backward."""

    @staticmethod
    def forward(group: Any, there: Sequence[int], came: Sequence[int], *tensors: Tensor) -> tuple[Tensor, ...]:
        return tuple(_exchange(group, there, came, tensors))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.group, ctx.there, ctx.came = inputs[:3]
        ctx.needs = ctx.needs_input_grad[3:]
        ctx.mark_non_differentiable(*[tensor for tensor, needs in zip(output, ctx.needs, strict=True) if not needs])

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        wanted = [gradient for gradient, needs in zip(gradients, ctx.needs, strict=True) if needs]
        found = iter(_Exchange.apply(ctx.group, ctx.came, ctx.there, *wanted))
        return None, None, None, *[next(found) if needs else None for needs in ctx.needs]


@dataclass(frozen=True)
class Trip:
    """The way of a call's samples, sorted by cell, to the ranks of their cells and back.

    Attributes:
        group: The process group.
        there: Samples that go to each rank.
        came: Samples that come from each rank.
        cells: int32 [m], the cell of each that came, counted from the first of this rank.
        linked: Which of the arguments take gradients on any rank.
    """

    group: Any
    there: list[int]
    came: list[int]
    cells: Tensor
    linked: list[bool]

    def send(self, rows: Sequence[Tensor]) -> list[Tensor]:
        """[n, ...] of this rank's samples -> [m, ...] of those that it evaluates."""
        # Where another rank's arguments take gradients, this one takes part in the backward.
        rows = [r.detach().requires_grad_() if on and not r.requires_grad else r for r, on in zip(rows, self.linked)]
        return list(_Exchange.apply(self.group, self.there, self.came, *rows)) if rows else []

    def give_back(self, rows: Sequence[Tensor]) -> list[Tensor]:
        """[m, ...] of the samples that this rank evaluates -> [n, ...] of its own."""
        return list(_Exchange.apply(self.group, self.came, self.there, *rows)) if rows else []


def deal_cells(weights: Tensor, ranks: int) -> tuple[int, ...]:
    """Bounds of contiguous shares of cells that are about equally heavy, with at least one cell each.

    Args:
        weights: [k], at least 0.
        ranks: At most k.
    """
    k = len(weights)
    heavy = weights.double().cpu() if weights.sum() > 0 else torch.ones(k, dtype=torch.float64)
    totals, bounds = torch.cat([heavy.new_zeros(1), heavy.cumsum(0)]), [0]
    for rank in range(1, ranks):
        before = totals[bounds[-1]]  # what is left is shared out by those that are left
        nearest = int((totals - before - (totals[-1] - before) / (ranks - rank + 1)).abs().argmin())
        bounds.append(min(max(nearest, bounds[-1] + 1), k - ranks + rank))
    return (*bounds, k)


def checksum(*values: Any) -> int:
    """Of the bytes of tensors and the text of other values."""
    total = 0
    for value in values:
        if isinstance(value, Tensor):
            data = value.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy().tobytes()
        else:
            data = repr(value).encode()
        total = zlib.crc32(data, total)
    return total


@dataclass(frozen=True)
class Shards:
    """Which rank has which cells.

    Attributes:
        group: The process group; None for all processes.
        bounds: Of the cells of each rank.
    """

    group: Any
    bounds: tuple[int, ...]

    def __deepcopy__(self, memo: dict[int, Any]) -> Shards:
        return self  # a process group cannot be copied

    @functools.cached_property
    def rank(self) -> int:
        """This process."""
        return dist.get_rank(self.group)

    @property
    def size(self) -> int:
        """Processes."""
        return len(self.bounds) - 1

    @property
    def own(self) -> slice:
        """The cells of this rank."""
        return slice(self.bounds[self.rank], self.bounds[self.rank + 1])

    @property
    def owners(self) -> Tensor:
        """int64 [k], the rank of each cell."""
        return torch.arange(self.size).repeat_interleave(torch.tensor(self.bounds).diff())

    def cells_text(self, rank: int) -> str:
        """The cells of a rank, for messages."""
        first, last = self.bounds[rank], self.bounds[rank + 1] - 1
        return f"cell {first}" if first == last else f"cells {first} to {last}"

    def check_same(self, what: str, *values: Any) -> None:
        """Raises ValueError on every rank where the values differ between ranks."""
        found = self.gather(checksum(*values), everywhere=True)
        odd = next((rank for rank, other in enumerate(found) if other != found[0]), None)
        if odd is not None:
            raise ValueError(f"{_OP}.{what} must be the same on all ranks, but rank {odd} has another than rank 0")

    def gather(self, value: Any, everywhere: bool = False) -> list[Any]:
        """What all ranks have, on rank 0 or everywhere; elsewhere an empty list."""
        found: list[Any] = [None] * self.size if everywhere or self.rank == 0 else []
        if everywhere:
            dist.all_gather_object(found, value, group=self.group)
        else:
            dist.gather_object(value, found or None, group=self.group, group_dst=0)
        return found

    def from_first(self, value: Any) -> Any:
        """What rank 0 has, for all."""
        box = [value]
        dist.broadcast_object_list(box, group=self.group, group_src=0)
        return box[0]

    def plan(self, offsets: Tensor, rows: Sequence[Tensor], *same: Any) -> Trip:
        """Says to every rank how many samples its cells get.

        Args:
            offsets: int32 [k + 1], of the samples by cell.
            rows: What will be sent of them, [n, ...].
            *same: What must be the same on all ranks besides.

        Raises:
            ValueError: On every rank, where the ranks make different calls.
        """
        shapes = [(tuple(tensor.shape[1:]), tensor.dtype) for tensor in rows]
        grad = torch.is_grad_enabled()
        bits = sum((grad and tensor.requires_grad) << i for i, tensor in enumerate(rows))
        facts = torch.tensor([bits, checksum(grad, shapes, *same)])
        counts = offsets.diff().long()
        head = [torch.cat([part, facts.to(part)]) for part in counts.split([b - a for a, b in self._pairs])]
        came = counts.new_empty(self.size, len(head[self.rank]))
        sizes = [len(head[self.rank])] * self.size, [len(part) for part in head]
        dist.all_to_all_single(came.view(-1), torch.cat(head), *sizes, group=self.group)
        table = came.cpu()  # waits for the device: messages have sizes that the host knows
        odd = (table[:, -1] != facts[1]).nonzero().view(-1).tolist()
        if odd:
            raise ValueError(
                f"{_OP}: all ranks must call the same method, with arguments of the same features, dtypes, options and "
                f"shared values, but rank {odd[0]} makes another call than rank {self.rank}"
            )
        own = torch.arange(came.shape[1] - 2, dtype=torch.int32, device=came.device).repeat(self.size)
        cells = own.repeat_interleave(came[:, :-2].reshape(-1), output_size=int(table[:, :-2].sum()))
        there = [int(part[:-2].sum()) for part in torch.cat(head).cpu().split([len(part) for part in head])]
        linked = [bool((table[:, -2] >> i & 1).any()) for i in range(len(rows))]
        return Trip(self.group, there, table[:, :-2].sum(1).tolist(), cells, linked)

    @property
    def _pairs(self) -> list[tuple[int, int]]:
        return list(zip(self.bounds, self.bounds[1:]))

    def take(self, stacked: Tensor, parents: Tensor, bounds: tuple[int, ...]) -> Tensor:
        """Entries of this rank's cells -> those of the parents of the cells that it has by other bounds."""
        owners, wanted = self.owners, Shards(self.group, bounds)
        lists = [parents[a:b].cpu() for a, b in wanted._pairs]
        send = [cells[owners[cells] == self.rank] - self.own.start for cells in lists]
        source = owners[lists[self.rank]]
        came = source.bincount(minlength=self.size).tolist()
        rows = stacked[torch.cat(send).to(stacked.device)]
        found = _exchange(self.group, [len(part) for part in send], came, [rows])[0]
        return found[source.argsort(stable=True).argsort().to(found.device)]

    def join(self, stacked: Tensor) -> Tensor:
        """Entries of this rank's cells -> those of all cells, on rank 0; none elsewhere."""
        there = [len(stacked) if rank == 0 else 0 for rank in range(self.size)]
        came = [b - a if self.rank == 0 else 0 for a, b in self._pairs]
        return _exchange(self.group, there, came, [stacked])[0]
