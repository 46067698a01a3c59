"""The built-in city: what grows, what stays, and that its rays see the first of all solids."""

import numpy as np
import pytest
import torch
from helpers import refuses

from voronerf.app.scenes import SceneError, city_scene, load_scene
from voronerf.app.scenes.builtin.caster import Caster
from voronerf.app.scenes.builtin.city import city_cameras, city_views
from voronerf.app.scenes.builtin.city_solids import TALLEST, city
from voronerf.app.scenes.builtin.opaque import LIGHT
from voronerf.app.scenes.builtin.solids import Sphere, normalised


@pytest.fixture(scope="module")
def scene():
    return city_scene(20, blocks=2, train_views=2, test_views=1)


def street_rays(blocks, count):
    random = np.random.default_rng(0)
    cameras = city_cameras(8, (blocks, blocks), 2, 0)
    origins = cameras.origins.numpy()[random.integers(len(cameras), size=count)]
    targets = random.uniform((-1, -1, 0), (1, 1, 0.5), size=(count, 3)).astype(np.float32)
    return origins, normalised(targets - origins)


def test_other_cameras_see_the_same_city(scene):
    cameras = scene.test.cameras[[0]]
    assert torch.equal(city_views(cameras, (2, 2)).images[0], scene.test.images[0])


@pytest.mark.parametrize("kind", ["from a point", "parallel", "any"])
def test_rays_see_the_first_of_all_solids(kind):
    """Each solid tested alone against every ray gives the same, bit for bit."""
    groups = city((2, 2))
    origins, directions = street_rays(2, 1501)
    if kind == "from a point":
        origins = np.array([[0.3, -2.1, 0.9]], dtype=np.float32)
        directions = normalised(directions + np.array((0, 2, -0.5), dtype=np.float32))
    elif kind == "parallel":
        origins = np.random.default_rng(1).uniform((-1, -1, 1), (1, 1, 2), size=(1501, 3)).astype(np.float32)
        directions = -LIGHT
    solids = [solid for group in groups for solid in group]
    alone = np.stack([Caster([[solid]])(origins, directions)[0] for solid in solids])
    depth, which = Caster(groups)(origins, directions)
    assert np.array_equal(depth, alone.min(axis=0)) and np.array_equal(which, alone.argmin(axis=0))
    assert np.isfinite(depth).mean() > 0.2 and len(np.unique(which)) > 20


def test_a_larger_city_holds_the_smaller_one():
    small, large = city((1, 1))[1], city((3, 3))[1]
    assert [type(solid) for solid in small] == [type(solid) for solid in large]
    away = np.array([s.centre for s in large]) - np.array([s.centre for s in small])
    np.testing.assert_allclose(away, np.broadcast_to((-1, -1, 0), away.shape), atol=1e-6)
    assert len({len(group) for group in city((3, 3))[1:]}) > 1, "blocks differ"


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
    for solid in (solid for group in city((3, 3)) for solid in group):
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


def test_a_rebuilt_block_changes_nothing_else(scene):
    before, after = city((2, 2)), city((2, 2), rebuilt=2)
    changed = [
        index for index, (a, b) in enumerate(zip(before, after)) if [s.centre for s in a] != [s.centre for s in b]
    ]
    assert changed == [3], "the ground comes first"
    other = city_scene(20, blocks=2, train_views=2, test_views=1, rebuilt=2)
    assert other.name == "builtin-city-2x2-rebuilt-2"
    assert torch.equal(other.train.cameras.poses, scene.train.cameras.poses)
    assert 0.02 < float((other.train.images != scene.train.images).any(-1).float().mean()) < 0.9
    assert load_scene("builtin-city:1x1,rebuilt=0", downscale=50).name == "builtin-city-1x1-rebuilt-0"
    for name in ("rebuilt=4", "rebuilt=", "rebuilt=-1", "other=1", ""):
        line = "builtin-city: after the blocks must come rebuilt=0 to rebuilt=3, got"
        refuses(line, load_scene, f"builtin-city:2x2,{name}", error=SceneError)
    refuses("city_scene: rebuilt must be a block of 0 to 3, got 4", city_scene, blocks=2, rebuilt=4)
