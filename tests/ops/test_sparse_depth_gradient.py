"""The loss of rays that end at known points: against autograd through a slow loop."""

from __future__ import annotations

import pytest
import torch
from helpers import on_any_number_of_threads
from op_cases import need

from voronerf.ops import composite, sparse_depth_gradient
from voronerf.ops.sparse_depth_gradient.reference import NEARBY

pytestmark = pytest.mark.op("sparse_depth_gradient")


def case(counts, dtype=torch.float32, first=0):
    """Rays with so many samples, whose densities make some of them opaque; points are among the samples."""
    m = sum(counts)
    offsets = torch.tensor([0, *counts]).cumsum(0).to(torch.int32)
    deltas = 0.02 + 0.1 * torch.rand(m, dtype=dtype)
    depths = torch.cat([2 + part.cumsum(0) for part in deltas.split(counts)]) if counts else deltas
    density = 20 * torch.rand(m, dtype=dtype)
    distances = 2 + torch.rand(len(counts), dtype=dtype)
    if m:
        given = density, torch.zeros(m, 3, dtype=dtype), depths, deltas
        weights = composite(*given, ray_offsets=offsets, backend="reference").weights
    else:
        weights = density
    return density, depths, deltas, weights, offsets + first, distances


def slow(density, depths, deltas, offsets, distances):
    """The loss in float64, one ray after the other, differentiable in the densities."""
    total = density.new_zeros(())
    for ray, distance in enumerate(distances):
        light, there = density.new_ones(()), density.new_zeros(())
        for i in range(int(offsets[ray] - offsets[0]), int(offsets[ray + 1] - offsets[0])):
            through = torch.exp(-density[i] * deltas[i])
            if abs(depths[i] - distance) <= NEARBY * distance + deltas[i]:
                there = there + light * (1 - through)
            light = light * through
        total = total - torch.log(there.clamp(1e-3, 1))
    return total


@pytest.mark.parametrize("first", [0, 7])
def test_equals_autograd_through_a_slow_loop(device, backend, first):
    need("sparse_depth_gradient", backend, device, torch.float32)
    given = case((5, 0, 1, 12, 33, 2), first=first)
    loss, gradient = sparse_depth_gradient(*(tensor.to(device) for tensor in given), backend=backend)
    density, depths, deltas, _, offsets, distances = given
    exact = density.double().requires_grad_()
    expected = slow(exact, depths.double(), deltas.double(), offsets, distances.double())
    expected.backward()
    torch.testing.assert_close(loss.cpu().double(), expected.detach(), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(gradient.cpu().double(), exact.grad, rtol=1e-4, atol=1e-6)
    assert bool(gradient.any())


def test_a_ray_whose_point_gets_no_light_has_no_gradient(device, backend):
    need("sparse_depth_gradient", backend, device, torch.float32)
    density, depths, deltas, weights, offsets, distances = case((6, 6, 6))
    weights[6:12] = 0
    distances[2] = torch.nan
    given = density, depths, deltas, weights, offsets, distances
    loss, gradient = sparse_depth_gradient(*(tensor.to(device) for tensor in given), backend=backend)
    assert bool(loss.isfinite()) and bool(gradient[:6].any()) and not bool(gradient[6:].any())


def test_no_rays(device, backend):
    need("sparse_depth_gradient", backend, device, torch.float32)
    loss, gradient = sparse_depth_gradient(*(tensor.to(device) for tensor in case(())), backend=backend)
    assert float(loss) == 0 and gradient.shape == (0,)


def test_does_not_depend_on_the_number_of_threads():
    need("sparse_depth_gradient", "native", torch.device("cpu"), torch.float32)
    given = case((9,) * 700)
    on_any_number_of_threads(lambda: sparse_depth_gradient(*given, backend="native"))
