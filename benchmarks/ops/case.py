"""One row of the throughput table before it is measured: what runs, against what, and how results are checked.

n samples, k cells. A case is cheap to make; its inputs and contenders are made when it is built.
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
"""Inputs of consecutive calls differ until they take this much, more than the caches of most processors."""


class NotApplicable(Exception):
    """An alternative cannot do this case; the message says why in one line."""


@dataclass
class Contender:
    """A way to compute a case's result.

    Attributes:
        run: call number -> result.
        adapt: result -> what ``Work.error`` compares, if that is not the result itself.
    """

    run: Run
    adapt: Callable[[Any], Any] = lambda result: result


@dataclass
class Work:
    """A case that is ready to run.

    Attributes:
        ours: backend -> contender.
        alternatives: name -> what sets it up, which may raise ``NotApplicable``.
        error: result of call 0 -> largest error against float64: relative to the largest entry for floats, the number
            of wrong ones for integers.
        tolerance: largest error of an alternative that counts as correct.
        amount: operations, or bytes read and written, of a call at the least; samples where there is no bound.
        bound: which limit of the machine the amount is compared with: "float32", "bfloat16" or "copy"; "" for none.
        executed: operations of a call with what is computed again, where that is more than ``amount``.
        moved: bytes read and written at the least, where ``amount`` counts operations and both may be the limit.
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
    """A row of the table, for each of its backends.

    Attributes:
        op: the operation.
        case: what identifies the row among those of the op, dtype and direction.
        dtype: of the parameters (of the points, where there are none).
        direction: ``FORWARD`` or ``BACKWARD``.
        n: samples.
        k: cells; None where there are none.
        build: makes inputs and contenders, on a device.
        backends: whose rows there are; those that cannot run are reported and left out.
        quick: part of --quick.
        isa: instruction set forced on the native backend; None is the best one.
        threads: of the row; None leaves the process's own number. A row of one thread is timed by its CPU time, which
            other processes disturb less.
        needs: the op whose backends the row has; empty for ``op`` itself.
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
    isa: str | None = None
    threads: int | None = None
    needs: str = ""

    @property
    def key(self) -> str:
        """What --filter is matched with."""
        return f"{self.op}/{self.case}/{dtype_name(self.dtype)}/{self.direction}"


def dtype_name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def optional(name: str) -> Any:
    """An installed package, or ``NotApplicable``."""
    try:
        return importlib.import_module(name)
    except Exception as error:
        reason = str(error).strip().splitlines()
        raise NotApplicable(f"{name} cannot be imported: {reason[0] if reason else type(error).__name__}") from error


def rotation(tensor_bytes: int) -> int:
    """Number of input sets of this size, at most 64; small inputs are in a cache in real use as well."""
    return min(max(ROTATED_BYTES // max(tensor_bytes, 1), 2), 64)


def relative_error(found: Tensor, expected: Tensor) -> float:
    """Largest difference over the largest expected entry; inf where something is not finite."""
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
    """Points [n, 3] spread evenly over the cube from -1 to 1."""
    return (torch.rand(n, 3, generator=generator(seed), dtype=dtype) * 2 - 1).to(device)
