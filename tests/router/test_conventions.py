"""Fields of other people's codebases through VoronoiRouter: every case against a loop over masks.

The cases: `convention_listed.py` has the codebases of examples/, `convention_layers.py` and `convention_calls.py`
what nobody listed.
"""

from __future__ import annotations

import copy
import dataclasses
import warnings
from typing import Any

import pytest
import torch
from convention_calls import CALLS
from convention_harness import (
    Case,
    Counter,
    K,
    close,
    gradients_of_cells,
    gradients_of_router,
    loop,
    nearest,
    prepared,
    randomised,
    routed,
    scalar,
    tensors,
)
from convention_layers import LAYERS
from convention_listed import LISTED
from torch import Tensor

from voronerf import VoronoiDiagram, VoronoiRouter

CASES = [*LISTED, *LAYERS, *CALLS]
every_case = pytest.mark.parametrize("case", CASES, ids=str)


@pytest.fixture
def centres() -> Tensor:
    return torch.rand(K, 3) * 2 - 1


@pytest.fixture(autouse=True)
def _quiet() -> Any:
    """What runs cell by cell says so; here that is expected."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@every_case
def test_identical_cells_give_the_fields_own_output(case: Case, centres: Tensor) -> None:
    field = randomised(case.make())
    router = VoronoiRouter(field, centres, **case.options)
    args, kwargs, _ = prepared(case, torch.float32)
    close(tensors(case.call(router, args, kwargs)), tensors(case.call(field, args, kwargs)), rtol=1e-4, atol=1e-5)


@every_case
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
def test_distinct_cells_equal_a_loop_over_masks(case: Case, dtype: torch.dtype, centres: Tensor) -> None:
    modules = case.modules(dtype)
    router = routed(case, modules, centres)
    args, kwargs, inputs = prepared(case, dtype)
    expected = loop(case, modules, centres, args, kwargs)
    # A network is recognised after some calls: both ways of running it must be right.
    first, _, found = (tensors(case.call(router, args, kwargs)) for _ in range(3))
    # float32: sums in another order, and a sample near the kink of a ReLU may fall on either side.
    rtol, atol = (1e-9, 1e-10) if dtype == torch.float64 else (2e-3, 2e-4)
    close(first, expected, rtol=rtol, atol=atol)
    close(found, expected, rtol=rtol, atol=atol)
    parameters, taken = gradients_of_cells(modules, scalar(expected), inputs)
    for outputs in (first, found):
        router_parameters, router_taken = gradients_of_router(router, list(parameters), scalar(outputs), inputs)
        close(router_parameters, parameters, rtol=rtol, atol=10 * atol)
        torch.testing.assert_close(router_taken, taken, rtol=rtol, atol=10 * atol)


@pytest.mark.parametrize("case", [case for case in CASES if case.smooth], ids=str)
def test_second_derivatives_equal_the_loops(case: Case, centres: Tensor) -> None:
    """The eikonal loss: gradients of the parameters through the gradient of the input."""
    modules = case.modules(torch.float64)
    router = routed(case, modules, centres)
    args, kwargs, inputs = prepared(case, torch.float64)
    found = []
    case.call(router, args, kwargs)
    case.call(router, args, kwargs)
    for outputs in (loop(case, modules, centres, args, kwargs), tensors(case.call(router, args, kwargs))):
        (gradient,) = torch.autograd.grad(scalar(outputs), inputs[:1], create_graph=True)
        loss = (gradient.norm(dim=-1) - 1).square().sum()
        names = [name for name, p in modules[0].named_parameters() if p.requires_grad]
        found.append(
            gradients_of_router(router, names, loss, inputs) if found else gradients_of_cells(modules, loss, inputs)
        )
    close(found[1][0], found[0][0], rtol=1e-8, atol=1e-9)
    torch.testing.assert_close(found[1][1], found[0][1], rtol=1e-8, atol=1e-9)


@every_case
def test_how_often_the_module_runs(case: Case, centres: Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once for all cells, or where that may not be, once for each cell that has samples."""
    field = case.make()
    counter = Counter(monkeypatch, type(field), case.method)
    # No sample is near the last of the centres: its cell is empty.
    router = VoronoiRouter(field, torch.cat([centres, torch.full((1, 3), 50.0)]), **case.options)
    args, kwargs, _ = prepared(case, torch.float32)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        case.call(router, args, kwargs)
    counter.rows.clear()  # whatever is found out on the first call
    case.call(router, args, kwargs)
    assert 0 not in counter.rows
    if case.one_pass:
        assert len(counter.rows) <= 1, f"ran {len(counter.rows)} times for {K} cells"
        assert not [str(w.message) for w in said if "cell by cell" in str(w.message)]
    elif len(counter.rows) > 1:
        counts = nearest(case, centres, args, kwargs).unique(return_counts=True)[1].tolist()
        # Where another batch may do without the loop, that is looked at on a few samples.
        assert sorted(counter.rows[-len(counts) :]) == sorted(counts)


@every_case
def test_without_samples_sizes_and_dtypes_are_kept(case: Case, centres: Tensor) -> None:
    router = VoronoiRouter(case.make(), centres, **case.options)
    args, kwargs, _ = prepared(case, torch.float32)
    some = tensors(case.call(router, args, kwargs))
    for empty in [(0,)] if len(case.lead) == 1 else [(0, case.lead[1])]:
        args, kwargs, _ = prepared(case, torch.float32, empty)
        none = tensors(case.call(router, args, kwargs))
        assert list(none) == list(some)
        for key, value in some.items():
            if isinstance(value, Tensor):
                assert none[key].shape == (*empty, *value.shape[len(case.lead) :]), key
                assert none[key].dtype == value.dtype, key


@every_case
def test_one_sample(case: Case, centres: Tensor) -> None:
    modules = case.modules(torch.float64)
    router = routed(case, modules, centres)
    single = (1,) if len(case.lead) == 1 else (1, 1)
    args, kwargs, _ = prepared(case, torch.float64, single)
    lone = dataclasses.replace(case, lead=single)
    close(tensors(case.call(router, args, kwargs)), loop(lone, modules, centres, args, kwargs), rtol=1e-9, atol=1e-10)


@every_case
def test_cells_come_out_as_they_went_in(case: Case, centres: Tensor) -> None:
    modules = case.modules()
    router = routed(case, modules, centres)
    args, kwargs, _ = prepared(case, torch.float32)
    for index in (0, K - 1):
        cell, module = router.cell(index), modules[index]
        assert type(cell) is type(module)
        assert [n for n, _ in cell.named_parameters()] == [n for n, _ in module.named_parameters()]
        close(cell.state_dict(), module.state_dict(), rtol=0, atol=0)
        assert [p.requires_grad for p in cell.parameters()] == [p.requires_grad for p in module.parameters()]
        close(tensors(case.call(cell, args, kwargs)), tensors(case.call(module, args, kwargs)), rtol=1e-5, atol=1e-6)


@every_case
def test_subdivision_and_state_change_nothing(case: Case, centres: Tensor) -> None:
    modules = case.modules()
    router = routed(case, modules, centres)
    args, kwargs, _ = prepared(case, torch.float32)
    before = tensors(case.call(router, args, kwargs))
    fresh = VoronoiRouter(modules[0], centres, **case.options)
    diagram, parents = router.diagram.refine({1: VoronoiDiagram(torch.rand(3, 3) - 0.5)})
    router.subdivide(diagram, parents)
    assert router.num_cells == K + 2
    close(tensors(case.call(router, args, kwargs)), before, rtol=1e-5, atol=1e-6)
    fresh.load_state_dict(copy.deepcopy(router.state_dict()))
    close(tensors(case.call(fresh, args, kwargs)), before, rtol=1e-5, atol=1e-6)
    close(tensors(case.call(copy.deepcopy(router), args, kwargs)), before, rtol=1e-5, atol=1e-6)
