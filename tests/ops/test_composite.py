from __future__ import annotations

import math

import pytest
import torch
from helpers import all_pairs
from op_cases import FLOATS, need, offsets_of, strided
from tolerances import assert_as_exact

from voronerf.ops import Composite, composite

pytestmark = pytest.mark.op("composite")

INF, NAN = math.inf, math.nan


def slow(sigma, rgb, depths, deltas, background=None):
    """Composites the samples one at a time in float64."""
    rays = []
    for ray in range(sigma.shape[0]):
        light, colour, opacity, depth, weights = 1.0, rgb.new_zeros(rgb.shape[2], dtype=torch.float64), 0.0, 0.0, []
        for density, value, at, length in zip(
            sigma[ray].tolist(), rgb[ray], depths[ray].tolist(), deltas[ray].tolist()
        ):
            passed = math.exp(-density * length) if length > 0 else 1.0
            weight = light * (1 - passed)
            light *= passed
            colour = colour + weight * value.double()
            opacity += weight
            depth += weight * at
            weights.append(weight)
        if background is not None:
            colour = colour + (1 - opacity) * (background if background.dim() == 1 else background[ray]).double()
        rays.append((colour, opacity, depth, weights))
    return Composite(
        torch.stack([ray[0] for ray in rays]),
        *(torch.tensor([ray[part] for ray in rays], dtype=torch.float64) for part in (1, 2, 3)),
    )


def rays(r, s, c=3, dtype=torch.float32):
    sigma = 5 * torch.rand(r, s) * (torch.rand(r, s) > 0.3)
    return tuple(
        tensor.to(dtype) for tensor in (sigma, torch.rand(r, s, c), torch.rand(r, s).cumsum(1), torch.rand(r, s) / 2)
    )


def pack(tensors, counts):
    return tuple(torch.cat([tensor[ray, :count] for ray, count in enumerate(counts)]) for tensor in tensors)


def composited(form, inputs, device, **options):
    """Composites rays of equal length, as they are or packed."""
    inputs = [tensor.to(device) for tensor in inputs]
    if form == "packed":
        options["ray_offsets"] = offsets_of([inputs[0].shape[1]] * len(inputs[0]), device)
        inputs = [tensor.flatten(0, 1) for tensor in inputs]
    return composite(*inputs, **options)


SIZES = [(1, 1, 3), (5, 33, 3), (3, 64, 1), (2, 7, 5)]


@pytest.mark.parametrize(*all_pairs({"r, s, c": SIZES, "dtype": FLOATS, "form": ["dense", "packed"]}))
def test_matches_a_slow_loop(device, backend, form, dtype, r, s, c):
    need("composite", backend, device, dtype)
    inputs = rays(r, s, c, dtype)
    background = torch.rand(r, c).to(dtype)
    exact = slow(*inputs, background=background)
    actual = composited(form, inputs, device, background=background.to(device), backend=backend)
    for part, expected in zip(actual, exact):
        assert_as_exact(part.reshape(expected.shape), expected.to(dtype), expected)


@pytest.mark.parametrize("counts", [[], [0], [0, 0, 0], [1], [3, 0, 17, 1, 0], [0, 200, 1]])
@pytest.mark.parametrize("with_background", [False, True])
def test_packed_rays_of_any_length_equal_each_ray_alone(device, backend, counts, with_background):
    inputs = rays(len(counts), max(counts, default=0))
    background = torch.tensor([0.2, 0.5, 1.0]) if with_background else None
    packed = pack(inputs, counts) if counts else tuple(tensor.flatten(0, 1) for tensor in inputs)
    actual = composite(
        *(strided(tensor.to(device)) for tensor in packed),
        ray_offsets=offsets_of(counts, device),
        background=None if background is None else background.to(device),
        backend=backend,
    )
    assert actual.colour.shape == (len(counts), 3)
    assert actual.opacity.shape == actual.depth.shape == (len(counts),)
    assert actual.weights.shape == (sum(counts),)
    for ray, count in enumerate(counts):
        exact = slow(*(tensor[ray : ray + 1, :count] for tensor in inputs), background=background)
        torch.testing.assert_close(actual.colour[ray].double().cpu(), exact.colour[0], rtol=0, atol=1e-6)
        torch.testing.assert_close(actual.opacity[ray].double().cpu(), exact.opacity[0], rtol=0, atol=1e-6)
        torch.testing.assert_close(actual.depth[ray].double().cpu(), exact.depth[0], rtol=1e-6, atol=1e-6)


def test_rays_without_samples_show_the_background(device, backend):
    inputs = tuple(tensor.to(device) for tensor in rays(4, 0))
    background = torch.rand(4, 3, device=device)
    result = composite(*inputs, background=background, backend=backend)
    assert torch.equal(result.colour, background)
    assert result.opacity.tolist() == result.depth.tolist() == [0, 0, 0, 0]
    assert composite(*(tensor[:0] for tensor in inputs), backend=backend).colour.shape == (0, 3)


def test_samples_outside_all_rays_count_for_nothing(device, backend):
    inputs = tuple(tensor.to(device) for tensor in pack(rays(1, 9), [9]))
    offsets = torch.tensor([2, 5, 7], dtype=torch.int32, device=device)
    result = composite(*inputs, ray_offsets=offsets, backend=backend)
    alone = composite(*(tensor[2:7] for tensor in inputs), ray_offsets=offsets - 2, backend=backend)
    torch.testing.assert_close(result.colour, alone.colour, rtol=0, atol=1e-6)
    torch.testing.assert_close(result.opacity, alone.opacity, rtol=0, atol=1e-6)


@pytest.mark.parametrize("form", ["dense", "packed"])
def test_infinite_density_is_opaque_and_hides_what_follows(device, backend, form):
    sigma = torch.tensor([[1.0, INF, INF, 2.0], [INF, INF, 0.0, 1.0]])
    deltas = torch.tensor([[0.5, 0.5, 0.5, 0.5], [0.0, 1e30, 1.0, 1.0]])
    rgb, depths = torch.rand(2, 4, 3), torch.arange(8.0).reshape(2, 4)
    inputs = [tensor.to(device).requires_grad_() for tensor in (sigma, rgb, depths, deltas)]
    actual = composited(form, inputs, device, backend=backend)
    first = 1 - math.exp(-0.5)
    expected = torch.tensor([[first, 1 - first, 0, 0], [0, 1, 0, 0]])
    torch.testing.assert_close(actual.weights.reshape(2, 4).cpu(), expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(actual.opacity.cpu(), torch.ones(2), rtol=0, atol=1e-6)
    sum(part.sum() for part in actual).backward()
    assert all(tensor.grad.isfinite().all() for tensor in inputs)


@pytest.mark.parametrize("form", ["dense", "packed"])
def test_an_opaque_ray_costs_the_rays_behind_it_no_digits(device, backend, form):
    inputs = rays(40, 30)
    inputs[0][::2] = 1e30
    exact = slow(*inputs)
    actual = composited(form, inputs, device, backend=backend)
    torch.testing.assert_close(actual.weights.reshape(40, 30).double().cpu(), exact.weights, rtol=0, atol=1e-6)


@pytest.mark.parametrize("form", ["dense", "packed"])
@pytest.mark.parametrize(("where", "bad"), [*((where, NAN) for where in range(4)), (1, INF), (2, -INF)])
def test_what_is_not_a_number_spoils_its_own_ray_alone(device, backend, form, where, bad):
    clean = rays(5, 6)
    spoiled = tuple(tensor.clone() for tensor in clean)
    spoiled[0][2, 3] = spoiled[3][2, 3] = 1
    spoiled[where][2, 3] = bad
    results = []
    for inputs in (clean, spoiled):
        leaves = [tensor.to(device).requires_grad_() for tensor in inputs]
        result = composited(form, leaves, device, background=torch.ones(3, device=device), backend=backend)
        sum(part.sum() for part in result).backward()
        parts = [part.detach().reshape(5, -1) for part in result] + [leaf.grad.reshape(5, -1) for leaf in leaves]
        results.append(torch.cat(parts, dim=1).cpu())
    others = [0, 1, 3, 4]
    torch.testing.assert_close(results[1][others], results[0][others], rtol=1e-5, atol=1e-6)
    assert results[1][2].isnan().any()


@pytest.mark.parametrize("form", ["dense", "packed"])
def test_a_spoiled_density_spoils_the_weights_from_there_on(device, backend, form):
    inputs = rays(1, 5)
    inputs[0][0, 2] = NAN
    weights = composited(form, inputs, device, backend=backend).weights
    assert weights.flatten().isnan().tolist() == [False, False, True, True, True]
