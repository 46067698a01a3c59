"""Tests of benchmarks/room.py: its capture loads like any other, and the measured depth errors are right."""

import numpy as np
import pytest
import room
import torch

from voronerf.app.scenes import load_scene
from voronerf.nerf.renderer import Renderer
from voronerf.nerf.samplers import Stratified


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("room")
    room.write_room(folder, 3, views=16, width=40, height=30)
    return folder


def test_points_and_cameras_are_those_of_the_pictures(folder):
    scene = load_scene(folder)
    assert (len(scene.train), len(scene.test), scene.kind) == (14, 2, "unbounded")
    known, scale = np.load(folder / "depths.npy"), float(torch.linalg.det(scene.transform[:3, :3])) ** (1 / 3)
    sparse, train = scene.train.sparse_depth, scene.train.cameras
    view, rest = sparse.pixels // (40 * 30), sparse.pixels % (40 * 30)
    off = []
    for each in range(len(train)):  # points of training views, projected into a held-out view
        own = rest[view == each]
        rays = train.image_rays(each)
        points = rays.origins[own] + sparse.distances[view == each, None] * rays.directions[own]
        places, ahead = scene.test.cameras.project(points, 0)
        inside = (ahead > 0) & (places >= 0).all(-1) & (places < torch.tensor((40, 30))).all(-1)
        column, row = places[inside].long().unbind(-1)
        away = (points[inside] - scene.test.cameras.poses[0, :3, 3]).norm(dim=-1)
        off.append((away / (scale * torch.from_numpy(known[0])[row, column]) - 1).abs())
    off = torch.cat(off)
    assert off[off < 0.1].median() < 0.02  # the median of the visible points


@pytest.mark.parametrize("density, before", [(0.0, 0.0), (1e6, 1.0)])
def test_light_before_the_surface_of_nothing_and_of_fog(folder, density, before):
    scene = load_scene(folder)

    def field(positions, directions, ray_index):
        return torch.ones_like(positions), torch.full_like(positions[:, 0], density)

    found = room.depth_errors(Renderer({"field": field}, Stratified(8, space=scene.space("none"))), scene, folder)
    assert found["light_before"] == pytest.approx(before, abs=1e-6)
    assert found["depth_error"] > 0.3


def test_a_seed_decides_the_room(folder, tmp_path):
    for seed in (3, 4):
        room.write_room(tmp_path / str(seed), seed, views=16, width=40, height=30)
    first, same, other = (np.load(each / "depths.npy") for each in (folder, tmp_path / "3", tmp_path / "4"))
    assert np.array_equal(first, same) and not np.array_equal(first, other)
