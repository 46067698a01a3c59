"""The compiled encodings: more cases than in tests/ops."""

from __future__ import annotations

import functools
from collections.abc import Callable

import pytest
import torch
from helpers import all_pairs
from tolerances import assert_as_exact
from torch import Tensor

from voronerf.ops import frequency_encode, integrated_encode, spherical_harmonics

pytestmark = pytest.mark.native
native = pytest.importorskip("voronerf.ops._core.native")

# Row counts next to the rows of a tile.
ROWS = (0, 1, 2, 31, 32, 33, 100)


def points(n: int, d: int = 3) -> Tensor:
    return 4 * torch.rand(n, d, dtype=torch.float64) - 2


def encodings(n: int, octaves: int = 4) -> list[tuple[Callable[..., Tensor], list[Tensor]]]:
    """Returns the frequency and integrated encodings, each with its float64 inputs."""
    return [
        (lambda x, backend: frequency_encode(x, octaves, backend=backend), [points(n)]),
        (lambda x, backend: frequency_encode(x, octaves, include_input=False, backend=backend), [points(n)]),
        (
            lambda x, variances, backend: integrated_encode(x, variances, octaves, backend=backend),
            [points(n), torch.rand(n, 3, dtype=torch.float64) / 10],
        ),
    ]


def all_encodings(n: int, octaves: int = 4) -> list[tuple[Callable[..., Tensor], list[Tensor]]]:
    """Returns the frequency and integrated encodings, and spherical harmonics of degrees 2 to 4, with their inputs."""

    def harmonics(degree: int, x: Tensor, backend: str) -> Tensor:
        return spherical_harmonics(x, degree, backend=backend)

    return [*encodings(n, octaves), *((functools.partial(harmonics, degree), [points(n)]) for degree in (2, 3, 4))]


def evaluate(run: Callable[..., Tensor], inputs: list[Tensor], dtype: torch.dtype, backend: str) -> list[Tensor]:
    """Returns the result and its gradients."""
    leaves = [tensor.to(dtype).requires_grad_() for tensor in inputs]
    out = run(*leaves, backend=backend)
    slopes = torch.linspace(-1, 1.5, out.numel(), dtype=torch.float64).view_as(out).to(dtype)
    return [out.detach(), *torch.autograd.grad(out, leaves, slopes)]


def assert_close(run: Callable[..., Tensor], inputs: list[Tensor]) -> None:
    """Compares the results with each instruction set of this processor."""
    inputs = [tensor.float().double() for tensor in inputs]
    exact, plain = (evaluate(run, inputs, dtype, "reference") for dtype in (torch.float64, torch.float32))
    for isa in native.SUPPORTED_ISAS:
        with native.using_isa(isa):
            results = evaluate(run, inputs, torch.float32, "native")
        for actual, same, right in zip(results, plain, exact):
            assert_as_exact(actual, same, right)


@pytest.mark.parametrize("n", ROWS)
def test_any_number_of_rows(n: int) -> None:
    for run, inputs in all_encodings(n):
        assert_close(run, inputs)


@pytest.mark.parametrize(
    *all_pairs({"d": [1, 2, 3, 4, 5, 8, 9, 16, 17, 40], "octaves": [1, 2, 3, 10, 16], "include_input": [True, False]})
)
def test_any_number_of_features(d: int, octaves: int, include_input: bool) -> None:
    assert_close(
        lambda x, backend: frequency_encode(x, octaves, include_input=include_input, backend=backend), [points(35, d)]
    )


@pytest.mark.parametrize("value", [3e3, 1e5, 1e9, 1e30, float("inf"), -float("inf"), float("nan")])
def test_large_angles_and_what_is_not_finite(isa: str, value: float) -> None:
    x = points(70).float()
    x[33, 1] = value
    for run, inputs in encodings(70, 8):
        inputs = [x, *(tensor.float() for tensor in inputs[1:])]
        got, want = (run(*inputs, backend=backend) for backend in ("native", "reference"))
        torch.testing.assert_close(got, want, rtol=0, atol=1e-6, equal_nan=True)


def test_large_variances(isa: str) -> None:
    variances = torch.tensor([0.0, 1e-3, 170.0, 200.0, 1e30, float("inf"), float("nan")])[:, None].expand(7, 3)
    run, inputs = encodings(0)[2][0], [torch.rand(7, 3), variances]
    results, expected = (evaluate(run, inputs, torch.float32, backend) for backend in ("native", "reference"))
    for got, want in zip(results, expected):
        assert got[:-1].isfinite().all() and got[-1].isnan().all()
        torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-5, equal_nan=True)
