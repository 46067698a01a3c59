"""The rich built-in scene: its rays are cast by the op, whose tables must mean the same solids as NumPy's."""

import numpy as np
import pytest
from helpers import refuses

from voronerf.backends import BackendUnavailable
from voronerf.data import load_scene, rich_scene
from voronerf.data.builtin.opaque import LIGHT, cast
from voronerf.data.builtin.opaque_solids import SOLIDS as FEW
from voronerf.data.builtin.rich import SOLIDS, caster
from voronerf.data.builtin.solids import Box, Cylinder, Sphere, Torus, first_hits, normalised


def rays(count, seed=0):
    random = np.random.default_rng(seed)
    origins = normalised(random.normal(size=(count, 3)).astype(np.float32)) * np.float32(4)
    targets = random.uniform(-0.7, 0.7, size=(count, 3)).astype(np.float32)
    return origins, normalised(targets - origins)


@pytest.mark.parametrize("solids", [FEW, SOLIDS], ids=["builtin", "rich"])
@pytest.mark.parametrize("name", ["reference", pytest.param("warp", marks=pytest.mark.warp)])
def test_backends_see_what_numpy_sees(name, solids):
    origins, directions = rays(4000)
    depth, which = first_hits(solids, origins, directions)
    found, number = caster(solids, name)(origins, directions)
    hit = np.isfinite(depth)
    assert 0.3 < hit.mean() < 1 and len(np.unique(which[hit])) > len(solids) / 3
    # A ray that grazes a solid may see it or what is behind, by rounding alone: its neighbours see both.
    apart = ~np.isclose(found, depth, rtol=0, atol=1e-3)
    across = normalised(np.cross(directions, LIGHT))
    beside = [first_hits(solids, origins, normalised(directions + s * across))[0] for s in np.float32([-1e-3, 1e-3])]
    grazing = ~np.isclose(*beside, rtol=0, atol=0.02)
    assert not (apart & ~grazing).any()
    assert ((number == which) | apart)[hit].mean() > 0.999
    # One origin or one direction may stand for all, and there may be none.
    single = caster(solids, name)(origins[:1], directions[:50])[0]
    np.testing.assert_allclose(single, first_hits(solids, origins[:1], directions[:50])[0], atol=1e-3)
    assert caster(solids, name)(origins[:0], LIGHT)[0].shape == (0,) == first_hits(solids, origins[:0], LIGHT)[0].shape


def test_every_kind_is_there_often_and_stands_on_the_plinth():
    for kind, least in ((Box, 190), (Sphere, 100), (Cylinder, 35), (Torus, 30)):
        assert sum(isinstance(solid, kind) for solid in SOLIDS) >= least
    lows = [float(solid.bounds()[0, 2]) for solid in SOLIDS[1:]]
    assert min(lows) >= -0.4605, "nothing sinks into the plinth's top at -0.46"


def test_the_scene_is_of_the_usual_form():
    scene = rich_scene(24, train_views=2, test_views=1)
    assert scene.name == "builtin-rich" and scene.train.images.shape == (2, 24, 24, 4) and len(scene.test) == 1
    alpha = scene.test.images[0, ..., 3].float() / 255
    assert 0.15 < float(alpha.mean()) < 0.8 and bool((alpha > 0.99).any()) and bool((alpha == 0).any())
    seen = scene.test.images[0][alpha > 0.99][:, :3].float()
    assert float(seen.std(0).mean()) > 25, "many colours"
    assert scene.box is not None and bool((scene.box[1] > scene.box[0]).all())
    same = rich_scene(24, train_views=2, test_views=1, backend="numpy")
    assert float((scene.test.images.int() - same.test.images.int()).abs().float().mean()) < 0.5
    refuses("rich_scene: size must be >= 1, got 0", rich_scene, 0)
    refuses("no native implementation of cast_solids", rich_scene, 8, backend="native", error=BackendUnavailable)


def test_it_is_named_on_the_command_line(monkeypatch):
    import voronerf.data as data

    monkeypatch.setitem(data.BUILTIN, "builtin-rich", lambda size: size)
    assert load_scene("builtin-rich", downscale=4) == 25


def test_shadows_are_cast_by_the_same_solids():
    """A patch of floor behind a wall, seen from the lamp's side and from above: dark only where the wall stands."""
    floor = Box((0, 0, -0.1), lambda p, n: np.ones_like(p), gloss=0.0, half=(2.0, 2.0, 0.1))
    wall = Box((0, 0, 0.5), lambda p, n: np.ones_like(p), gloss=0.0, half=(0.3, 0.02, 0.5))
    origin = np.array([[0.0, 0.0, 4.0]], np.float32)
    # A point in the wall's shadow: the lamp stands at (0.45, -0.55, 0.70), so shadows fall towards (-x, +y).
    targets = np.array([[-0.2, 0.3, 0.0], [0.2, -0.3, 0.0]], np.float32)
    directions = normalised(targets - origin)
    for hits in (None, caster((floor, wall), "reference")):
        colour, depth = cast(origin, directions, (floor, wall), hits)
        np.testing.assert_allclose(depth, np.linalg.norm(targets - origin, axis=1), atol=1e-3)
        assert colour[0, 0] < 0.8 * colour[1, 0]
