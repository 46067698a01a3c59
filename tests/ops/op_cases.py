"""What the tests of the operations share."""

from __future__ import annotations

import re
from contextlib import contextmanager

import pytest
import torch

from voronerf.ops._core import backends

FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
HALVES = (torch.float16, torch.bfloat16)
COUNTS = {
    "none": [0, 0, 0],
    "one": [0, 1, 0],
    "odd": [3, 0, 7, 1, 0, 13, 0],
    "unequal": [1, 0, 9001, 2],
    "single cell": [33],
}
"""Samples of each cell: no samples, one, odd numbers with empty cells, more than two pieces, a plain network."""


def need(op, backend, device, dtype):
    """Skips, with the reason, where a backend does not take a device or dtype."""
    reason = backends.why_not(op, backend, device, dtype)
    if reason is not None:
        pytest.skip(reason)


def offsets_of(counts, device="cpu"):
    """Cell offsets from the number of samples of each cell."""
    return torch.tensor([0, *counts]).cumsum(0).to(torch.int32).to(device)


def strided(tensor):
    """The same values with no two of them next to each other in memory."""
    wide = tensor.new_full((*tensor.shape[:-1], 2 * tensor.shape[-1]), torch.nan if tensor.is_floating_point() else -7)
    wide[..., ::2] = tensor
    return wide[..., ::2]


@contextmanager
def refused(kind, message):
    """Passes if the block raises just this message; "..." stands for anything."""
    with pytest.raises(kind) as caught:
        yield
    begin, _, end = message.partition("...")
    assert type(caught.value) is kind
    found = str(caught.value)
    assert found == message or ("..." in message and found.startswith(begin) and found.endswith(end)), found


def refusals(call, name=None, /, **good):
    """Checks that an op takes the arguments ``good``, and what it says, after its name, where some of them are changed.

    The error is a TypeError where the message speaks of a type, and else a ValueError.
    """
    call(**good)

    def refuses(message, **changed):
        of_types = re.search("dtype|must be an integer|must be a tensor", message)
        with refused(TypeError if of_types else ValueError, f"{name or call.__name__}: {message}"):
            call(**{**good, **changed})

    return refuses
