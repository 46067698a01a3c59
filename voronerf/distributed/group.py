"""The processes that train one run together: start and end, what they send each other, and who says what is wrong.

torchrun starts the ranks and says in the environment who they are. They meet over ``torch.distributed``: gloo on CPUs,
nccl on GPUs.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

#: Seconds after which a rank that does not answer is given up.
PATIENCE = 50
_TOLD = "voronerf/told"


class RankLost(Exception):
    """Another rank has ended, or does not answer."""


def world_size() -> int:
    """The ranks that torchrun has started; 1 without it."""
    return int(os.environ.get("WORLD_SIZE", "1"))


def own_rank() -> int:
    """The number of this process among them, from 0."""
    return int(os.environ.get("RANK", "0"))


def local_rank() -> int:
    """The number of this process among those of its machine, which is that of its GPU."""
    return int(os.environ.get("LOCAL_RANK", "0"))


def restarted() -> bool:
    """Whether torchrun has started the ranks again after one of them failed."""
    return int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")) > 0


class Group:
    """All ranks of a training.

    Attributes:
        rank: The number of this one.
        size: How many there are.
        sent: Bytes that this rank has sent to others by :meth:`send`, for each kind.

    Args:
        device: Where the tensors are that are sent.

    Raises:
        RankLost: When the others do not come.
    """

    def __init__(self, device: torch.device) -> None:
        self.rank, self.size, self.device = own_rank(), world_size(), device
        self.sent: Counter[str] = Counter()
        backend = "nccl" if device.type == "cuda" else "gloo"
        if device.type == "cuda":
            torch.cuda.set_device(device)  # where torch puts what it sends of Python objects
        timeout = timedelta(seconds=PATIENCE)
        with self._waiting():
            self.store, rank, size = next(iter(dist.rendezvous("env://", timeout=timeout)))
            dist.init_process_group(backend, store=self.store, rank=rank, world_size=size, timeout=timeout)

    @contextlib.contextmanager
    def _waiting(self) -> Iterator[None]:
        try:
            yield
        except RuntimeError as error:  # DistError and what gloo throws
            reason = re.sub(r"^\[\S+\] *", "", str(error)).splitlines()[0].split(". ")[0]
            raise RankLost(f"another rank has ended, or has not answered for {PATIENCE} s ({reason})") from None

    def check_equal(self, what: dict[str, str]) -> None:
        """Compares texts of all ranks, each rank naming them alike.

        Raises:
            ValueError: Names the first that differs, its ranks and both values.
        """
        found: list[Any] = [None] * self.size
        with self._waiting():
            dist.all_gather_object(found, what)
        for name, value in found[0].items():
            for rank, other in enumerate(found):
                if other[name] != value:
                    raise ValueError(
                        f"{name} must be the same on all ranks, got {value} on 0 and {other[name]} on {rank}"
                    )

    def total(self, values: Tensor) -> Tensor:
        """The sum over all ranks, in place."""
        with self._waiting():
            dist.all_reduce(values)
        return values

    def largest(self, values: Tensor) -> Tensor:
        """The largest of all ranks, in place."""
        with self._waiting():
            dist.all_reduce(values, dist.ReduceOp.MAX)
        return values

    def send(
        self, kind: str, rows: Tensor, counts: Sequence[int], expected: Sequence[int] | None = None
    ) -> tuple[Tensor, list[int]]:
        """Sends the first ``counts[0]`` rows to rank 0, the next ``counts[1]`` to rank 1 and so on.

        Args:
            kind: What they are, for :attr:`sent`.
            rows: [n, ...], contiguous.
            counts: Of every rank, n in all.
            expected: How many rows each rank sends to this one, where that is known.

        Returns:
            The rows that came, in the order of the ranks, and how many came from each.
        """
        with self._waiting():
            if expected is None:
                came = torch.empty(self.size, dtype=torch.int64, device=self.device)
                dist.all_to_all_single(came, torch.tensor(counts, device=self.device))
                expected = came.tolist()
            found = rows.new_empty(sum(expected), *rows.shape[1:])
            dist.all_to_all_single(found, rows, list(expected), list(counts))
        others = sum(counts) - counts[self.rank]
        self.sent[kind] += others * rows[:1].numel() * rows.element_size()
        return found, list(expected)

    def share(self, kind: str, rows: Tensor) -> Tensor:
        """The rows of all ranks, one rank after the other; each may have another number of them."""
        every = rows.repeat(self.size, *[1] * (rows.dim() - 1))
        return self.send(kind, every, [len(rows)] * self.size)[0]

    def from_first(self, value: Any) -> Any:
        """What rank 0 has, for all."""
        box = [value]
        with self._waiting():
            dist.broadcast_object_list(box, src=0)
        return box[0]

    def at_first(self, value: Any) -> list[Any]:
        """What all ranks have, for rank 0; empty elsewhere."""
        found: list[Any] = [None] * self.size if self.rank == 0 else []
        with self._waiting():
            dist.gather_object(value, found or None, dst=0)
        return found


_current: Group | None = None


@contextlib.contextmanager
def joined(device: torch.device) -> Iterator[Group]:
    """The group of all ranks, which they leave together.

    Raises:
        RankLost: When the others do not come.
    """
    global _current
    _current = group = Group(device)
    yield group
    group.total(torch.zeros(1, device=device))  # all have come as far
    dist.destroy_process_group()
    _current = None


def may_tell(error: Exception) -> bool:
    """Whether this process is to say what is wrong: of many ranks that meet an error, the first.

    One that only knows that another has ended leaves that one a second to say why.
    """
    if _current is None:
        return own_rank() == 0
    if isinstance(error, RankLost):
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # of torchrun, which ends the ranks that are left
        time.sleep(1)
    try:
        return bool(_current.store.add(_TOLD, 1) == 1)
    except RuntimeError:  # the process that kept the store is gone
        return True
