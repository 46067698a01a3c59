"""Losses along rays and their gradients, carried on to densities, compared with autograd through slow loops."""

from __future__ import annotations

import itertools

import pytest
import torch
from helpers import on_any_number_of_threads
from op_cases import need

from voronerf import ops
from voronerf.ops import composite, rendered_gradient
from voronerf.ops.ray_losses.reference import NEARBY

SPARSE, SMOOTH, SURFACE = OPS = "sparse_depth_loss", "smooth_depth_loss", "surface_loss"
OPTIONS = {SPARSE: {}, SMOOTH: {"triples": 2}, SURFACE: {"distortion": 0.25, "orientation": 0.5}}
ALL = [pytest.param(op, marks=pytest.mark.op(op)) for op in OPS]


def case(counts, outside=(0, 0)):
    """Returns samples of rays with ``counts`` samples each, and samples of no ray before and behind them.

    Some rays are opaque. The points of sparse depths lie among the samples of all rays but the last two.
    """
    m = sum(counts) + sum(outside)
    offsets = (torch.tensor([0, *counts]).cumsum(0) + outside[0]).to(torch.int32)
    deltas, density = 0.02 + 0.1 * torch.rand(m), 8 * torch.rand(m)
    apart = deltas * torch.where(torch.rand(m) < 0.3, 4, 1)  # some samples lie behind a gap
    parts = apart.split([outside[0], *counts, outside[1]])
    depths = torch.cat([1 + part.cumsum(0) for part in parts])
    weights = composite(density, torch.zeros(m, 3), depths, deltas, ray_offsets=offsets, backend="reference").weights
    near = 0.5 + 0.5 * torch.rand(len(counts))
    rays = {"near": near, "far": 4 + near, "distances": 1 + 0.8 * torch.rand(max(0, len(counts) - 2))}
    return {"density": density, "depths": depths, "deltas": deltas, "weights": weights, "ray_offsets": offsets, **rays}


def learnt(op, given, backend, device="cpu", hidden=0.0, **options):
    """Returns what an op adds to a loss, and the gradient of the densities that its slopes give."""
    given = {name: value.to(device) for name, value in given.items()}
    names = {SPARSE: ("deltas", "distances"), SMOOTH: ("far",), SURFACE: ("deltas", "near", "far")}[op]
    arguments = {name: given[name] for name in ("depths", "weights", "ray_offsets", *names)}
    arguments |= {**OPTIONS[op], **options, "backend": backend}
    arguments |= {"hidden": hidden} if op == SURFACE else {"factor": 0.25}
    arguments |= {name: torch.full_like(given["density"], 2) for name in slopes_of(op)}
    loss = torch.full_like(given["density"].sum(), 2)
    getattr(ops, op)(loss, **arguments)
    slopes = {name: arguments[name] - 2 for name in slopes_of(op)}
    gradient = torch.zeros(len(given["density"]), 4, device=device)
    along = [given[name] for name in ("density", "depths", "deltas", "weights", "ray_offsets")]
    options = {"hidden": hidden, "activated": True, "backend": "reference"}
    rendered_gradient(gradient, torch.cat((gradient[:, :3], along[0][:, None]), 1), *along, **slopes, **options)
    return loss.cpu() - 2, gradient[:, 3].cpu()


def slopes_of(op):
    return ("of_weights", "of_density") if op == SURFACE else ("of_weights",)


def lit_samples(given, ray, hidden):
    """Yields index, weight and opacity of the samples of a ray that are not hidden, and last the light behind it."""
    density, deltas, offsets = given["density"], given["deltas"], given["ray_offsets"]
    light = density.new_ones(())
    for i in range(int(offsets[ray]), int(offsets[ray + 1])):
        is_hidden = hidden > 0 and float(light.detach()) <= hidden
        opacity = 1 - torch.exp(-(density[i].detach() if is_hidden else density[i]) * deltas[i])
        yield i, light * opacity, None if is_hidden else opacity
        light = light * (1 - opacity)
    yield -1, light, None


def slow_sparse(given, hidden):
    total = given["density"].new_zeros(())
    for ray, distance in enumerate(given["distances"]):
        there = given["density"].new_zeros(())
        for i, weight, _ in [*lit_samples(given, ray, hidden)][:-1]:
            if abs(given["depths"][i] - distance) <= NEARBY * distance + given["deltas"][i]:
                there = there + weight
        total = total - torch.log(there.clamp_min(1e-3))
    return 0.25 * total / len(given["distances"])


def slow_smooth(given, hidden, triples=2):
    seen, far = [], given["far"]
    for ray in range(len(far) - 3 * triples, len(far)):
        *samples, (_, left, _) = lit_samples(given, ray, hidden)
        seen.append(sum(weight / given["depths"][i] for i, weight, _ in samples) + left / far[ray])
    sides = zip(seen[:triples], seen[triples : 2 * triples], seen[2 * triples :])
    curvatures = [torch.log((one + other) / (2 * middle)) for middle, one, other in sides]
    return 0.25 * sum(2 * 0.05 * ((curvature**2 + 0.05**2) ** 0.5 - 0.05) for curvature in curvatures) / triples


def slow_surface(given, hidden):
    depths, deltas, near, far = (given[name] for name in ("depths", "deltas", "near", "far"))
    total = given["density"].new_zeros(())
    for ray in range(len(far)):
        scale, lit = 1 / (1 / near[ray] - 1 / far[ray]), []
        for i, weight, opacity in [*lit_samples(given, ray, hidden)][:-1]:
            if opacity is not None:
                place, length = (1 / near[ray] - 1 / depths[i]) * scale, deltas[i] / depths[i] ** 2 * scale
                lit.append((i, weight, opacity, place, length))
        for _, weight, _, place, length in lit:
            total = total + 0.25 * weight**2 * length / 3
            for _, other, _, there, _ in lit:
                total = total + 0.25 * weight * other * abs(place - there)
        for (i, weight, opacity, *_), (j, _, behind, *_) in itertools.pairwise(lit):
            if depths[j] - depths[i] < deltas[i] + deltas[j]:
                total = total + 0.5 * weight * (opacity - behind).clamp_min(0) ** 2
    return total / len(far)


SLOW = {SPARSE: slow_sparse, SMOOTH: slow_smooth, SURFACE: slow_surface}


@pytest.mark.parametrize("op", ALL)
@pytest.mark.parametrize("hidden", [0.0, 0.3])
@pytest.mark.parametrize(("counts", "outside"), [((5, 0, 1, 12, 33, 2, 7), (0, 0)), ((4, 9, 30, 3, 6, 8), (5, 3))])
def test_equals_autograd_through_a_slow_loop(device, backend, op, counts, outside, hidden):
    need(op, backend, device, torch.float32)
    given = case(counts, outside)
    loss, gradient = learnt(op, given, backend, device, hidden)
    exact = {name: value.double() if value.is_floating_point() else value for name, value in given.items()}
    leaf = exact["density"].requires_grad_()
    expected = SLOW[op](exact, hidden)
    expected.backward()
    torch.testing.assert_close(loss.double(), expected.detach(), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(gradient.double(), leaf.grad, rtol=1e-4, atol=1e-6)
    assert bool(gradient.any())


@pytest.mark.parametrize("op", ALL)
@pytest.mark.parametrize("anything", [0.0, float("nan")])
def test_samples_of_no_ray_hold_anything(device, backend, op, anything):
    """Samples of no ray may hold anything: steps on a GPU allocate more rows than they fill."""
    need(op, backend, device, torch.float32)
    given = case((4, 9, 30, 3, 6, 8), outside=(5, 3))
    expected = learnt(op, given, backend, device)
    for name in ("density", "depths", "deltas", "weights"):
        given[name][:5] = given[name][-3:] = anything
    loss, gradient = learnt(op, given, backend, device)
    assert torch.equal(loss, expected[0]) and torch.equal(gradient[5:-3], expected[1][5:-3])
    assert not bool(gradient[:5].any() or gradient[-3:].any())


@pytest.mark.parametrize("op", ALL)
@pytest.mark.parametrize("counts", [(), (0,) * 6])
def test_without_samples_or_points_only_the_loss_of_darkness_is_added(device, backend, op, counts):
    need(op, backend, device, torch.float32)
    options = {"triples": len(counts) // 3} if op == SMOOTH else {}
    loss, gradient = learnt(op, case(counts), backend, device, **options)
    assert gradient.shape == (0,) and bool(loss.isfinite()) and (op == SURFACE or counts or float(loss) == 0)


@pytest.mark.parametrize("op", ALL)
def test_does_not_depend_on_the_number_of_threads(op):
    need(op, "native", torch.device("cpu"), torch.float32)
    given = case((9,) * 700)
    on_any_number_of_threads(lambda: learnt(op, given, "native"))


@pytest.mark.op(SPARSE)
def test_what_is_not_a_number_stays_in_its_ray(device, backend):
    """A ray with a NaN weight near its point has no slopes, and the loss is NaN."""
    need(SPARSE, backend, device, torch.float32)
    given = case((12, 12, 12, 12, 1, 1))
    points = torch.cat((given["distances"].repeat_interleave(12), torch.full((2,), torch.nan)))
    near = (given["depths"] - points).abs() <= NEARBY * points + given["deltas"]
    given["weights"][near] += 0.1
    arguments = [given[name].to(device) for name in ("depths", "deltas", "weights", "ray_offsets", "distances")]
    clean, spoiled = torch.zeros(2, 50, device=device)
    loss = torch.zeros((), device=device)
    ops.sparse_depth_loss(loss, clean, *arguments, factor=1.0, backend=backend)
    arguments[2][12:24][near[12:24].to(device)] = torch.nan
    ops.sparse_depth_loss(loss, spoiled, *arguments, factor=1.0, backend=backend)
    assert bool(loss.isnan()) and bool(clean[12:24].any()) and not bool(spoiled[12:24].any())
    clean[12:24] = 0
    torch.testing.assert_close(spoiled, clean)


@pytest.mark.op(SPARSE)
def test_a_ray_whose_point_gets_no_light_has_no_gradient(device, backend):
    need(SPARSE, backend, device, torch.float32)
    given = case((6, 6, 6, 1, 1))
    given["weights"][6:12] = 0
    given["distances"][2] = torch.nan
    loss, gradient = learnt(SPARSE, given, backend, device)
    assert bool(loss.isfinite()) and bool(gradient[:6].any()) and not bool(gradient[6:].any())
