from __future__ import annotations

import pytest
import torch
from op_cases import refusals

from voronerf.ops import frequency_encode, integrated_encode

pytestmark = pytest.mark.op("integrated_encode")


def test_is_the_mean_of_the_encoding_over_the_gaussian(device, backend):
    mean, deviation = torch.tensor([[0.3, -1.0, 2.0]]), torch.tensor([[0.05, 0.2, 0.6]])
    normal = torch.randn(200_000, 3, dtype=torch.float64)
    drawn = frequency_encode(mean + deviation * torch.cat([normal, -normal]), 3, include_input=False).mean(dim=0)
    encoded = integrated_encode(mean.to(device), deviation.square().to(device), 3, backend=backend)
    # The tolerance is five times the largest standard error of 400,000 samples between -1 and 1.
    torch.testing.assert_close(encoded[0].double().cpu(), drawn, rtol=0, atol=5 / 400_000**0.5)


def test_without_variance_is_the_frequency_encoding(device, backend):
    means = torch.rand(33, 3, device=device)
    result = integrated_encode(means, torch.zeros_like(means), 5, backend=backend)
    torch.testing.assert_close(result, frequency_encode(means, 5, include_input=False), rtol=0, atol=1e-6)


def test_errors():
    means = torch.rand(4, 3)
    refuses = refusals(integrated_encode, means=means, variances=means, octaves=2)
    refuses("octaves must be at least 0, got -2", octaves=-2)
