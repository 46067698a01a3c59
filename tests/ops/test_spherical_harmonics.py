from __future__ import annotations

import math

import pytest
import torch
from op_cases import refusals

from voronerf.ops import spherical_harmonics

pytestmark = pytest.mark.op("spherical_harmonics")


def directions_of(n):
    return torch.nn.functional.normalize(torch.randn(n, 3, dtype=torch.float64), dim=1)


def legendre(band, order, z):
    """Computes the associated Legendre function of z = cos(theta), with Condon-Shortley phase, by its recurrence."""
    before, value = 0.0, (-1) ** order * math.prod(range(1, 2 * order, 2)) * math.sqrt(1 - z * z) ** order
    for l in range(order + 1, band + 1):
        before, value = value, ((2 * l - 1) * z * value - (l + order - 1) * before) / (l - order)
    return value


def slow(directions, degree):
    """Computes each harmonic of each unit vector by its definition in spherical coordinates."""
    rows = []
    for x, y, z in directions.double().tolist():
        row, angle = [], math.atan2(y, x)
        for band in range(degree):
            for order in range(-band, band + 1):
                m = abs(order)
                norm = math.sqrt((2 * band + 1) / (4 * math.pi) * math.factorial(band - m) / math.factorial(band + m))
                wave = 1 if m == 0 else math.sqrt(2) * (math.cos if order > 0 else math.sin)(m * angle)
                row.append(norm * wave * legendre(band, m, max(-1.0, min(1.0, z))))
        rows.append(row)
    return torch.tensor(rows, dtype=torch.float64).reshape(len(rows), -1)


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_matches_the_definition(device, backend, degree):
    n, directions = 65, directions_of(65)
    result = spherical_harmonics(directions.float().to(device), degree, backend=backend)
    assert result.shape == (n, degree**2)
    torch.testing.assert_close(result.double().cpu(), slow(directions, degree), rtol=0, atol=2e-6)


def test_poles_and_axes(device, backend):
    axes = torch.cat([torch.eye(3), -torch.eye(3)])
    result = spherical_harmonics(axes.to(device), 4, backend=backend)
    torch.testing.assert_close(result.double().cpu(), slow(axes, 4), rtol=0, atol=1e-6)


def tiny_cuda_nn(x, y, z):
    """Returns the polynomials as written in tiny-cuda-nn's kernel_sh (sphericalharmonics.h, degree 4)."""
    xy, xz, yz, x2, y2, z2 = x * y, x * z, y * z, x * x, y * y, z * z
    return [
        0.28209479177387814,
        -0.48860251190291987 * y,
        0.48860251190291987 * z,
        -0.48860251190291987 * x,
        1.0925484305920792 * xy,
        -1.0925484305920792 * yz,
        0.94617469575755997 * z2 - 0.31539156525251999,
        -1.0925484305920792 * xz,
        0.54627421529603959 * x2 - 0.54627421529603959 * y2,
        0.59004358992664352 * y * (-3.0 * x2 + y2),
        2.8906114426405538 * xy * z,
        0.45704579946446572 * y * (1.0 - 5.0 * z2),
        0.3731763325901154 * z * (5.0 * z2 - 3.0),
        0.45704579946446572 * x * (1.0 - 5.0 * z2),
        1.4453057213202769 * z * (x2 - y2),
        0.59004358992664352 * x * (-x2 + 3.0 * y2),
    ]


def test_of_any_length_as_in_tiny_cuda_nn(device, backend):
    x = 4 * torch.rand(40, 3, dtype=torch.float64) - 2
    expected = torch.tensor([tiny_cuda_nn(*row) for row in x.tolist()], dtype=torch.float64)
    actual = spherical_harmonics(x.float().to(device), 4, backend=backend)
    torch.testing.assert_close(actual.double().cpu(), expected, rtol=1e-5, atol=1e-5)


def test_not_a_number_stays_in_its_row(device, backend):
    directions = directions_of(20).float().to(device)
    directions[7, 1] = torch.nan
    result = spherical_harmonics(directions, 4, backend=backend)
    assert result[7, 1].isnan() and result[:7].isfinite().all() and result[8:].isfinite().all()


def test_errors():
    directions = torch.rand(4, 3)
    refuses = refusals(spherical_harmonics, directions=directions, degree=2)
    refuses("degree must be at least 1, got 0", degree=0)
    refuses("degree must be at most 4, got 5", degree=5)
