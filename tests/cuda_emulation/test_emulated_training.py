"""Tests of whole training steps on the emulated device: all CUDA kernels in the training loop's order and dtypes."""

import contextlib
import functools
from unittest import mock

import pytest
from emulated import emulated

from voronerf.app.scenes import builtin_scene
from voronerf.app.train import Callback, TrainConfig, build, train

SMALL = {"nerf": {"depth": 2, "occupancy": False}, "hashgrid": {"field_options": ("levels=2", "log2_entries=10")}}


class Losses(Callback):
    """A callback that stores the loss of every step."""

    def __init__(self):
        self.losses = []

    def after_step(self, state):
        self.losses.append(state.loss)


@functools.cache
def losses(field, precision, *, on_device):
    """Returns the losses of a run's steps and its last state; the run splits in the middle."""
    config = TrainConfig(
        field=field, **SMALL[field], steps=8, cells=(4,), split_at=(0.5,), width=16, rays=32, samples=(8,),
        lr=0.005, evaluations=1, precision=precision,
    )  # fmt: skip
    kept = Losses()
    with mock.patch("voronerf.nerf.schedule.WARMUP", 1e-9), emulated() if on_device else contextlib.nullcontext():
        train(state := build(config, builtin_scene(12)), [kept])
    return kept.losses, state


@pytest.mark.native
@pytest.mark.parametrize(
    ("field", "precision", "allowed"),
    [("nerf", "fp32", 1e-3), ("nerf", "bf16", 0.05), ("nerf", "fp16", 0.02), ("hashgrid", "fp32", 1e-3)],
)
def test_steps_are_those_of_the_cpu(field, precision, allowed):
    expected, _ = losses(field, "fp32", on_device=False)
    found, state = losses(field, precision, on_device=True)
    assert state.router.num_cells == 4 and len(found) == 8
    assert found == pytest.approx(expected, rel=allowed)
    assert found != expected
    if precision == "fp16":
        assert state.scaler.get_scale() == 2.0**16, "no step was left out"
