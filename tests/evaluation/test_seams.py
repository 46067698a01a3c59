"""The seam measure on a ball whose cells are painted differently, and slices through a known density."""

import math
from functools import partial

import pytest
import torch
from helpers import refuses
from torch import nn

from voronerf import VoronoiRouter
from voronerf.data import builtin_scene
from voronerf.evaluation.scores import render_view
from voronerf.evaluation.seams import seam
from voronerf.evaluation.slices import picture_of_density, slice_density, slice_points
from voronerf.fields import MipNeRF, NeRF
from voronerf.rendering.contraction import Contraction
from voronerf.rendering.renderer import Renderer

RADIUS, THICK = 0.6, 800.0


class Ball(nn.Module):
    """An opaque ball with a gradient on it, in a colour of its own."""

    def __init__(self):
        super().__init__()
        self.paint = nn.Parameter(torch.full((3,), 0.3))
        self.thickness = nn.Parameter(torch.tensor(THICK))

    def forward(self, positions, directions, ray_index):
        inside = (positions.norm(dim=-1) < RADIUS).to(positions.dtype)
        return self.paint + 0.2 * positions, inside * self.thickness


@pytest.fixture(scope="module")
def scene():
    return builtin_scene(40)


def painted(*paints, centres=None):
    places = torch.tensor([[-0.4, 0.0, 0.0], [0.4, 0.0, 0.0]]) if centres is None else centres
    router = VoronoiRouter(Ball(), places, coords=lambda positions, *_: positions, shared=["directions"])
    with torch.no_grad():
        router.module.paint += torch.tensor(paints) if paints else 0.0
    return router.eval()


def measure(router, scene, **options):
    return seam(router, scene, partial(render_view_of, router, scene), views=4, **options)


def render_view_of(router, scene, view):
    return render_view(Renderer({"field": router}, samples=128, backend="reference"), scene, view)


def test_a_known_jump(scene):
    for step, options in ((0.05, {}), (0.2, {"margin": 0.1})):
        router = painted((0.0, 0.0, 0.0), (step, 0.0, -2 * step))
        assert measure(router, scene, **options) == pytest.approx(step, rel=0.02)
        assert router.blend == 0


def test_no_seam(scene):
    assert measure(painted(), scene) == pytest.approx(0, abs=1e-6)
    assert measure(painted((0.3, 0.3, 0.3), centres=torch.zeros(1, 3)), scene) == 0
    far = torch.tensor([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0]])
    assert math.isnan(measure(painted((0.0,) * 3, (0.4,) * 3, centres=far), scene))  # no border is visible


def test_more_borders_weigh_by_what_is_seen(scene):
    centres = torch.tensor([[-0.5, -0.1, 0.0], [0.0, 0.0, 0.0], [0.5, 0.1, 0.0]])
    found = measure(painted((0.0,) * 3, (0.1,) * 3, (0.4,) * 3, centres=centres), scene)
    assert 0.1 < found < 0.3


def test_what_was_set_stays_set(scene):
    router = painted((0.0,) * 3, (0.1,) * 3)
    router.blend = 0.07

    def broken(view):
        raise RuntimeError("out of memory")

    with pytest.raises(RuntimeError):
        seam(router, scene, broken)
    assert router.blend == 0.07
    for margin in (0.0, -1.0, math.inf):
        refuses("seam: margin must be positive and finite, got", measure, router, scene, margin=margin)


def test_a_slice(scene):
    router = painted((0.0,) * 3, (0.1,) * 3)
    with torch.no_grad():
        router.module.thickness.copy_(torch.tensor([20.0, 60.0]))
    points = slice_points(scene, axis=1, at=0.5, size=31)
    assert points.shape == (31, 31, 3) and (points[..., 1] - points[0, 0, 1]).abs().max() == 0
    assert points[0, 0, 0] < points[0, 1, 0] and points[0, 0, 2] > points[1, 0, 2]
    assert (points >= scene.box[0]).all() and (points <= scene.box[1]).all()
    density = slice_density(router.train(), points)
    assert router.training
    expected = torch.where(points[..., 0] < 0, 20.0, 60.0) * (points.norm(dim=-1) < RADIUS)
    off_border = points[..., 0].abs() > 1e-5
    assert torch.equal(density[off_border], expected[off_border])
    router.blend = 0.2
    mixed = slice_density(router, points)
    assert ((mixed != density) <= (points[..., 0].abs() < 0.2)).all() and (mixed != density).any()
    refuses("axis must be 0, 1 or 2, got 3", slice_points, scene, axis=3)
    refuses("size must be at least 1, got 0", slice_points, scene, size=0)


def test_the_picture_of_a_slice():
    density = torch.tensor([[0.0, 1.0, 10.0], [100.0, 1e6, math.nan]])
    picture = picture_of_density(density)
    light = picture.float().sum(-1).flatten().tolist()
    assert picture.dtype == torch.uint8 and picture.shape == (2, 3, 3)
    assert light[0] == light[5] < 10 and light[0] < light[1] < light[2] < light[3] == light[4]


@pytest.mark.parametrize("cones", [False, True])
def test_a_slice_through_a_layer_table_and_contracted_space(scene, cones):
    field = (MipNeRF if cones else NeRF)(width=8, depth=2, position_octaves=2)
    router, points = VoronoiRouter(field, torch.randn(4, 3)), slice_points(scene, size=8)
    router.blend = 0.1
    density = slice_density(router, points, cones=cones)
    assert density.shape == (8, 8) and (density > 0).all()
    router.blend = 0.0
    density = slice_density(router, points, cones=cones)
    within, across = Contraction(torch.zeros(3), 10.0), Contraction(torch.zeros(3), 0.5)
    torch.testing.assert_close(slice_density(router, points, cones=cones, contraction=within), density)
    contracted = slice_density(router, points, cones=cones, contraction=across)
    if cones:
        assert not torch.equal(contracted, density)
    else:
        torch.testing.assert_close(contracted, slice_density(router, across.points(points)))
