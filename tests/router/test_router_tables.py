"""Tables and planes of cells: one look-up for all cells gives the same gradients as separate modules."""

from __future__ import annotations

import pytest
import torch
from ops.foreign_kinds import CORNERS
from router_loop import masked_loop, perturb
from torch import Tensor, nn

from voronerf import VoronoiRouter


def _router(module: nn.Module, k: int) -> VoronoiRouter:
    return perturb(
        VoronoiRouter(module, torch.rand(k, 3) * 2 - 1, coords="first3"), torch.Generator().manual_seed(k), 1
    )


def _loop(router: VoronoiRouter, x: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Returns the results, and the parameters of the cells' modules: for each name, one parameter per cell."""
    (result,), modules = masked_loop(router, router.assign(x), [x])
    return result, [p for name, _ in router.module.named_parameters() for p in (m.get_parameter(name) for m in modules)]


def _gradients(out: Tensor, parameters: list[Tensor], k: int, weights: Tensor) -> list[Tensor]:
    """Returns gradients [k, ...]: stacks the gradients of k modules, or keeps a router's gradients (k = 0)."""
    result = torch.autograd.grad(out, parameters, weights, retain_graph=True, materialize_grads=True, allow_unused=True)
    return list(result) if k == 0 else [torch.stack(result[i : i + k]) for i in range(0, len(result), k)]


def test_indices_outside_of_a_table_are_refused() -> None:
    router = _router(CORNERS.make(), 3)
    x = torch.rand(40, 3)
    router(x)
    x[7, 0] = 2.4
    with pytest.raises(IndexError):
        router(x)


def test_pieces_cut_large_cells_and_join_small_ones() -> None:
    """A wide network runs in pieces of 1,024 rows: a large cell is cut into several, small cells share one."""
    torch.manual_seed(3)
    router = _router(nn.Sequential(nn.Linear(3, 1100), nn.ReLU(), nn.Linear(1100, 2)), 40)
    x = torch.cat([torch.rand(2500, 3) * 0.1, torch.rand(1500, 3) * 2 - 1])[torch.randperm(4000)]
    cells = router.assign(x)
    assert cells.bincount(minlength=40).max() > 2048, "one cell of three pieces"
    actual, (expected, leaves) = router(x), _loop(router, x)
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-4 * float(expected.detach().abs().max()))
    weights = torch.randn(4000, 2)
    theirs = _gradients(expected, leaves, 40, weights)
    for a, b in zip(_gradients(actual, list(router.parameters()), 0, weights), theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-3 * float(b.abs().max()))
