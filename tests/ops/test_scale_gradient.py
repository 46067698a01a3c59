"""Gradients of samples near the camera."""

from __future__ import annotations

import pytest
import torch
from helpers import on_any_number_of_threads
from op_cases import need, strided

from voronerf.ops import scale_gradient

pytestmark = pytest.mark.op("scale_gradient")


@pytest.mark.parametrize(("m", "c"), [(0, 4), (1, 4), (5, 0), (1023, 3), (2049, 4)])
def test_equals_a_slow_loop(device, backend, m, c):
    need("scale_gradient", backend, device, torch.float32)
    gradient, depths = torch.randn(m, c), 3 * torch.rand(m)
    expected = [[value * min((depth / 2) ** 2, 1.0) for value in row] for row, depth in zip(gradient, depths.tolist())]
    found = gradient.to(device, copy=True)
    scale_gradient(found, strided(depths.to(device)), 2.0, backend=backend)
    torch.testing.assert_close(found.cpu(), torch.tensor(expected).reshape(m, c), rtol=1e-6, atol=0)
    assert bool((found.cpu() == gradient)[depths >= 2].all())


def test_threads_and_the_reference_make_no_difference():
    need("scale_gradient", "native", torch.device("cpu"), torch.float32)
    gradient, depths = torch.randn(5000, 4), 3 * torch.rand(5000)

    def call(backend="native"):
        found = gradient.clone()
        scale_gradient(found, depths, 1.7, backend=backend)
        return found

    on_any_number_of_threads(call)
    depths[7] = torch.nan
    torch.testing.assert_close(call(), call("reference"), rtol=0, atol=0, equal_nan=True)
