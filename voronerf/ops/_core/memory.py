"""Memory of large results on CPUs: huge pages, and that of earlier results that are gone.

The C library gives large blocks back to the system when they are freed, so each step would wait for the same pages
again. Its limits are those of the whole process and stay as they are: blocks that are kept here are our own.
"""

from __future__ import annotations

import ctypes
import mmap
import sys
import weakref
from contextlib import suppress

import torch
from torch import Tensor

from voronerf.ops._core.active import active

LARGE = 1 << 22
"""Bytes of a result that is put on huge pages; for smaller ones the allocator usually has warm memory."""
_KEPT = 1 << 29  # bytes of blocks that no result uses
_unused: list[mmap.mmap] = []


def on_huge_pages(result: Tensor) -> Tensor:
    """Gives a new result, where it is large, the memory of an earlier one, or huge pages, on Linux.

    Args:
        result: What was allocated and not written yet.

    Returns:
        The same tensor.
    """
    size = result.nbytes
    if size < LARGE or result.device.type != "cpu" or active.recording is not None or sys.platform != "linux":
        return result
    for block in _unused.copy():
        if size <= len(block) <= size + size // 4:
            with suppress(ValueError):  # another thread has taken it
                _unused.remove(block)
                break
    else:
        block = mmap.mmap(-1, size, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        with suppress(OSError):  # a kernel without huge pages
            block.madvise(mmap.MADV_HUGEPAGE)
    held = (ctypes.c_char * size).from_buffer(block)  # which lives as long as a tensor of this memory
    weakref.finalize(held, _keep, block).atexit = False
    memory = torch.frombuffer(held, dtype=result.dtype).untyped_storage()
    result.set_(memory, 0, result.shape, result.stride())
    return result


def _keep(block: mmap.mmap) -> None:
    _unused.append(block)
    while sum(map(len, _unused)) > _KEPT:
        _unused.pop(0)
