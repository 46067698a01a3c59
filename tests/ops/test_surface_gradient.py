"""The loss of rays whose light comes from several surfaces, compared with autograd through a slow loop over pairs."""

from __future__ import annotations

import itertools

import pytest
import torch
from helpers import on_any_number_of_threads
from op_cases import need

from voronerf.ops import composite, surface_gradient

pytestmark = pytest.mark.op("surface_gradient")


def case(counts, skipped=0):
    """Returns samples of rays with ``counts`` samples each, after ``skipped`` samples of no ray."""
    m = sum(counts) + skipped
    offsets = (torch.tensor([0, *counts]).cumsum(0) + skipped).to(torch.int32)
    deltas, density = 0.02 + 0.1 * torch.rand(m), 8 * torch.rand(m)
    apart = deltas * torch.where(torch.rand(m) < 0.3, 4, 1)  # some samples lie behind a gap
    depths = torch.cat([1 + torch.rand(skipped), *(1 + part.cumsum(0) for part in apart[skipped:].split(counts))])
    weights = composite(density, torch.zeros(m, 3), depths, deltas, ray_offsets=offsets, backend="reference").weights
    near = 0.5 + 0.5 * torch.rand(len(counts))
    return density, depths, deltas, weights, offsets, near, 4 + near


def learnt(arguments, device="cpu", **rule):
    """Returns the loss, initially 2, and the gradient, initially ones, after the op has added to both."""
    arguments = [tensor.to(device) for tensor in arguments]
    loss, gradient = torch.full_like(arguments[-1].sum(), 2), arguments[0].new_ones(len(arguments[0]), 4)
    surface_gradient(loss, gradient, *arguments, **rule)
    return loss.cpu(), gradient.cpu()


def slow(density, depths, deltas, offsets, near, far, hidden, distortion, orientation):
    """Computes the loss ray by ray in float64, so that autograd can differentiate it."""
    total = density.new_zeros(())
    for ray in range(len(far)):
        light, lit, scale = density.new_ones(()), [], 1 / (1 / near[ray] - 1 / far[ray])
        for i in range(int(offsets[ray]), int(offsets[ray + 1])):
            if float(light.detach()) <= hidden:
                break
            opacity = 1 - torch.exp(-density[i] * deltas[i])
            place, length = (1 / near[ray] - 1 / depths[i]) * scale, deltas[i] / depths[i] ** 2 * scale
            lit.append((i, light * opacity, opacity, place, length))
            light = light * (1 - opacity)
        for _, weight, _, place, length in lit:
            total = total + distortion * weight**2 * length / 3
            for _, other, _, there, _ in lit:
                total = total + distortion * weight * other * abs(place - there)
        for (i, weight, opacity, *_), (j, _, behind, *_) in itertools.pairwise(lit):
            if depths[j] - depths[i] < deltas[i] + deltas[j]:
                total = total + orientation * weight * (opacity - behind).clamp_min(0) ** 2
    return total / len(far)


@pytest.mark.parametrize(("scale", "hidden"), [(None, 0.0), (2.5, 0.3)])
@pytest.mark.parametrize(("counts", "skipped"), [((5, 0, 1, 12, 33, 2, 7), 0), ((4, 9, 30, 3), 5)])
@pytest.mark.parametrize("factors", [{"distortion": 0.25, "orientation": 0.5}, {"distortion": 0.0, "orientation": 1.0}])
def test_equals_autograd_through_a_slow_loop(device, backend, counts, skipped, scale, hidden, factors):
    need("surface_gradient", backend, device, torch.float32)
    arguments = case(counts, skipped)
    rule = {"activated": True} if scale is None else {"density_scale": scale}
    loss, gradient = learnt(arguments, device, **factors, **rule, hidden=hidden, backend=backend)
    density, depths, deltas, _, *rest = (
        tensor.double() if tensor.is_floating_point() else tensor for tensor in arguments
    )
    exact = density.requires_grad_()
    if scale is not None:  # raw values before the softplus
        exact = (scale * torch.expm1(exact.detach() / scale).log() / scale).requires_grad_()
    of_density = exact if scale is None else scale * torch.nn.functional.softplus(exact)
    expected = slow(of_density, depths, deltas, *rest, hidden, **factors)
    expected.backward()
    torch.testing.assert_close(loss.double(), 2 + expected.detach(), rtol=1e-5, atol=1e-5)
    assert bool((gradient[:skipped] == 1).all() and (gradient[:, :3] == 1).all())
    torch.testing.assert_close(gradient[:, 3].double(), 1 + exact.grad, rtol=1e-4, atol=1e-6)
    assert bool((gradient[skipped:, 3] != 1).any())


@pytest.mark.parametrize("anything", [0.0, float("nan")])
def test_samples_of_no_ray_hold_anything(device, backend, anything):
    """Samples of no ray may hold anything: steps on a GPU allocate more rows than they fill."""
    need("surface_gradient", backend, device, torch.float32)
    *samples, offsets, near, far = case((4, 9, 30, 3), skipped=5)
    offsets, near, far = offsets[:-1], near[:-1], far[:-1]
    rule = {"distortion": 0.25, "orientation": 0.5, "density_scale": 1.0, "backend": backend}
    expected = learnt((*samples, offsets, near, far), device, **rule)
    for tensor in samples:
        tensor[:5] = tensor[-3:] = anything
    loss, gradient = learnt((*samples, offsets, near, far), device, **rule)
    assert torch.equal(loss, expected[0]) and torch.equal(gradient[5:-3], expected[1][5:-3])


@pytest.mark.parametrize("backend", ["reference", "native"])
@pytest.mark.parametrize("counts", [(), (0, 0)])
def test_without_samples_nothing_changes(backend, counts):
    loss, gradient = learnt(case(counts), distortion=1.0, orientation=1.0, activated=True, backend=backend)
    assert float(loss) == 2 and gradient.shape == (0, 4)


def test_does_not_depend_on_the_number_of_threads():
    need("surface_gradient", "native", torch.device("cpu"), torch.float32)
    arguments = case((9,) * 700)
    on_any_number_of_threads(
        lambda: learnt(arguments, distortion=1.0, orientation=1.0, density_scale=2.0, backend="native")
    )
