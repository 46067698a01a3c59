"""The loss of rays that end at known points, compared with autograd through a slow loop."""

from __future__ import annotations

import pytest
import torch
from helpers import on_any_number_of_threads
from op_cases import need

from voronerf.ops import composite, sparse_depth_gradient
from voronerf.ops.sparse_depth_gradient.reference import NEARBY

pytestmark = pytest.mark.op("sparse_depth_gradient")


def case(counts, dtype=torch.float32, others=(), skipped=0):
    """Returns rays with ``counts`` samples each, some of them opaque; the end points lie among the samples.

    Rays with ``others`` samples follow, without end points. The first ``skipped`` samples belong to no ray.
    """
    counts = [*counts, *others]
    m = sum(counts)
    offsets = torch.tensor([0, *counts]).cumsum(0).to(torch.int32)
    deltas = 0.02 + 0.1 * torch.rand(m, dtype=dtype)
    depths = torch.cat([2 + part.cumsum(0) for part in deltas.split(counts)]) if counts else deltas
    density = 20 * torch.rand(m, dtype=dtype)
    distances = 2 + torch.rand(len(counts) - len(others), dtype=dtype)
    if m:
        arguments = density, torch.zeros(m, 3, dtype=dtype), depths, deltas
        weights = composite(*arguments, ray_offsets=offsets, backend="reference").weights
    else:
        weights = density
    loose = torch.rand(4, skipped, dtype=dtype)
    samples = (torch.cat(both) for both in zip(loose, (density, depths, deltas, weights)))
    return *samples, offsets + skipped, distances


def learnt(arguments, device="cpu", **rule):
    """Returns what the op adds to an existing loss and density gradient."""
    arguments = [tensor.to(device) for tensor in arguments]
    loss, gradient = torch.full_like(arguments[-1].sum(), 2), arguments[0].new_ones(len(arguments[0]), 4)
    sparse_depth_gradient(loss, gradient, *arguments, **rule)
    assert bool((gradient[:, :3] == 1).all())
    return loss.cpu() - 2, gradient[:, 3].cpu() - 1


def slow(density, depths, deltas, offsets, distances):
    """Computes the loss ray by ray in float64, so that autograd can differentiate it."""
    total = density.new_zeros(())
    for ray, distance in enumerate(distances):
        light, there = density.new_ones(()), density.new_zeros(())
        for i in range(int(offsets[ray]), int(offsets[ray + 1])):
            through = torch.exp(-density[i] * deltas[i])
            if abs(depths[i] - distance) <= NEARBY * distance + deltas[i]:
                there = there + light * (1 - through)
            light = light * through
        total = total - torch.log(there.clamp_min(1e-3))
    return total / len(distances)


@pytest.mark.parametrize("scale", [None, 2.5])
@pytest.mark.parametrize(("others", "skipped"), [((), 0), ((7, 0, 40), 0), ((3,), 5)])
def test_equals_autograd_through_a_slow_loop(device, backend, others, skipped, scale):
    need("sparse_depth_gradient", backend, device, torch.float32)
    arguments = case((5, 0, 1, 12, 33, 2), others=others, skipped=skipped)
    rule = {"activated": True} if scale is None else {"density_scale": scale}
    loss, gradient = learnt(arguments, device, factor=0.25, backend=backend, **rule)
    density, depths, deltas, _, offsets, distances = arguments
    exact = density.double().requires_grad_()
    if scale is not None:  # raw values before the softplus
        exact = (scale * torch.expm1(exact.detach() / scale).log() / scale).requires_grad_()
    of_density = exact if scale is None else scale * torch.nn.functional.softplus(exact)
    expected = 0.25 * slow(of_density, depths.double(), deltas.double(), offsets, distances.double())
    expected.backward()
    torch.testing.assert_close(loss.double(), expected.detach(), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(gradient.double(), exact.grad, rtol=1e-4, atol=1e-5)
    assert bool(gradient.any())


def test_what_is_not_finite_stays_in_its_ray(device, backend):
    """A ray with a NaN weight near its point has no gradient; an infinite density gives finite gradients."""
    need("sparse_depth_gradient", backend, device, torch.float32)
    counts = (12, 12, 12, 12)
    arguments = [tensor.clone() for tensor in case(counts)]
    density, depths, deltas, weights, _, distances = arguments
    near = (depths - distances.repeat_interleave(12)).abs() <= NEARBY * distances.repeat_interleave(12) + deltas
    weights[near] += 0.1
    fine, rule = learnt(arguments, device, factor=0.25, activated=True, backend=backend), {"factor": 0.25}
    weights[:12][~near[:12]] = torch.nan  # weights of the first ray, away from its point
    density[12:24] = torch.inf
    _, gradient = learnt(arguments, device, **rule, activated=True, backend=backend)
    torch.testing.assert_close(gradient[:12], fine[1][:12])
    assert bool(gradient[12:24].isfinite().all())
    torch.testing.assert_close(gradient[24:], fine[1][24:])
    weights[24:36][near[24:36]] = torch.nan
    loss, gradient = learnt(arguments, device, **rule, activated=True, backend=backend)
    assert bool(loss.isnan()) and not bool(gradient[24:36].any())
    torch.testing.assert_close(gradient[:12], fine[1][:12])


def test_a_ray_whose_point_gets_no_light_has_no_gradient(device, backend):
    need("sparse_depth_gradient", backend, device, torch.float32)
    density, depths, deltas, weights, offsets, distances = case((6, 6, 6))
    weights[6:12] = 0
    distances[2] = torch.nan
    arguments = density, depths, deltas, weights, offsets, distances
    loss, gradient = learnt(arguments, device, factor=1.0, activated=True, backend=backend)
    assert bool(loss.isfinite()) and bool(gradient[:6].any()) and not bool(gradient[6:].any())


@pytest.mark.parametrize("others", [(), (4,)])
def test_no_points(device, backend, others):
    need("sparse_depth_gradient", backend, device, torch.float32)
    loss, gradient = learnt(case((), others=others), device, factor=1.0, activated=True, backend=backend)
    assert float(loss) == 0 and gradient.shape == (sum(others),) and not bool(gradient.any())


def test_does_not_depend_on_the_number_of_threads():
    need("sparse_depth_gradient", "native", torch.device("cpu"), torch.float32)
    arguments = case((9,) * 700)
    on_any_number_of_threads(lambda: learnt(arguments, factor=1.0, density_scale=2.0, backend="native"))
