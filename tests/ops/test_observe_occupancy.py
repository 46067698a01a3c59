from __future__ import annotations

import math

import pytest
import torch
from op_cases import refusals, strided

from voronerf.nerf import Contraction, Perspective
from voronerf.ops import observe_occupancy

pytestmark = pytest.mark.op("observe_occupancy")
BOX = torch.tensor([[-1.0, 0.0, -1.0], [1.0, 3.0, 1.0]])


SPACES = {
    "world": None,
    "sphere": Contraction(torch.tensor([0.25, 1.0, 0.0]), 0.75),
    "perspective": Perspective(torch.rand(3), torch.eye(3), 0.5, (0.5, 0.25)),
}


def slow(density, positions, sigma, deltas, weights, decay, hidden, stretch):
    """Observes one sample at a time; collects the samples of each cell in a dictionary."""
    results = {}
    for place, *sample in zip(*(part.tolist() for part in (positions, sigma, deltas, weights, stretch))):
        if sample[1] == 0:  # a sample of length 0 belongs to no ray
            continue
        cell = []
        for axis, size in enumerate(density.shape):
            low, high = BOX[:, axis].tolist()
            share = (place[axis] - low) / (high - low)
            cell.append(0 if math.isnan(share) else int(min(max(share * size, 0), size - 1)))
        value = math.inf if math.isnan(sample[0]) else sample[0]
        seen = sample[2] > hidden * -math.expm1(-value * sample[1])
        results.setdefault(tuple(cell), []).append(value * sample[3] if seen else 0.0)
    result = density.clone()
    for cell, values in results.items():
        result[cell] = max(float(density[cell] * decay), *values)
    return result


@pytest.mark.parametrize(("shape", "m"), [((3, 4, 5), 0), ((3, 4, 5), 1), ((1, 1, 1), 9), ((5, 6, 7), 2001)])
@pytest.mark.parametrize(("decay", "space"), [(0.0, "sphere"), (0.75, "world"), (1.0, "world"), (0.5, "perspective")])
def test_equals_a_slow_loop(device, backend, shape, m, decay, space):
    density = 2 * torch.rand(shape)
    # Exact binary fractions that avoid cell borders; some positions lie outside the box.
    positions = BOX[0] + (BOX[1] - BOX[0]) * (torch.randint(-9, 137, (m, 3)) / 128 + 1 / 1024)
    sigma, deltas = 3 * torch.rand(m) * (torch.rand(m) < 0.7), torch.rand(m)
    weights = 0.02 * torch.rand(m) * (torch.rand(m) < 0.8)
    deltas[2::7] = 0.0
    sigma[::50], positions[3::50, 1] = torch.nan, torch.nan
    contraction = SPACES[space]
    # A NaN position counts as far away.
    far = positions.nan_to_num(1e9)
    stretch = torch.ones(m) if contraction is None else contraction.stretch(far.double())
    expected = slow(density, positions, sigma, deltas, weights, decay, 0.01, stretch)
    actual, occupied = density.to(device, copy=True), (density >= 0.9).to(device)
    samples = [strided(tensor.to(device)) for tensor in (positions, sigma, deltas, weights)]
    arguments = [tensor.clone() for tensor in samples]
    numbers = None if contraction is None else contraction.numbers.to(device)
    rule = {"decay": decay, "threshold": 0.9, "hidden": 0.01, "contraction": numbers, "backend": backend}
    observe_occupancy(actual, occupied, BOX.to(device), *samples, **rule)
    rounding = {"rtol": 0 if contraction is None else 1e-3, "atol": 0}
    torch.testing.assert_close(actual.cpu(), expected, **rounding)
    assert torch.equal(occupied, actual >= 0.9)
    for before, after in zip(arguments, samples):
        torch.testing.assert_close(after, before, rtol=0, atol=0, equal_nan=True)


def test_samples_without_rays_are_seen_and_fixed_cells_stay(device, backend):
    density = 2 * torch.rand(5, 6, 7)
    positions, sigma = BOX[0] + (BOX[1] - BOX[0]) * torch.rand(500, 3), 3 * torch.rand(500)
    sigma[::50] = torch.nan
    fixed = torch.rand(5, 6, 7) < 0.3
    arguments = positions, sigma, torch.ones(500), torch.ones(500), torch.ones(500)
    for kept in (fixed, None):
        expected = slow(density, *arguments[:4], 0.5, 0.0, arguments[4])
        expected = expected if kept is None else torch.where(kept, density, expected)
        actual, occupied = density.to(device, copy=True), (density >= 0.9).to(device)
        rule = {"decay": 0.5, "threshold": 0.9, "hidden": 0.0, "backend": backend}
        samples = (strided(tensor.to(device)) for tensor in arguments[:2])
        there = None if kept is None else strided(kept.to(device))
        observe_occupancy(actual, occupied, BOX.to(device), *samples, **rule, fixed=there)
        assert torch.equal(actual.cpu(), expected)
        assert torch.equal(occupied.cpu(), expected >= 0.9)


def test_refuses_what_makes_no_sense():
    density, occupied = torch.rand(2, 3, 4), torch.ones(2, 3, 4, dtype=torch.bool)
    samples = {"positions": torch.rand(5, 3), "sigma": torch.rand(5), "deltas": torch.rand(5), "weights": torch.rand(5)}
    numbers = {"decay": 0.5, "threshold": 1.0, "hidden": 0.01}
    refuses = refusals(observe_occupancy, density=density, occupied=occupied, box=BOX, **samples, **numbers)
    refuses("density must be contiguous, got strides (1, 2, 6)", density=torch.rand(4, 3, 2).permute(2, 1, 0))
    refuses("deltas and weights must be given together, got no weights", weights=None)
    refuses("decay must lie in 0 to 1, got -1", decay=-1)
    none = {"density": torch.rand(0, 3, 4), "occupied": torch.ones(0, 3, 4, dtype=torch.bool)}
    refuses("density must have at least one cell, got [0, 3, 4]", **none)
