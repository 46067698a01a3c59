"""Tests of benchmarks/walks.py: cameras stay inside the box of their walk, and captures load as "inside-out"."""

import pytest
import walks

from voronerf.app.scenes import load_scene


@pytest.mark.parametrize("place", walks.PLACES)
def test_walks_are_seen_from_within(tmp_path, place):
    walks.write_walk(tmp_path, place, 0, views=16, width=40, height=30)
    scene = load_scene(tmp_path)
    assert (len(scene.train), len(scene.test), scene.kind) == (14, 2, "inside-out")
    middle, reach, _ = walks.PLACES[place]
    places = (scene.train.cameras.origins - scene.transform[:3, 3]) @ scene.transform[:3, :3].inverse().T
    assert ((places - places.new_tensor(middle)).abs() < places.new_tensor(reach) + 1e-5).all()
