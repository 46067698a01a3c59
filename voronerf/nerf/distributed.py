"""Data-parallel training by `torch.distributed`: several processes hold the same networks and average their gradients.

Each process (rank) draws its own rays. Ranks exchange gradients and the loss in each step, the occupancy grid after
each `GROUP` of steps, and kept samples before a split. All other decisions follow from the exchanged values, from
values of rank 0, and from a random generator that is equal on all ranks. So the networks of all ranks stay equal to the
bit, if their processors are of the same model.
"""

from __future__ import annotations

import atexit
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

T = TypeVar("T")
#: Tensors with fewer elements are copied into one message; larger contiguous tensors are sent without a copy.
SMALL = 1 << 15
#: Difference between the seeds of the rays of two ranks.
STRIDE = 1_000_003


class PeerLost(RuntimeError):
    """Another process of a data-parallel training has ended, so this process cannot continue."""


@dataclass(frozen=True)
class Ranks:
    """The processes of a data-parallel training; for a single process, no method changes its input.

    Attributes:
        rank: The number of this process, 0..size - 1.
        size: The number of processes.

    Examples:
        >>> from voronerf.nerf import Ranks
        >>> ranks = Ranks.join()  # one of several processes if torchrun has started this program
        >>> ranks.rank, ranks.size, ranks.first("a decision")
        (0, 1, 'a decision')
    """

    rank: int = 0
    size: int = 1

    @classmethod
    def join(cls, device: torch.device | str = "cpu") -> Ranks:
        """Joins the processes that ``torchrun`` has started; without ``torchrun``, the process stays alone.

        Args:
            device: The device of the networks. On GPUs, this process uses the GPU with the number ``LOCAL_RANK``.

        Raises:
            ValueError: There are fewer GPUs than processes.
            PeerLost: Another process has ended.
        """
        if int(os.environ.get("WORLD_SIZE", "1")) < 2:
            return cls()
        if not dist.is_initialized():
            on_gpu = torch.device(device).type == "cuda"
            if on_gpu:
                local, count = int(os.environ.get("LOCAL_RANK", "0")), torch.cuda.device_count()
                if local >= count:
                    raise ValueError(f"Ranks.join: every process needs a GPU; LOCAL_RANK is {local}, of {count} GPUs")
                torch.cuda.set_device(local)
            with _peers():
                store, rank, size = next(dist.rendezvous("env://"))
                # After a restart, torchrun's store still has the addresses of the processes that have ended.
                store = dist.PrefixStore(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"), store)
                backend = "nccl" if on_gpu else "gloo"
                dist.init_process_group(backend, store=store, rank=rank, world_size=size)
            atexit.register(_leave)
        return cls(dist.get_rank(), dist.get_world_size())

    def seed(self, seed: Tensor) -> Tensor:
        """Returns the seed of this rank's rays, from a seed that all ranks have drawn."""
        return seed + STRIDE * self.rank if self.rank else seed

    @torch.no_grad()
    def average(self, tensors: Iterable[Tensor]) -> None:
        """Replaces tensors by their means over the ranks, in place; all ranks get the same bits."""
        if self.size == 1:
            return
        tensors = list(tensors)
        large = [each for each in tensors if each.numel() >= SMALL and each.is_contiguous()]
        small = [each for each in tensors if each.numel() < SMALL or not each.is_contiguous()]
        message = torch.cat([each.reshape(-1) for each in small]) if small else tensors[0].new_empty(0)
        with _peers():
            works = [dist.all_reduce(each, async_op=True) for each in (message, *large)]
            for work, each in zip(works, (message, *large), strict=True):
                work.wait()
                each /= self.size
        for each, mean in zip(small, message.split([each.numel() for each in small]), strict=True):
            each.copy_(mean.view_as(each))

    def maximum(self, tensor: Tensor) -> None:
        """Replaces a tensor by the elementwise maximum over the ranks, in place."""
        if self.size > 1:
            with _peers():
                dist.all_reduce(tensor, dist.ReduceOp.MAX)

    def gather(self, rows: Tensor) -> Tensor:
        """Returns the rows of all ranks, in the order of the ranks; their numbers may differ."""
        if self.size == 1:
            return rows
        parts: list[Any] = [None] * self.size
        with _peers():
            dist.all_gather_object(parts, rows.cpu())
        return torch.cat(parts).to(rows.device)

    def first(self, held: T) -> T:
        """Returns the object of rank 0; all ranks call it."""
        parts = [held]
        if self.size > 1:
            with _peers():
                dist.broadcast_object_list(parts, src=0)
        return parts[0]


#: A process on its own.
ALONE = Ranks()


def _leave() -> None:
    """Ends the process group's threads before Python exits, since a later free of a tensor would abort the process."""
    if dist.is_initialized():
        dist.destroy_process_group()


@contextmanager
def _peers() -> Iterator[None]:
    """Turns the errors of gloo and NCCL into `PeerLost`."""
    try:
        yield
    except RuntimeError as error:
        reason = str(error).partition("\n")[0]
        raise PeerLost(f"another process of this training has ended or does not answer: {reason}") from error
