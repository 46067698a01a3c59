"""Products in tile registers: emulated on every machine, and in AMX if the processor has it."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator

import pytest
import torch
from test_native_mlp import arguments, cast, evaluate
from torch import Tensor

from voronerf.ops import frequency_encode, grouped_mlp
from voronerf.ops._core.layers import MLP, Layer

native = pytest.importorskip("voronerf.ops._core.native")
programs = pytest.importorskip("voronerf.ops.network.native")

PRECISIONS = {"highest": 2e-6, "high": 1e-4, "medium": 0.05}
"""Values of ``torch.set_float32_matmul_precision``, and the largest allowed errors against float64."""


@pytest.fixture(params=["double", "amx"])
def registers(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    if request.param == "amx":
        if "amx" not in native.SUPPORTED_ISAS:
            pytest.skip("this processor has no AMX")
        with native.using_isa("amx"):
            yield "amx"
        return
    double = {"portable": programs._LAYOUTS["amx"]}
    monkeypatch.setattr(programs, "_LAYOUTS", double)
    with native.using_isa("portable"):
        yield "double"


@pytest.fixture
def precision() -> Iterator[Callable[[str], None]]:
    before = torch.get_float32_matmul_precision()
    yield torch.set_float32_matmul_precision
    torch.set_float32_matmul_precision(before)


def network(
    widths: tuple[int, ...], p: int, octaves: int | None, counts: list[int], activation: str = "softplus"
) -> dict:
    """Returns arguments for a chain of layers, whose last layer reads the positions again."""
    layers = [Layer((i - 1 if i else "positions",), width, activation) for i, width in enumerate(widths)]
    layers.append(Layer((len(layers) - 1, "positions"), 4))
    call = arguments(MLP(tuple(layers), (len(layers) - 1,), position_octaves=octaves), counts, p=p)
    return {**call, "positions": call["positions"].float()}  # octaves would multiply the rounding to float32


def error(results: list[Tensor], exact: list[Tensor]) -> float:
    distances = [float((a.double() - b).norm() / (b.norm() + 1e-9)) for a, b in zip(results, exact, strict=True)]
    return max(distances)


@pytest.mark.parametrize("asked", PRECISIONS)
@pytest.mark.parametrize(
    ("widths", "p", "octaves"),
    [((64, 64, 64), 3, 10), ((32,), 3, 4), ((1, 3), 1, None), ((17, 48, 33), 5, 2), ((130, 65), 90, None)],
)
def test_each_precision_is_as_exact_as_it_says(
    widths: tuple[int, ...], p: int, octaves: int | None, asked: str, registers: str, precision: Callable[[str], None]
) -> None:
    call = network(widths, p, octaves, [97, 0, 1, 40])
    exact, tight = evaluate(call, torch.float64, "reference"), evaluate(call, torch.float32, "native")
    precision(asked)
    actual = evaluate(call, torch.float32, "native")
    assert error(actual, exact) < PRECISIONS[asked]
    same = all(torch.equal(a, b) for a, b in zip(actual, tight))
    assert same == (asked == "highest")


@pytest.mark.parametrize(("asked", "most"), [("high", 1e-5), ("medium", 2.0**-9 + 4e-6)])
@pytest.mark.parametrize("largest", [1.0, 15.0, 1e5])  # angles to 512, to 7,680, and beyond the vector sine
@pytest.mark.parametrize("d", [1, 3, 5])
def test_octaves_are_no_less_exact_than_what_they_are_rounded_to(
    d: int, largest: float, asked: str, most: float, registers: str, precision: Callable[[str], None]
) -> None:
    x = largest * (2 * torch.rand(1057, d, generator=torch.Generator().manual_seed(1)) - 1)
    width = 2 * 10 * d + d
    table = MLP((Layer(("positions",), width),), (0,), position_octaves=10)
    precision(asked)
    offsets, weights = torch.tensor([0, len(x)], dtype=torch.int32), [torch.eye(width)[None]]

    def encoded(x: Tensor) -> Tensor:
        return grouped_mlp(x, offsets, weights, [None], layers=table, backend="native")[:, d:]

    actual, exact = encoded(x), frequency_encode(x.double(), 10, include_input=False, backend="reference")
    assert (actual - exact).abs().max() < most
    beside = x.clone()
    beside[40] = 1e7
    assert torch.equal(encoded(beside)[:40], actual[:40])


@pytest.mark.parametrize("asked", ["high", "medium"])
@pytest.mark.parametrize("rows", [0, 1, 15, 16, 17, 31, 33, 95, 96, 97, 1025])
def test_any_number_of_rows(rows: int, asked: str, registers: str, precision: Callable[[str], None]) -> None:
    call = network((40, 64), 3, 4, [rows, 3])
    exact = evaluate(call, torch.float64, "reference")
    precision(asked)
    assert error(evaluate(call, torch.float32, "native"), exact) < PRECISIONS[asked]


def test_layers_with_a_relu_read_nothing_behind_their_columns(registers: str, precision: Callable[[str], None]) -> None:
    # A layer of 16 columns overwrites the slot of 32 columns, whose other 16 are nonzero.
    call = network((32, 16, 16), 3, 4, [97, 0, 1, 400], activation="relu")
    exact = evaluate(call, torch.float64, "reference")
    precision("high")
    assert error(evaluate(call, torch.float32, "native"), exact) < PRECISIONS["high"]


def test_other_threads_and_forked_children_compute_the_same(precision: Callable[[str], None], registers: str) -> None:
    call = network((64, 64), 3, 4, [500, 33])
    precision("high")
    before = torch.get_num_threads()
    torch.set_num_threads(1)  # a forked child can run only with one thread
    try:
        want = evaluate(call, torch.float32, "native")
        results: list[list[Tensor]] = []
        others = [
            threading.Thread(target=lambda: results.append(evaluate(call, torch.float32, "native"))) for _ in range(3)
        ]
        for other in others:
            other.start()
        for other in others:
            other.join()
        assert len(results) == 3
        assert all(torch.equal(a, b) for result in results for a, b in zip(result, want, strict=True))
        with torch.no_grad():
            child = os.fork()
            if child == 0:
                same = torch.equal(grouped_mlp(**cast(call, torch.float32), backend="native"), want[0])
                os._exit(0 if same else 1)
            _, status = os.waitpid(child, 0)
        assert os.waitstatus_to_exitcode(status) == 0
    finally:
        torch.set_num_threads(before)
