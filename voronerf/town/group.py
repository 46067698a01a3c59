"""The processes that train one run together: rendezvous, communication, and reports of errors.

torchrun starts the ranks and sets their environment variables. The ranks communicate by ``torch.distributed``: gloo on
CPUs, nccl on GPUs.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
import signal
import time
import zlib
from collections.abc import Iterator, Mapping, Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from voronerf.app.scenes import Scene

#: Timeout in seconds, after which a rank that does not answer counts as lost.
PATIENCE = 50
#: Settings that may differ between ranks.
MAY_DIFFER = ("data", "device", "lpips")
#: The sending and the receiving territory of a message; for a message sent ``back`` (`Group.send`), in reverse order.
Key = tuple[int, int]


class RankLost(ConnectionError):
    """An error because another rank has ended or does not answer."""


def world_size() -> int:
    """Returns the number of ranks that torchrun has started; 1 without torchrun."""
    return int(os.environ.get("WORLD_SIZE", "1"))


def local_rank() -> int:
    """Returns the number of this process on its machine, from 0; it is also the number of its GPU."""
    return int(os.environ.get("LOCAL_RANK", "0"))


def restarts() -> int:
    """Returns the number of times that torchrun has restarted the ranks after failures."""
    return int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"))


class Group:
    """All ranks of a training. A group of one is a single process without communication.

    Attributes:
        rank: The number of this rank.
        size: The number of ranks.
        device: The device of the tensors that are sent.
        store: torchrun's key-value store, which all ranks share; None in a group of one.
    """

    def __init__(self, device: torch.device, rank: int = 0, size: int = 1, store: dist.Store | None = None) -> None:
        self.rank, self.size, self.device, self.store = rank, size, device, store

    @classmethod
    def join(cls, device: torch.device) -> Group:
        """Joins the rendezvous of torchrun; `meet` then connects the ranks."""
        if world_size() == 1:
            return cls(device)
        with waiting():
            store, rank, size = next(iter(dist.rendezvous("env://", timeout=timedelta(seconds=PATIENCE))))
        # torchrun's store survives restarts. The prefix hides the addresses of ranks that were killed.
        return cls(device, rank, size, dist.PrefixStore(f"voronerf/{restarts()}", store))

    def meet(self) -> None:
        """Connects to the other ranks; all ranks call it together."""
        if self.size == 1:
            return
        if self.device.type == "cuda":
            torch.cuda.set_device(self.device)  # `dist.all_gather_object` uses the current device
        backend, timeout = "nccl" if self.device.type == "cuda" else "gloo", timedelta(seconds=PATIENCE)
        with waiting():
            dist.init_process_group(backend, None, timeout, store=self.store, rank=self.rank, world_size=self.size)

    def leave(self) -> None:
        """Disconnects from the other ranks; all ranks call it together."""
        if self.size > 1:
            self.total(torch.zeros(1))  # a barrier
            dist.destroy_process_group()

    def total(self, values: Tensor) -> Tensor:
        """Returns the sum of the tensors of all ranks, on the CPU."""
        return self._reduce(values, dist.ReduceOp.SUM)

    def any(self, value: bool) -> bool:
        """Returns whether a value is true on any rank."""
        return bool(self._reduce(torch.tensor(float(value)), dist.ReduceOp.MAX))

    def _reduce(self, values: Tensor, kind: Any) -> Tensor:
        if self.size == 1:
            return values.cpu()
        values = values.to(self.device, copy=True)
        with waiting():
            dist.all_reduce(values, kind)
        return values.cpu()

    def gather(self, value: Any) -> list[Any]:
        """Returns the values of all ranks, by rank."""
        values: list[Any] = [value] * self.size
        if self.size > 1:
            with waiting():
                dist.all_gather_object(values, value)
        return values

    def send(
        self, parts: Mapping[Key, Tensor], counts: Tensor, owner: Sequence[int], width: int, *, back: bool = False
    ) -> dict[Key, Tensor]:
        """Sends messages between territories; all ranks call it together.

        Args:
            parts: The messages that territories of this rank send, by key, float32 [counts[key], width].
            counts: int64 [T, T], the number of rows of each message, the same on all ranks; 0 for no message.
            owner: The rank of each territory.
            width: Number of columns of a message.
            back: Whether the messages are sent back, from the second territory of a key to the first.

        Returns:
            The messages that territories of this rank receive, by key; keys ascend.
        """
        ends = {(n, m): (owner[m], owner[n]) if back else (owner[n], owner[m]) for n, m in counts.nonzero().tolist()}
        sent, received = (
            [[key for key in ends if ends[key] == pair] for pair in pairs]
            for pairs in (
                [(self.rank, other) for other in range(self.size)],
                [(other, self.rank) for other in range(self.size)],
            )
        )
        outgoing = torch.cat(
            [torch.empty(0, width, device=self.device), *(parts[key] for keys_of_rank in sent for key in keys_of_rank)]
        )
        incoming = outgoing
        if self.size > 1:
            incoming_rows, outgoing_rows = (
                [sum(int(counts[key]) for key in keys_of_rank) for keys_of_rank in keys] for keys in (received, sent)
            )
            incoming = outgoing.new_empty(sum(incoming_rows), width)
            with waiting():
                dist.all_to_all_single(incoming, outgoing, incoming_rows, outgoing_rows)
        keys = [key for keys_of_rank in received for key in keys_of_rank]
        return dict(sorted(zip(keys, incoming.split([int(counts[key]) for key in keys]), strict=True)))

    def check_equal(self, texts: dict[str, str]) -> None:
        """Raises ValueError unless ``texts``, by name, are the same on all ranks."""
        first, *others = self.gather(texts)
        for name, value in first.items():
            for rank, other in enumerate(others, 1):
                if other[name] != value:
                    raise ValueError(
                        f"{name} must be the same on all ranks, got {value} on 0 and {other[name]} on {rank}"
                    )

    def check_same(self, config: Any, territories: int) -> None:
        """Raises ValueError unless all ranks have the same settings (`config`, a dataclass) and the same code."""
        root, code = Path(__file__).resolve().parents[1], 0
        for path in sorted(root.rglob("*.py")):
            code = zlib.crc32(path.read_bytes(), code)
        names = [field.name for field in dataclasses.fields(config) if field.name not in MAY_DIFFER]
        settings = {f"--{name.replace('_', '-')}": repr(getattr(config, name)) for name in names}
        versions = {"the code of voronerf": f"{code:08x}", "the version of torch": torch.__version__}
        self.check_equal({**versions, "--territories": str(territories), **settings})

    def check_same_scene(self, scene: Scene) -> None:
        """Raises ValueError unless cameras and the middle row of every image are the same on all ranks.

        Whole images are not compared, since they may not fit into memory.
        """
        views = scene.train
        rows = views.images[:, views.images.shape[1] // 2]
        tensors = (rows, views.cameras.poses, views.cameras.intrinsics, scene.test.cameras.poses)
        checksums = [zlib.crc32(tensor.contiguous().cpu().numpy().data) for tensor in tensors]
        self.check_equal({"the scene": f"{scene.name} {'-'.join(f'{number:08x}' for number in checksums)}"})

    def may_tell(self, error: Exception) -> bool:
        """Returns whether this process reports an error: True for the first failing rank only.

        A rank with a `RankLost` waits a second, so that the lost rank can report the reason.
        """
        if isinstance(error, RankLost):
            signal.signal(signal.SIGTERM, signal.SIG_IGN)  # torchrun sends it to the remaining ranks
            time.sleep(1)
        try:
            return self.store is None or bool(self.store.add("voronerf/told", 1) == 1)
        except RuntimeError:  # the process with the store has ended
            return True


@contextlib.contextmanager
def waiting() -> Iterator[None]:
    """Converts errors of torch.distributed into `RankLost` within the context."""
    try:
        yield
    except RuntimeError as error:  # DistError, and errors of gloo
        reason = re.sub(r"^\[\S+\] *", "", str(error)).splitlines()[0].split(". ")[0]
        raise RankLost(f"another rank has ended, or has not answered for {PATIENCE} s ({reason})") from None
