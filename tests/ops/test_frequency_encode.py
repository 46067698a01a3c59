from __future__ import annotations

import math

import pytest
import torch
from op_cases import refusals

from voronerf.ops import frequency_encode

pytestmark = pytest.mark.op("frequency_encode")


def slow(x, octaves, include_input=True):
    """Encodes the numbers one at a time in float64."""
    rows = []
    for point in x.double().tolist():
        row = list(point) if include_input else []
        for octave in range(octaves):
            row += [math.sin(2**octave * value) for value in point] + [math.cos(2**octave * value) for value in point]
        rows.append(row)
    return torch.tensor(rows, dtype=torch.float64).reshape(len(rows), -1)


@pytest.mark.parametrize(("n", "d", "octaves"), [(1, 3, 10), (17, 3, 4), (65, 1, 3), (9, 5, 1), (7, 3, 0)])
@pytest.mark.parametrize("include_input", [True, False])
def test_matches_a_slow_loop(device, backend, n, d, octaves, include_input):
    x = 4 * torch.rand(n, d) - 2
    encoded = frequency_encode(x.to(device), octaves, include_input=include_input, backend=backend)
    assert encoded.shape == (n, d * (include_input + 2 * octaves))
    torch.testing.assert_close(encoded.double().cpu(), slow(x, octaves, include_input), rtol=0, atol=3e-7)


def test_errors():
    x = torch.rand(4, 3)
    refuses = refusals(frequency_encode, x=x, octaves=2)
    refuses("octaves must be at least 0, got -1", octaves=-1)
    refuses("octaves must be an integer, got float", octaves=2.0)
