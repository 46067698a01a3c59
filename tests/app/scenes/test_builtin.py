"""Tests of the built-in scene against its own formulas, and of the box carved from its masks."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import refuses

from voronerf.app.scenes import builtin_scene, load_scene
from voronerf.app.scenes.builtin.caster import Caster
from voronerf.app.scenes.builtin.pictures import LIGHT, shaded
from voronerf.app.scenes.builtin.plain import SOLIDS
from voronerf.app.scenes.builtin.solids import Box, Cylinder, Sphere, Torus, rotation
from voronerf.app.scenes.carving import MARGIN, _Silhouette, carve_box
from voronerf.nerf.cameras import Cameras


@pytest.fixture(scope="module")
def scene():
    return builtin_scene(40)


def white(points, normals):
    return np.ones_like(points)


def cast(origins, directions, solids=SOLIDS):
    """Returns (colour [r, 3], depth [r]) of rays; every ray is tested with every solid."""
    caster = Caster(solids, LIGHT)
    origins = np.broadcast_to(origins, directions.shape)
    indices = np.arange(len(solids))
    none = np.zeros_like(indices)
    depth, number = caster.first(origins.T, directions.T, indices, none, none, none + len(origins))
    return shaded(origins, directions, depth, number, caster), depth


def inside(solid, points):
    """Returns which points are in a solid, by its definition, bool [n]."""
    local = points - np.array(solid.centre)
    if solid.turn is not None:
        local = local @ solid.turn
    x, y, z = local.T
    if isinstance(solid, Sphere):
        return x * x + y * y + z * z < solid.radius**2
    if isinstance(solid, Box):
        return (np.abs(local) < solid.half).all(axis=-1)
    if isinstance(solid, Cylinder):
        return (np.hypot(x, y) < solid.radius) & (np.abs(z) < solid.half_height)
    assert isinstance(solid, Torus)
    return np.hypot(np.hypot(x, y) - solid.ring, z) < solid.tube


@pytest.mark.parametrize(
    "solid",
    [
        Sphere((0.1, 0.2, -0.1), white, radius=0.5),
        Box((0.1, 0.0, 0.2), white, turn=rotation("z", 30), half=(0.3, 0.5, 0.2)),
        Cylinder((0.0, 0.1, 0.0), white, turn=rotation("x", 50), radius=0.3, half_height=0.4),
        Torus((0.0, 0.1, 0.1), white, turn=rotation("y", 70), ring=0.4, tube=0.12),
    ],
    ids=lambda solid: type(solid).__name__,
)
def test_hits_against_marching(solid):
    generator = np.random.default_rng(0)
    origins = generator.normal(size=(150, 3))
    origins = (2 * origins / np.linalg.norm(origins, axis=-1, keepdims=True)).astype(np.float32)
    directions = generator.normal(size=(150, 3)) * 0.35 - origins
    directions = (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).astype(np.float32)
    _, depths = cast(origins, directions, [solid])
    steps = np.arange(0.5, 3.5, 1e-3)
    hits = 0
    for origin, direction, distance in zip(origins, directions, depths):
        within = inside(solid, origin + steps[:, None] * direction)
        hits += within.any()
        # A ray without a hit may graze the solid at a few of the tested points.
        assert np.isfinite(distance) or within.sum() < 20
        if within.any() and np.isfinite(distance):
            first = steps[within][0]
            assert distance <= first + 1e-3 and (distance > first - 3e-3 or within.sum() < 60)
    assert 20 < hits < 150
    seen = np.isfinite(depths)
    points = origins[seen] + depths[seen, None] * directions[seen]
    normals, _ = solid.surface(points)
    assert np.abs(np.linalg.norm(normals, axis=-1) - 1).max() < 1e-4
    assert inside(solid, points - 5e-3 * normals).mean() > 0.99
    assert not inside(solid, points + 5e-3 * normals).any()
    box = solid.bounds()
    assert (points >= box[0] - 1e-3).all() and (points <= box[1] + 1e-3).all()


def test_pixels_are_the_average_of_their_rays(scene):
    cameras = scene.test.cameras
    offsets = (torch.arange(3) + 0.5) / 3
    for y, x in ((12, 20), (25, 14), (30, 25), (1, 1)):
        v, u = torch.meshgrid(y + offsets, x + offsets, indexing="ij")
        rays = cameras.rays(4, u.reshape(-1), v.reshape(-1))
        colour, depth = cast(rays.origins[:1].numpy(), rays.directions.numpy())
        expected = colour.mean(axis=0) + 1 - np.isfinite(depth).mean()
        pixel = scene.test.truth(4, torch.ones(3))[y, x]
        assert np.abs(pixel.numpy() - expected).max() < 2.5 / 255


def test_shape_and_determinism(scene):
    assert scene.train.images.shape == (100, 40, 40, 4) and scene.test.images.shape == (25, 40, 40, 4)
    assert (scene.near, scene.far, scene.background) == (2, 6, "white")
    first, again = (builtin_scene(6, train_views=9, test_views=views).train.images for views in (1, 2))
    assert torch.equal(first, again)
    alpha = scene.train.images[..., 3]
    assert 0.3 < float((alpha > 0).float().mean()) < 0.6
    assert ((alpha > 0) & (alpha < 255)).any()  # edges are antialiased
    colours = scene.train.images[..., :3][alpha == 255].float()
    assert float(colours.min()) < 20 and float(colours.max()) == 255
    radius = scene.train.cameras.origins.norm(dim=-1)
    torch.testing.assert_close(radius, torch.full((100,), 4.0), atol=1e-5, rtol=0)
    nearest = torch.cdist(scene.test.cameras.origins, scene.train.cameras.origins).amin(-1)
    assert float(nearest.min()) > 0.02  # no test view is a training view


def test_shadows_are_cast_by_the_same_solids():
    """The floor behind a wall is dark, and the floor on the lamp's side is not."""
    floor = Box((0, 0, -0.1), lambda p, n: np.ones_like(p), gloss=0.0, half=(2.0, 2.0, 0.1))
    wall = Box((0, 0, 0.5), lambda p, n: np.ones_like(p), gloss=0.0, half=(0.3, 0.02, 0.5))
    origin = np.array([[0.0, 0.0, 4.0]], np.float32)
    # The lamp is in direction (0.45, -0.55, 0.70), so shadows fall towards (-x, +y).
    targets = np.array([[-0.2, 0.3, 0.0], [0.2, -0.3, 0.0]], np.float32)
    directions = (targets - origin) / np.linalg.norm(targets - origin, axis=1, keepdims=True)
    colour, depth = cast(origin, directions, [floor, wall])
    np.testing.assert_allclose(depth, np.linalg.norm(targets - origin, axis=1), atol=1e-3)
    assert colour[0, 0] < 0.8 * colour[1, 0]


def test_sizes():
    assert load_scene("builtin", downscale=50).train.images.shape == (100, 2, 2, 4)
    assert builtin_scene(1, train_views=1, test_views=1).train.images.shape == (1, 1, 1, 4)
    refuses("size, train_views and test_views must be >= 1, got 0, 100 and 25", builtin_scene, 0)


def test_carved_box_holds_the_scene_and_is_tight(scene):
    masks = scene.train.images[..., 3]
    wrong = masks.clone()
    wrong[50] = 0  # an empty mask
    for alpha in (wrong, masks):
        box = carve_box(scene.train.cameras, alpha, 2.0, 6.0)
        assert box is not None and scene.box is not None
        assert (box[0] <= scene.box[0]).all() and (box[1] >= scene.box[1]).all()
    sides = float((scene.box[1] - scene.box[0]).max())
    assert (box[1] - scene.box[1]).max() < 0.12 * sides
    # Views from above cannot carve all space below the plinth.
    assert (scene.box[0] - box[0])[:2].max() < 0.12 * sides and (scene.box[0] - box[0])[2] < 0.5 * sides


@pytest.mark.parametrize("k1", [-1.0, 0.8])
def test_box_is_carved_by_masks_of_a_lens(scene, k1):
    straight, masks = scene.train.cameras[:50], scene.train.images[:50, ..., 3]
    lenses = torch.zeros(len(straight), 8)
    lenses[:, 0] = k1
    cameras = replace(straight, distortion=lenses)
    bent = torch.zeros_like(masks)
    for index in range(len(cameras)):  # looks up each ray in the mask without a lens
        rays = cameras.image_rays(index)
        column, row = straight.project(rays.origins + rays.directions, index)[0].floor().long().unbind(-1)
        seen = (column >= 0) & (column < 40) & (row >= 0) & (row < 40)
        bent[index].view(-1)[seen] = masks[index, row[seen], column[seen]]
    carved, expected = carve_box(cameras, bent, 2.0, 6.0), carve_box(straight, masks, 2.0, 6.0)
    assert carved is not None and expected is not None
    assert (carved - expected).abs().max() < 0.02
    without = carve_box(straight, bent, 2.0, 6.0)
    assert without is not None and (without - expected).abs().max() > 0.05


@pytest.mark.parametrize("cut", [False, True])
def test_what_a_picture_does_not_show_may_be_an_object_that_it_cuts(scene, cut):
    lenses = torch.zeros(len(scene.train.cameras), 8)
    lenses[:, 0] = 0.8  # without this lens a camera sees a wider area
    visible = np.zeros((40, 40), dtype=bool)
    visible[18:22, 18:] = cut
    visible[18:22, 18:22] = True
    silhouette = _Silhouette(replace(scene.train.cameras, distortion=lenses), 0, visible, 1)
    straight = silhouette.masks[0][MARGIN:-MARGIN, MARGIN:-MARGIN]
    assert silhouette.shows_all != cut and straight[20, 20] and straight[0, 0] == cut


def test_no_box_without_silhouettes(scene):
    cameras, alpha = scene.train.cameras, scene.train.images[..., 3]
    assert carve_box(cameras, torch.zeros_like(alpha), 2.0, 6.0) is None
    assert carve_box(cameras, torch.full_like(alpha, 255), 2.0, 6.0) is None
    parallel = Cameras(torch.eye(4).repeat(100, 1, 1), cameras.intrinsics, 40, 40)
    assert carve_box(parallel, alpha, 2.0, 6.0) is None
