"""Tests of the built-in city: its growth, its views, and that rays hit the nearest solid."""

import numpy as np
import pytest
import torch
from helpers import refuses

from voronerf.app.scenes import SceneError, city_scene, load_scene
from voronerf.app.scenes.builtin.caster import Caster
from voronerf.app.scenes.builtin.city import city_cameras
from voronerf.app.scenes.builtin.city_solids import TALLEST, block, city
from voronerf.app.scenes.builtin.pictures import LIGHT, _images, render_views
from voronerf.app.scenes.builtin.solids import Sphere


@pytest.fixture(scope="module")
def scene():
    return city_scene(20, blocks=2, train_views=2, test_views=1)


def test_other_cameras_see_the_same_city(scene):
    cameras = scene.test.cameras[[0]]
    views = render_views(cameras, "view", Caster(city((2, 2)), LIGHT))
    assert torch.equal(views.images[0], scene.test.images[0])


def test_rays_meet_the_first_of_all_solids(monkeypatch):
    """With culling, the rays of views and shadows have the same hits, bit for bit, as without culling."""
    caster, cameras = Caster(city((2, 2)), LIGHT), city_cameras(9, (2, 2), 2, 0)
    indices, tested, first = np.arange(len(caster.solids)), [], caster.first

    def compared(origins, directions, solid, near, start, end):
        depth, hit_solid = first(origins, directions, solid, near, start, end)
        rays = np.broadcast_shapes(origins.shape, directions.shape)[1]
        none = np.zeros_like(indices)
        alone, number = first(origins, directions, indices, none, none, none + rays)
        if directions.shape[1] == 1:  # shadow rays: any hit counts
            assert np.array_equal(np.isinf(depth), np.isinf(alone))
        else:
            assert np.array_equal(depth, alone) and np.array_equal(hit_solid, number)
        tested.append((np.isfinite(depth).mean(), len(np.unique(hit_solid)), (end - start).sum() / rays))
        return depth, hit_solid

    monkeypatch.setattr(caster, "first", compared)
    assert _images(cameras, range(len(cameras)), caster).shape == (8, 9, 9, 4)
    (hit, number, share), (dark, _, shadows) = tested
    assert hit > 0.5 and number > 100 and 0.1 < dark < 0.9
    assert share < 0.1 * len(indices) and shadows < 0.1 * len(indices), "most solids are left out"


def test_a_larger_city_holds_the_smaller_one():
    small, large = city((1, 1))[1:], city((3, 3))[1:]
    assert [type(solid) for solid in small] == [type(solid) for solid in large[: len(small)]]
    shift = np.array([s.centre for s in large[: len(small)]]) - np.array([s.centre for s in small])
    np.testing.assert_allclose(shift, np.broadcast_to((-1, -1, 0), shift.shape), atol=1e-6)
    assert len({len(block(column, 0)) for column in range(3)}) > 1, "blocks differ"


def test_views_are_from_streets_and_from_above(scene):
    assert (len(scene.train), len(scene.test), scene.name) == (8, 4, "builtin-city-2x2")
    heights = scene.train.cameras.origins[:, 2]
    assert bool((heights[::2] < 0.2).all()) and bool((heights[1::2] > TALLEST).all())
    alpha = scene.train.images[..., 3].float().mean((1, 2)) / 255
    assert bool((alpha > 0.15).all()), "every view shows much of the city"
    colours = scene.train.images[..., :3][scene.train.images[..., 3] == 255].float()
    assert float(colours.std(0).mean()) > 25
    assert scene.box[1, :2].tolist() == [1, 1] and float(scene.box[1, 2]) <= TALLEST + 0.1


def test_no_camera_is_in_a_solid():
    cameras = city_cameras(8, (3, 3), 40, 1)
    points = cameras.origins.numpy()
    for solid in city((3, 3)):
        low, high = solid.bounds()
        assert isinstance(solid, Sphere) or not ((points > low) & (points < high)).all(-1).any()


def test_names(scene):
    one = load_scene("builtin-city", downscale=50)
    assert one.name == "builtin-city-1x1" and one.train.images.shape == (40, 2, 2, 4)
    again = city_scene(20, blocks=2, train_views=2, test_views=1)
    assert torch.equal(again.test.images, scene.test.images)
    wide = city_scene(2, blocks=(1, 2), train_views=1, test_views=1)
    assert wide.name == "builtin-city-1x2" and len(wide.train) == 2
    assert torch.allclose(wide.box[1] - wide.box[0], torch.tensor([1.0, 2.0, 0.7]), atol=0.1)
    for name in ("builtin-city:4", "builtin-city:0x0", "builtin-city:2x", "builtin-city:99x99"):
        refuses("builtin-city: blocks must be 1x1, 2x2, 2x4, ... or 32x32, got", load_scene, name, error=SceneError)
    refuses("city_scene: blocks must be 1 to 32, got 0", city_scene, blocks=0)
    refuses("city_scene: size must be >= 1, got 0", city_scene, 0)
