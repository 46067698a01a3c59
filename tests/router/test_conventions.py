"""Tests of VoronoiRouter on fields in the styles of other codebases: every row against a loop over masks.

The rows of `benchmarks/ops/foreign_kinds.py` with `ways` are tested. Tests of every run compare the first way of a
row. Long tests compare its other ways, second derivatives, identical cells, empty batches and subdivisions, and batches
of many sizes (`tests/benchmarks/test_foreign_modules.py`).
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Iterator
from typing import Any
from unittest import mock

import pytest
import torch
from ops.foreign_kinds import EXAMPLES, KINDS, SHARED
from ops.foreign_rows import ROUNDED, Case, Row, curved, errors, leaves
from torch import Tensor, nn

from voronerf import VoronoiDiagram, VoronoiRouter

pytestmark = pytest.mark.filterwarnings("ignore")  # such as the warning about fields that run cell by cell

OPTIONS: dict[str, dict[str, Any]] = {"fused": {"fuse": True}, "grouped": {}, "cell by cell": {}}
ROWS = [(kind, row) for kind, rows in KINDS.items() for row in rows]


def each_way(rows: list[tuple[str, Row]]) -> Any:
    """Parametrizes a test with rows and ways; only long tests take other ways than the first of a row."""
    pairs = [
        pytest.param(row, way, id=f"{kind}, {row.module}, {way}", marks=[pytest.mark.slow] * (way != row.ways[0]))
        for kind, row in rows
        for way in row.ways
    ]
    return pytest.mark.parametrize(("row", "way"), pairs)


@pytest.fixture
def double() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def close(actual: dict[str, Any], expected: dict[str, Any], rtol: float = 1e-4, atol: float = 1e-5) -> None:
    """Checks that structures, shapes, dtypes and other values than tensors are equal, and that numbers are close."""
    assert list(actual) == list(expected)
    for path, value in expected.items():
        if isinstance(value, Tensor):
            torch.testing.assert_close(actual[path], value, rtol=rtol, atol=atol)
        else:
            assert actual[path] == value


def test_every_kind_has_a_row() -> None:
    assert all(any(row.ways for row in rows) for rows in KINDS.values())


@each_way(ROWS)
def test_distinct_cells_equal_a_loop_over_masks(row: Row, way: str) -> None:
    case = Case(row)
    router = case.router(**OPTIONS[way])
    close(case.routed(router), case.looped, 2e-3, 2e-4)
    with mock.patch.object(case, "router", lambda **_: router):  # later calls, which may be cached
        found = errors(case, OPTIONS[way])
    assert found["how"].startswith(way)
    for name in ("value_error", "gradient_error"):  # above ROUNDED, rounding switched a ReLU: float64 decides
        assert found[name] <= ROUNDED or found[f"{name}_float64"] < 1e-9, found


@pytest.mark.slow
@each_way(ROWS)
def test_second_derivatives_equal_those_of_a_loop(row: Row, way: str, double: None) -> None:
    # PyTorch's second derivatives by the parameters of weight_norm are wrong.
    loss = functools.partial(curved, by_parameters="weight_norm" not in row.module)
    found = errors(Case(row, dtype=torch.float64), OPTIONS[way], curved_error=loss)
    assert max(found[name] for name in found if name.endswith("error")) < 1e-7, found


class Counter:
    """Counts the calls of a method and the rows of the first tensor in each call, which holds the samples."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, cls: type[nn.Module], method: str) -> None:
        self.rows: list[int] = []
        owner = next(base for base in cls.__mro__ if method in vars(base))
        original = getattr(owner, method)

        @functools.wraps(original)
        def counted(module: nn.Module, *args: Any, **kwargs: Any) -> Any:
            inputs = [value for _, value in leaves((args, kwargs)) if isinstance(value, Tensor)]
            self.rows.append(inputs[0].shape[0])
            return original(module, *args, **kwargs)

        monkeypatch.setattr(owner, method, counted)


@pytest.mark.slow
@each_way(ROWS)
def test_identical_cells_give_the_fields_own_output(row: Row, way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The field runs once for all cells or, if this is impossible, once for each cell that has samples."""
    case = Case(row)
    field, expected = case.modules[0], case.routed(case.modules[0])
    case.modules = [field] * (len(case.centres) + 1)
    case.centres = torch.cat([case.centres, case.centres[:1] + 50])  # no sample is near the last centre
    router = case.router(**OPTIONS[way])
    counter = Counter(monkeypatch, type(field), row.method)
    for _ in range(2):
        counter.rows.clear()  # forget the calls that choose the way
        close(case.routed(router), expected)
    assert f"{row.method}: {way}" in router.explain()
    assert 0 not in counter.rows
    if way != "cell by cell":
        assert len(counter.rows) <= 1, f"ran {len(counter.rows)} times"
    elif len(counter.rows) > 1:
        counts = case.cells().unique(return_counts=True)[1].tolist()
        # The router may first call the field on a few samples, to see whether this batch can run without the loop.
        assert sorted(counter.rows[-len(counts) :]) == sorted(counts)


@pytest.mark.slow
@each_way(ROWS)
def test_no_samples(row: Row, way: str) -> None:
    case = Case(row)
    router = case.router(**OPTIONS[way])
    some, none = case.routed(router), case.routed(router, 0)
    assert list(none) == list(some)
    for path, value in some.items():
        if isinstance(value, Tensor):
            assert none[path].shape == (0, *value.shape[1:]) and none[path].dtype == value.dtype, path
    total = sum(value.sum() for value in none.values() if isinstance(value, Tensor) and value.requires_grad)
    if isinstance(total, Tensor):
        total.backward()
        assert all(p.grad is None or not p.grad.any() for p in router.parameters())


@pytest.mark.slow
@each_way([("examples", row) for row in EXAMPLES] + [("shared", row) for row in SHARED])
def test_subdivision_and_state_change_nothing(row: Row, way: str) -> None:
    case = Case(row)
    router = case.router(**OPTIONS[way])
    before = case.routed(router)
    case.modules = case.modules[:1] * len(case.centres)
    fresh = case.router(**OPTIONS[way])
    diagram, parents = router.diagram.refine({1: VoronoiDiagram(torch.rand(3, 3) - 0.5)})
    router.subdivide(diagram, parents)
    assert router.num_cells == len(case.centres) + 2
    close(case.routed(router), before)
    fresh.load_state_dict(copy.deepcopy(router.state_dict()))
    for same in (fresh, copy.deepcopy(router)):
        assert isinstance(same, VoronoiRouter)
        close(case.routed(same), before)
