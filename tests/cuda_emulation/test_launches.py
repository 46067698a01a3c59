"""What a training step asks of a GPU, counted without one: launches, and reads of the host, which wait for it."""

import pytest
import torch
from emulated import emulated
from launches import asked

import voronerf
from voronerf.data import builtin_scene
from voronerf.training.config import TrainConfig
from voronerf.training.trainer import Trainer

LAUNCHES, READS = 29, 1
"""Of a default step. These go down only: at the aim there are no reads."""


def test_what_is_asked_is_counted():
    with asked() as counted:
        x = torch.rand(5, 3)
        voronerf.nearest_centre(x, x, backend="native")
        total = float((x.T + 1).sum())
        x[x > 0.5], torch.tensor([1.0])
    assert total > 15
    assert counted.kernels == {"nearest_centre": 1} and not counted.on_cpu
    assert counted.operations == {"rand": 1, "add": 1, "sum": 1, "gt": 1}
    assert counted.reads == {"_local_scalar_dense": 1, "index": 1, "lift_fresh": 1}
    assert counted.launches == 5


@pytest.mark.native
def test_a_default_step(tmp_path):
    """After the last split, without the cells that are looked at again every sixteenth step."""
    config = TrainConfig(
        out=tmp_path, steps=16, field_options=("levels=2", "log2_entries=10"), cells=(4,), split_at=(0.25,), width=16,
        rays=32, samples=8, evaluations=1, reservoir=200, reservoir_batches=8,
    )  # fmt: skip
    with emulated():
        trainer = Trainer(config, builtin_scene(12))
        for trainer.step in range(6):
            if trainer.split_is_due():
                trainer.split()
            trainer.train_step()
    with asked() as counted:
        trainer.train_step()
    told = f"{counted.kernels} {counted.operations} {counted.reads}"
    assert counted.launches <= LAUNCHES and counted.reads.total() <= READS, told
    assert not counted.on_cpu
