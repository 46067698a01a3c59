"""Memory of large results on CPUs: huge pages, and reuse of the blocks of freed results.

The C library returns large freed blocks to the system, so each step would wait for the same page faults again. Its
thresholds affect the whole process, so this module does not change them and caches blocks itself.
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
"""The smallest size of a result on huge pages, in bytes; for smaller results the allocator usually reuses memory."""
_MAX_UNUSED = 1 << 29  # the largest size of all unused blocks, in bytes
_unused: list[mmap.mmap] = []


def on_huge_pages(result: Tensor) -> Tensor:
    """Moves a large new result into the memory of a freed result, or onto huge pages. A no-op outside Linux.

    Args:
        result: An allocated tensor that has not been written yet.

    Returns:
        The same tensor.
    """
    size = result.nbytes
    if size < LARGE or result.device.type != "cpu" or active.recording is not None or sys.platform != "linux":
        return result
    for block in _unused.copy():
        if size <= len(block) <= size + size // 4:
            with suppress(ValueError):  # another thread has taken the block
                _unused.remove(block)
                break
    else:
        block = mmap.mmap(-1, size, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        with suppress(OSError):  # the system has no huge pages
            block.madvise(mmap.MADV_HUGEPAGE)
    buffer = (ctypes.c_char * size).from_buffer(block)  # lives as long as any tensor in this memory
    weakref.finalize(buffer, _recycle, block).atexit = False
    memory = torch.frombuffer(buffer, dtype=result.dtype).untyped_storage()
    result.set_(memory, 0, result.shape, result.stride())
    return result


def _recycle(block: mmap.mmap) -> None:
    _unused.append(block)
    while sum(map(len, _unused)) > _MAX_UNUSED:
        _unused.pop(0)
