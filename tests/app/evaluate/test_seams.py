"""The seam measure on a ball whose cells are painted differently."""

import math
from functools import partial

import pytest
import torch
from helpers import refuses, renderer_of
from torch import nn

from voronerf import VoronoiRouter
from voronerf.app.evaluate.scores import render_view
from voronerf.app.evaluate.seams import seam
from voronerf.app.scenes import builtin_scene

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
    return render_view(renderer_of({"field": router}, samples=128, backend="reference"), scene, view)


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
