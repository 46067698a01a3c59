"""The processes that train one run together: how they meet, what they send each other, and who says what is wrong.

torchrun starts the ranks and says in the environment who they are. They meet over ``torch.distributed``: gloo on CPUs,
nccl on GPUs.
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

#: Seconds after which a rank that does not answer is given up.
PATIENCE = 50
#: Settings that machines may name in their own ways.
OWN = ("data", "device", "lpips")
#: Of a part of a message: the territory that it is from, and the one that it is for.
Key = tuple[int, int]


class RankLost(ConnectionError):
    """Another rank has ended, or does not answer."""


def world_size() -> int:
    """The ranks that torchrun has started; 1 without it."""
    return int(os.environ.get("WORLD_SIZE", "1"))


def local_rank() -> int:
    """The number of this process among those of its machine, from 0, which is that of its GPU."""
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
        store: What torchrun keeps for all ranks; None in a group of one.
    """

    def __init__(self, device: torch.device, rank: int = 0, size: int = 1, store: dist.Store | None = None) -> None:
        self.rank, self.size, self.device, self.store = rank, size, device, store

    @classmethod
    def join(cls, device: torch.device) -> Group:
        """Finds the store of the ranks that torchrun has started, which `meet` each other."""
        if world_size() == 1:
            return cls(device)
        with waiting():
            store, rank, size = next(iter(dist.rendezvous("env://", timeout=timedelta(seconds=PATIENCE))))
        # torchrun keeps one store for all starts: a rank would find the addresses of those that were killed.
        return cls(device, rank, size, dist.PrefixStore(f"voronerf/{restarts()}", store))

    def meet(self) -> None:
        """Meets the other ranks."""
        if self.size == 1:
            return
        if self.device.type == "cuda":
            torch.cuda.set_device(self.device)  # where torch puts what it sends of Python objects
        backend, timeout = "nccl" if self.device.type == "cuda" else "gloo", timedelta(seconds=PATIENCE)
        with waiting():
            dist.init_process_group(backend, None, timeout, store=self.store, rank=self.rank, world_size=self.size)

    def leave(self) -> None:
        """Leaves together with the others."""
        if self.size > 1:
            self.total(torch.zeros(1))  # all have come as far
            dist.destroy_process_group()

    def total(self, values: Tensor) -> Tensor:
        """The sum of the tensors of all ranks, on the CPU."""
        return self._reduce(values, dist.ReduceOp.SUM)

    def any(self, value: bool) -> bool:
        """Whether a value is true on any rank."""
        return bool(self._reduce(torch.tensor(float(value)), dist.ReduceOp.MAX))

    def _reduce(self, values: Tensor, kind: Any) -> Tensor:
        if self.size == 1:
            return values.cpu()
        values = values.to(self.device, copy=True)
        with waiting():
            dist.all_reduce(values, kind)
        return values.cpu()

    def gather(self, value: Any) -> list[Any]:
        """The values of all ranks, by rank."""
        found: list[Any] = [value] * self.size
        if self.size > 1:
            with waiting():
                dist.all_gather_object(found, value)
        return found

    def send(
        self, parts: Mapping[Key, Tensor], counts: Tensor, owner: Sequence[int], width: int, *, back: bool = False
    ) -> dict[Key, Tensor]:
        """Sends parts from territories to others.

        Args:
            parts: float32 [counts[key], width] of the territories of this rank.
            counts: int64 [T, T], the rows of all parts, the same on all ranks; there is no part without rows.
            owner: The rank of each territory.
            width: Columns of a part.
            back: Answers: the parts go from the second territory of a key to the first.

        Returns:
            The parts for territories of this rank, by key in ascending order.
        """
        ends = {(n, m): (owner[m], owner[n]) if back else (owner[n], owner[m]) for n, m in counts.nonzero().tolist()}
        sent, came = (
            [[key for key in ends if ends[key] == pair] for pair in pairs]
            for pairs in (
                [(self.rank, other) for other in range(self.size)],
                [(other, self.rank) for other in range(self.size)],
            )
        )
        out = torch.cat([torch.empty(0, width, device=self.device), *(parts[key] for each in sent for key in each)])
        found = out
        if self.size > 1:
            coming, going = ([sum(int(counts[key]) for key in each) for each in keys] for keys in (came, sent))
            found = out.new_empty(sum(coming), width)
            with waiting():
                dist.all_to_all_single(found, out, coming, going)
        keys = [key for each in came for key in each]
        return dict(sorted(zip(keys, found.split([int(counts[key]) for key in keys]), strict=True)))

    def check_equal(self, what: dict[str, str]) -> None:
        """Compares texts of all ranks, each rank naming them alike."""
        first, *others = self.gather(what)
        for name, value in first.items():
            for rank, other in enumerate(others, 1):
                if other[name] != value:
                    raise ValueError(
                        f"{name} must be the same on all ranks, got {value} on 0 and {other[name]} on {rank}"
                    )

    def check_same(self, config: Any, territories: int) -> None:
        """Compares the settings, a dataclass, and the code of all ranks."""
        root, code = Path(__file__).resolve().parents[1], 0
        for path in sorted(root.rglob("*.py")):
            code = zlib.crc32(path.read_bytes(), code)
        names = [field.name for field in dataclasses.fields(config) if field.name not in OWN]
        settings = {f"--{name.replace('_', '-')}": repr(getattr(config, name)) for name in names}
        made = {"the code of voronerf": f"{code:08x}", "the version of torch": torch.__version__}
        self.check_equal({**made, "--territories": str(territories), **settings})

    def check_same_scene(self, scene: Scene) -> None:
        """Compares cameras and the middle row of every image on all ranks; images may not fit into memory."""
        views = scene.train
        rows = views.images[:, views.images.shape[1] // 2]
        tensors = (rows, views.cameras.poses, views.cameras.intrinsics, scene.test.cameras.poses)
        found = [zlib.crc32(tensor.contiguous().cpu().numpy().data) for tensor in tensors]
        self.check_equal({"the scene": f"{scene.name} {'-'.join(f'{number:08x}' for number in found)}"})

    def may_tell(self, error: Exception) -> bool:
        """Whether this process is to say what is wrong: of many ranks that meet an error, the first.

        One that only knows that another has ended leaves that one a second to say why.
        """
        if isinstance(error, RankLost):
            signal.signal(signal.SIGTERM, signal.SIG_IGN)  # of torchrun, which ends the ranks that are left
            time.sleep(1)
        try:
            return self.store is None or bool(self.store.add("voronerf/told", 1) == 1)
        except RuntimeError:  # the process that kept the store is gone
            return True


@contextlib.contextmanager
def waiting() -> Iterator[None]:
    """A context in which what torch.distributed raises is a `RankLost`."""
    try:
        yield
    except RuntimeError as error:  # DistError and what gloo throws
        reason = re.sub(r"^\[\S+\] *", "", str(error)).splitlines()[0].split(". ")[0]
        raise RankLost(f"another rank has ended, or has not answered for {PATIENCE} s ({reason})") from None
