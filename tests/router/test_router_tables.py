"""Tables and planes of the cells: looked up for all cells at once, with the gradients of one module for each cell."""

from __future__ import annotations

from typing import Any

import pytest
import torch
import torch.nn.functional as F
from convention_rules import Corners
from router_fields import masked_loop, perturb
from torch import Tensor, nn

from voronerf import VoronoiRouter


def _router(module: nn.Module, k: int) -> VoronoiRouter:
    return perturb(
        VoronoiRouter(module, torch.rand(k, 3) * 2 - 1, coords="first3"), torch.Generator().manual_seed(k), 1
    )


def _loop(router: VoronoiRouter, x: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Results, and the parameters of each cell's module, one after the other for each name."""
    (found,), modules = masked_loop(router, router.assign(x), [x])
    return found, [p for name, _ in router.module.named_parameters() for p in (m.get_parameter(name) for m in modules)]


def _gradients(out: Tensor, parameters: list[Tensor], k: int, weights: Tensor) -> list[Tensor]:
    """Of a router, [k, ...], or of the modules of a loop."""
    found = torch.autograd.grad(out, parameters, weights, retain_graph=True, materialize_grads=True, allow_unused=True)
    return list(found) if k == 0 else [torch.stack(found[i : i + k]) for i in range(0, len(found), k)]


class Factors(nn.Module):
    """A plane and a line, as TensoRF has them, read beyond their borders too."""

    def __init__(self, **options: Any) -> None:
        super().__init__()
        self.plane, self.line = nn.Parameter(torch.randn(1, 3, 5, 4)), nn.Parameter(torch.randn(1, 3, 6, 1))
        self.options = options

    def forward(self, x: Tensor) -> Tensor:
        plane = F.grid_sample(self.plane, x[:, :2].view(1, -1, 1, 2), **self.options)
        at = torch.stack([torch.zeros_like(x[:, 2]), x[:, 2]], -1)
        line = F.grid_sample(self.line, at.view(1, 1, -1, 2), **self.options)
        return torch.cat([plane[0, :, :, 0], line[0, :, 0] * plane[0, :, :, 0]]).T


@pytest.mark.parametrize("n", [60, 7000], ids=["few samples a cell", "many"])
@pytest.mark.parametrize("align", [True, False])
@pytest.mark.parametrize("padding", ["zeros", "border"])
def test_planes_and_lines_are_those_of_grid_sample(padding: str, align: bool, n: int) -> None:
    torch.manual_seed(n)
    router = _router(Factors(padding_mode=padding, align_corners=align), 4)
    x = torch.rand(n, 3) * 3 - 1.5
    x[:8] = torch.tensor([[-1.0, 1, 0.2], [1, -1, -1], [0, 0, 1], [9, -9, 9]]).repeat(2, 1)  # at borders and far beyond
    given = [x.clone().requires_grad_() for _ in range(2)]
    found, (expected, leaves) = router(given[0]), _loop(router, given[1])
    assert router.explain() == "forward: grouped"
    torch.testing.assert_close(found, expected)
    weights = torch.randn(found.shape)
    ours = [*_gradients(found, list(router.parameters()), 0, weights), *torch.autograd.grad(found, given[0], weights)]
    theirs = [*_gradients(expected, leaves, 4, weights), *torch.autograd.grad(expected, given[1], weights)]
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


def test_indices_outside_of_a_table_are_refused() -> None:
    router = _router(Corners(), 3)
    x = torch.rand(40, 3)
    router(x)
    x[7, 0] = 2.4
    with pytest.raises(IndexError):
        router(x)


def test_pieces_cut_large_cells_and_join_small_ones() -> None:
    """A wide network runs in pieces of 1,024 rows: of one cell that has most of the samples, of several small ones."""
    torch.manual_seed(3)
    router = _router(nn.Sequential(nn.Linear(3, 1100), nn.ReLU(), nn.Linear(1100, 2)), 40)
    x = torch.cat([torch.rand(2500, 3) * 0.1, torch.rand(1500, 3) * 2 - 1])[torch.randperm(4000)]
    cells = router.assign(x)
    assert cells.bincount(minlength=40).max() > 2048, "one cell of three pieces"
    found, (expected, leaves) = router(x), _loop(router, x)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4 * float(expected.detach().abs().max()))
    weights = torch.randn(4000, 2)
    theirs = _gradients(expected, leaves, 40, weights)
    for a, b in zip(_gradients(found, list(router.parameters()), 0, weights), theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-3 * float(b.abs().max()))
