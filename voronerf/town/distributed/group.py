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
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
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
        self._expected: dict[str, tuple[dict[int, Tensor], list[dist.Work] | None]] = {}
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

    def exchange(
        self, kind: str, width: int, parts: Mapping[int, Sequence[Tensor]], sources: Mapping[int, int]
    ) -> dict[int, list[Tensor]]:
        """Sends some ranks their parts, and gets those of others; how many rows these have need not be known.

        A message begins with the rows of each part, and has room for some more rows than the one of its kind before it
        to the same rank. What does not fit follows in another.

        Args:
            kind: What they are.
            width: c, the columns of all parts of a kind.
            parts: float32 [n, c] for each rank that gets some, at least one of them.
            sources: The ranks that send this one parts, and how many.

        Returns:
            The parts that came, by rank.
        """
        heads = {rank: -(-count // width) for rank, count in sources.items()}
        room = {rank: self._rooms.get((kind, "from", rank), 0) for rank in sources}
        empty = torch.empty(0, width, device=self.device)
        if kind not in self._expected:
            self.expect(kind, width, sources)
        expected, works = self._expected.pop(kind)
        messages, rests = {}, {}
        for rank, own in parts.items():
            message, end, total = _message(own, width, self._rooms.get((kind, "to", rank), 0))
            messages[rank] = message[:end]
            if len(message) > end:
                rests[rank] = message[end:]
            self._rooms[kind, "to", rank] = _room(total)
        came = self.swap(kind, messages, expected, works)
        sizes = {
            rank: message[: heads[rank]].view(-1).view(torch.int32)[: sources[rank]].tolist()
            for rank, message in came.items()
        }
        counts = {rank: sum(each) for rank, each in sizes.items()}
        more = {rank: empty.new_empty(n - room[rank], width) for rank, n in counts.items() if n > room[rank]}
        if rests or more:
            more = self.swap(kind, rests, more)
        found = {}
        for rank, message in came.items():
            rows = message[heads[rank] : heads[rank] + counts[rank]]
            rows = torch.cat((rows, more[rank])) if rank in more else rows
            found[rank] = [rows] if len(sizes[rank]) == 1 else list(rows.split(sizes[rank]))
            self._rooms[kind, "from", rank] = _room(counts[rank])
        return found

    def expect(self, kind: str, width: int, sources: Mapping[int, int]) -> None:
        """Asks for what the next :meth:`exchange` of a kind will bring, so that it comes while this rank computes.

        Args:
            kind: What the parts are.
            width: c, as there.
            sources: As there.
        """
        rows = {rank: -(-n // width) + self._rooms.get((kind, "from", rank), 0) for rank, n in sources.items()}
        came = {rank: torch.empty(count, width, device=self.device) for rank, count in rows.items()}
        self._expected[kind] = came, self._ask(kind, came)

    def _ask(self, kind: str, came: Mapping[int, Tensor]) -> list[dist.Work] | None:
        """Lets gloo fill tensors as soon as others send; nccl is asked together with what is sent."""
        if self.device.type == "cuda" or not came:
            return None
        with self._waiting():
            return [self._world.recv([tensor], rank, _tag(kind)) for rank, tensor in came.items()]

    @property
    def _world(self) -> dist.ProcessGroup:  # past the checks of torch.distributed, which take gloo as long again
        world = dist.group.WORLD
        assert world is not None
        return world

    def swap(
        self,
        kind: str,
        parts: Mapping[int, Tensor],
        came: Mapping[int, Tensor],
        asked: Sequence[dist.Work] | None = None,
    ) -> dict[int, Tensor]:
        """Sends some ranks a tensor each, and fills the tensors for what comes of others; returns these.

        Args:
            kind: What they are.
            parts: Contiguous, by rank.
            came: Of the sizes of what comes, by rank.
            asked: What :meth:`expect` has begun for these.
        """
        self.sent[kind] += sum(tensor.numel() * tensor.element_size() for tensor in parts.values())
        self.messages[kind] += len(parts)
        if not parts and not came:
            return {}
        with self._waiting():
            if self.device.type == "cuda":
                calls = [dist.P2POp(dist.irecv, tensor, rank) for rank, tensor in came.items()]
                calls += [dist.P2POp(dist.isend, tensor, rank) for rank, tensor in parts.items()]
                works = dist.batch_isend_irecv(calls)
            else:
                works = list(asked or self._ask(kind, came) or ())
                works += [self._world.send([tensor], rank, _tag(kind)) for rank, tensor in parts.items()]
            for work in works:
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


def _message(parts: Sequence[Tensor], width: int, room: int) -> tuple[Tensor, int, int]:
    """A message of the rows of each part, then these, then what is left of the room; where it ends, and all rows.

    What comes after that end had no room.
    """
    sizes = [len(part) for part in parts]
    rows, head = sum(sizes), -(-len(sizes) // width)
    header = torch.tensor(sizes + [0] * (head * width - len(sizes)), dtype=torch.int32).view(torch.float32)
    left = parts[0].new_empty(max(room - rows, 0), width)
    return torch.cat((header.view(head, width).to(left.device), *parts, left)), head + room, rows


def _tag(kind: str) -> int:
    """Keeps messages of several kinds apart that are asked for at once."""
    return zlib.crc32(kind.encode()) % 2**16


def _room(rows: int) -> int:
    """For so many rows in the next message."""
    return rows * 9 // 8 + 8


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
