"""Networks that lie in files, of which no more than a bound is in memory.

Before a part is asked, its networks are read whole, into memory of this process and past the system's cache; those that
were not used for longest make room before. So what is in memory is known, and never more than the bound.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import json
import mmap
import os
import re
import sys
from collections import OrderedDict
from collections.abc import Iterable
from math import prod
from pathlib import Path

import torch
from torch import Tensor

from voronerf.app.train.checkpoint import CheckpointError
from voronerf.app.train.config import ConfigError
from voronerf.router import VoronoiRouter

#: Share of the bound that is left for what comes and goes within a picture.
SPARE = 0.1
#: Bytes of a read; what the system caches of it, if it does, is dropped before the next.
_READ = 1 << 23
#: Bytes that are read of a file to begin with, most often its whole header.
_HEADER = 1 << 14
_UNITS = {"": 1, "k": 2**10, "m": 2**20, "g": 2**30}
_DTYPES = {"F32": torch.float32, "F64": torch.float64, "F16": torch.float16, "BF16": torch.bfloat16, "I32": torch.int32}


def bytes_of(text: str | int) -> int:
    """The bytes that "512M" or "2G" means.

    Raises:
        ConfigError: For anything else.
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([kmg]?)i?b?", str(text).strip().lower())
    if found is None or float(found[1]) == 0:
        raise ConfigError(f"--memory must be a size such as 512M or 2G, got {text!r:.40}")
    return int(float(found[1]) * _UNITS[found[2]])


def anonymous_bytes() -> int:
    """Memory of this process that no file has."""
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("RssAnon")) * 1024


class _File:
    """The networks of a safetensors file, in memory of their own that is there or not.

    Where it is not, their addresses lead to the file, so that whoever reads them unasked still finds what they hold.

    Attributes:
        tensors: Weights and averages of weights, by their names; others, such as Adam's moments, are left out.
        size: Bytes that are read, which `take` makes those of the tensors in use.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.number = _open(path)
        try:
            self.length = self.size = os.fstat(self.number).st_size
            self.ranges = [(0, self.length)]
            self.pages = mmap.mmap(-1, self.length, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
            self.start = ctypes.addressof(ctypes.c_char.from_buffer(self.pages))
            self._read(0, _HEADER)
            self._read(_HEADER, 8 + int.from_bytes(self.pages[:8], "little"))
            first = 8 + int.from_bytes(self.pages[:8], "little")
            header = json.loads(self.pages[8:first])
            header.pop("__metadata__", None)
            self.tensors: dict[str, Tensor] = {}
            for name, entry in header.items():
                if not (name.startswith("router.module.") or name.endswith(".average")):
                    continue
                dtype, (start, end) = _DTYPES[entry["dtype"]], entry["data_offsets"]
                count = prod(entry["shape"])
                if end - start != count * dtype.itemsize or first + end > self.length:
                    raise ValueError(f"{name} must have {count * dtype.itemsize} bytes")
                flat = torch.frombuffer(self.pages, dtype=dtype, count=count, offset=first + start) if count else None
                self.tensors[name] = (torch.empty(0, dtype=dtype) if flat is None else flat).reshape(entry["shape"])
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            os.close(self.number)
            raise CheckpointError(f"{path}: not a readable file of networks: {error}") from None
        self.drop()

    def take(self, tensors: Iterable[Tensor]) -> None:
        """Reads from now on only the pages of some of its tensors."""
        ends: list[tuple[int, int]] = []
        for first, size in sorted((tensor.data_ptr() - self.start, tensor.nbytes) for tensor in tensors):
            if size and 0 <= first < self.length:
                low = first // mmap.PAGESIZE * mmap.PAGESIZE
                high = -(-(first + size) // mmap.PAGESIZE) * mmap.PAGESIZE
                if ends and low <= ends[-1][1]:
                    low = ends.pop()[0]
                ends.append((low, min(high, self.length)))
        self.ranges, self.size = ends, sum(end - first for first, end in ends)

    def read(self) -> None:
        """Reads it.

        Raises:
            CheckpointError: When it cannot be read any more.
        """
        self._map(-1)
        try:
            for low, high in self.ranges:
                for first in range(low, high, _READ):
                    self._read(first, min(first + _READ, high))
        except OSError as error:
            raise CheckpointError(f"{self.path}: {error.strerror or error}") from None

    def _read(self, first: int, end: int) -> None:
        """Reads some of its bytes, or what there are of them."""
        end = min(end, self.length)
        whole = -(-end // mmap.PAGESIZE) * mmap.PAGESIZE  # a read past the cache takes no part of a block
        while first < end:
            room = (ctypes.c_char * (whole - first)).from_address(self.start + first)
            done = os.preadv(self.number, [room], first)
            os.posix_fadvise(self.number, first, done, os.POSIX_FADV_DONTNEED)
            if not done:
                raise OSError("it has become shorter")
            first += done

    def drop(self) -> None:
        """Gives its memory back."""
        self._map(self.number)
        os.posix_fadvise(self.number, 0, 0, os.POSIX_FADV_DONTNEED)

    def _map(self, number: int) -> None:
        """Puts new memory, or the file, at the addresses of the tensors."""
        rights, flags = mmap.PROT_READ | mmap.PROT_WRITE, mmap.MAP_PRIVATE | _MAP_FIXED
        flags |= mmap.MAP_ANONYMOUS if number < 0 else 0
        if _libc().mmap(self.start, self.length, rights, flags, number, 0) != self.start:
            raise MemoryError(f"no memory for {self.path}")


#: Of Linux on every processor that this runs on.
_MAP_FIXED = 0x10


@functools.cache
def _libc() -> ctypes.CDLL:
    libc = ctypes.CDLL(None, use_errno=True)
    number, size = ctypes.c_void_p, ctypes.c_size_t
    libc.mmap.argtypes = [number, size, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_long]
    libc.mmap.restype = ctypes.c_void_p
    return libc


def _open(path: Path) -> int:
    """Opens a file to read it past the system's cache, where its file system can."""
    with contextlib.suppress(OSError):
        return os.open(path, os.O_RDONLY | os.O_DIRECT)
    return os.open(path, os.O_RDONLY)


class Pages:
    """The files of the networks of a run, and a bound on the memory of the process.

    Args:
        folder: Of the files.
        memory: Bytes of anonymous memory of the process, networks included; next to none is in the system's cache.

    Attributes:
        reads: Files that were read.

    Raises:
        ConfigError: Where the system cannot tell what is in memory.
    """

    def __init__(self, folder: Path, memory: int) -> None:
        if sys.platform != "linux":
            raise ConfigError("--memory works on Linux alone")
        self.folder, self.memory = folder, memory
        self.files: dict[str, _File] = {}
        self.held: OrderedDict[str, _File] = OrderedDict()  # the file that was used last at the end
        self.reads = 0

    def tensors(self, name: str) -> dict[str, Tensor]:
        """The tensors of a file, none of which is read yet.

        Raises:
            CheckpointError: When it is missing or no file of networks.
        """
        if name not in self.files:
            try:
                self.files[name] = _File(self.folder / name)
            except OSError as error:
                raise CheckpointError(f"{self.folder / name}: {error.strerror}") from None
        return self.files[name].tensors

    def watch(self, name: str, router: VoronoiRouter) -> None:
        """Has what a router has of a file read before each call of it."""
        self.files[name].take([*router.parameters(), *router.buffers()])
        router.register_forward_pre_hook(lambda *_: self.use(name))

    def check(self) -> None:
        """Compares the bound with what is needed.

        Raises:
            ConfigError: When the process and the largest file do not fit into it.
        """
        needed = anonymous_bytes() + max((file.size for file in self.files.values()), default=0)
        if needed > self.memory * (1 - SPARE):
            least = needed / (1 - SPARE) / 2**20
            raise ConfigError(f"--memory must be at least {least:.0f}M for this run, got {self.memory / 2**20:.0f}M")

    def forget(self, path: Path) -> None:
        """Drops what the system has cached of a file that nobody has mapped any more."""
        with open(path, "rb") as file:
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)

    def use(self, name: str) -> None:
        """Reads a file, if it is not in memory, after others have made room."""
        if name in self.held:
            self.held.move_to_end(name)
            return
        file = self.files[name]
        while self.held and anonymous_bytes() + file.size > self.memory * (1 - SPARE):
            self.held.popitem(last=False)[1].drop()
        file.read()
        self.reads += 1
        self.held[name] = file
