"""Tensors at the end of a memory page: a read or write behind the last element ends the process."""

from __future__ import annotations

import ctypes
import mmap
from typing import Any

import torch
from torch import Tensor

_INACCESSIBLE = 0  # PROT_NONE


def at_page_end(value: Any) -> Any:
    """Returns a copy of a contiguous tensor, whose last byte is the last of a page; the next page is inaccessible.

    Other values are returned unchanged.
    """
    if not isinstance(value, Tensor) or not value.is_contiguous() or value.is_neg() or value.device.type != "cpu":
        return value
    size = value.numel() * value.element_size()
    end = -(-size // mmap.PAGESIZE) * mmap.PAGESIZE
    memory = mmap.mmap(-1, end + mmap.PAGESIZE)
    whole = torch.frombuffer(memory, dtype=torch.uint8)
    if ctypes.CDLL(None).mprotect(ctypes.c_void_p(whole.data_ptr() + end), mmap.PAGESIZE, _INACCESSIBLE):
        raise OSError("mprotect failed")
    copy: Tensor = whole[end - size : end].view(value.dtype).view(value.shape)
    return copy.copy_(value.detach()).requires_grad_(value.requires_grad)
