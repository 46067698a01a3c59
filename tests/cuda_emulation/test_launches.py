"""What a training step asks of a GPU, counted without one: launches, and reads of the host, which wait for it."""

from dataclasses import replace

import pytest
import torch
from emulated import emulated
from launches import asked

import voronerf
from voronerf.app.scenes import builtin_scene
from voronerf.app.train.config import TrainConfig
from voronerf.app.train.trainer import Trainer

LAUNCHES, READS = 26, 0
"""Of a default step. The launches go down only."""


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


@pytest.fixture
def on_device(monkeypatch):
    """Tensors of the emulation say that they are on a CPU; here the sampler does not believe them."""
    monkeypatch.setattr("voronerf.nerf.samplers._on_host", lambda tensor: False)


def trained(out, steps, *, empty=False):
    """A trainer of a small default run on the emulated device, after some steps; the split is before the fifth.

    ``empty``: most of space is, and steps have as many rays as at first.
    """
    config = TrainConfig(
        out=out, steps=16, field_options=("levels=2", "log2_entries=10"), cells=(4,), split_at=(0.25,), width=16,
        rays=32, samples=8, evaluations=1, reservoir=200, reservoir_batches=8, ray_growth=1.0 if empty else None,
    )  # fmt: skip
    with emulated():
        trainer = Trainer(config, builtin_scene(12))
        if empty:
            for table in (trainer.occupancy.density, trainer.occupancy.occupied):
                table[:, :, 8:] = 0
        for trainer.step in range(int(empty), steps):  # none is looked at again
            if trainer.split_is_due():
                trainer.split()
            trainer.train_step()
    return trainer


@pytest.mark.native
def test_rows_beyond_the_samples_change_nothing(tmp_path, monkeypatch):
    """With one cell and with four: the host knows the number of samples, or the device alone."""
    found = []
    for known in (True, False):
        monkeypatch.setattr("voronerf.nerf.samplers._on_host", lambda tensor, known=known: known)
        trainer = trained(tmp_path / str(known), 6, empty=True)
        rows = trainer._rows
        assert (rows is None) == known and trainer.router.num_cells == 4
        found.append([*trainer.router.parameters(), trainer.occupancy.density, trainer.cells.reservoir.samples()[1]])
    assert 0 < int(rows) < 32 * 8  # some rows were beyond
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)
    trainer.config = replace(trainer.config, ray_growth=4.0)
    trainer._read(torch.zeros(()))
    assert 32 < trainer.rays <= 128  # as many more as the samples left out allow


@pytest.mark.native
def test_a_default_step(tmp_path, on_device):
    """After the last split, without the cells that are looked at again every sixteenth step."""
    trainer = trained(tmp_path, 6)
    with asked() as counted:
        trainer.train_step()
    told = f"{counted.kernels} {counted.operations} {counted.reads}"
    assert counted.launches <= LAUNCHES and counted.reads.total() <= READS, told
    assert not counted.on_cpu
