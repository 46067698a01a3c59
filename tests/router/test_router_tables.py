"""Tables and planes of the cells: looked up for all cells at once, with the gradients of one module for each cell."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from convention_rules import Corners, Planes
from torch import Tensor, nn

from voronerf import VoronoiRouter


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


@pytest.mark.filterwarnings("error")
def test_planes_run_cell_by_cell_where_cells_have_many_samples() -> None:
    router = _router(Planes(), 3)
    few, many = torch.rand(300, 3) * 2 - 1, torch.rand(600, 3) * 2 - 1
    router(few)
    assert "cell by cell" not in router.explain()
    found = router(many)
    assert "cell by cell: it reads planes" in router.explain() and "grouped" in router.explain()
    torch.testing.assert_close(found, _loop(router, many))
    one = _router(Planes(), 1)
    one(many)
    assert "cell by cell" not in one.explain()


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
