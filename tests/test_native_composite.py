"""What composite of the compiled module has beyond the tests of every backend (tests/ops/test_composite.py)."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

from voronerf.ops import composite

pytestmark = pytest.mark.native


@pytest.fixture(params=["portable", "avx2", "avx512"])
def isa(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    native = pytest.importorskip("voronerf._native")
    number = native.ISAS.index(request.param)
    if not native._C.isa_supported(number):
        pytest.skip(f"{request.param}: not supported by this processor")
    monkeypatch.setattr(native, "_ISA", number)
    yield request.param


def rays(counts: list[int], c: int = 3) -> tuple[list[Tensor], Tensor]:
    """sigma, rgb, depths, deltas and background of packed rays in float64, and their offsets."""
    m = sum(counts)
    sigma = 4 * torch.rand(m, dtype=torch.float64) * (torch.rand(m) > 0.3)
    others = [torch.rand(*shape, dtype=torch.float64) for shape in ((m, c), (m,), (m,), (len(counts), c))]
    return [sigma, *others], torch.tensor([0, *counts]).cumsum(0).int()


def evaluate(given: list[Tensor], offsets: Tensor, dtype: torch.dtype, backend: str) -> list[Tensor]:
    """Results and all gradients."""
    leaves = [tensor.detach().to(dtype).requires_grad_() for tensor in given]
    results = composite(*leaves[:4], ray_offsets=offsets, background=leaves[4], backend=backend)
    slopes = [torch.linspace(-1, 1.5, part.numel(), dtype=dtype).view_as(part) for part in results]
    return [*(part.detach() for part in results), *torch.autograd.grad(results, leaves, slopes)]


@pytest.mark.parametrize("counts", [[], [0], [1], [63, 64, 65, 0, 129, 1], [3] * 100])
@pytest.mark.parametrize("c", [1, 3, 5])
def test_every_instruction_set_matches_float64(isa: str, counts: list[int], c: int) -> None:
    given, offsets = rays(counts, c)
    exact = evaluate(given, offsets, torch.float64, "reference")
    for got, want in zip(evaluate(given, offsets, torch.float32, "native"), exact):
        atol = 3e-6 * float(want.abs().max()) if want.numel() else 0.0
        torch.testing.assert_close(got.double(), want, rtol=1e-5, atol=atol)


def test_same_bits_for_any_number_of_threads() -> None:
    given, offsets = rays([40, 0, 3] * 200)
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(evaluate(given, offsets, torch.float32, "native"))
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))


def test_every_output_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    native = pytest.importorskip("voronerf._native_composite")
    given, _ = rays([2, 70, 0, 9])
    offsets = torch.tensor([3, 60, 60, 78], dtype=torch.int32)  # samples of no ray on both sides
    given[4] = given[4][:3]
    want = evaluate(given, offsets, torch.float32, "native")
    allocate, allocate_gradients = native._allocate, native._allocate_gradients

    def poisoned(tensors: list[Tensor]) -> list[Tensor]:
        return [tensor.fill_(float("nan")) for tensor in tensors]

    monkeypatch.setattr(native, "_allocate", lambda *a: tuple(poisoned(allocate(*a))))
    monkeypatch.setattr(native, "_allocate_gradients", lambda *a: poisoned(allocate_gradients(*a)))
    got = evaluate(given, offsets, torch.float32, "native")
    assert all(torch.equal(a, b) for a, b in zip(want, got))


def test_second_derivatives() -> None:
    given, offsets = rays([5, 0, 8])
    results = {}
    for backend, dtype in (("reference", torch.float64), ("native", torch.float32)):
        leaves = [tensor.detach().to(dtype).requires_grad_() for tensor in given]
        out = composite(*leaves[:4], ray_offsets=offsets, background=leaves[4], backend=backend)
        loss = (out.colour**2).sum() + (out.depth * out.opacity).sum()
        firsts = torch.autograd.grad(loss, leaves, create_graph=True)
        penalty = sum((first * first).sum() for first in firsts)
        results[backend] = torch.autograd.grad(penalty, leaves)
    for want, got in zip(results["reference"], results["native"]):
        torch.testing.assert_close(got.double(), want, rtol=1e-3, atol=1e-5 * float(want.abs().max()))


def test_opcheck() -> None:
    native = pytest.importorskip("voronerf._native_composite")
    given, offsets = rays([5, 0, 8])
    sigma, rgb, depths, deltas, background = (tensor.float().requires_grad_() for tensor in given)
    arguments = (sigma, rgb, depths, deltas, offsets, background)
    torch.library.opcheck(native._forward, arguments)
    results = [part.detach() for part in native._forward(*arguments)]
    gradients = [torch.randn_like(part).requires_grad_() for part in results]
    torch.library.opcheck(native._backward, (gradients, results, *arguments))


@pytest.mark.parametrize("bad", [[0, 9, 5], [0, 5, 14], [-1, 5, 13]])
def test_offsets_are_checked(bad: list[int]) -> None:
    given, _ = rays([5, 8])
    with pytest.raises(ValueError, match="composite: ray_offsets must rise"):
        evaluate(given, torch.tensor(bad, dtype=torch.int32), torch.float32, "native")
