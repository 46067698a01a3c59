"""Products in tile registers: emulated on every machine, and in AMX if the processor has it."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator

import pytest
import torch
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
    widths: tuple[int, ...],
    p: int,
    octaves: int | None,
    counts: list[int],
    seed: int = 0,
    activation: str = "softplus",
) -> dict[str, object]:
    """Returns arguments for a chain of layers, whose last layer reads the positions again."""
    layers = [Layer(("positions",), widths[0], activation)]
    layers += [Layer((i,), width, activation) for i, width in enumerate(widths[1:])]
    layers.append(Layer((len(layers) - 1, "positions"), 4))
    table = MLP(tuple(layers), (len(layers) - 1,), position_octaves=octaves)
    draw = torch.Generator().manual_seed(seed)
    k, rows = len(counts), sum(counts)
    shapes = table.weight_shapes(p, 0)
    return {
        "layers": table,
        "positions": torch.randn(rows, p, generator=draw),
        "offsets": torch.tensor([0, *torch.tensor(counts).cumsum(0).tolist()], dtype=torch.int32),
        "weights": [torch.randn(k, o, i, generator=draw) / i**0.5 for o, i in shapes],
        "biases": [torch.randn(k, o, generator=draw) for o, _ in shapes],
    }


def outcome(call: dict[str, object], dtype: torch.dtype, backend: str) -> list[Tensor]:
    """Returns the result and the gradients of positions, weights and biases."""
    leaves = [call["positions"], *call["weights"], *call["biases"]]  # type: ignore[misc]
    leaves = [leaf.to(dtype, copy=True).requires_grad_() for leaf in leaves]
    count = len(call["weights"])  # type: ignore[arg-type]
    x, weights, biases = leaves[0], leaves[1 : 1 + count], leaves[1 + count :]
    y = grouped_mlp(x, call["offsets"], weights, biases, layers=call["layers"], backend=backend)  # type: ignore[arg-type]
    arriving = torch.sin(torch.arange(y.numel(), dtype=torch.float64)).view(y.shape).to(y.dtype)
    return [y.detach(), *torch.autograd.grad(y, leaves, arriving)]


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
    arguments = network(widths, p, octaves, [97, 0, 1, 40])
    exact, tight = outcome(arguments, torch.float64, "reference"), outcome(arguments, torch.float32, "native")
    precision(asked)
    actual = outcome(arguments, torch.float32, "native")
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
@pytest.mark.parametrize("rows", [0, 1, 2, 15, 16, 17, 31, 32, 33, 63, 65, 95, 96, 97, 129, 1025])
def test_any_number_of_rows(rows: int, asked: str, registers: str, precision: Callable[[str], None]) -> None:
    arguments = network((40, 64), 3, 4, [rows, 3])
    exact = outcome(arguments, torch.float64, "reference")
    precision(asked)
    assert error(outcome(arguments, torch.float32, "native"), exact) < PRECISIONS[asked]


def test_layers_with_a_relu_read_nothing_behind_their_columns(registers: str, precision: Callable[[str], None]) -> None:
    # A layer of 16 columns overwrites the slot of 32 columns, whose other 16 are nonzero.
    arguments = network((32, 16, 16), 3, 4, [97, 0, 1, 400], activation="relu")
    exact = outcome(arguments, torch.float64, "reference")
    precision("high")
    assert error(outcome(arguments, torch.float32, "native"), exact) < PRECISIONS["high"]


def test_other_threads_and_forked_children_compute_the_same(precision: Callable[[str], None], registers: str) -> None:
    call = network((64, 64), 3, 4, [500, 33])
    precision("high")
    before = torch.get_num_threads()
    torch.set_num_threads(1)  # a forked child can run only with one thread
    try:
        want = outcome(call, torch.float32, "native")
        results: list[list[Tensor]] = []
        others = [
            threading.Thread(target=lambda: results.append(outcome(call, torch.float32, "native"))) for _ in range(3)
        ]
        for other in others:
            other.start()
        for other in others:
            other.join()
        assert len(results) == 3
        assert all(torch.equal(a, b) for result in results for a, b in zip(result, want, strict=True))
        with torch.no_grad():
            y = want[0]
            child = os.fork()
            if child == 0:
                arguments = (call["positions"], call["offsets"], call["weights"], call["biases"])
                same = torch.equal(grouped_mlp(*arguments, layers=call["layers"], backend="native"), y)  # type: ignore[arg-type]
                os._exit(0 if same else 1)
            _, status = os.waitpid(child, 0)
        assert os.waitstatus_to_exitcode(status) == 0
    finally:
        torch.set_num_threads(before)
