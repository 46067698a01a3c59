"""bfloat16 networks by torch's products on the CPU, as where AMX makes them the fastest; on any processor."""

import pytest
import torch
from torch import Tensor

from voronerf.app.cli.info import info
from voronerf.ops import grouped_mlp, routed_mlp
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS, Layer
from voronerf.ops._core.native import LEAST_GAIN
from voronerf.ops.grouped_mlp import by_torch
from voronerf.ops.grouped_mlp import native as kernels

pytestmark = pytest.mark.native

TABLES = {
    "skips": MLP(
        (
            Layer((POSITIONS,), 24, "sine"),
            Layer((0,), 33, "softplus"),
            Layer((1, POSITIONS), 17, "sigmoid"),
            Layer((2, DIRECTIONS), 3),
        ),
        (3, 1),
        position_octaves=2,
        direction_encoding="spherical",
        direction_degree=2,
    ),
    "gaussians": MLP((Layer((POSITIONS,), 16, "sigmoid"), Layer((0,), 2)), (1,), 3, position_encoding="integrated"),
}
COUNTS = [0, 40, 0, 7, 2]
STRAYS = 3


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Which way networks went, on a machine where torch is nine times as fast."""
    ways: list[str] = []

    def counted(way: str) -> None:
        module, name = (by_torch, "run") if way == "torch" else (kernels, "fused")
        whole = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *given: (ways.append(way), whole(*given))[1])

    monkeypatch.setattr(by_torch, "available", lambda: True)
    monkeypatch.setattr(by_torch, "gain", lambda *_: 9.0)
    counted("torch")
    counted("kernel")
    return ways


def results(layers: MLP, routed: bool, dtype: torch.dtype, *, half: bool, backend: str = "native") -> list[Tensor]:
    """Output and gradients; parameters are those of bfloat16 whatever the dtype. ``half``: under autocast."""
    draws = torch.Generator().manual_seed(3)
    n, k, seen = sum(COUNTS) + STRAYS, len(COUNTS), layers.uses_directions
    p = 6 if layers.integrated else 3
    parameters = [
        torch.randn(k, *shape, generator=draws) / shape[1] ** 0.5 for shape in layers.weight_shapes(p, 3 * seen)
    ]
    parameters += [torch.randn(k, layer.width, generator=draws) / 4 for layer in layers.layers]
    leaves = [torch.rand(n, p, generator=draws).to(dtype)]
    leaves += [parameter.bfloat16().to(torch.float32 if half else dtype) for parameter in parameters]
    positions, *rest = [leaf.requires_grad_() for leaf in leaves]
    weights, biases = rest[: len(layers.layers)], rest[len(layers.layers) :]
    read = {"layers": layers, "backend": backend, "directions": None}
    if seen:
        read["directions"] = torch.nn.functional.normalize(torch.rand(4, 3, generator=draws), dim=1).to(dtype)
        read["direction_index"] = (torch.arange(n) % 4).int()
    with torch.autocast("cpu", torch.bfloat16, enabled=half):
        if routed:
            counts = torch.tensor([*COUNTS[:-1], COUNTS[-1] + STRAYS])
            cells = torch.arange(k, dtype=torch.int32).repeat_interleave(counts).flip(0)
            out, _ = routed_mlp(positions, weights, biases, cells=cells, **read)
        else:
            offsets = torch.tensor([0, *COUNTS]).cumsum(0).int()
            out = grouped_mlp(positions, offsets, weights, biases, **read)
    gradient = torch.linspace(-1, 1, out.numel()).reshape(out.shape).sin().to(out.dtype)
    return [out, *torch.autograd.grad(out, leaves, gradient)]


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("routed", [False, True])
@pytest.mark.parametrize("table", TABLES)
def test_values_and_gradients(calls: list[str], table: str, routed: bool, half: bool) -> None:
    found = results(TABLES[table], routed, torch.bfloat16, half=half)
    assert calls == ["torch"]
    assert found[0].dtype == torch.bfloat16
    exact = results(TABLES[table], routed, torch.float64, half=False, backend="reference")
    for part, expected in zip(found, exact, strict=True):
        assert (part.double() - expected).norm() <= 2.5e-2 * expected.norm(), list(part.shape)
    if not routed:
        assert (found[0][-STRAYS:] == 0).all()


def test_what_is_not_faster_is_left_to_the_kernels(calls: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    results(TABLES["skips"], False, torch.float32, half=False)
    monkeypatch.setattr(by_torch, "gain", lambda *_: LEAST_GAIN - 0.01)
    results(TABLES["skips"], False, torch.bfloat16, half=False)
    monkeypatch.setattr(by_torch, "gain", lambda *_: LEAST_GAIN)
    results(TABLES["skips"], False, torch.bfloat16, half=False)
    assert calls == ["kernel", "kernel", "torch"]


def test_both_are_timed_and_info_says_it(
    calls: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert info() == 0
    assert "4 layers of 64 9 x as fast as the kernels" in " ".join(capsys.readouterr().out.split())
    monkeypatch.undo()
    assert 1e-3 < by_torch.gain(kernels.fused, TABLES["skips"], 3, 3, 16) < 1e3
    assert by_torch.describe(kernels.fused).startswith("not used")


@pytest.mark.parametrize(("amx", "isa", "expected"), [(True, "", True), (True, "portable", False), (False, "", False)])
def test_torch_is_asked_for_amx(monkeypatch: pytest.MonkeyPatch, amx: bool, isa: str, expected: bool) -> None:
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: amx)
    monkeypatch.setenv("VORONERF_ISA", isa)
    assert by_torch.available.__wrapped__() == expected
    monkeypatch.delattr(torch.cpu, "_is_amx_tile_supported")  # a private function of torch's
    assert not by_torch.available.__wrapped__()
