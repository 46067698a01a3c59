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
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import timedelta
from pathlib import Path
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
        messages: How many these were.

    Args:
        device: Where the tensors are that are sent.
    """

    def __init__(self, device: torch.device) -> None:
        self.rank, self.size, self.device = 0, 1, device
        self.sent: Counter[str] = Counter()
        self.messages: Counter[str] = Counter()
        self._rooms: dict[tuple[str, str, int], int] = {}  # rows of a message of each kind, to and from each rank
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
        _let_gloo_wait()

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
        """The sum over all ranks, in place: up a tree of ranks and down again, at most six messages for each."""
        return self._reduce(values, Tensor.add_)

    def largest(self, values: Tensor) -> Tensor:
        """The largest of all ranks, in place; as :meth:`total`."""
        return self._reduce(values, lambda whole, part: whole.copy_(torch.maximum(whole, part)))

    def _reduce(self, values: Tensor, add: Callable[[Tensor, Tensor], Any]) -> Tensor:
        if self.size == 1:
            return values
        children = [rank for rank in (2 * self.rank + 1, 2 * self.rank + 2) if rank < self.size]
        parts = self.swap("agreement", {}, {child: torch.empty_like(values) for child in children})
        for child in children:
            add(values, parts[child])
        if self.rank:
            parent = (self.rank - 1) // 2
            whole = self.swap("agreement", {parent: values}, {parent: torch.empty_like(values)})
            values.copy_(whole[parent])
        self.swap("agreement", dict.fromkeys(children, values), {})
        return values

    def exchange(self, kind: str, width: int, parts: Mapping[int, Tensor], sources: Iterable[int]) -> dict[int, Tensor]:
        """Sends some ranks their parts, and gets those of others; how many rows these have need not be known.

        A message has room for some more rows than the one of its kind before it to the same rank, and says how many
        there are. What does not fit follows in another.

        Args:
            kind: What they are.
            width: c, the columns of all parts of a kind.
            parts: float32 [n, c] for each rank that gets one.
            sources: The ranks that send this one a part.

        Returns:
            The parts that came, by rank.
        """
        there = {rank: self._rooms.get((kind, "to", rank), 0) for rank in parts}
        room = {rank: self._rooms.get((kind, "from", rank), 0) for rank in sources}
        empty = torch.empty(0, width, device=self.device)
        messages = {rank: _message(part, there[rank]) for rank, part in parts.items()}
        came = self.swap(kind, messages, {rank: empty.new_empty(1 + n, width) for rank, n in room.items()})
        counts = {rank: int(message[0, :1].view(torch.int32)) for rank, message in came.items()}
        rests = {rank: part[there[rank] :] for rank, part in parts.items() if len(part) > there[rank]}
        more = {rank: empty.new_empty(n - room[rank], width) for rank, n in counts.items() if n > room[rank]}
        more = self.swap(kind, rests, more)
        for way, sizes in (("to", {rank: len(part) for rank, part in parts.items()}), ("from", counts)):
            for rank, n in sizes.items():
                self._rooms[kind, way, rank] = n * 9 // 8 + 8
        return {
            rank: torch.cat((message[1:], more[rank])) if rank in more else message[1 : 1 + counts[rank]]
            for rank, message in came.items()
        }

    def swap(self, kind: str, parts: Mapping[int, Tensor], came: Mapping[int, Tensor]) -> dict[int, Tensor]:
        """Sends some ranks a tensor each, and fills the tensors for what comes of others; returns these.

        Args:
            kind: What they are.
            parts: Contiguous, by rank.
            came: Of the sizes of what comes, by rank.
        """
        messages = [dist.P2POp(dist.irecv, tensor, rank) for rank, tensor in came.items()]
        messages += [dist.P2POp(dist.isend, tensor, rank) for rank, tensor in parts.items()]
        self.sent[kind] += sum(tensor.numel() * tensor.element_size() for tensor in parts.values())
        self.messages[kind] += len(parts)
        with self._waiting():  # gloo takes half as long for these as for its collectives
            for work in dist.batch_isend_irecv(messages) if messages else []:
                work.wait()
        return dict(came)

    def from_first(self, value: Any) -> Any:
        """What rank 0 has, for all."""
        box = [value]
        if self.size > 1:
            with self._waiting():
                dist.broadcast_object_list(box, src=0)
        return box[0]


def _let_gloo_wait() -> None:
    """Lets gloo's threads preempt no other, which takes a millisecond off each exchange where ranks share a core.

    A message wakes gloo's thread. Where that preempts the one that trains, while this has the lock of the connection,
    it spins until its time is over.
    """
    if not hasattr(os, "SCHED_BATCH"):
        return
    for thread in Path("/proc/self/task").iterdir():
        with contextlib.suppress(OSError):
            if "gloo" in (thread / "comm").read_text():
                os.sched_setscheduler(int(thread.name), os.SCHED_BATCH, os.sched_param(0))


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
