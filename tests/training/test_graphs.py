"""Steps for CUDA graphs, on a machine that has none: what they may not do, and when they are captured and replayed."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from voronerf.data import Scene, builtin_scene
from voronerf.training.config import ConfigError, TrainConfig
from voronerf.training.graphs import WARMUP, GraphedStep, set_learning_rate
from voronerf.training.model import load_grid
from voronerf.training.trainer import Trainer

aten = torch.ops.aten
#: Operations after which the host knows something of the device's: a number, or a size.
READING = {
    aten._local_scalar_dense.default,
    aten.nonzero.default,
    aten.masked_select.default,
    aten.equal.default,
    aten.is_nonzero.default,
    aten._unique2.default,
    aten.repeat_interleave.Tensor,
}


class NoReading(TorchDispatchMode):
    """Fails where an operation makes the host wait, or copies to the device from memory of the host."""

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        assert function not in READING, f"{function} reads a device value on the host"
        if function is aten.index.Tensor:
            assert all(index is None or index.dtype != torch.bool for index in args[1]), "an index by bool reads sizes"
        assert function is not aten.lift_fresh.default, "torch.tensor copies from the host"
        return function(*args, **(kwargs or {}))


def test_what_reads_is_noticed() -> None:
    x = torch.rand(5)
    for read in (lambda: float(x[0]), lambda: x.nonzero(), lambda: x[x > 0.5], lambda: torch.tensor([1.0])):
        with pytest.raises(AssertionError), NoReading():
            read()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return builtin_scene(16)


def small(out: Path, **settings: Any) -> TrainConfig:
    defaults: dict[str, Any] = {"steps": 24, "cells": (4,), "split_at": (0.5,), "width": 8, "depth": 2, "rays": 64}
    defaults |= {"samples": 12, "reservoir": 400, "reservoir_batches": 10, "evaluations": 1, "eval_views": 1}
    return TrainConfig(out=out, **{**defaults, "final_views": 1, **settings})


@pytest.mark.native
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"precision": "bf16"},
        {"precision": "fp16"},
        {"background": "white", "assignment": "stochastic"},
        {"sampling": "hierarchical"},
        {"sampling": "proposal"},
        {"field": "mipnerf", "sampling": "hierarchical"},
        {"field": "kilonerf"},
        {"contraction": "sphere"},
    ],
    ids=lambda settings: "-".join(settings.values()) or "plain",
)
def test_a_step_reads_nothing_on_the_host(tmp_path: Path, scene: Scene, settings: dict[str, Any]) -> None:
    """In the coarse stage and after the split; the first step of either may look at the network once."""
    trainer = Trainer(small(tmp_path, **settings), scene)
    for _ in range(2):
        for _ in range(WARMUP):
            trainer._step()
        # The optimiser's own reading of its step counter is left out by its capturable form, which is for CUDA alone.
        with pytest.MonkeyPatch.context() as patch, NoReading():
            patch.setattr(trainer.optimizer, "step", lambda: None)
            trainer._forward_backward()
        if trainer.router.num_cells == 1:
            trainer._split()
            assert trainer.router.num_cells == 4


class FakeGraph:
    """Keeps what is done between a capture's begin and end, and does it at every replay."""

    capturing: FakeGraph | None = None

    def __init__(self) -> None:
        self.work: list[Any] = []
        self.generators: list[torch.Generator] = []

    def register_generator_state(self, generator: torch.Generator) -> None:
        self.generators.append(generator)

    def replay(self) -> None:
        for each in self.work:
            each()


class FakeStream:
    def wait_stream(self, other: FakeStream) -> None:
        pass


@contextlib.contextmanager
def capture(graph: FakeGraph) -> Iterator[None]:
    FakeGraph.capturing = graph
    yield
    FakeGraph.capturing = None


@pytest.fixture
def fake_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.CUDAGraph", FakeGraph)
    monkeypatch.setattr("torch.cuda.graph", capture)
    monkeypatch.setattr("torch.cuda.Stream", FakeStream)
    monkeypatch.setattr("torch.cuda.current_stream", FakeStream)
    monkeypatch.setattr("torch.cuda.stream", lambda stream: contextlib.nullcontext())
    monkeypatch.setattr("torch.cuda.device", lambda device: contextlib.nullcontext())


def test_every_call_is_one_step(fake_cuda: None) -> None:
    result, launches = torch.zeros(()), []

    def step() -> torch.Tensor:
        launches.append("called")
        add = lambda: result.add_(1)  # noqa: E731
        FakeGraph.capturing.work.append(add) if FakeGraph.capturing else add()
        return result

    generator = torch.Generator()
    graphed = GraphedStep(step, [generator])
    for call in range(1, 10):
        assert graphed() is result and result == call
    assert len(launches) == WARMUP + 1
    assert isinstance(graphed.graph, FakeGraph) and graphed.graph.generators == [generator]


def test_a_split_ends_a_graph(tmp_path: Path, scene: Scene, fake_cuda: None) -> None:
    trainer = Trainer(small(tmp_path), scene)
    object.__setattr__(trainer.config, "cuda_graph", True)
    trainer._compute = trainer._make_step()
    before = trainer._compute
    assert isinstance(before, GraphedStep) and before.generators == [trainer.draws]
    for _ in range(WARMUP):
        trainer._step()
    trainer._split()
    assert isinstance(trainer._compute, GraphedStep) and trainer._compute is not before
    assert trainer._compute.graph is None and trainer._compute.runs == 0


def test_a_learning_rate_in_a_tensor_is_changed_in_place() -> None:
    rate = torch.tensor(1.0)
    optimizer = torch.optim.SGD([torch.zeros(2, requires_grad=True)], lr=rate)
    set_learning_rate(optimizer, 0.25)
    assert optimizer.param_groups[0]["lr"] is rate and rate == 0.25
    optimizer = torch.optim.SGD([torch.zeros(2, requires_grad=True)], lr=1.0)
    set_learning_rate(optimizer, 0.5)
    assert optimizer.param_groups[0]["lr"] == 0.5


def test_half_types_learn_with_parameters_in_float32(tmp_path: Path, scene: Scene) -> None:
    psnr = {}
    for precision in ("fp32", "bf16", "fp16"):
        trainer = Trainer(small(tmp_path / precision, precision=precision, steps=150), scene)
        psnr[precision] = trainer.run()["psnr"]
        assert all(parameter.dtype == torch.float32 for parameter in trainer.router.parameters())
        assert trainer.scaler.is_enabled() == (precision == "fp16")
    for precision in ("bf16", "fp16"):
        assert psnr[precision] != psnr["fp32"] and psnr[precision] > psnr["fp32"] - 1.5 and psnr[precision] > 12


def test_a_step_that_overflows_is_left_out_and_the_scale_halved(tmp_path: Path, scene: Scene) -> None:
    trainer = Trainer(small(tmp_path, precision="fp16"), scene)
    for _ in range(2):
        trainer._step()
    scale = trainer.scaler.get_scale()
    before = [parameter.detach().clone() for parameter in trainer.router.parameters()]
    moments = [state["exp_avg"].clone() for state in trainer.optimizer.state.values()]
    first = next(trainer.router.parameters())
    first.register_hook(lambda gradient: gradient.fill_(torch.inf))
    trainer._step()
    assert trainer.scaler.get_scale() == scale / 2
    assert all(torch.equal(a, b) for a, b in zip(before, trainer.router.parameters()))
    assert all(torch.equal(a, state["exp_avg"]) for a, state in zip(moments, trainer.optimizer.state.values()))


def test_a_resumed_run_goes_on_with_its_scale(tmp_path: Path, scene: Scene) -> None:
    """Bit for bit, a scale that has been halved included."""
    whole = Trainer(small(tmp_path / "whole", precision="fp16", steps=16), scene)
    begun = Trainer(small(tmp_path / "parts", precision="fp16", steps=16), scene)
    for trainer in (whole, begun):
        trainer._step()
        trainer.scaler.update(2.0**12)
        trainer.step = 1
    begun._step()
    begun.step = 2
    begun.save()
    resumed = Trainer(small(tmp_path / "parts", precision="fp16", steps=16, resume=True), scene)
    whole._step()
    for trainer in (whole, resumed):
        trainer.step = 2
        trainer._step()
        assert trainer.scaler.get_scale() == 2.0**12 and trainer.scaler._get_growth_tracker() == 3
    assert all(torch.equal(a, b) for a, b in zip(whole.router.parameters(), resumed.router.parameters()))


def test_graphs_need_a_gpu_and_no_grid() -> None:
    for settings in ({}, {"device": "cuda", "occupancy": True}):
        with pytest.raises(ConfigError, match="--cuda-graph must come with --device cuda and without --occupancy"):
            TrainConfig(cuda_graph=True, **settings)
    assert TrainConfig(cuda_graph=True, device="cuda:1").cuda_graph


@pytest.mark.cuda
@pytest.mark.parametrize("settings", [{}, {"sampling": "hierarchical", "precision": "bf16"}, {"precision": "fp16"}])
def test_replayed_steps_are_the_steps_themselves(tmp_path: Path, scene: Scene, settings: dict[str, Any]) -> None:
    """The same seeds, the same draws: the losses of a graphed run and of a plain one agree."""
    losses = []
    for graphed in (False, True):
        trainer = Trainer(small(tmp_path / str(graphed), device="cuda", cuda_graph=graphed, **settings), scene)
        losses.append([])
        for trainer.step in range(12):
            losses[-1].append(float(trainer._step()))
    torch.testing.assert_close(torch.tensor(losses[1]), torch.tensor(losses[0]), rtol=0.02, atol=1e-4)


def test_a_graph_is_captured_on_the_trainers_device(fake_cuda: None, monkeypatch: pytest.MonkeyPatch) -> None:
    entered = []
    monkeypatch.setattr("torch.cuda.device", lambda device: entered.append(device) or contextlib.nullcontext())
    generator = torch.Generator()
    graphed = GraphedStep(lambda: None, [generator])
    for _ in range(WARMUP + 2):
        graphed()
    assert entered == [generator.device] * (WARMUP + 2)


def test_pictures_through_a_grid_of_a_run_that_was_graphed(tmp_path: Path, scene: Scene) -> None:
    trainer = Trainer(small(tmp_path, steps=2, cells=(), split_at=None), scene)
    trainer.run()
    config = replace(trainer.config, device="cuda", cuda_graph=True)
    assert load_grid(tmp_path, config, trainer.router, scene, wanted=True) is not None
