"""Tests of training steps as CUDA graphs on the emulated device: captures, and replays that equal eager steps."""

import contextlib
import gc
import itertools
import weakref

import pytest
import torch
from emulated import emulated
from graphs import graphs
from step_training import Scaled, Training

from voronerf.app.scenes import builtin_scene
from voronerf.app.train import Callback, State, TrainConfig, build, train
from voronerf.nerf import SplitStrategy, batches, loss, replayed, terms
from voronerf.ops._core import capture
from voronerf.ops._core.capture import Capture
from voronerf.ops.keep_heaviest import reference
from voronerf.router import optimizers

pytestmark = pytest.mark.native


@pytest.fixture(autouse=True)
def on_device(monkeypatch):
    """Makes tensors of the emulation report a CUDA device."""
    monkeypatch.setattr(torch.Tensor, "is_cpu", False)
    monkeypatch.setattr(torch.Tensor, "is_cuda", True)
    monkeypatch.setattr(State, "read_output", lambda state, output: None)
    monkeypatch.setattr(reference, "check_range", lambda *_: None)  # the check reads only on a CPU
    for place, op in (
        (batches, "unseen_rays"),
        (terms, "sparse_depth_loss"),
        (terms, "smooth_depth_loss"),
        (terms, "surface_loss"),
        (loss, "rendered_gradient"),
    ):  # ops without CUDA kernels
        monkeypatch.setattr(place, op, in_torch(getattr(place, op)))


def in_torch(op):
    """Returns an op that always runs its reference."""
    return lambda *given, **options: op(*given, **{**options, "backend": "reference"})


def built(**options):
    """Builds a small default run, which splits before the fifth step."""
    config = TrainConfig(
        steps=16, field_options=("levels=2", "log2_entries=10"), cells=(4,), split_at=(0.25,), width=16,
        rays=32, samples=(8,), evaluations=1, **options,
    )  # fmt: skip
    state = build(config, builtin_scene(12))
    state.strategy.backend = "reference"  # as on a GPU, where torch collects the samples of a split
    return state


def steps(state, count):
    train(state, [Callback()], until=state.seconds + count, clock=itertools.count().__next__)  # groups of one step


def everything(state):
    moments = [value for each in state.optimizer.state.values() for value in each.values()]
    gradients = [p.grad for p in state.router.parameters()]
    kept = state.strategy.state_dict().values()
    grid = state.sampler.grid
    return [*state.router.parameters(), *gradients, *moments, grid.density, grid.occupied, *kept, *state.guard[:3]]


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_replays_are_the_same_steps(precision, monkeypatch):
    """Compares replays with eager steps, across a split and changes of the learning rate and of the number of rays."""
    found, calls, pools = [], [], []
    for as_it_is in (False, True):
        with emulated(), graphs() as seen:
            state, losses = built(precision=precision), []
            step = state.training_step
            assert step.autocast == (torch.bfloat16 if precision == "bf16" else None)
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
    # Before the split come an eager step, a captured step, and two replays; later captures follow in the same way.
    assert calls == [[*captured(2), *captured(3), *captured(3)], []]
    assert pools == [False, False, True]  # the first capture, after the split, and with more rays


def captured(replays):
    return ["register", "capture", *["replay"] * replays]


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_moved_memory_is_captured_anew(precision):
    """Checks that the old graph's memory is kept alive, since the graph uses fixed addresses."""
    with emulated(), graphs() as seen:
        state = built(precision=precision)
        steps(state, 7)
        step, parameter = state.training_step, state.router.module.colour.weight
        places = {
            "parameter": lambda: parameter,
            "gradient": lambda: parameter.grad,
            "moment": lambda: state.optimizer.state[parameter]["exp_avg"],
            "grid": lambda: state.sampler.grid.density,
            "pictures": lambda: step.batches.images,
            "centres": lambda: state.router.diagram.centres,
            "poses": lambda: step.batches.cameras.poses,
            "guard": lambda: state.guard.skipped,
        }
        before = len(seen.calls)
        step(32), step(32)
        assert seen.calls[before:] == ["replay", "replay"]
        for place in places if precision == "fp32" else ("parameter", "gradient"):
            moved, before = places[place](), len(seen.calls)
            moved.data = moved.data.clone()
            step(32)
            assert len(seen.calls) == before, place
            step(32), step(32), step(32)  # one or two of them prepare the capture
            assert seen.calls[before:].count("capture") == 1 and seen.calls[-1] == "replay", place


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
        assert step.explain() == "step: runs eagerly, since it needs a warm-up step before the capture"
        step.strategy = Reading({"field": state.router}, [])
        steps(state, 3)
        assert step.explain().endswith(f"since the host waits for the device, in test_graphs.py:{step.strategy.line}")
        step.strategy = None
        step.autocast, step.scaler = torch.float16, torch.amp.GradScaler("cpu")
        steps(state, 1)
        assert step.explain() == "step: runs eagerly, since a GradScaler scales its loss"
        step.autocast, step.scaler = None, None
        handle = state.router.module.colour.weight.register_hook(lambda slope: None)
        steps(state, 1)
        assert step.explain().endswith(
            "since a hook of module.colour.weight runs in Python, which a CUDA graph cannot replay"
        )
        handle.remove()
        step.batches.place = torch.device("meta")
        assert step._standing_obstacle() == "its pictures are on meta"
    assert "capture" not in seen.calls


@pytest.mark.parametrize("photograph", [False, True])
def test_no_step_is_left_out_for_what_is_behind_the_last_sample(photograph):
    """Checks that terms in torch ignore the spare rows of a captured step, which has room for more samples."""
    with emulated(), graphs() as seen:
        training = Training(cells=2, photograph=photograph)
        training.train(4)
        assert "capture" in seen.calls and float(training.guard.skipped) == 0


def test_precision_of_a_traced_field():
    """Checks that a traced field runs as separate operations under autocast, which rounds between layers."""
    with emulated(), graphs():
        training = Training(field=Scaled, cells=2, fuse=True)
        training.train(4, rays=lambda step: 16)
        assert training.step.explain() == "step: captured and replayed as a CUDA graph"
        training.step.autocast = torch.bfloat16
        training.train(3, rays=lambda step: 16)
        assert training.step.explain() == "step: runs eagerly, since Scaled.forward runs under autocast"


def test_a_router_does_not_check_its_parameters_in_a_capture(monkeypatch):
    """Reading parameters, as a router does after `PATIENCE` calls in Python, would end a capture."""
    monkeypatch.setattr(optimizers, "PATIENCE", 3)
    with emulated(), graphs() as seen:
        state = built()
        for rays in (32, 33, 34, 35):
            state.rays = rays
            steps(state, 1)
        assert state.training_step.explain() == "step: captured and replayed as a CUDA graph"
        assert seen.calls.count("capture") == 2


def test_no_other_graph_is_destroyed_in_a_capture(monkeypatch):
    with emulated(), graphs() as seen:
        step = built().training_step
        update = step._update

        def leaves_garbage(output):
            old = [Capture(torch.device("cpu"), step.generator)]
            old.append(old)  # only the garbage collector can destroy it
            del old
            lists = [[] for _ in range(100_000)]  # so many new objects that garbage is collected
            return update(output) if lists else None

        monkeypatch.setattr(step, "_update", leaves_garbage)
        step(32), step(32)
        assert "capture" in seen.calls and "destroyed in a capture" not in seen.calls
        assert gc.isenabled() and not capture._FREED


def test_a_capture_is_freed_without_the_garbage_collector():
    with emulated(), graphs():
        step = built().training_step
        step(32), step(32)
        (segment,) = step._step._segments
        first = weakref.ref(segment.recording)
        gc.disable()
        try:
            while segment.recording is first():
                step(33)
            assert first() is None
        finally:
            gc.enable()


def test_another_precision_is_captured_anew():
    """Checks that a change of dtype, scaler or the caller's autocast causes a new capture."""
    with emulated(), graphs() as seen:
        training = Training(cells=2)

        def train(*around):
            before = seen.calls.count("capture")
            with contextlib.ExitStack() as stack:
                for context in around:
                    stack.enter_context(context)
                training.train(3, rays=lambda step: 16)
            assert seen.calls.count("capture") == before + 1 and "CUDA graph" in training.step.explain()

        train()
        training.step.autocast = torch.bfloat16
        train()
        training.step.autocast, training.step.scaler = torch.float16, torch.amp.GradScaler("cpu", enabled=False)
        train()
        training.step.autocast = None
        train()
        train(torch.autocast("cpu", torch.bfloat16))
        train(torch.autocast("cpu", torch.float16))
        training.step.autocast, training.step.scaler = torch.float16, torch.amp.GradScaler("cpu")
        before = seen.calls.count("capture")
        training.train(3, rays=lambda step: 16)
        assert seen.calls.count("capture") == before


def test_no_graph_of_autograd_outlives_a_step():
    """Checks that the autograd tapes of steps are freed, since their nodes would run on an earlier step's stream."""
    with emulated(), graphs() as seen:
        training, alive = Training(cells=2), list[weakref.ref]()
        training.step.autocast = torch.bfloat16
        backward = training.step._backward

        def marked(output):
            mark = contextlib.ExitStack()  # supports weak references
            alive.append(weakref.ref(mark))
            output.loss.grad_fn.metadata["mark"] = mark
            return backward(output)

        training.step._backward = marked
        gc.disable()
        try:
            held = [training.step(16) for _ in range(4)]
        finally:
            gc.enable()
        assert len(held) == 4 and "capture" in seen.calls
        assert len(alive) == 3 and not any(each() is not None for each in alive[:2])  # a CUDA graph holds the third
