"""Counts, without a GPU, the launches and the host's blocking reads of a training step on a GPU."""

import itertools

import pytest
import torch
from emulated import emulated
from launches import asked

import voronerf
from voronerf.app.scenes import builtin_scene
from voronerf.app.train import Callback, State, TrainConfig, build, train

LAUNCHES, READS = 23, 0
"""The most launches and reads of a default step; the numbers may only be lowered."""


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
    """Makes tensors of the emulation report a CUDA device."""
    monkeypatch.setattr(torch.Tensor, "is_cpu", False)
    monkeypatch.setattr(torch.Tensor, "is_cuda", True)


def trained(steps, monkeypatch, *, empty=False):
    """Runs some steps of a small default run, which splits before the fifth step; returns its state and last output.

    ``empty`` makes most of space empty. The reads of outputs, every fiftieth step on a GPU, are left out.
    """
    config = TrainConfig(
        steps=16, field_options=("levels=2", "log2_entries=10"), cells=(4,), split_at=(0.25,), width=16,
        rays=32, samples=(8,), evaluations=1,
    )  # fmt: skip
    state, outputs = build(config, builtin_scene(12)), []
    with monkeypatch.context() as patch:
        patch.setattr(State, "read_output", lambda state, output: outputs.append(output))
        if empty:
            for table in (state.sampler.grid.density, state.sampler.grid.occupied):
                table[:, :, 8:] = 0
            state.step = 1  # skips the first step, which evaluates voxels
        train(state, [Callback()], until=steps - state.step, clock=itertools.count().__next__)  # groups of one step
    return state, outputs[-1]


@pytest.mark.native
def test_rows_beyond_the_samples_change_nothing(monkeypatch, request):
    """Compares a run in which the host knows the number of samples with a run in which only the device does."""
    found = []
    for known in (True, False):
        if not known:
            request.getfixturevalue("on_device")
        with emulated():
            state, output = trained(6, monkeypatch, empty=True)
        rows = output.output.samples.rows
        assert (rows is None) == known and state.router.num_cells == 4
        reservoir = state.strategy.reservoir.samples()[1]
        found.append([*state.router.parameters(), state.sampler.grid.density, reservoir])
    assert 0 < int(rows) < 32 * 8  # some rows have no sample
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)
    monkeypatch.setattr("voronerf.nerf.schedule.GROUP", 1)
    state.read_output(output)
    assert 32 < state.rays <= 256  # empty space allows more rays


@pytest.mark.native
def test_a_default_step(monkeypatch, on_device):
    """Counts a step after the last split, without the voxel evaluation of every sixteenth step."""
    with emulated():
        state, _ = trained(6, monkeypatch)
    monkeypatch.setattr(State, "read_output", lambda state, output: None)
    with asked() as counted:
        train(state, [Callback()], until=state.seconds + 1, clock=itertools.count().__next__)
    told = f"{counted.kernels} {counted.operations} {counted.reads}"
    assert counted.launches <= LAUNCHES and counted.reads.total() <= READS, told
    assert not counted.on_cpu
