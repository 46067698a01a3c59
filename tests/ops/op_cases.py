"""Helpers that the tests of the operations share."""

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
"""The numbers of samples in the cells, by name; "unequal" has a cell with more rows than two tasks of a kernel."""


def need(op, backend, device, dtype):
    """Skips the test, with the reason, if the backend does not support the device or dtype."""
    reason = backends.why_not(op, backend, device, dtype)
    if reason is not None:
        pytest.skip(reason)


def compared(op):
    """Returns a parametrization over the backends and devices of an op, without the reference on the CPU."""
    backs = [(backend, device) for device in ("cpu", "cuda") for backend in backends.implemented(op)]
    runs = [run for run in backs if run != ("reference", "cpu") and op in backends.ops(*run)]
    return pytest.mark.parametrize(("backend", "device"), runs, indirect=["device"], ids=map("-".join, runs))


def offsets_of(counts, device="cpu"):
    """Returns the cell offsets for the numbers of samples in the cells."""
    return torch.tensor([0, *counts]).cumsum(0).to(torch.int32).to(device)


def strided(tensor):
    """Returns a tensor with the same values, of which no two are adjacent in memory."""
    wide = tensor.new_full((*tensor.shape[:-1], 2 * tensor.shape[-1]), torch.nan if tensor.is_floating_point() else -7)
    wide[..., ::2] = tensor
    return wide[..., ::2]


@contextmanager
def refused(kind, message):
    """Passes if the block raises this exception with exactly this message; "..." stands for any text."""
    with pytest.raises(kind) as caught:
        yield
    begin, _, end = message.partition("...")
    assert type(caught.value) is kind
    text = str(caught.value)
    assert text == message or ("..." in message and text.startswith(begin) and text.endswith(end)), text


def refusals(call, name=None, /, **good):
    """Calls an op with the valid arguments ``good``; returns a function that checks the error for changed arguments.

    The error begins with the op's name; it must be a TypeError if the message mentions a type, else a ValueError.
    """
    call(**good)

    def refuses(message, **changed):
        of_types = re.search("dtype|must be an integer|must be a tensor", message)
        with refused(TypeError if of_types else ValueError, f"{name or call.__name__}: {message}"):
            call(**{**good, **changed})

    return refuses
