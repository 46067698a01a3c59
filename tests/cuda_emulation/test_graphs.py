"""A training step as a CUDA graph, on the emulated device: what it captures, and that replays are the same steps."""

import importlib
import itertools

import pytest
import torch
from emulated import emulated
from graphs import graphs

from voronerf.app.scenes import builtin_scene
from voronerf.app.train import Callback, State, TrainConfig, build, train
from voronerf.nerf import SplitStrategy, replayed

pytestmark = pytest.mark.native


@pytest.fixture(autouse=True)
def on_device(monkeypatch):
    """Tensors of the emulation say that they are on a GPU."""
    monkeypatch.setattr(torch.Tensor, "is_cpu", False)
    monkeypatch.setattr(torch.Tensor, "is_cuda", True)
    monkeypatch.setattr(State, "read_output", lambda state, output: None)
    reference = importlib.import_module("voronerf.ops.keep_heaviest.reference")
    monkeypatch.setattr(reference, "check_range", lambda *_: None)  # which reads on a CPU alone


def built(**options):
    """A small default run, which splits before the fifth step."""
    config = TrainConfig(
        steps=16, field_options=("levels=2", "log2_entries=10"), cells=(4,), split_at=(0.25,), width=16,
        rays=32, samples=(8,), evaluations=1, **options,
    )  # fmt: skip
    state = build(config, builtin_scene(12))
    state.strategy.backend = "reference"  # as on a GPU: torch keeps the samples for a split there
    return state


def steps(state, count):
    train(state, [Callback()], until=state.seconds + count, clock=itertools.count().__next__)  # one by one


def everything(state):
    moments = [value for each in state.optimizer.state.values() for value in each.values()]
    gradients = [p.grad for p in state.router.parameters()]
    kept = state.strategy.state_dict().values()
    grid = state.sampler.grid
    return [*state.router.parameters(), *gradients, *moments, grid.density, grid.occupied, *kept, *state.guard[:3]]


def test_replays_are_the_same_steps(monkeypatch):
    """With splits, rates that change, and other numbers of rays."""
    found, calls, pools = [], [], []
    for as_it_is in (False, True):
        with emulated(), graphs() as seen:
            state, losses = built(), []
            step = state.training_step
            if as_it_is:
                monkeypatch.setattr(step, "_standing_obstacle", lambda: "a test")
            monkeypatch.setattr(state, "read_output", lambda made, to=losses: to.append(made.loss.clone()))
            steps(state, 9)
            state.rays = 48
            steps(state, 4)
            assert ("CUDA graph" in step.explain()) != as_it_is, step.explain()
            found.append([*everything(state), *losses])
            calls.append(seen.calls)
            pools = pools or [pool is not None for pool in seen.pools]
    assert len(found[0]) == len(found[1]) and state.router.num_cells == 4 and len(losses) == 13
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))
    # One as it is, one that is captured, and two that are replayed, before the split; and so on.
    assert calls == [[*captured(2), *captured(3), *captured(3)], []]
    assert pools == [False, False, True]  # other cells, and other rays


def captured(replays):
    return ["register", "capture", *["replay"] * replays]


@pytest.mark.parametrize("which", ["parameter", "gradient", "moment", "grid", "pictures", "centres", "poses", "guard"])
def test_moved_memory_is_captured_anew(which):
    """The graph goes on with the addresses that it has, so what lies there is held, and no longer used."""
    with emulated(), graphs() as seen:
        state = built()
        steps(state, 7)
        parameter = state.router.module.colour.weight
        moved = {
            "parameter": parameter,
            "gradient": parameter.grad,
            "moment": state.optimizer.state[parameter]["exp_avg"],
            "grid": state.sampler.grid.density,
            "pictures": state.training_step.batches.images,
            "centres": state.router.diagram.centres,
            "poses": state.training_step.batches.cameras.poses,
            "guard": state.guard.skipped,
        }[which]
        before = seen.calls.count("capture")
        steps(state, 2)
        assert seen.calls.count("capture") == before
        moved.data = moved.data.clone()
        steps(state, 2)
        assert seen.calls.count("capture") == before + 1


@replayed
class Reading(SplitStrategy):
    def step_post_backward(self, output):
        self.line = 1 + (lambda: None).__code__.co_firstlineno
        output.loss.item()


def test_what_keeps_a_step_from_it():
    with emulated(), graphs() as seen:
        state = built()
        step = state.training_step
        steps(state, 1)
        assert step.explain() == "step: runs as it is, since no step of its kind was made before"
        step.strategy = Reading({"field": state.router}, [])
        steps(state, 3)
        assert step.explain().endswith(f"since the host waits for the device, in test_graphs.py:{step.strategy.line}")
        step.strategy = None
        step.autocast = torch.bfloat16
        steps(state, 1)
        assert step.explain().endswith("since it runs under autocast")
        step.autocast, step.batches.place = None, torch.device("meta")
        assert step._standing_obstacle() == "its pictures are on meta"
    assert "capture" not in seen.calls
