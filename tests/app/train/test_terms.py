"""Tests of the terms in a training's loss."""

from __future__ import annotations

from dataclasses import replace

import torch

from voronerf.app.scenes import builtin_scene
from voronerf.app.train import TrainConfig, build
from voronerf.nerf import Perspective, Surface


def test_photographs_alone_learn_one_surface_and_not_those_that_face_forward():
    options = ("levels=4", "log2_entries=10")
    computed = builtin_scene(16, train_views=2, test_views=1)
    images = computed.train.images[..., :3].contiguous()
    views = replace(computed.train, images=images)
    around = replace(computed, train=views, box=None, background=None, kind="unbounded")
    ahead = replace(around, kind="forward", contraction=Perspective(torch.zeros(3), torch.eye(3), 1.0, (0.7, 0.7)))

    def surfaces(scene):
        state = build(TrainConfig(steps=1, rays=32, samples=(16,), field_options=options), scene)
        return [vars(term) for term in state.ray_loss.terms if isinstance(term, Surface)]

    assert surfaces(around) == [{"distortion": 0.003, "orientation": 0.01}]
    assert surfaces(ahead) == surfaces(computed) == []
