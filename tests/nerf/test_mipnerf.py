"""mip-NeRF and the density field: their encodings and heads, and their cells chosen by the mean of a Gaussian."""

import pytest
import torch
import torch.nn.functional as F
from helpers import refuses, seeded

from voronerf.diagram import VoronoiDiagram
from voronerf.nerf.fields import DensityField, MipNeRF
from voronerf.nerf.fields.radiance import INITIAL_DENSITY
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
    """Octaves that a Gaussian cannot resolve have no part in the result."""
    field = MipNeRF(width=16, depth=2, view_directions=False)
    x = gaussians(30)
    x[:, 3:] = 0.5
    before = field(x)[1]
    with torch.no_grad():
        field.trunk[0].weight[:, 6 * 5 :] += 1.0
    torch.testing.assert_close(field(x)[1], before)
    x[:, 3:] = 0
    assert not torch.allclose(field(x)[1], before)


def test_density_field():
    field = DensityField(width=8, depth=2, position_octaves=3)
    assert [tuple(layer.weight.shape) for layer in field.linears()] == [(8, 21), (8, 8), (1, 8)]
    raw = torch.tensor([[-50.0], [0.0], [3.0]])
    colour, density = field.activate(raw)
    assert not colour.any() and colour.shape == (3, 3)
    torch.testing.assert_close(density, 10 * F.softplus(raw[:, 0]))
    with torch.no_grad():
        field.linears()[-1].weight.zero_()
    router = VoronoiRouter(field, VoronoiDiagram(torch.zeros(1, 3)))
    _, density = router(torch.rand(5, 3), directions(5))
    torch.testing.assert_close(density, torch.full((5,), INITIAL_DENSITY))
    refuses("width and depth must be at least 1, got 0 and 2", DensityField, width=0)


@pytest.mark.parametrize("kind", ["mipnerf", "density"])
@pytest.mark.parametrize("assignment", ["nearest", "stochastic", "many", "nested"])
def test_cells_by_the_mean_of_a_gaussian(kind, assignment):
    torch.manual_seed(0)
    if kind == "mipnerf":
        field: torch.nn.Module = MipNeRF(width=8, depth=2, position_octaves=4)
    else:
        field = DensityField(8, 2, 4, position_encoding="integrated")
    k = 300 if assignment == "many" else 7
    diagram = VoronoiDiagram(torch.rand(k, 3) * 2 - 1)
    if assignment == "nested":
        diagram = diagram.refine({2: torch.rand(3, 3) * 2 - 1})[0]
    router = VoronoiRouter(field, diagram, assignment="stochastic" if assignment == "stochastic" else "nearest")
    router.eval()
    with torch.no_grad():
        for parameter in router.parameters():
            parameter += 0.3 * torch.randn_like(parameter)
    x, d = gaussians(200), directions(200)
    colour, density = router(x, d)
    cells = diagram.locate(x[:, :3])
    for cell in cells.unique().tolist():
        rows = cells == cell
        alone = VoronoiRouter(router.cell(cell), VoronoiDiagram(torch.zeros(1, 3)))
        expected = alone(x[rows], d[rows])
        torch.testing.assert_close(colour[rows], expected[0])
        torch.testing.assert_close(density[rows], expected[1], rtol=1e-4, atol=1e-5)
    # Told where they are, they go there instead.
    elsewhere = router(x, d, coords=x[:, :3].flip(0).contiguous())[1]
    assert not torch.allclose(elsewhere, density)
    if assignment == "stochastic":
        router.train()
        router.generator = seeded(0)
        assert router(x, d)[1].shape == (200,)


def test_shapes_are_checked():
    router = VoronoiRouter(MipNeRF(width=8, depth=1, position_octaves=2), torch.zeros(2, 3))
    refuses("positions must have shape [n, 6], got [4, 3]", router, torch.zeros(4, 3), directions(4))
    rule = "coords must have shape [..., 3], got [4, 6]"
    refuses(rule, router, gaussians(4), directions(4), coords=gaussians(4))
