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
from collections.abc import Callable, Iterator, Sequence
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


def restarts() -> int:
    """How often torchrun has started the ranks again after one of them failed."""
    return int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"))


class Group:
    """All ranks of a training.

    Attributes:
        rank: The number of this one.
        size: How many there are.
        sent: Bytes that this rank has sent to others, for each kind of message.

    Args:
        device: Where the tensors are that are sent.

    Raises:
        RankLost: When the others do not come.
    """

    def __init__(self, device: torch.device) -> None:
        self.rank, self.size, self.device = own_rank(), world_size(), device
        self.sent: Counter[str] = Counter()
        self._room: dict[str, int] = {}  # rows of a message of each kind
        self._rooms = [0] * self.size, [0] * self.size  # rows of an exchange, to and from each rank
        backend = "nccl" if device.type == "cuda" else "gloo"
        if device.type == "cuda":
            torch.cuda.set_device(device)  # where torch puts what it sends of Python objects
        timeout = timedelta(seconds=PATIENCE)
        with self._waiting():
            store, rank, size = next(iter(dist.rendezvous("env://", timeout=timeout)))
            # torchrun keeps one store for all starts: a rank would find the addresses of those that were killed.
            self.store = dist.PrefixStore(f"voronerf/{restarts()}", store)
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
        self.begin_total(values)()
        return values

    def largest(self, values: Tensor) -> Tensor:
        """The largest of all ranks, in place."""
        with self._waiting():
            dist.all_reduce(values, dist.ReduceOp.MAX)
        return values

    def begin_total(self, values: Tensor) -> Callable[[], None]:
        """Begins to sum values over all ranks, in place; what it returns waits for the end."""
        with self._waiting():
            work = dist.all_reduce(values, async_op=True)

        def wait() -> None:
            with self._waiting():
                work.wait()

        return wait

    def share(self, kind: str, rows: Tensor) -> list[Tensor]:
        """The rows of every rank, as many as each has.

        One message does it: it has room for some more rows than the fullest of its kind before it, and says how many
        there are. What does not fit follows in another.

        Args:
            kind: What they are.
            rows: float32 [n, c].
        """
        n, room = len(rows), self._room.get(kind, 0)
        message = rows.new_empty(1 + room, rows.shape[1])
        message[:1].view(torch.int32)[:] = n
        message[1 : 1 + n] = rows[:room]
        found = self._gather(kind, message)
        counts = found.view(torch.int32)[:, 0, 0].tolist()
        parts, most = found[:, 1:], max(counts)
        if most > room:
            rest = rows.new_empty(most - room, rows.shape[1])
            rest[: max(n - room, 0)] = rows[room:]
            parts = torch.cat((parts, self._gather(kind, rest)), 1)
        self._room[kind] = most + most // 4 + 1
        return [part[:count] for part, count in zip(parts, counts, strict=True)]

    def exchange(self, kind: str, parts: Sequence[Tensor]) -> list[Tensor]:
        """Sends each rank its part, and gets one of each; how many rows these have need not be known.

        As in :meth:`share`, a message has room for some more rows than the one before it to the same rank.

        Args:
            kind: What they are; all exchanges are of one kind.
            parts: float32 [n, c] for each rank; the own one stays.
        """
        there, came = self._rooms
        messages = [part.new_empty(1 + room, part.shape[1]) for part, room in zip(parts, there, strict=True)]
        for message, part in zip(messages, parts, strict=True):
            message[:1].view(torch.int32)[:] = len(part)
            message[1 : 1 + len(part)] = part[: len(message) - 1]
        found = self.swap(kind, messages, [1 + room for room in came])
        counts = torch.stack([message[0] for message in found]).view(torch.int32)[:, 0].tolist()
        rests = [part.new_empty(max(n - room, 0), part.shape[1]) for part, n, room in zip(parts, counts, came)]
        others = [rank for rank in range(self.size) if rank != self.rank]
        left = [(rank, parts[rank][there[rank] :].contiguous()) for rank in others if len(parts[rank]) > there[rank]]
        with self._waiting():
            sends = [dist.P2POp(dist.isend, rest, rank) for rank, rest in left]
            sends += [dist.P2POp(dist.irecv, rests[rank], rank) for rank in others if len(rests[rank])]
            for work in dist.batch_isend_irecv(sends) if sends else []:
                work.wait()
        self.sent[kind] += sum(rest.numel() * rest.element_size() for _, rest in left)
        result = [torch.cat((part[1 : 1 + n], rest)) for part, n, rest in zip(found, counts, rests, strict=True)]
        result[self.rank] = parts[self.rank]
        self._rooms = [n + n // 4 + 1 for n in map(len, parts)], [n + n // 4 + 1 for n in counts]
        return result

    def swap(self, kind: str, parts: Sequence[Tensor], came: Sequence[int]) -> list[Tensor]:
        """Sends each rank its part [n, c], and gets ``came`` rows of each; the own part stays."""
        own = self.rank
        others = [part[:0] if rank == own else part for rank, part in enumerate(parts)]
        there, came = list(map(len, others)), [0 if rank == own else n for rank, n in enumerate(came)]
        message = torch.cat(others)
        found = message.new_empty(sum(came), message.shape[1])
        with self._waiting():
            dist.all_to_all_single(found, message, came, there)
        self.sent[kind] += message.numel() * message.element_size()
        result = list(found.split(came))
        result[own] = parts[own]
        return result

    def _gather(self, kind: str, message: Tensor) -> Tensor:
        every = message.repeat(self.size, 1, 1)
        found = torch.empty_like(every)
        with self._waiting():
            dist.all_to_all_single(found, every)  # gloo gathers in twice the time
        self.sent[kind] += (self.size - 1) * message.numel() * message.element_size()
        return found

    def from_first(self, value: Any) -> Any:
        """What rank 0 has, for all."""
        box = [value]
        with self._waiting():
            dist.broadcast_object_list(box, src=0)
        return box[0]


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
