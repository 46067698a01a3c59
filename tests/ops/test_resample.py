from __future__ import annotations

import math

import pytest
import torch
from op_cases import FLOATS, need, refusals, strided

from voronerf.ops import resample

pytestmark = pytest.mark.op("resample")


def slow(weights, edges, targets):
    """Walks along one ray, for each target, to the depth where the accumulated mass reaches the target."""
    if sum(weights) == 0:
        weights = [1.0] * len(weights)
    total, depths = sum(weights), []
    for target in sorted(targets):
        left, index = target * total, 0
        while left > weights[index] or weights[index] == 0:
            left -= weights[index]
            index += 1
        depths.append(edges[index] + (edges[index + 1] - edges[index]) * left / weights[index])
    return depths


def rays(r, s):
    weights = torch.rand(r, s) * (torch.rand(r, s) > 0.4)
    return weights, (0.1 + torch.rand(r, s + 1)).cumsum(dim=1)


@pytest.mark.parametrize(("r", "s", "count"), [(1, 1, 1), (9, 2, 3), (5, 63, 17), (3, 64, 128)])
@pytest.mark.parametrize("given", [False, True])
def test_matches_a_slow_walk(device, backend, r, s, count, given):
    weights, edges = rays(r, s)
    uniforms = torch.rand(r, count)
    depths = resample(
        weights.to(device), edges.to(device), count, uniforms=uniforms.to(device) if given else None, backend=backend
    ).cpu()
    assert depths.shape == (r, count)
    midpoints = [(index + 0.5) / count for index in range(count)]
    for ray in range(r):
        targets = uniforms[ray].tolist() if given else midpoints
        expected = slow(weights[ray].tolist(), edges[ray].tolist(), targets)
        # Rounding of the accumulated mass moves a depth by a fraction of its bin, and more if the bin has little mass.
        share = weights[ray].sum() / weights[ray][weights[ray] > 0].min() if weights[ray].sum() > 0 else 1
        tolerance = float(1e-6 * s * max(1, share) * edges[ray].max())
        torch.testing.assert_close(depths[ray], torch.tensor(expected), rtol=0, atol=tolerance)


@pytest.mark.parametrize("dtype", FLOATS)
def test_depths_rise_and_stay_in_bins_that_have_mass(device, backend, dtype):
    need("resample", backend, device, dtype)
    weights, edges = (tensor.to(device, dtype) for tensor in rays(50, 20))
    weights[:, 7] = 0
    uniforms = torch.rand(50, 40, device=device).to(dtype)
    uniforms[:, 0], uniforms[:, 1] = 0, 1
    depths = resample(strided(weights), strided(edges), 40, uniforms=strided(uniforms), backend=backend)
    assert depths.dtype == dtype
    assert (depths.diff(dim=1) >= 0).all()
    assert (depths >= edges[:, :1]).all() and (depths <= edges[:, -1:]).all()
    inside = (depths > edges[:, 7:8]) & (depths < edges[:, 8:9])
    assert not inside[weights.sum(dim=1) > 0].any()


def test_converges_to_the_density(device, backend):
    weights = torch.tensor([[1.0, 0.0, 3.0]], device=device)
    edges = torch.tensor([[0.0, 1.0, 2.0, 4.0]], device=device)
    depths = resample(weights, edges, 4000, backend=backend)
    # A quarter of the mass is in the first bin, three quarters are in the last, distributed evenly in each bin.
    assert (depths < 1).double().mean().item() == pytest.approx(0.25, abs=1e-3)
    assert (depths > 3).double().mean().item() == pytest.approx(0.375, abs=1e-3)
    assert depths.mean().item() == pytest.approx(0.25 * 0.5 + 0.75 * 3, abs=1e-3)


@pytest.mark.parametrize(
    ("weights", "expected"),
    [
        # Rays without weight are drawn evenly over the bins.
        *(([value] * 4, [0.5, 1.5, 3.0, 6.0]) for value in (0.0, -1.0, math.nan, math.inf)),
        ([math.nan, 1.0, -3.0, math.inf], [1.125, 1.375, 1.625, 1.875]),  # weights that are no weights count as zero
        *(([value, value, 0.0, 0.0], [0.25, 0.75, 1.25, 1.75]) for value in (3e38, 1e-45)),  # the ends of float32
    ],
)
def test_special_weights(device, backend, weights, expected):
    edges = torch.tensor([[0.0, 1.0, 2.0, 4.0, 8.0]], device=device)
    depths = resample(torch.tensor([weights], device=device), edges, 4, backend=backend)
    torch.testing.assert_close(depths.cpu(), torch.tensor([expected]))


def test_uniforms_at_and_beyond_the_ends(device, backend):
    weights, edges = torch.tensor([[0.0, 1, 0, 1, 0]], device=device), torch.arange(6.0, device=device)[None]
    uniforms = torch.tensor([[2.0, 1, 0.5, 0, -1]], device=device)
    assert resample(weights, edges, 5, uniforms=uniforms, backend=backend).tolist() == [[1, 1, 3, 4, 4]]
    uniforms = torch.tensor([[0.75, math.nan, 0.25]], device=device)
    depths = resample(weights, edges, 3, uniforms=uniforms, backend=backend)[0]
    assert depths[:2].tolist() == [1.5, 3.5] and depths[2].isnan()


def test_carries_no_gradient(device, backend):
    weights, edges = (tensor.to(device).requires_grad_() for tensor in rays(2, 5))
    assert not resample(weights, edges, 3, backend=backend).requires_grad


def test_errors():
    weights, edges = rays(4, 5)
    refuses = refusals(resample, weights=weights, edges=edges, count=3)
    refuses("weights must have at least one bin, got none", weights=weights[:, :0], edges=edges[:, :1])
