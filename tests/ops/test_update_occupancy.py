from __future__ import annotations

import pytest
import torch
from op_cases import refusals, refused

from voronerf.ops import update_occupancy

pytestmark = pytest.mark.op("update_occupancy")


def slow(density, cells, values, decay, threshold):
    """One cell at a time."""
    flat = density.reshape(-1)
    result = flat.clone()
    for cell in set(cells.tolist()):
        found = [float(value) for row, value in zip(cells.tolist(), values) if row == cell]
        result[cell] = max(float(flat[cell] * decay), *found)
    return result.reshape(density.shape), result.reshape(density.shape) >= threshold


@pytest.mark.parametrize(("shape", "q"), [((3, 4, 5), 37), ((1, 1, 1), 5), ((2, 1, 3), 0), ((40, 40, 50), 9000)])
@pytest.mark.parametrize("decay", [0.0, 0.75, 1.0])
def test_equals_a_slow_loop(device, backend, decay, shape, q):
    density, values = 2 * torch.rand(shape), torch.rand(q)
    cells = torch.randint(0, density.numel(), (q,), dtype=torch.int32)
    if q > 1000:
        cells = torch.randperm(density.numel())[:q].to(torch.int32)
    given = density.clone()
    found = update_occupancy(
        density.to(device), cells.to(device), values.to(device), decay=decay, threshold=0.5, backend=backend
    )
    assert torch.equal(density, given)
    if q <= 1000:
        expected = slow(density, cells, values, decay, 0.5)
    else:
        expected = update_occupancy(density, cells, values, decay=decay, threshold=0.5, backend="reference")
    for a, b in zip(found, expected):
        assert a.dtype == b.dtype and torch.equal(a.cpu(), b)


def test_infinite_values(device, backend):
    density = torch.tensor([[[1.0, torch.inf, 3.0]]], device=device)
    cells, values = (
        torch.tensor([0, 2], dtype=torch.int32, device=device),
        torch.tensor([torch.inf, 0.0], device=device),
    )
    found = update_occupancy(density, cells, values, decay=0.5, threshold=1.5, backend=backend)
    assert found[0].tolist() == [[[torch.inf, torch.inf, 1.5]]] and bool(found[1].all())


def test_refuses_what_makes_no_sense(device):
    density, cells, values = torch.rand(2, 2, 2), torch.zeros(3, dtype=torch.int32), torch.rand(3)
    for backend in ("reference", "native") if device.type == "cpu" else ():
        with refused(ValueError, "update_occupancy: cells must lie in 0 to 7, got values from 0 to 8"):
            update_occupancy(
                density, cells + torch.tensor([0, 8, 1]).int(), values, decay=0.5, threshold=1, backend=backend
            )
    refuses = refusals(update_occupancy, density=density, cells=cells, values=values, decay=0.5, threshold=1)
    refuses("decay must lie in 0 to 1, got 1.5", decay=1.5)
