"""Tests of the NeRF field: its published architecture, its initial state, and its errors."""

import pytest
import torch
import torch.nn.functional as F
from helpers import refuses, seeded
from torch import nn

from voronerf.nerf.fields import KiloNeRF, NeRF
from voronerf.nerf.fields.radiance import INITIAL_DENSITY
from voronerf.ops import frequency_encode


def published_nerf(field, positions, directions):
    """Evaluates figure 7 of the NeRF paper with the field's own layers."""
    x, d = frequency_encode(positions, 10), frequency_encode(directions, 4)
    h = x
    for i, layer in enumerate(field.trunk):
        h = F.relu(layer(h))
        if i == 4:
            h = torch.cat([x, h], -1)
    sigma = F.softplus(field.density(h)[:, 0]) * field.density_scale
    h = F.relu(field.view(torch.cat([field.feature(h), d], -1)))
    return torch.sigmoid(field.colour(h)), sigma


@pytest.fixture
def inputs():
    generator = seeded(0)
    positions = torch.randn(37, 3, generator=generator)
    return positions, F.normalize(torch.randn(37, 3, generator=generator), dim=-1)


def test_is_the_published_architecture(inputs):
    torch.manual_seed(1)
    field = NeRF(width=256, depth=8)
    assert field.trunk[5].in_features == 256 + 63
    assert field.view.in_features == 256 + 27
    assert field.colour.in_features == 128
    rgb, sigma = field(*inputs)
    expected_rgb, expected_sigma = published_nerf(field, *inputs)
    torch.testing.assert_close(rgb, expected_rgb)
    torch.testing.assert_close(sigma, expected_sigma)


@pytest.mark.parametrize("depth", [1, 2, 5, 9])
@pytest.mark.parametrize("view_directions", [True, False])
def test_every_depth_has_gradients_everywhere(inputs, depth, view_directions):
    skips = tuple(s for s in (0, 4) if s < depth - 1)
    field = NeRF(width=7, depth=depth, skips=skips, view_directions=view_directions)
    assert [layer.in_features for layer in field.trunk[1:]] == [7 + 63 * (i in skips) for i in range(depth - 1)]
    rgb, sigma = field(*inputs) if view_directions else field(inputs[0])
    (rgb.sum() + sigma.sum()).backward()
    for name, parameter in field.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name
    assert len(field.linears()) == len(field.layers.layers)
    assert all(isinstance(layer, nn.Linear) for layer in field.linears())


def test_per_ray_directions_equal_expanded_ones(inputs):
    field = NeRF(width=16, depth=2)
    index = torch.arange(37, dtype=torch.int32) // 5
    directions = inputs[1][:8]
    per_ray = field(inputs[0], directions, index)
    expanded = field(inputs[0], directions[index])
    torch.testing.assert_close(per_ray, expanded)


@pytest.mark.parametrize("seed", range(2))
def test_starts_translucent(seed):
    torch.manual_seed(seed)
    _, sigma = NeRF()(torch.randn(500, 3), F.normalize(torch.randn(500, 3), dim=-1))
    assert 0.3 * INITIAL_DENSITY < sigma.mean() < 5 * INITIAL_DENSITY


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"width": 1}, "width must be at least 2, got 1"),
        ({"depth": 0}, "depth must be at least 1, got 0"),
        ({"density_scale": 0.0}, "density_scale must be positive, got 0.0"),
        ({"position_octaves": -1}, "octaves must not be negative"),
        ({"skips": (-1,)}, "skips must be indices of trunk layers before the last"),
        ({"depth": 4, "skips": (3,)}, "0..2, got (3,)"),
    ],
)
def test_bad_settings(settings, message):
    refuses(message, NeRF, **settings)


def test_missing_directions(inputs):
    refuses("directions must be given", NeRF(), inputs[0])


def test_kilonerf_has_the_published_size():
    """Trunk, feature and view layers have 32 channels; encoded positions have 63 columns, encoded directions 27."""
    field = KiloNeRF()
    shapes = [tuple(layer.weight.shape) for layer in field.linears()]
    assert shapes == [(32, 63), (32, 32), (1, 32), (32, 32), (32, 59), (3, 32)]
    colour, density = field(torch.rand(7, 3), torch.nn.functional.normalize(torch.randn(7, 3), dim=1))
    assert colour.shape == (7, 3) and density.shape == (7,)
    assert KiloNeRF(width=16, depth=3, view_directions=False).width == 16
