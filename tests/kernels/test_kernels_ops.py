"""The Warp kernels as PyTorch ops: what the tests of every backend (tests/ops) leave open."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from composite_cases import PARTS, dense, evaluate, leaves_of, scene
from torch import Tensor

from voronerf.ops import (
    centre_grid,
    composite,
    frequency_encode,
    integrated_encode,
    march_rays,
    resample,
    spherical_harmonics,
)

pytestmark = pytest.mark.warp


def op(name: str) -> Any:
    return getattr(torch.ops.voronerf, name).default


def with_kernels(name: str) -> Any:
    return pytest.importorskip(f"voronerf.kernels.{name}")


@pytest.mark.parametrize("background", ["ray", "all", ""])
def test_composite_and_its_gradients(background: str) -> None:
    for given in (dense(4, 33, 3, background), scene([3, 0, 130, 1], 2, background, (2, 5))):
        exact, plain = (evaluate(given, dtype, "reference") for dtype in (torch.float64, torch.float32))
        for found, same, right in zip(evaluate(given, torch.float32, "warp"), plain, exact):
            error = (found.double() - right).abs().max() if right.numel() else 0
            allowed = 2 * (same.double() - right).abs().max() + 2e-6 * right.abs().max() if right.numel() else 0
            assert error <= allowed


@pytest.mark.parametrize("parts", [("colour",), ("depth",), ("opacity", "weights")])
def test_composite_gradients_of_some_outputs(parts: tuple[str, ...]) -> None:
    given = scene([4, 0, 9])
    exact = evaluate(given, torch.float64, "reference", parts)
    for found, right in zip(evaluate(given, torch.float32, "warp", parts), exact):
        torch.testing.assert_close(found.double(), right, rtol=1e-5, atol=1e-5)


def test_composite_second_derivatives() -> None:
    given, results = scene([3, 0, 6], 2, "all", (1, 1)), {}
    for backend, dtype in (("reference", torch.float64), ("warp", torch.float32)):
        cast, leaves = leaves_of(given, dtype)
        total = sum(part.square().sum() for part in composite(**cast, backend=backend))
        firsts = torch.autograd.grad(total, leaves, create_graph=True)
        results[backend] = torch.autograd.grad(sum(first.square().sum() for first in firsts), leaves)
    for want, got in zip(results["reference"], results["warp"]):
        torch.testing.assert_close(got.double(), want, rtol=1e-4, atol=1e-5 * (1 + float(want.abs().max())))


def test_composite_reads_nothing_outside_whatever_the_offsets_say() -> None:
    given, _ = leaves_of(scene([5, 8]), torch.float32)
    for bad in ([0, 9, 5], [0, 5, 2_000_000_000], [-2_000_000_000, 5, 13]):
        result = composite(**{**given, "ray_offsets": torch.tensor(bad, dtype=torch.int32)}, backend="warp")
        assert all(bool(part.isfinite().all()) for part in result)


def encodings(backend: str) -> list[Callable[..., Tensor]]:
    return [
        lambda x: frequency_encode(x, 4, backend=backend),
        lambda x: frequency_encode(x, 3, include_input=False, backend=backend),
        lambda x, v: integrated_encode(x, v.exp(), 4, backend=backend),
        lambda x: spherical_harmonics(x, 3, backend=backend),
        lambda x: spherical_harmonics(x, 4, backend=backend),
    ]


def test_encodings_and_their_derivatives() -> None:
    x, spread = torch.randn(6, 3, dtype=torch.float64), torch.randn(6, 3, dtype=torch.float64)
    for exact_run, run in zip(encodings("reference"), encodings("warp")):
        results = []
        for encode, dtype in ((exact_run, torch.float64), (run, torch.float32)):
            count = encode.__code__.co_argcount
            leaves = [tensor.to(dtype).requires_grad_() for tensor in (x, spread)[:count]]
            out = encode(*leaves)
            firsts = torch.autograd.grad(out.pow(3).sum(), leaves, create_graph=True)
            seconds = torch.autograd.grad(sum(first.square().sum() for first in firsts), leaves)
            results.append([out, *firsts, *seconds])
        for want, got in zip(*results):
            torch.testing.assert_close(got.double(), want, rtol=1e-4, atol=1e-5 * float(want.detach().abs().max()))


def test_uniforms_at_and_beyond_the_ends() -> None:
    weights, edges = torch.tensor([[0.0, 1.0, 0.0, 1.0, 0.0]]), torch.arange(6.0)[None]
    uniforms = torch.tensor([[2.0, 1.0, 0.5, 0.0, -1.0]])
    assert resample(weights, edges, 5, uniforms=uniforms, backend="warp").tolist() == [[1, 1, 3, 4, 4]]
    uniforms = torch.tensor([[0.75, float("nan"), 0.25]])
    depths = resample(weights, edges, 3, uniforms=uniforms, backend="warp")[0]
    assert depths[:2].tolist() == [1.5, 3.5] and depths[2].isnan()


def test_locate_cell_stays_inside_unsound_tables() -> None:
    with_kernels("locate_cell")
    points, centres = torch.rand(7, 3), torch.rand(3, 3)
    for offsets, child, depth in (
        ([0, 3], [5, 1_000_000_000, 9], 3),  # no such diagram
        ([0, 2_000_000_000], [-1, -2, -3], 1),  # more centres than there are
        ([0, 0, 3], [1, 1, 1], 2),  # a diagram without centres
        ([0, 1, 3], [1, 1, 0], 4),  # a walk that ends at no leaf
    ):
        tables = (torch.tensor(table, dtype=torch.int32) for table in (offsets, child))
        leaves = op("locate_cell_warp")(points, centres, *tables, depth, None)
        assert bool((leaves < 3).all())
        assert bool((leaves < 0).all()) == (offsets != [0, 2_000_000_000])


def test_opcheck() -> None:
    for name in ("composite", "encode", "spherical_harmonics", "resample", "locate_cell", "cell_sort"):
        with_kernels(name)
    for name in ("march_rays", "update_occupancy"):
        with_kernels(name)
    check = torch.library.opcheck
    cast, _ = leaves_of(scene([3, 0, 5], 2, "all", (1, 1)), torch.float32)
    inputs = tuple(cast.values())
    check(op("composite_warp"), inputs)
    slopes = [torch.rand_like(part).requires_grad_() for part in composite(**cast, backend="warp")]
    check(op("composite_warp_backward"), (*slopes, *inputs, [True] * 5))
    x, variances = torch.rand(5, 3, requires_grad=True), torch.rand(5, 3, requires_grad=True)
    for given in ((x, None, 2, True), (x, variances, 2, False)):
        check(op("encode_warp"), given)
        gradient = torch.rand(5, 3 * (4 + given[3]), requires_grad=True)
        check(op("encode_warp_backward"), (gradient, *given))
    for degree in (1, 4):
        check(op("spherical_harmonics_warp"), (x, degree))
        check(op("spherical_harmonics_warp_backward"), (torch.rand(5, degree**2, requires_grad=True), x, degree))
    check(op("resample_warp"), (torch.rand(4, 3), torch.rand(4, 4).cumsum(1), 6, torch.rand(4, 6)))
    tables = (torch.tensor([0, 4], dtype=torch.int32), torch.tensor([-1, -2, -3, -4], dtype=torch.int32))
    check(op("locate_cell_warp"), (torch.rand(5, 3), torch.rand(4, 3), *tables, 1, torch.rand(4)))
    grid = centre_grid(torch.rand(9, 3)).tables
    with_kernels("nearest_centre_grid")
    searched = (torch.rand(5, 3), torch.rand(9, 3), torch.rand(9), grid.frame, grid.entries, grid.lists, grid.bits)
    check(op("nearest_centre_grid_warp"), searched)
    check(op("cell_sort_warp"), (torch.tensor([2, 0, 1, 2], dtype=torch.int32), 3))
    cells = torch.tensor([3, 0], dtype=torch.int32)
    check(op("update_occupancy_warp"), (torch.rand(2, 2, 2), cells, torch.rand(2), 0.5, 0.1))
    rays = [torch.rand(4, 3), torch.rand(4, 3), torch.rand(4), 1 + torch.rand(4)]
    marched = [*rays, torch.rand(3, 3, 3) < 0.5, torch.tensor([[0.0] * 3, [2.0] * 3]), None, None]
    check(op("march_rays_warp_count"), (*marched, 6, False, 6, 99))
    offsets = op("march_rays_warp_count")(*marched, 6, False, 6, 99)
    check(op("march_rays_warp_fill"), (*marched, offsets, 6, False, 6, 4 * 6))


def test_compiles_whole() -> None:
    weights, edges = torch.rand(5, 4), torch.rand(5, 5).cumsum(1)
    rays = [torch.rand(5, 3), torch.rand(5, 3), torch.rand(5), 1 + torch.rand(5)]
    grid, box = torch.rand(3, 3, 3) < 0.5, torch.tensor([[0.0] * 3, [2.0] * 3])

    def loss(x: Tensor, variances: Tensor) -> Tensor:
        depths = resample(weights, edges, 3, backend="warp")
        march = march_rays(*rays, grid, box, 9, capacity=45, backend="warp")
        plain = frequency_encode(x, 3, backend="warp").square()
        seen = composite(plain[:5, :9], plain[:5, :9, None], plain[:5, :9], plain[:5, :9], backend="warp")
        blurred = integrated_encode(x, variances, 2, backend="warp") ** 3
        return plain.sum() + blurred.sum() + depths.sum() + seen.colour.sum() + march.deltas.sum()

    leaves = [torch.rand(9, 3, requires_grad=True), torch.rand(9, 3, requires_grad=True)]
    eager = loss(*leaves)
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")(*leaves)
    torch.testing.assert_close(compiled, eager)
    for got, want in zip(torch.autograd.grad(compiled, leaves), torch.autograd.grad(eager, leaves)):
        torch.testing.assert_close(got, want)


def test_half_storage() -> None:
    given, leaves = leaves_of(dense(2, 5), torch.bfloat16)
    result = composite(**given, backend="warp")
    gradients = torch.autograd.grad(sum(part.float().sum() for part in result), leaves)
    assert all(tensor.dtype == torch.bfloat16 for tensor in (*result, *gradients))
    assert result._fields == PARTS
