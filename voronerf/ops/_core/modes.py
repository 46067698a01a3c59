"""Runs functions within dispatch modes of torch."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch
from torch.utils import _python_dispatch
from torch.utils._python_dispatch import TorchDispatchMode

T = TypeVar("T")
_set_flag = getattr(_python_dispatch, "set_is_in_mode_without_ignore_compile_internals", None)  # newer torch


def run_within(mode: TorchDispatchMode, function: Callable[[], T]) -> T:
    """Runs a function within a mode, and ends the mode even if Ctrl-C interrupts the exit from torch's context.

    A mode that did not end would see all further calls of the thread, and torch's compiler would skip all functions.
    The flags of modes are restored, since modes in several threads at once may leave them set, with the same effect.
    """
    modes = torch._C._len_torch_dispatch_stack()
    # Modes belong to a thread, but their flags to the process: another thread may have set them.
    flags = {name: modes > 0 and value for name, value in vars(_python_dispatch).items() if name.startswith("_is_in_")}
    try:
        with mode:
            return function()
    finally:
        while torch._C._len_torch_dispatch_stack() > modes:
            torch._C._pop_torch_dispatch_stack(None)
        vars(_python_dispatch).update(flags)
        if _set_flag is not None:
            _set_flag(flags["_is_in_any_mode_without_ignore_compile_internals"])
