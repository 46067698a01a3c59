from __future__ import annotations

import math

import pytest
import torch
from op_cases import refusals, strided

from voronerf.ops import balance_centres

pytestmark = pytest.mark.op("balance_centres")


def samples(m):
    points = torch.nn.functional.normalize(torch.randn(m, 3), dim=1) * (1 + 0.05 * torch.randn(m, 1))
    return points, torch.randn(m, dtype=torch.float64).exp() * (1 + 3 * points[:, 0].clamp(min=0))


def slow(points, masses, centres, steps, alpha, nearby):
    """Balances in loops over samples and neighbours; centres are rounded to float32 between the steps."""

    def weigh():
        weights = [0.0] * len(places)
        for point, mass in zip(points.tolist(), masses.tolist()):
            weights[min(range(len(places)), key=lambda i: math.dist(point, places[i]))] += mass
        return weights

    places = centres.tolist()
    for _ in range(steps):
        weights, moved = weigh(), []
        for i, place in enumerate(places):
            others = sorted((j for j in range(len(places)) if j != i), key=lambda j: math.dist(place, places[j]))
            others = others[:nearby]
            heaviest = max(weights[j] for j in [i, *others])
            pulls = [(weights[j] - weights[i]) / heaviest if heaviest > 0 else 0.0 for j in others]
            shift = [sum((places[j][axis] - place[axis]) * p for j, p in zip(others, pulls)) for axis in range(3)]
            moved.append([place[axis] + alpha * shift[axis] / len(others) for axis in range(3)])
        places = torch.tensor(moved).tolist()
    return torch.tensor(places), torch.tensor(weigh(), dtype=torch.float64)


@pytest.mark.parametrize(("k", "neighbours"), [(2, 8), (5, 2), (9, 8), (20, 8), (12, 1)])
def test_equals_slow_loops(device, backend, k, neighbours):
    points, masses = samples(300)
    arguments = points.to(device), masses.to(device), points[:k].to(device)
    result = balance_centres(*arguments, steps=3, alpha=0.3, neighbours=neighbours, backend=backend)
    centres, weights = slow(points, masses, points[:k], 3, 0.3, neighbours)
    torch.testing.assert_close(result[0].cpu(), centres, rtol=0, atol=2e-6)
    torch.testing.assert_close(result[1].cpu(), weights, rtol=1e-12, atol=1e-12)


def test_balances_and_repeats_itself(device, backend):
    points, masses = samples(2000)
    arguments = points.to(device), masses.to(device), points[:16].to(device)
    start, end = (balance_centres(*arguments, steps=steps, backend=backend) for steps in (0, 300))
    assert torch.equal(start[0], arguments[2])
    before, after = (float((part[1] / part[1].max()).std(correction=0)) for part in (start, end))
    assert before > 0.2 and after < before / 3
    again = balance_centres(*(strided(tensor) for tensor in arguments), steps=300, backend=backend)
    assert torch.equal(again[0], end[0]) and torch.equal(again[1], end[1])


def test_cells_and_samples_without_mass(device, backend):
    points = torch.rand(20, 3, device=device)
    nothing = torch.zeros(20, dtype=torch.float64, device=device)
    centres = torch.rand(4, 3, device=device)
    for masses, rows in ((nothing, 20), (nothing[:0], 0)):
        moved, weights = balance_centres(points[:rows], masses, centres, steps=5, backend=backend)
        assert torch.equal(moved, centres) and torch.equal(weights, torch.zeros_like(weights))
    moved, weights = balance_centres(points, nothing + 1, centres[:1], steps=5, backend=backend)
    assert torch.equal(moved, centres[:1]) and weights.tolist() == [20.0]


def test_refuses_what_makes_no_sense():
    points, masses = samples(5)
    refuses = refusals(balance_centres, samples=points, masses=masses, centres=points[:2])
    refuses("centres must hold at least one centre, got none", centres=points[:0])
    refuses("steps must be at least 0, got -1", steps=-1)
    refuses("neighbours must be at least 1, got 0", neighbours=0)
