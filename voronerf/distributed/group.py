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
    """All ranks of a training. A group of one is a process by itself, which sends nothing.

    Attributes:
        rank: The number of this one.
        size: How many there are.
        device: Where the tensors are that are sent.
        sent: Bytes that this rank has sent to others, for each kind of message.

    Args:
        device: Where the tensors are that are sent.
    """

    def __init__(self, device: torch.device) -> None:
        self.rank, self.size, self.device = 0, 1, device
        self.sent: Counter[str] = Counter()
        self._rooms: dict[str, tuple[list[int], list[int]]] = {}  # rows of a message of each kind, to and from ranks
        self.store: dist.Store | None = None

    def join(self) -> None:
        """Meets the other ranks that torchrun has started.

        Raises:
            RankLost: When they do not come.
        """
        self.rank, self.size = own_rank(), world_size()
        backend = "nccl" if self.device.type == "cuda" else "gloo"
        if self.device.type == "cuda":
            torch.cuda.set_device(self.device)  # where torch puts what it sends of Python objects
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
        if self.size > 1:
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
        """The rows of every rank, as many as each has; see :meth:`exchange`."""
        return self.exchange(kind, [rows] * self.size)

    def exchange(self, kind: str, parts: Sequence[Tensor]) -> list[Tensor]:
        """Sends each rank its part, and gets one of each; how many rows these have need not be known.

        A message has room for some more rows than the one of its kind before it to the same rank, and says how many
        there are. What does not fit follows in another.

        Args:
            kind: What they are.
            parts: [n, c] of 4 bytes each for each rank; the own one stays.
        """
        there, came = self._rooms.get(kind, ([0] * self.size, [0] * self.size))
        messages = [
            part if rank == self.rank else _message(part, room)
            for rank, (part, room) in enumerate(zip(parts, there, strict=True))
        ]
        found = self.swap(kind, messages, [1 + room for room in came])
        counts = [
            len(message) if rank == self.rank else int(message[0, :1].view(torch.int32))
            for rank, message in enumerate(found)
        ]
        rests = [part[room:] for part, room in zip(parts, there, strict=True)]
        more = self.swap(kind, rests, [max(n - room, 0) for n, room in zip(counts, came, strict=True)])
        self._rooms[kind] = [len(part) * 9 // 8 + 8 for part in parts], [n * 9 // 8 + 8 for n in counts]
        result = [
            torch.cat((message[1:], rest)) if len(rest) else message[1 : 1 + n]
            for message, rest, n in zip(found, more, counts, strict=True)
        ]
        result[self.rank] = parts[self.rank]
        return result

    def swap(self, kind: str, parts: Sequence[Tensor], came: Sequence[int]) -> list[Tensor]:
        """Sends each rank its part [n, c], and gets ``came`` rows of each; the own part stays."""
        found = list(parts)
        messages = []
        for rank, (part, n) in enumerate(zip(parts, came, strict=True)):
            if rank == self.rank:
                continue
            found[rank] = part.new_empty(n, part.shape[1])
            if n:
                messages.append(dist.P2POp(dist.irecv, found[rank], rank))
            if len(part):
                messages.append(dist.P2POp(dist.isend, part, rank))
                self.sent[kind] += part.numel() * part.element_size()
        with self._waiting():  # gloo takes half as long for these as for its collectives
            for work in dist.batch_isend_irecv(messages) if messages else []:
                work.wait()
        return found

    def from_first(self, value: Any) -> Any:
        """What rank 0 has, for all."""
        box = [value]
        if self.size > 1:
            with self._waiting():
                dist.broadcast_object_list(box, src=0)
        return box[0]


def _message(rows: Tensor, room: int) -> Tensor:
    """The number of rows [n, c], and as many of them as there is room for, [1 + room, c]."""
    message = rows.new_empty(1 + room, rows.shape[1])
    message[0, :1].view(torch.int32).fill_(len(rows))
    message[1 : 1 + len(rows)] = rows[:room]
    return message


_current: Group | None = None


@contextlib.contextmanager
def joined(device: torch.device) -> Iterator[Group]:
    """The group of all ranks, which they leave together.

    Raises:
        RankLost: When the others do not come.
    """
    global _current
    _current = group = Group(device)
    group.join()
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
        return _current.store is None or bool(_current.store.add(_TOLD, 1) == 1)
    except RuntimeError:  # the process that kept the store is gone
        return True
