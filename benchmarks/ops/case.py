"""A row of the throughput table: its contenders and the check of their results.

n samples, k cells. A case is cheap to construct; ``Case.build`` makes its inputs and contenders.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from harness import Run
from torch import Tensor

FORWARD, BACKWARD = "forward", "forward+backward"
ROTATED_BYTES = 1 << 26
"""The total bytes of the input sets, which consecutive calls use in turn: more than most processors' caches."""


class NotApplicable(Exception):
    """Raised when an alternative cannot compute a case; the message gives the reason in one line."""


@dataclass
class Contender:
    """A way to compute a case's result.

    Attributes:
        run: A function: call number -> result.
        adapt: A function: result -> value for ``Work.error``. Default: the result itself.
    """

    run: Run
    adapt: Callable[[Any], Any] = lambda result: result


@dataclass
class Work:
    """A case that is ready to run.

    Attributes:
        ours: A function: backend -> contender.
        alternatives: Functions that set up alternatives, by name; each may raise ``NotApplicable``.
        error: A function of the result of call 0. It returns the largest error against float64, relative to the largest
            entry, or the number of wrong entries if the result has integers.
        tolerance: The largest error of an alternative that counts as correct.
        amount: The least number of operations, or of bytes read and written, of a call; the number of samples if
            ``bound`` is empty.
        bound: The peak rate that the amount is compared with: "float32", "bfloat16" or "copy"; "" for none.
        executed: The number of operations of a call with recomputation, if larger than ``amount``.
        moved: The least number of bytes read and written, if ``amount`` counts operations but memory may be the limit.
    """

    ours: Callable[[str], Contender]
    alternatives: dict[str, Callable[[], Contender]]
    error: Callable[[Any], float]
    tolerance: float
    amount: float
    bound: str
    executed: float | None = None
    moved: float | None = None


@dataclass(frozen=True)
class Case:
    """A case of the table, with one row for each of its backends.

    Attributes:
        op: The operation.
        case: The name, unique among cases of the same op, dtype and direction.
        dtype: The type of the parameters, or of the points if there are no parameters.
        direction: ``FORWARD`` or ``BACKWARD``.
        n: The number of samples.
        k: The number of cells; None if there are none.
        build: A function that makes inputs and contenders on a device.
        backends: The backends of the rows; backends that cannot run are reported and omitted.
        quick: Whether --quick includes the case.
        threads: The number of threads; None keeps the process's number. A row of one thread is timed by CPU time, which
            other processes disturb less.
        needs: The op that determines the available backends; empty for ``op`` itself.
    """

    op: str
    case: str
    dtype: torch.dtype
    direction: str
    n: int
    k: int | None
    build: Callable[[torch.device], Work] = field(compare=False, repr=False)
    backends: tuple[str, ...] = ("native",)
    quick: bool = False
    threads: int | None = None
    needs: str = ""

    @property
    def key(self) -> str:
        """The text that --filter is matched with."""
        return f"{self.op}/{self.case}/{dtype_name(self.dtype)}/{self.direction}"


def dtype_name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def optional(name: str) -> Any:
    """Imports an optional package; raises ``NotApplicable`` if the import fails."""
    try:
        return importlib.import_module(name)
    except Exception as error:
        reason = str(error).strip().splitlines()
        raise NotApplicable(f"{name} cannot be imported: {reason[0] if reason else type(error).__name__}") from error


def rotation(tensor_bytes: int) -> int:
    """Returns the number (2 to 64) of input sets of ``tensor_bytes`` bytes each.

    It is limited because small inputs are in cache in real use, too.
    """
    return min(max(ROTATED_BYTES // max(tensor_bytes, 1), 2), 64)


def relative_error(found: Tensor, expected: Tensor) -> float:
    """Returns the largest difference divided by the largest expected entry; inf for different shapes or NaN."""
    if found.shape != expected.shape:
        return float("inf")
    if expected.numel() == 0:
        return 0.0
    found, expected = found.detach().double().cpu(), expected.detach().double().cpu()
    error = float((found - expected).abs().max() / expected.abs().max().clamp(min=1e-30))
    return error if error == error else float("inf")


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def uniform_points(n: int, seed: int, device: torch.device, dtype: torch.dtype = torch.float32) -> Tensor:
    """Draws points [n, 3] uniformly from the cube from -1 to 1."""
    return (torch.rand(n, 3, generator=generator(seed), dtype=dtype) * 2 - 1).to(device)
