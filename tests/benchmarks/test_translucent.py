"""The built-in translucent scene against marching, and what makes it translucent."""

import numpy as np
import pytest
from helpers import refuses
from paper.translucent import MEDIA, integrate, translucent_scene

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
