"""Whole training steps on the emulated device: every CUDA kernel of a step, in the trainer's own order and types."""

import contextlib
from unittest import mock

import pytest
from emulated import emulated

from voronerf.app.scenes import builtin_scene
from voronerf.app.train.config import TrainConfig
from voronerf.app.train.trainer import Trainer

STEPS = 16


SMALL = {
    "nerf": {"depth": 2, "occupancy": False},
    "hashgrid": {"field_options": ("levels=2", "log2_entries=10")},
}


def losses(out, field, precision, *, on_device):
    """Of the steps of a run that splits in the middle."""
    config = TrainConfig(
        out=out, field=field, **SMALL[field], steps=STEPS,
        cells=(4,), split_at=(0.5,), width=16, rays=32, samples=8, lr=0.005,
        reservoir=200, reservoir_batches=8, evaluations=1, precision=precision,
    )  # fmt: skip
    found = []
    with mock.patch("voronerf.app.train.rates.WARMUP", 0.0), emulated() if on_device else contextlib.nullcontext():
        trainer = Trainer(config, builtin_scene(12))
        for trainer.step in range(STEPS):
            if trainer.split_is_due():
                trainer.split()
            found.append(float(trainer.train_step()))
    return found, trainer


@pytest.mark.native
@pytest.mark.parametrize(
    ("field", "precision", "allowed"),
    [("nerf", "fp32", 1e-3), ("nerf", "bf16", 0.05), ("nerf", "fp16", 0.02), ("hashgrid", "fp32", 1e-3)],
)
def test_steps_are_those_of_the_cpu(tmp_path, field, precision, allowed):
    expected, _ = losses(tmp_path / "cpu", field, "fp32", on_device=False)
    found, trainer = losses(tmp_path / "emulated", field, precision, on_device=True)
    assert trainer.router.num_cells == 4
    assert found == pytest.approx(expected, rel=allowed)
    assert found != expected
    if precision == "fp16":
        assert trainer.scaler.get_scale() == 2.0**16, "no step was left out"
