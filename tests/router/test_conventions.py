"""Tests of VoronoiRouter on fields of other codebases: every case against a loop over masks.

The cases: `convention_listed.py` has the codebases of examples/. `convention_layers.py`, `convention_calls.py` and
`convention_arguments.py` have other fields, `convention_rules.py` single steps, `convention_shared.py` encoders that
cells share, and `convention_sizes.py` fields with samples in other axes. Each case that can be fused is also tested
with ``fuse=True``.
"""

from __future__ import annotations

import copy
import dataclasses
import warnings
from typing import Any

import pytest
import torch
from convention_arguments import ARGUMENTS
from convention_calls import CALLS
from convention_harness import (
    Case,
    Counter,
    K,
    close,
    gradients,
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
from convention_rules import RULES
from convention_shared import ENCODERS
from convention_sizes import SIZES
from torch import Tensor

from voronerf import VoronoiDiagram, VoronoiRouter

CASES = [*LISTED, *LAYERS, *CALLS, *ARGUMENTS, *RULES, *ENCODERS, *SIZES]
CASES += [case.fused() for case in CASES if case.fuses]
every_case = pytest.mark.parametrize("case", CASES, ids=str)


@pytest.fixture
def centres() -> Tensor:
    return torch.rand(K, 3) * 2 - 1


@pytest.fixture(autouse=True)
def _quiet() -> Any:
    """Ignores the warning about fields that run cell by cell, which is expected here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@every_case
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
def test_distinct_cells_equal_a_loop_over_masks(case: Case, dtype: torch.dtype, centres: Tensor) -> None:
    """Values, gradients, and gradients of gradients (as in the eikonal loss) equal the results of the loop."""
    modules = case.modules(dtype)
    router = routed(case, modules, centres)
    args, kwargs, inputs = prepared(case, dtype)
    expected = loop(case, modules, nearest(case, centres, args, kwargs), args, kwargs)
    # The first call chooses the evaluation path of later calls.
    close(tensors(case.call(router, args, kwargs)), expected, rtol=2e-3, atol=2e-4)
    actual = tensors(case.call(router, args, kwargs))
    # In float32 the order of sums matters, and an input near 0 of a ReLU may fall on either side.
    rtol, atol = (1e-9, 1e-10) if dtype == torch.float64 else (2e-3, 2e-4)
    slopes = gradients(modules, scalar(expected), inputs, create_graph=True)
    compared = [name for name in slopes if case.by_parameters or name.startswith("input")]
    curves = gradients(modules, scalar({name: slopes[name] for name in compared}), inputs)
    close(actual, expected, rtol=rtol, atol=atol)
    ours = gradients(router, scalar(actual), inputs, create_graph=True)
    close(ours, slopes, rtol=rtol, atol=10 * atol)
    bent = gradients(router, scalar({name: ours[name] for name in compared}), inputs)
    # The second derivatives of a fine grid are large; where they cancel, the rounding of the largest remains.
    largest = max(float(curve.detach().abs().max()) for curve in curves.values() if curve.numel())
    close(bent, curves, rtol=rtol, atol=atol * max(100, 0.5 * largest))


@every_case
def test_identical_cells_give_the_fields_own_output(
    case: Case, centres: Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The field runs once for all cells or, if this is impossible, once for each cell that has samples."""
    field = randomised(case.make())
    args, kwargs, _ = prepared(case, torch.float32)
    expected = tensors(case.call(field, args, kwargs))
    counter = Counter(monkeypatch, type(field), case.method)
    # No sample is near the last centre, so its cell is empty.
    router = VoronoiRouter(field, torch.cat([centres, torch.full((1, 3), 50.0)]), **case.options)
    for _ in range(2):
        counter.rows.clear()  # forget the calls that choose the path
        close(tensors(case.call(router, args, kwargs)), expected, rtol=1e-4, atol=1e-5)
    assert f"{case.method}: {case.way}" in router.explain()
    assert 0 not in counter.rows
    if case.way != "cell by cell":
        assert len(counter.rows) <= 1, f"ran {len(counter.rows)} times for {K} cells"
    elif len(counter.rows) > 1:
        counts = nearest(case, centres, args, kwargs).unique(return_counts=True)[1].tolist()
        # The router may first call the field on a few samples, to see whether this batch can run without the loop.
        assert sorted(counter.rows[-len(counts) :]) == sorted(counts)


@every_case
def test_few_samples_and_none(case: Case, centres: Tensor) -> None:
    modules = case.modules(torch.float64)
    router = routed(case, modules, centres)
    args, kwargs, _ = prepared(case, torch.float64)
    some = tensors(case.call(router, args, kwargs))
    single, empty = ((1,), (0,)) if len(case.lead) == 1 else ((1, 1), (0, case.lead[1]))
    args, kwargs, _ = prepared(case, torch.float64, single)
    expected = loop(dataclasses.replace(case, lead=single), modules, nearest(case, centres, args, kwargs), args, kwargs)
    close(tensors(case.call(router, args, kwargs)), expected, rtol=1e-9, atol=1e-10)
    args, kwargs, inputs = prepared(case, torch.float64, empty)
    none = tensors(case.call(router, args, kwargs))
    assert list(none) == list(some)
    for key, value in some.items():
        if isinstance(value, Tensor):
            assert none[key].shape == (*empty, *value.shape[len(case.lead) :]), key
            assert none[key].dtype == value.dtype, key
    if scalar(none).requires_grad:
        assert all(not gradient.any() for gradient in gradients(router, scalar(none), inputs).values())


@every_case
def test_numbers_of_samples_that_equal_other_sizes(case: Case, centres: Tensor) -> None:
    """A batch may have as many samples as a tensor of the module has rows, or columns, or a part of them."""
    modules = case.modules(torch.float64)
    router = routed(case, modules, centres)
    sizes = {size for tensor in modules[0].state_dict().values() for size in tensor.shape if size < 70}
    sizes |= {1, 2, 53, *(size // 2 for size in sizes if size > 1)}
    for n in (61, *sorted(sizes)):
        lead = (n, *case.lead[1:])
        args, kwargs, _ = prepared(case, torch.float64, lead)
        sized = dataclasses.replace(case, lead=lead)
        expected = loop(sized, modules, nearest(case, centres, args, kwargs), args, kwargs)
        close(tensors(case.call(router, args, kwargs)), expected, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("case", [*LISTED, *ENCODERS], ids=str)
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
