"""Tables and planes of the cells: looked up for all cells at once, with the gradients of one module for each cell."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from voronerf import VoronoiRouter


class Corners(nn.Module):
    """Several look-ups into one table, and one into another, with positions between them."""

    def __init__(self) -> None:
        super().__init__()
        self.table, self.codes = nn.Parameter(torch.randn(11, 2)), nn.Embedding(7, 3)

    def forward(self, x: Tensor) -> Tensor:
        index = (x[:, :2].abs() * 5).long()
        low, high = self.table[index], self.table[-1 - index]
        mixed = (low * x[:, :2, None] + high * (1 - x[:, :2, None]) ** 2).sum(1)
        return torch.cat([mixed, mixed**2, self.codes(index[:, 0]) * x[:, 2:3] ** 3], 1)


class Planes(nn.Module):
    """A plane read with the samples in the second dimension, and a volume with them in the last but one."""

    def __init__(self) -> None:
        super().__init__()
        self.plane, self.volume = nn.Parameter(torch.randn(1, 3, 5, 4)), nn.Parameter(torch.randn(1, 2, 3, 4, 5))

    def forward(self, x: Tensor) -> Tensor:
        pairs = torch.stack([x[:, :2], x[:, 1:]], 1)
        plane = F.grid_sample(self.plane, pairs[None], align_corners=True)
        volume = F.grid_sample(self.volume, x.view(1, 1, 1, -1, 3), padding_mode="border", align_corners=False)
        return torch.cat([plane[0].permute(1, 0, 2).flatten(1), volume.view(2, -1).T], -1)


def _loop(router: VoronoiRouter, x: Tensor) -> Tensor:
    """Each sample by itself."""
    parameters = {name: p.unbind() for name, p in router.module.named_parameters()}
    template, out = router.cell(0), []
    for row, cell in enumerate(router.assign(x).tolist()):
        own = {name: values[cell] for name, values in parameters.items()}
        out.append(torch.func.functional_call(template, own, (x[row : row + 1],)))
    return torch.cat(out)


def _router(module: nn.Module, k: int) -> VoronoiRouter:
    router = VoronoiRouter(module, torch.rand(k, 3) * 2 - 1, coords="first3")
    with torch.no_grad():
        for parameter in router.parameters():
            parameter.add_(torch.randn(parameter.shape))
    return router


@pytest.mark.parametrize("make", [Corners, Planes])
@pytest.mark.parametrize(("n", "k"), [(60, 5), (300, 1), (300, 40)])
def test_look_ups_give_what_one_module_for_each_cell_gives(make: Callable[[], nn.Module], n: int, k: int) -> None:
    torch.manual_seed(n + k)
    router, x = _router(make(), k), torch.rand(n, 3) * 2 - 1
    found, expected = router(x), _loop(router, x)
    assert "grouped" in router.explain() or k == 1
    torch.testing.assert_close(found, expected)
    weights = torch.randn(found.shape)
    parameters = list(router.parameters())
    theirs = torch.autograd.grad(expected, parameters, weights)
    for _ in range(2):  # a graph that is kept gives the same gradients again
        ours = torch.autograd.grad(found, parameters, weights, retain_graph=True)
        for a, b in zip(ours, theirs, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("of_parameters", [False, True])
def test_second_derivatives_through_look_ups(of_parameters: bool) -> None:
    torch.manual_seed(2)
    router = _router(Corners(), 4)
    parameters = list(router.parameters())
    results = []
    for call in (router, lambda x: _loop(router, x)):
        x = torch.rand(50, 3, generator=torch.Generator().manual_seed(1)).requires_grad_()
        leaves = [x, *parameters] if of_parameters else [x]
        slopes = torch.autograd.grad((call(x) ** 3).sum(), leaves, create_graph=True)
        total = sum((slope**2).sum() for slope in slopes)
        results.append(torch.autograd.grad(total, [x, *parameters]))
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-3 * float(b.abs().max()))


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
    found, expected = router(x), torch.zeros(4000, 2)
    for cell in cells.unique().tolist():
        own = {name: p[cell] for name, p in router.module.named_parameters()}
        rows = (cells == cell).nonzero()[:, 0]
        expected = expected.index_copy(0, rows, torch.func.functional_call(router.cell(cell), own, (x[rows],)))
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max()))
    weights = torch.randn(4000, 2)
    ours, theirs = (torch.autograd.grad(out, list(router.parameters()), weights) for out in (found, expected))
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-3 * float(b.abs().max()))
