"""The compiled `composite`: more cases than in tests/ops/test_composite.py, which tests every backend."""

from __future__ import annotations

import pytest
import torch
from composite_cases import PARTS, dense, evaluate, leaves_of, scene
from helpers import on_any_number_of_threads
from tolerances import assert_as_exact

from voronerf.ops import composite

pytestmark = pytest.mark.native
native = pytest.importorskip("voronerf.ops._core.native")

INF = float("inf")


def assert_close(arguments: dict, parts: tuple[str, ...] = PARTS) -> None:
    """Compares the results with each instruction set of this processor."""
    exact, plain = (evaluate(arguments, dtype, "reference", parts) for dtype in (torch.float64, torch.float32))
    for isa in native.SUPPORTED_ISAS:
        with native.using_isa(isa):
            results = evaluate(arguments, torch.float32, "native", parts)
        for actual, same, right in zip(results, plain, exact):
            assert_as_exact(actual, same, right)


SAMPLES = (0, 1, 2, 3, 4, 5, 15, 16, 17, 31, 33, 64, 127, 129, 300)


@pytest.mark.parametrize("s", SAMPLES)
def test_any_number_of_samples(s: int) -> None:
    """The 15 numbers of samples have all pairs of a number of channels and a kind of background."""
    number = SAMPLES.index(s)
    c, background = (1, 2, 3, 4, 19)[number % 5], ("ray", "all", "")[number % 3]
    assert_close(dense(5, s, c, background))
    assert_close(scene([0, s, 1, 0, 40], c, background, outside=(3, 2)))


@pytest.mark.parametrize("parts", [("colour",), ("opacity",), ("depth",), ("weights",), ("depth", "weights")])
def test_gradients_of_some_outputs(parts: tuple[str, ...]) -> None:
    for arguments in (dense(4, 21), dense(4, 21, 2, "all"), scene([4, 0, 9])):
        assert_close(arguments, parts)


@pytest.mark.parametrize("counts", [[], [0], [0, 0], [1], [1, 0, 1], [700, 0, 3], [1] * 50])
def test_any_number_of_rays(counts: list[int]) -> None:
    assert_close(scene(counts))
    assert_close(scene(counts, background="all", outside=(7, 1)))


@pytest.mark.parametrize("c", [3, 2])
def test_same_bits_for_any_number_of_threads(isa: str, c: int) -> None:
    packed = scene([0, 5000, 1, 9000, *[70] * 100], c, "all", outside=(5, 9))
    many = dense(40_000, 2, c, "all")  # enough rays to split the gradient of the shared background
    for arguments in (packed, many):
        on_any_number_of_threads(lambda arguments=arguments: evaluate(arguments, torch.float32, "native"))


def test_a_long_ray_keeps_its_digits() -> None:
    arguments = scene([100_001])
    arguments["sigma"] /= 10_000
    assert_close(arguments)


@pytest.mark.parametrize("density", [50.0, 80.0, 87.0, 90.0, 1e4, 1e30, 3e38, INF])
def test_huge_densities(isa: str, density: float) -> None:
    arguments = dense(3, 40)
    arguments["sigma"][:, 5::7] = density
    arguments["deltas"][:] = 0.5
    arguments["deltas"][:, 5] = 0
    expected, actual = (evaluate(arguments, torch.float32, backend) for backend in ("reference", "native"))
    for want, got in zip(expected, actual):
        assert got.isfinite().all()
        torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-5)
    assert (actual[3][:, 13:] < 1e-10).all()


@pytest.mark.parametrize("form", ["dense", "packed"])
@pytest.mark.parametrize("parts", [("colour",), ("depth",), PARTS])
def test_second_derivatives(form: str, parts: tuple[str, ...]) -> None:
    arguments = dense(3, 6) if form == "dense" else scene([3, 0, 6], 2, "all", (1, 1))
    results = {}
    for backend, dtype in (("reference", torch.float64), ("native", torch.float32)):
        cast, leaves = leaves_of(arguments, dtype)
        result = composite(**cast, backend=backend)
        total = sum(getattr(result, part).square().sum() for part in parts)
        firsts = torch.autograd.grad(total, leaves, create_graph=True, allow_unused=True, materialize_grads=True)
        penalty = sum((first * first).sum() for first in firsts)
        results[backend] = torch.autograd.grad(penalty, leaves, allow_unused=True, materialize_grads=True)
    for want, got in zip(results["reference"], results["native"]):
        torch.testing.assert_close(got.double(), want, rtol=1e-4, atol=1e-5 * (1 + float(want.abs().max())))
