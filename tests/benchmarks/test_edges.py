"""Tests of benchmarks/edges.py: the measures of silhouettes, plain patches and holes, for a ball in front of a wall."""

from __future__ import annotations

import math
from dataclasses import replace

import edges
import pytest
import torch

from voronerf import OccupancyGrid
from voronerf.app.scenes import builtin_scene
from voronerf.nerf import Cameras, Occupancy, Renderer
from voronerf.nerf.cameras import look_at

BOX = torch.tensor([[-3.0, -3, -3], [3, 3, 3]])


def figures(fur=0.0, bumps=0.0, hole=0.0):
    """Measures a ball of radius 0.4 with half-transparent fur, in front of a wall with bumps and a hole."""

    def field(positions, directions, ray_index):
        x, y, z = positions.unbind(-1)
        radius = positions.norm(dim=-1)
        wall = z < -1.5 + bumps * torch.sin(40 * x) * torch.cos(40 * y)
        wall &= positions[:, :2].norm(dim=-1) >= hole
        hair = (radius > 0.4) & (radius < 0.4 + fur)
        density = torch.where((radius < 0.4) | wall, 1e3, torch.where(hair, 2.0, 0.0))
        return torch.full_like(positions, 0.5), density

    pose = look_at(torch.tensor([[0.0, 0.0, 3.0]]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    cameras = Cameras(pose, torch.tensor([[90.0, 90, 48, 48]]), 96, 96)
    scene = builtin_scene(8, train_views=2, test_views=1)
    views = replace(scene.test, cameras=cameras, images=torch.full((1, 96, 96, 3), 128, dtype=torch.uint8))
    scene = replace(scene, test=views, background=None, box=None, near=1.0, far=6.0)
    sampler = Occupancy(OccupancyGrid(BOX, 8, threshold=0.1), 512)
    return edges.measure_views(Renderer({"field": field}, sampler), scene)


@pytest.fixture(scope="module")
def clean():
    return figures()


def test_of_clean_surfaces(clean):
    assert clean["half"] < 0.01 and clean["rough"] < 0.5 and clean["holes"] == 0


def test_hair_is_half_transparent(clean):
    assert 0.05 < figures(fur=0.1)["half"] < 0.5


def test_bumps_are_rough(clean):
    assert figures(bumps=0.1)["rough"] > 3 * clean["rough"]


def test_holes_are_counted():
    seen = (90 * 1.0 / 6) ** 2 - (90 * 0.4 / 3) ** 2  # the visible far end of a hole of radius 1, around the ball
    assert figures(hole=1.0)["holes"] == pytest.approx(100 * math.pi * seen / 96**2, abs=0.2)
