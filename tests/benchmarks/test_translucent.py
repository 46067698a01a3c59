"""The built-in translucent scene against marching, and what makes it translucent."""

import numpy as np
import pytest
from helpers import refuses
from paper.translucent import MEDIA, Medium, bounds, integrate, layered_block, striped_shell, translucent_scene

from voronerf.data import load_scene


@pytest.fixture(scope="module")
def scene():
    return translucent_scene(25)


def contains(medium, points):
    """Whether points [n, 3] lie in a medium."""
    ball = (((points - medium.centre) / medium.radii) ** 2).sum(axis=-1) < 1
    return ball & (points > medium.low).all(axis=-1) & (points < medium.high).all(axis=-1)


def marched(origin, direction, media, steps=60_000):
    """Premultiplied colour and opacity along one ray by many small steps, from the definition of the media."""
    edges = np.linspace(0, 7, steps + 1)
    points = origin + ((edges[1:] + edges[:-1]) / 2)[:, None] * direction
    density = np.zeros(steps)
    glow = np.zeros((steps, 3))
    for medium in media:
        held = contains(medium, points)
        density[held] += medium.density
        glow[held] += medium.density * np.array(medium.colour)
    assert density.min() > -1e-9
    passed = density * (7 / steps)
    through = np.exp(-(passed.cumsum() - passed))
    colour = (through * (7 / steps) * np.exp(-passed / 2)) @ glow
    return np.append(colour, 1 - np.exp(-passed.sum()))


def rays(count, seed=0):
    generator = np.random.default_rng(seed)
    origins = generator.normal(size=(count, 3))
    origins = 4 * origins / np.linalg.norm(origins, axis=-1, keepdims=True)
    directions = generator.normal(size=(count, 3)) * 0.3 - origins
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    return origins.astype(np.float32), directions.astype(np.float32)


def test_rays_against_marching():
    seen = []
    for origin, direction in zip(*rays(20)):
        found = integrate(origin[None], direction[None])[0]
        expected = marched(origin.astype(np.float64), direction.astype(np.float64), MEDIA)
        np.testing.assert_allclose(found, expected, atol=4e-3)
        seen.append(found[3])
    assert 0.1 < np.mean(seen) < 0.9
    batch = integrate(origin[None], np.stack([direction, -direction, direction]))
    np.testing.assert_allclose(batch, [found, [0, 0, 0, 0], found], atol=1e-6)  # what is behind is not seen
    assert integrate(origin[None], np.zeros((0, 3), np.float32)).shape == (0, 4)


def test_a_ball_and_a_shell_by_hand():
    origin, ahead = np.array([[-4.0, 0, 0]], np.float32), np.array([[1.0, 0, 0]], np.float32)
    ball = (Medium((0, 0, 0), (0.5, 1, 1), 2.0, (1.0, 0.5, 0.0)),)
    opacity = 1 - np.exp(-2.0)
    np.testing.assert_allclose(integrate(origin, ahead, ball), [[opacity, opacity / 2, 0, opacity]], atol=1e-6)
    shell = tuple(striped_shell((0, 0, 0), 1.0, 0.1, 3.0, 0, ((1.0, 0, 0), (0, 0, 1.0))))
    wall = 1 - np.exp(-0.3)  # red in front, blue behind
    expected = [[wall, 0, (1 - wall) * wall, 1 - (1 - wall) ** 2]]
    np.testing.assert_allclose(integrate(origin, ahead, shell), expected, atol=1e-5)
    block = tuple(layered_block((-1, -1, -1), (1, 1, 1), 0.5, ((1.0, 0, 0), (0, 1.0, 0))))
    np.testing.assert_allclose(integrate(origin, ahead, block)[0, 3], 1 - np.exp(-1.0), atol=1e-6)
    beside = np.array([[-4.0, 1.5, 0]], np.float32)
    assert not integrate(beside, ahead, block).any()


def test_everything_lies_in_the_box_and_no_density_is_negative():
    box = bounds()
    points = np.random.default_rng(0).uniform(box[0] - 0.2, box[1] + 0.2, size=(200_000, 3))
    density = sum(medium.density * contains(medium, points) for medium in MEDIA)
    assert density.min() > -1e-9
    outside = ((points < box[0]) | (points > box[1])).any(axis=-1)
    assert not density[outside].any() and density[~outside].mean() > 0.1


def test_most_of_what_is_seen_is_translucent(scene):
    alpha = scene.train.images[..., 3]
    inside = alpha > 5
    assert 0.2 < float(inside.float().mean()) < 0.7
    assert float((alpha[inside] < 245).float().mean()) > 0.7
    assert float((alpha > 250).float().mean()) > 0.005  # the opaque seeds
    solid = load_scene("builtin", downscale=4).train.images[..., 3]
    assert float((solid[solid > 5] < 245).float().mean()) < 0.3


def test_shape_and_name(scene):
    assert scene.train.images.shape == (100, 25, 25, 4) and scene.test.images.shape == (25, 25, 25, 4)
    assert (scene.name, scene.near, scene.far, scene.background) == ("translucent", 2, 6, "white")
    refuses("translucent_scene: size must be >= 1, got 0", translucent_scene, 0)
