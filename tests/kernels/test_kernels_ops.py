"""The Warp kernels as PyTorch ops: what the tests of every backend (tests/ops) leave open."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from composite_cases import PARTS, dense, evaluate, leaves_of, scene

from voronerf.ops import (
    composite,
)

pytestmark = pytest.mark.warp


def op(name: str) -> Any:
    return getattr(torch.ops.voronerf, name).default


def with_kernels(name: str) -> Any:
    return pytest.importorskip(f"voronerf.kernels.{name}")


@pytest.mark.parametrize("background", ["ray", "all", ""])
def test_composite_and_its_gradients(background: str) -> None:
    for given in (dense(4, 33, 3, background), scene([3, 0, 130, 1], 2, background, (2, 5))):
        exact, plain = (evaluate(given, dtype, "reference") for dtype in (torch.float64, torch.float32))
        for found, same, right in zip(evaluate(given, torch.float32, "warp"), plain, exact):
            error = (found.double() - right).abs().max() if right.numel() else 0
            allowed = 2 * (same.double() - right).abs().max() + 2e-6 * right.abs().max() if right.numel() else 0
            assert error <= allowed


@pytest.mark.parametrize("parts", [("colour",), ("depth",), ("opacity", "weights")])
def test_composite_gradients_of_some_outputs(parts: tuple[str, ...]) -> None:
    given = scene([4, 0, 9])
    exact = evaluate(given, torch.float64, "reference", parts)
    for found, right in zip(evaluate(given, torch.float32, "warp", parts), exact):
        torch.testing.assert_close(found.double(), right, rtol=1e-5, atol=1e-5)


def test_composite_reads_nothing_outside_whatever_the_offsets_say() -> None:
    given, _ = leaves_of(scene([5, 8]), torch.float32)
    for bad in ([0, 9, 5], [0, 5, 2_000_000_000], [-2_000_000_000, 5, 13]):
        result = composite(**{**given, "ray_offsets": torch.tensor(bad, dtype=torch.int32)}, backend="warp")
        assert all(bool(part.isfinite().all()) for part in result)


def test_locate_cell_stays_inside_unsound_tables() -> None:
    with_kernels("locate_cell")
    points, centres = torch.rand(7, 3), torch.rand(3, 3)
    for offsets, child, depth in (
        ([0, 3], [5, 1_000_000_000, 9], 3),  # no such diagram
        ([0, 2_000_000_000], [-1, -2, -3], 1),  # more centres than there are
        ([0, 0, 3], [1, 1, 1], 2),  # a diagram without centres
        ([0, 1, 3], [1, 1, 0], 4),  # a walk that ends at no leaf
    ):
        tables = (torch.tensor(table, dtype=torch.int32) for table in (offsets, child))
        leaves = op("locate_cell_warp")(points, centres, *tables, depth, None)
        assert bool((leaves < 3).all())
        assert bool((leaves < 0).all()) == (offsets != [0, 2_000_000_000])


def test_half_storage() -> None:
    given, leaves = leaves_of(dense(2, 5), torch.bfloat16)
    result = composite(**given, backend="warp")
    gradients = torch.autograd.grad(sum(part.float().sum() for part in result), leaves)
    assert all(tensor.dtype == torch.bfloat16 for tensor in (*result, *gradients))
    assert result._fields == PARTS
