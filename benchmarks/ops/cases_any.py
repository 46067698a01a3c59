"""A row for every operation that no other table has: calls of its own case, with the alternatives that it names."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map_only

from voronerf import backends, ops
from voronerf.ops import cases as of_ops
from voronerf.ops.cases import Draw

from .case import FORWARD, Case, Contender, Work, relative_error

ROWS = 1 << 14


def cases(others: list[Case]) -> list[Case]:
    """Rows of the operations that have none among the others."""
    covered = {case.op for case in others}
    missing = [op for op, case in of_ops.cases().items() if case.comparable and op not in covered]
    return [
        Case(op, f"n={ROWS}", torch.float32, FORWARD, ROWS, None, functools.partial(_work, op), backends.BACKENDS, True)
        for op in missing
    ]


def _work(op: str, device: torch.device) -> Work:
    case = of_ops.cases()[op]
    given = tree_map_only(Tensor, lambda tensor: tensor.to(device), case.make(Draw(), ROWS))

    def run(backend: str, call: int) -> list[Tensor]:
        own = tree_map_only(Tensor, Tensor.clone, given) if case.in_place else given
        out = getattr(ops, case.call or op)(**own, backend=backend)
        return [part for part in tree_leaves(own if case.in_place else out) if isinstance(part, Tensor)]

    expected = run("reference", 0)

    def error(found: list[Tensor]) -> float:
        return max(
            (relative_error(part.nan_to_num(), right.nan_to_num()) for part, right in zip(found, expected)), default=0.0
        )

    def alternative(function: Any) -> Contender:
        return Contender(lambda call: function(**given), lambda result: [result])

    alternatives = {name: functools.partial(alternative, function) for name, function in case.alternatives.items()}
    return Work(lambda name: Contender(functools.partial(run, name)), alternatives, error, 1e-4, float(ROWS), "")
