"""``torch.utils.checkpoint`` inside of a routed module.

A checkpointed function runs a second time in the backward pass, after the routed call is over. It then has to find the
stand-ins for parameters, and be followed, as in the first run.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import Any

import torch.utils.checkpoint as torch_checkpoint
from torch import Tensor

_GENERATOR, _FUNCTION = "_checkpoint_without_reentrant_generator", "CheckpointFunction"


@contextlib.contextmanager
def rerun_in(
    enter: Callable[[], AbstractContextManager[Callable[[Tensor], Any]]], rows: Callable[[Tensor], bool]
) -> Iterator[None]:
    """While active, functions that are checkpointed are run again inside of ``enter()``.

    Args:
        enter: sets up what a second run needs, and gives the function that marks tensors of rows.
        rows: whether an argument of the first run is a tensor of rows.
    """
    active = True

    def again(function: Callable[..., Any], args: tuple[Any, ...]) -> Callable[..., Any]:
        marked = [isinstance(value, Tensor) and rows(value) for value in args]

        def run(*args: Any, **kwargs: Any) -> Any:
            if active:
                return function(*args, **kwargs)
            with enter() as mark:
                for value, is_marked in zip(args, marked, strict=True):
                    if is_marked:
                        mark(value)
                return function(*args, **kwargs)

        return run

    generator = getattr(torch_checkpoint, _GENERATOR)
    reentrant = getattr(torch_checkpoint, _FUNCTION)

    class Reentrant:
        @staticmethod
        def apply(function: Callable[..., Any], preserve: bool, *args: Any) -> Any:
            return reentrant.apply(again(function, args), preserve, *args)

    def without_reentrant(function: Callable[..., Any], *options: Any, **kwargs: Any) -> Any:
        # preserve_rng_state, context_fn, determinism_check, debug, early_stop, then the function's own arguments.
        return generator(again(function, options[5:]), *options, **kwargs)

    # checkpoint() itself may have been imported by name; what it looks up at each call can be replaced.
    setattr(torch_checkpoint, _GENERATOR, without_reentrant)
    setattr(torch_checkpoint, _FUNCTION, Reentrant)
    try:
        yield
    finally:
        setattr(torch_checkpoint, _GENERATOR, generator)
        setattr(torch_checkpoint, _FUNCTION, reentrant)
        active = False
