"""The rich built-in scene: what stands in it, and that it is seen and lit."""

from helpers import refuses

from voronerf.app.scenes import load_scene, rich_scene
from voronerf.app.scenes.builtin.rich import SOLIDS
from voronerf.app.scenes.builtin.solids import Box, Cylinder, Sphere, Torus


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
    refuses("builtin-rich: size must be >= 1, got 0", rich_scene, 0)


def test_it_is_named_on_the_command_line(monkeypatch):
    import voronerf.app.scenes as data

    monkeypatch.setitem(data.BUILTIN, "builtin-rich", lambda size: size)
    assert load_scene("builtin-rich", downscale=4) == 25
