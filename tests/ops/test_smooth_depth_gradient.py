"""The smoothness loss on depths of unseen rays, compared with autograd through a slow loop."""

from __future__ import annotations

import pytest
import torch
from helpers import on_any_number_of_threads
from op_cases import need

from voronerf.ops import composite, smooth_depth_gradient

pytestmark = pytest.mark.op("smooth_depth_gradient")


def case(counts, skipped=0):
    """Returns samples of rays with ``counts`` samples each, after ``skipped`` samples of no ray."""
    m = sum(counts) + skipped
    offsets = (torch.tensor([0, *counts]).cumsum(0) + skipped).to(torch.int32)
    deltas, density = 0.02 + 0.1 * torch.rand(m), 8 * torch.rand(m)
    depths = torch.cat([1 + torch.rand(skipped), *(1 + part.cumsum(0) for part in deltas[skipped:].split(counts))])
    weights = composite(density, torch.zeros(m, 3), depths, deltas, ray_offsets=offsets, backend="reference").weights
    return density, depths, deltas, weights, offsets, 4 + torch.rand(len(counts))


def learnt(arguments, device="cpu", **rule):
    """Returns the loss, initially 2, and the gradient, initially ones, after the op has added to both."""
    arguments = [tensor.to(device) for tensor in arguments]
    loss, gradient = torch.full_like(arguments[-1].sum(), 2), arguments[0].new_ones(len(arguments[0]), 4)
    smooth_depth_gradient(loss, gradient, *arguments, **rule)
    return loss.cpu(), gradient.cpu()


def slow(density, depths, deltas, offsets, far, triples, hidden):
    """Computes the loss ray by ray in float64, so that autograd can differentiate it."""
    seen = []
    for ray in range(len(far) - 3 * triples, len(far)):
        light, disparity = density.new_ones(()), density.new_zeros(())
        for i in range(int(offsets[ray]), int(offsets[ray + 1])):
            through = torch.exp(-(density[i] if float(light.detach()) > hidden else density[i].detach()) * deltas[i])
            disparity = disparity + light * (1 - through) / depths[i]
            light = light * through
        seen.append(disparity + light / far[ray])
    sides = zip(seen[:triples], seen[triples : 2 * triples], seen[2 * triples :])
    curvatures = [torch.log((one + other) / (2 * middle)) for middle, one, other in sides]
    return sum(2 * 0.05 * ((curvature**2 + 0.05**2) ** 0.5 - 0.05) for curvature in curvatures) / triples


@pytest.mark.parametrize(("scale", "hidden"), [(None, 0.0), (2.5, 0.3)])
@pytest.mark.parametrize(("counts", "skipped", "triples"), [((5, 0, 1, 12, 33, 2, 7), 0, 2), ((4, 9, 30, 3), 5, 1)])
def test_equals_autograd_through_a_slow_loop(device, backend, counts, skipped, triples, scale, hidden):
    need("smooth_depth_gradient", backend, device, torch.float32)
    arguments = case(counts, skipped)
    rule = {"activated": True} if scale is None else {"density_scale": scale}
    rule |= {"triples": triples, "factor": 0.25, "hidden": hidden, "backend": backend}
    loss, gradient = learnt(arguments, device, **rule)
    density, depths, deltas, _, offsets, far = arguments
    exact = density.double().requires_grad_()
    if scale is not None:  # raw values before the softplus
        exact = (scale * torch.expm1(exact.detach() / scale).log() / scale).requires_grad_()
    of_density = exact if scale is None else scale * torch.nn.functional.softplus(exact)
    expected = 0.25 * slow(of_density, depths.double(), deltas.double(), offsets, far.double(), triples, hidden)
    expected.backward()
    torch.testing.assert_close(loss.double(), 2 + expected.detach(), rtol=1e-5, atol=1e-5)
    begins = int(offsets[len(counts) - 3 * triples])
    assert bool((gradient[:begins] == 1).all() and (gradient[:, :3] == 1).all())
    torch.testing.assert_close(gradient[begins:, 3].double(), 1 + exact.grad[begins:], rtol=1e-4, atol=1e-6)
    assert bool((gradient[begins:, 3] != 1).any())


@pytest.mark.parametrize("backend", ["reference", "native"])
def test_no_triples_change_nothing(backend):
    loss, gradient = learnt(case((3, 2)), triples=0, factor=1.0, activated=True, backend=backend)
    assert float(loss) == 2 and bool((gradient == 1).all())


def test_does_not_depend_on_the_number_of_threads():
    need("smooth_depth_gradient", "native", torch.device("cpu"), torch.float32)
    arguments = case((9,) * 700)
    on_any_number_of_threads(lambda: learnt(arguments, triples=200, factor=1.0, density_scale=2.0, backend="native"))
