"""Marks for ``torch.compile`` that do not import it.

The decorators of ``torch.compiler`` import the whole compiler of torch, which takes as long as importing torch.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
R = TypeVar("R")


def constant_result(function: Callable[P, R]) -> Callable[P, R]:
    """``torch.compiler.assume_constant_result``: the compiler runs the function while tracing and keeps its result."""
    function._dynamo_marked_constant = True  # type: ignore[attr-defined]  # all that torch's own decorator does
    return function


def not_compiled(function: Callable[P, R], reason: str) -> Callable[P, R]:
    """``torch.compiler.disable``, applied at the first call: the compiler runs the function as it is.

    Args:
        function: Any that is called in this way only where torch's compiler has been imported.
        reason: What the compiler says where a graph must not break.
    """

    @functools.wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        disabled = getattr(function, "_not_compiled", None)
        if disabled is None:
            disabled = torch.compiler.disable(function, reason=reason)
            function._not_compiled = disabled  # type: ignore[attr-defined]
        result: R = disabled(*args, **kwargs)
        return result

    run._torchdynamo_disable, run._torchdynamo_disable_msg = True, reason  # type: ignore[attr-defined]  # what it reads
    return run
