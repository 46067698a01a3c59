"""What ranks tell each other in a step, beside the partial sums of rays.

n heaviest samples of each rank, c samples in voxels that other ranks reach.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from voronerf.distributed.group import Group
from voronerf.ops.touched_entries import add_entries, pack_entries

#: Numbers of 64 bits, as those of 32 that a message is made of.
_COUNTS, _FIGURES = 2 * 4, 2 * 3


class Told(NamedTuple):
    """What a rank has to say; and from :meth:`Exchange.agree`, what all ranks have said.

    Attributes:
        loss: [], of the rays that a rank puts together; the sum.
        total: [], of the loss and the gradients that a guard reads; the sum.
        kept: [n, 4], heaviest samples with their importance; those of all.
        seen: [c, 2], see `OccupancyGrid.tell`; those of the others.
        samples: In occupied cells; the sum.
        passed: Seconds since the message before, on rank 0.
        stop: Whether a stop was asked for, on any rank.
        ready: Whether the own part of a checkpoint is written, on all ranks.
    """

    loss: Tensor
    total: Tensor
    kept: Tensor
    seen: Tensor
    samples: int
    passed: float
    stop: bool
    ready: bool


class Exchange:
    """Adds up gradients of what all ranks have, and lets them agree on the rest.

    Args:
        group: The ranks.
        whole: Parameters that all ranks have, and that a step updates whole.
        tables: Parameters that all ranks have, of which a step touches few entries: these alone travel.
    """

    def __init__(self, group: Group, whole: list[nn.Parameter], tables: list[nn.Parameter]) -> None:
        self.group, self.whole, self.tables = group, whole, tables

    def begin(self) -> Callable[[], None]:
        """Begins to add up the gradients of whole parameters; what it returns waits for the end."""
        if self.group.size == 1 or not self.whole:
            return lambda: None
        flat = torch.cat([p.grad.reshape(-1) for p in self.whole if p.grad is not None])
        wait = self.group.begin_total(flat)

        def end() -> None:
            wait()
            _set_gradients(self.whole, flat)

        return end

    def agree(self, own: Told) -> Told:
        """Tells all ranks what each has to say, and adds up the gradients of tables."""
        if self.group.size == 1:
            return own
        device = own.kept.device
        counts = torch.tensor((len(own.seen), own.samples, own.stop, own.ready), device=device)
        figures = torch.tensor((own.passed * (self.group.rank == 0), 0, 0), dtype=torch.float64, device=device)
        figures[1], figures[2] = own.loss, own.total
        gradients = [p.grad.reshape(-1) for p in self.tables if p.grad is not None]
        entries = torch.cat(gradients) if gradients else own.kept.new_empty(0)
        parts = [counts, figures, own.kept, own.seen, pack_entries(entries)]
        message = torch.cat([part.reshape(-1).view(torch.int32) for part in parts])
        came = [part[:, 0] for part in self.group.share("news", message[:, None])]
        total = torch.stack([part[:_COUNTS].clone().view(torch.int64) for part in came])
        sums = torch.stack([part[_COUNTS : _COUNTS + _FIGURES].clone().view(torch.float64) for part in came]).sum(0)
        middle = _COUNTS + _FIGURES + own.kept.numel()
        kept = [part[_COUNTS + _FIGURES : middle].view(torch.float32).view(-1, 4) for part in came]
        ends = [middle + 2 * count for count in total[:, 0].tolist()]
        if len(entries):
            rest = [part[end:].view(torch.float32) for part, end in zip(came, ends, strict=True)]
            _set_gradients(self.tables, add_entries(rest, len(entries)))
        seen = [part[middle:end].view(torch.float32).view(-1, 2) for part, end in zip(came, ends, strict=True)]
        del seen[self.group.rank]
        _, samples, stops, ready = total.sum(0).tolist()
        return Told(
            loss=sums[1].float(),
            total=sums[2].float(),
            kept=torch.cat(kept),
            seen=torch.cat(seen),
            samples=samples,
            passed=float(sums[0]),
            stop=stops > 0,
            ready=ready == self.group.size,
        )


def _set_gradients(parameters: list[nn.Parameter], flat: Tensor) -> None:
    for parameter, part in zip(parameters, flat.split([p.numel() for p in parameters]), strict=True):
        parameter.grad = part.view_as(parameter)
