"""Whole training steps on the emulated device: every CUDA kernel of a step, in the trainer's own order and types."""

import contextlib

import pytest
from emulated import emulated

from voronerf.data import builtin_scene
from voronerf.training.config import TrainConfig
from voronerf.training.trainer import Trainer

STEPS = 16


def losses(out, precision, *, on_device):
    """Of the steps of a run that splits in the middle."""
    config = TrainConfig(
        out=out, field="nerf", occupancy=False, steps=STEPS,
        cells=(4,), split_at=(0.5,), width=16, depth=2, rays=32, samples=8, lr=0.005,
        warmup=0.0, reservoir=200, reservoir_batches=8, evaluations=1, precision=precision,
    )  # fmt: skip
    found = []
    with emulated() if on_device else contextlib.nullcontext():
        trainer = Trainer(config, builtin_scene(12))
        for trainer.step in range(STEPS):
            if trainer.split_is_due():
                trainer.split()
            found.append(float(trainer.train_step()))
    return found, trainer


@pytest.mark.native
@pytest.mark.parametrize(("precision", "allowed"), [("fp32", 1e-3), ("bf16", 0.05), ("fp16", 0.02)])
def test_steps_are_those_of_the_cpu(tmp_path, precision, allowed):
    expected, _ = losses(tmp_path / "cpu", "fp32", on_device=False)
    found, trainer = losses(tmp_path / "emulated", precision, on_device=True)
    assert trainer.router.num_cells == 4
    assert found == pytest.approx(expected, rel=allowed)
    assert found != expected
    if precision == "fp16":
        assert trainer.scaler.get_scale() == 2.0**16, "no step was left out"
