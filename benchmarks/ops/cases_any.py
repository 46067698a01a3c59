"""Cases of all remaining operations, from their test cases (``tests/ops/cases``)."""

from __future__ import annotations

import functools
import sys
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map_only

from voronerf import ops
from voronerf.ops._core import backends

from .case import BACKWARD, FORWARD, Case, Contender, Work, relative_error

sys.path.append(str(Path(__file__).resolve().parents[2] / "tests" / "ops"))
from cases import CASES, Draw

ROWS = 1 << 14


def cases(others: list[Case]) -> list[Case]:
    """Returns the cases of operations that ``others`` does not cover."""
    covered = {case.op for case in others}
    missing = {op: case for op, case in CASES.items() if case.comparable and op not in covered}
    rows = []
    for op, case in missing.items():
        for direction in (FORWARD, BACKWARD) if case.differentiable else (FORWARD,):
            work = functools.partial(_work, op, direction)
            quick = direction == FORWARD
            rows.append(Case(op, f"n={ROWS}", torch.float32, direction, ROWS, None, work, backends.BACKENDS, quick))
    return rows


def _work(op: str, direction: str, device: torch.device) -> Work:
    case = CASES[op]
    backward = direction == BACKWARD

    def ready(tensor: Tensor) -> Tensor:
        return tensor.to(device).requires_grad_(backward and tensor.is_floating_point())

    arguments = tree_map_only(Tensor, ready, case.make(Draw(), ROWS))
    leaves = [leaf for leaf in tree_leaves(arguments) if isinstance(leaf, Tensor) and leaf.requires_grad]

    def run(backend: str, call: int) -> list[Tensor]:
        own = tree_map_only(Tensor, Tensor.clone, arguments) if case.in_place else arguments
        out = getattr(ops, case.call or op)(**own, backend=backend)
        found = [part for part in tree_leaves(own if case.in_place else out) if isinstance(part, Tensor)]
        if backward:
            total = sum(part.square().sum() for part in found if part.requires_grad)
            found += torch.autograd.grad(total, leaves, allow_unused=True, materialize_grads=True)
        return [part.detach() for part in found]

    expected = run("reference", 0)

    def error(found: list[Tensor]) -> float:
        return max(
            (relative_error(part.nan_to_num(), right.nan_to_num()) for part, right in zip(found, expected)), default=0.0
        )

    def alternative(function: Any) -> Contender:
        return Contender(lambda call: function(**arguments), lambda result: [result])

    alternatives = {
        name: functools.partial(alternative, function) for name, function in case.alternatives.items() if not backward
    }
    return Work(lambda name: Contender(functools.partial(run, name)), alternatives, error, 1e-4, float(ROWS), "")
