"""Decorators for ``torch.compile`` that do not import the compiler.

The decorators of ``torch.compiler`` import torch's whole compiler, which takes as long as importing torch.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
R = TypeVar("R")


def constant_result(function: Callable[P, R]) -> Callable[P, R]:
    """Makes the result of a function a constant of the graph, like ``torch.compiler.assume_constant_result``."""
    function._dynamo_marked_constant = True  # type: ignore[attr-defined]  # torch's decorator does the same
    return function


def not_compiled(function: Callable[P, R], reason: str) -> Callable[P, R]:
    """Applies ``torch.compiler.disable`` at the first call, so that the compiler does not trace the function.

    Args:
        function: The function to exclude. Its first call imports torch's compiler.
        reason: The reason that the compiler's error states if graph breaks are forbidden.
    """

    @functools.wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        disabled = getattr(function, "_not_compiled", None)
        if disabled is None:
            disabled = torch.compiler.disable(function, reason=reason)
            function._not_compiled = disabled  # type: ignore[attr-defined]
        result: R = disabled(*args, **kwargs)
        return result

    run._torchdynamo_disable, run._torchdynamo_disable_msg = True, reason  # type: ignore[attr-defined]  # for dynamo
    return run
