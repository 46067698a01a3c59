"""Tests that training steps are the same bit for bit on any number of threads."""

import pytest
import torch
from helpers import on_any_number_of_threads
from tiny_runs import small, steps_of

from voronerf.app.train import build, loop, snapshot
from voronerf.nerf.samplers import SAMPLERS, Stratified
from voronerf.ops._core import backends

HASH = {"field": "hashgrid", "width": 16}
VARIANTS = {
    "nerf": {},
    "hierarchical": {"sampling": "hierarchical", "samples": (67, 6)},
    "cones": {"field": "mipnerf", "contraction": "sphere", "sampling": "hierarchical", "samples": (67, 6)},
    "half": {"precision": "bf16", "assignment": "stochastic"},
    "hash grid in a sphere": HASH | {"contraction": "sphere"},
    "hash grid with occupancy": HASH | {"occupancy": True, "average": 0.9},
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_steps_do_not_depend_on_threads(scene, variant):
    def four_steps():
        # PyTorch splits tensors of 32,768 or more elements among threads; 521 x 67 elements give uneven parts.
        few = {"steps": 4, "rays": 521, "samples": (67,), "depth": 1, "split_at": (2,)}
        state = steps_of(build(small(**{**few, **VARIANTS[variant]}), scene), 4)
        return [tensor for _, tensor in sorted(snapshot(state).tensors.items())]

    on_any_number_of_threads(four_steps, (1, 2, 8))


def test_what_a_sampler_of_the_users_gives_is_checked_in_every_step(scene, monkeypatch):
    class Late(Stratified):
        steps = 0

        def sample(self, *arguments, **more):
            self.steps += 1
            samples = super().sample(*arguments, **more)
            return samples._replace(deltas=samples.deltas[:-8], edges=None) if self.steps == 3 else samples

    monkeypatch.setitem(SAMPLERS, "late", Late)
    state = build(small(sampling="late", steps=5), scene)
    with pytest.raises(ValueError, match="deltas must"):
        loop.train(state)
    assert state.step == 2


def test_torch_on_one_thread():
    """PyTorch runs on one thread within the context, which may be nested; voronerf's ops keep their threads."""
    before = torch.get_num_threads()
    with backends.torch_on_one_thread():
        with backends.torch_on_one_thread():
            assert (torch.get_num_threads(), backends.threads()) == (1, before)
        assert (torch.get_num_threads(), backends.threads()) == (1, before)
    assert (torch.get_num_threads(), backends.threads()) == (before, before)
