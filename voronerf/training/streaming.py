"""Networks as pages of files, of which no more than a bound stays in memory.

A page is read when a sample meets it. When a part was asked, but not all the time, what the process has for itself and
what the files have in memory is counted, and the pages of the networks that were not used for longest are dropped.
"""

from __future__ import annotations

import ctypes
import json
import mmap
import os
import re
import sys
import time
from collections import OrderedDict
from math import prod
from pathlib import Path

import torch
from torch import Tensor

from voronerf.router import Part, VoronoiRouter
from voronerf.training.checkpoint import CheckpointError
from voronerf.training.config import ConfigError

#: Share of the bound that is left for what comes and goes within a picture.
SPARE = 0.15
#: Seconds between two counts of what is in memory.
EVERY = 0.02
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
    """The tensors of a safetensors file, mapped."""

    def __init__(self, path: Path) -> None:
        self.number = os.open(path, os.O_RDONLY)
        try:
            self.size = os.fstat(self.number).st_size
            self.pages = mmap.mmap(self.number, 0, flags=mmap.MAP_PRIVATE, prot=mmap.PROT_READ | mmap.PROT_WRITE)
            first = 8 + int.from_bytes(self.pages[:8], "little")
            header = json.loads(self.pages[8:first])
            header.pop("__metadata__", None)
            self.tensors: dict[str, Tensor] = {}
            for name, entry in header.items():
                dtype, (start, end) = _DTYPES[entry["dtype"]], entry["data_offsets"]
                count = prod(entry["shape"])
                if end - start != count * dtype.itemsize or first + end > self.size:
                    raise ValueError(f"{name} must have {count * dtype.itemsize} bytes")
                flat = torch.frombuffer(self.pages, dtype=dtype, count=count, offset=first + start) if count else None
                self.tensors[name] = (torch.empty(0, dtype=dtype) if flat is None else flat).reshape(entry["shape"])
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            os.close(self.number)
            raise CheckpointError(f"{path}: not a readable file of networks: {error}") from None
        self.start = ctypes.addressof(ctypes.c_char.from_buffer(self.pages))
        self.states = (ctypes.c_ubyte * -(-self.size // mmap.PAGESIZE))()

    def resident(self, libc: ctypes.CDLL) -> int:
        """Bytes of it that are in memory."""
        if libc.mincore(ctypes.c_void_p(self.start), ctypes.c_size_t(self.size), self.states) != 0:
            return self.size
        return bytes(self.states).count(1) * mmap.PAGESIZE

    def drop(self) -> None:
        """Gives its memory back; it is read again when it is needed."""
        self.pages.madvise(mmap.MADV_DONTNEED)
        os.posix_fadvise(self.number, 0, 0, os.POSIX_FADV_DONTNEED)


class Pages:
    """The files of the networks of a run, and a bound on what they and the process take of memory.

    Args:
        folder: Of the files.
        memory: Bytes: anonymous memory of the process and pages of the files together.

    Raises:
        ConfigError: Where the system cannot tell what is in memory, or the bound is less than a process needs.
    """

    def __init__(self, folder: Path, memory: int) -> None:
        if sys.platform != "linux":
            raise ConfigError("--memory works on Linux alone")
        self.folder, self.memory = folder, memory
        self.files: dict[str, _File] = {}
        self.of: dict[int, str] = {}
        self.touched: set[str] = set()  # since memory was counted last
        self.counted = 0.0
        self.recent: OrderedDict[str, int] = OrderedDict()  # bytes in memory, the file that was used last at the end
        self.libc = ctypes.CDLL(None, use_errno=True)

    def read(self, name: str) -> dict[str, Tensor]:
        """The tensors of a file, none of which is read yet.

        Raises:
            CheckpointError: When it is missing or no file of networks.
        """
        if name not in self.files:
            try:
                self.files[name] = _File(self.folder / name)
            except OSError as error:
                raise CheckpointError(f"{self.folder / name}: {error.strerror}") from None
            self.files[name].drop()
        return self.files[name].tensors

    def watch(self, name: str, router: VoronoiRouter) -> None:
        """Remembers that a router has the tensors of a file."""
        self.of[id(router)] = name

    def check(self) -> None:
        """Compares the bound with what is needed.

        Raises:
            ConfigError: When the process and the largest file do not fit into it.
        """
        needed = anonymous_bytes() + max((file.size for file in self.files.values()), default=0)
        if needed > self.memory * (1 - SPARE):
            least = needed / (1 - SPARE) / 2**20
            raise ConfigError(f"--memory must be at least {least:.0f}M for this run, got {self.memory / 2**20:.0f}M")

    def used(self, part: Part) -> None:
        """Counts what the routers of a part that was just asked have read, and drops what is too much."""
        for router in part:
            name = self.of[id(router)]
            self.recent.setdefault(name, 0)
            self.recent.move_to_end(name)
            self.touched.add(name)
        if time.monotonic() - self.counted < EVERY:
            return
        for name in self.touched & self.recent.keys():
            self.recent[name] = self.files[name].resident(self.libc)
        self.touched.clear()
        self.counted = time.monotonic()
        room = self.memory * (1 - SPARE) - anonymous_bytes()
        while sum(self.recent.values()) > room and len(self.recent) > 1:
            oldest, _ = self.recent.popitem(last=False)
            self.files[oldest].drop()
