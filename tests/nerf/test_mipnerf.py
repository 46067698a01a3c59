"""Tests of mip-NeRF: its encoding, its heads, and its cells, which are chosen by the Gaussians' means."""

import torch
import torch.nn.functional as F
from helpers import refuses, seeded

from voronerf.nerf.fields import MipNeRF
from voronerf.ops import integrated_encode
from voronerf.router import VoronoiRouter


def gaussians(n, seed=0):
    generator = seeded(seed)
    means = 2 * torch.rand(n, 3, generator=generator) - 1
    return torch.cat((means, 0.02 * torch.rand(n, 3, generator=generator)), dim=1)


def directions(n):
    return F.normalize(torch.randn(n, 3, generator=seeded(9)), dim=1)


def test_mipnerf_layer_by_layer():
    field = MipNeRF(width=16, depth=3, position_octaves=5, view_directions=False).double()
    x = gaussians(40).double()
    h = integrated_encode(x[:, :3], x[:, 3:], 5)
    for layer in field.trunk:
        h = layer(h).relu()
    colour, density = field(x)
    torch.testing.assert_close(colour, torch.sigmoid(field.colour(h)))
    torch.testing.assert_close(density, 10 * F.softplus(field.density(h)[:, 0]))


def test_wide_gaussians_hide_what_is_finer():
    """Octaves that a Gaussian cannot resolve do not change the result."""
    field = MipNeRF(width=16, depth=2, view_directions=False)
    x = gaussians(30)
    x[:, 3:] = 0.5
    before = field(x)[1]
    with torch.no_grad():
        field.trunk[0].weight[:, 6 * 5 :] += 1.0
    torch.testing.assert_close(field(x)[1], before)
    x[:, 3:] = 0
    assert not torch.allclose(field(x)[1], before)


def test_shapes_are_checked():
    router = VoronoiRouter(MipNeRF(width=8, depth=1, position_octaves=2), torch.zeros(2, 3))
    refuses("positions must have shape [n, 6], got [4, 3]", router, torch.zeros(4, 3), directions(4))
    rule = "coords must have shape [..., 3], got [4, 6]"
    refuses(rule, router, gaussians(4), directions(4), coords=gaussians(4))
