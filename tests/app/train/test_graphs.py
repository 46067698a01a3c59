"""Steps for CUDA graphs, on a machine that has none: what they may not do, and when they are captured and replayed."""

import contextlib
import functools
from dataclasses import replace
from typing import Any

import pytest
import torch
from helpers import same
from tiny_runs import small
from torch.utils._python_dispatch import TorchDispatchMode

import voronerf.app.train.trainer as trainer_module
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.train.cuda_graph import WARMUP, GraphedStep, set_learning_rate
from voronerf.app.train.renderers import make_picture_grid
from voronerf.app.train.trainer import Trainer

aten = torch.ops.aten
#: Operations after which the host knows something of the device's: a number, or a size.
READING = {
    *(aten._local_scalar_dense.default, aten.nonzero.default, aten.masked_select.default, aten.equal.default),
    *(aten.is_nonzero.default, aten._unique2.default, aten.repeat_interleave.Tensor),
}


class NoReading(TorchDispatchMode):
    """Fails where an operation makes the host wait, or copies to the device from memory of the host."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        assert function not in READING, f"{function} reads a device value on the host"
        if function is aten.index.Tensor:
            assert all(index is None or index.dtype != torch.bool for index in args[1]), "an index by bool reads sizes"
        assert function is not aten.lift_fresh.default, "torch.tensor copies from the host"
        return function(*args, **(kwargs or {}))


def test_what_reads_is_noticed():
    x = torch.rand(5)
    for read in (lambda: float(x[0]), lambda: x.nonzero(), lambda: x[x > 0.5], lambda: torch.tensor([1.0])):
        with pytest.raises(AssertionError), NoReading():
            read()


@pytest.mark.native
@pytest.mark.parametrize(
    "settings",
    [
        *({}, {"precision": "bf16"}, {"precision": "fp16"}, {"background": "white", "assignment": "stochastic"}),
        *({"sampling": "hierarchical"}, {"sampling": "proposal"}, {"field": "mipnerf", "sampling": "hierarchical"}),
        *({"field": "kilonerf"}, {"contraction": "sphere"}),
    ],
    ids=lambda settings: "-".join(settings.values()) or "plain",
)
def test_a_step_reads_nothing_on_the_host(tmp_path, scene, monkeypatch, settings):
    """In the coarse stage and after the split; the first step of either may look at the network once."""
    trainer = Trainer(small(tmp_path, **settings), scene)
    for cells in (1, 4):
        assert trainer.router.num_cells == cells
        for _ in range(WARMUP):
            trainer.train_step()
        with monkeypatch.context() as patch, NoReading():
            patch.setattr(trainer.cells.reservoir, "add", lambda *kept: None)  # after the step that a graph holds
            trainer.train_step()
        if cells == 1:
            trainer.split()


class FakeGraph:
    """Keeps what is done between a capture's begin and end, and does it at every replay."""

    capturing = None

    def __init__(self):
        self.work: list[Any] = []
        self.generators: list[torch.Generator] = []
        self.register_generator_state = self.generators.append

    def replay(self):
        for each in self.work:
            each()


@pytest.fixture
def fake_cuda(monkeypatch):
    """Devices that were entered."""
    entered = []

    @contextlib.contextmanager
    def capture(graph):
        FakeGraph.capturing = graph
        yield
        FakeGraph.capturing = None

    class FakeStream:
        def wait_stream(self, other):
            pass

    fakes = {"CUDAGraph": FakeGraph, "graph": capture, "Stream": FakeStream, "current_stream": FakeStream}
    fakes["stream"] = lambda stream: contextlib.nullcontext()
    fakes["device"] = lambda device: entered.append(device) or contextlib.nullcontext()
    for name, fake in fakes.items():
        monkeypatch.setattr(f"torch.cuda.{name}", fake)
    return entered


def test_every_call_is_one_step(fake_cuda):
    """On the device of the trainer's generator, which need not be the current one."""
    result, launches = torch.zeros(()), []

    def step():
        launches.append("called")
        add = lambda: result.add_(1)  # noqa: E731
        FakeGraph.capturing.work.append(add) if FakeGraph.capturing else add()
        return result

    generator = torch.Generator()
    graphed = GraphedStep(step, [generator])
    for call in range(1, 10):
        assert graphed() is result and result == call
    assert len(launches) == WARMUP + 1 and fake_cuda == [generator.device] * 9
    assert isinstance(graphed.graph, FakeGraph) and graphed.graph.generators == [generator]


def test_a_split_ends_a_graph(tmp_path, scene, fake_cuda, monkeypatch):
    made = []
    monkeypatch.setattr(trainer_module, "GraphedStep", lambda *given: made.append(GraphedStep(*given)) or made[-1])
    trainer = Trainer(small(tmp_path, cells=(2, 2), min_cell_samples=2), scene)
    object.__setattr__(trainer.config, "cuda_graph", True)  # which no configuration without a GPU may say
    for _ in range(WARMUP):
        trainer.train_step()
    trainer.split()
    for _ in range(WARMUP):
        trainer.train_step()
    assert [graphed.runs for graphed in made] == [WARMUP] and made[0].generators == [trainer.draws]
    trainer.split()
    trainer.train_step()
    assert [graphed.runs for graphed in made] == [WARMUP, 1] and made[1].graph is None


@pytest.mark.native
def test_what_a_graph_cannot_follow_ends_it(tmp_path, scene, fake_cuda):
    """Other numbers of rays and a return to a checkpoint do; other rates and the same number do not."""
    trainer = Trainer(small(tmp_path, occupancy=True, ray_growth=4.0), scene)
    graphs = functools.partial(object.__setattr__, trainer.config, "cuda_graph")
    trainer.save()
    graphs(True)  # which no configuration without a GPU may say
    trainer._begin_stage()

    def graph():
        for _ in range(WARMUP + 1):
            trainer.train_step()
        captured = trainer._compute.graph
        assert captured is not None
        return captured

    def read(samples):
        trainer._rows = torch.tensor([samples], dtype=torch.int32)
        trainer._read(torch.zeros(()))

    first, rays = graph(), trainer.rays
    set_learning_rate(trainer.optimizer, 1e-4)
    read(rays * trainer.config.samples)  # all of space is occupied
    assert trainer.rays == rays and graph() is first
    read(1)
    assert trainer.rays == 4 * rays
    second = graph()
    assert second is not first
    trainer._go_back("losses not finite")
    assert graph() is not second


def test_a_learning_rate_in_a_tensor_is_changed_in_place():
    for rate in (torch.tensor(1.0), 1.0):
        optimizer = torch.optim.SGD([torch.zeros(2, requires_grad=True)], lr=rate)
        set_learning_rate(optimizer, 0.25)
        found = optimizer.param_groups[0]["lr"]
        assert found == 0.25 and (found is rate) == isinstance(rate, torch.Tensor)


def test_half_types_learn_with_parameters_in_float32(tmp_path, scene):
    psnr = {}
    for precision in ("fp32", "bf16", "fp16"):
        trainer = Trainer(small(tmp_path / precision, precision=precision, steps=150, evaluations=1), scene)
        psnr[precision] = trainer.run()["psnr"]
        assert all(parameter.dtype == torch.float32 for parameter in trainer.router.parameters())
        assert trainer.scaler.is_enabled() == (precision == "fp16")
    for precision in ("bf16", "fp16"):
        assert psnr[precision] != psnr["fp32"] and psnr[precision] > psnr["fp32"] - 1.5 and psnr[precision] > 12


def test_a_step_that_overflows_is_left_out_and_the_scale_halved(tmp_path, scene):
    trainer = Trainer(small(tmp_path, precision="fp16"), scene)
    for _ in range(2):
        trainer.train_step()

    def state():
        moments = [state["exp_avg"] for state in trainer.optimizer.state.values()]
        return [tensor.detach().clone() for tensor in (*trainer.router.parameters(), *moments)]

    scale, before = trainer.scaler.get_scale(), state()
    next(trainer.router.parameters()).register_hook(lambda gradient: gradient.fill_(torch.inf))
    trainer.train_step()
    assert trainer.scaler.get_scale() == scale / 2 and same(before, state())


def test_a_resumed_run_goes_on_with_its_scale(tmp_path, scene):
    """Bit for bit, a scale that has been halved and the steps since then included."""
    whole, begun = (Trainer(small(tmp_path / name, precision="fp16", steps=16), scene) for name in ("a", "b"))
    for trainer in (whole, begun):
        trainer.train_step()
        trainer.scaler.update(2.0**12)
        trainer.step = 1
        trainer.train_step()
        trainer.step = 2
    begun.save()
    resumed = Trainer(small(tmp_path / "b", precision="fp16", steps=16, resume=True), scene)
    for trainer in (whole, resumed):
        trainer.train_step()
        assert trainer.scaler.get_scale() == 2.0**12
    assert whole.scaler.state_dict() == resumed.scaler.state_dict()
    assert same(whole.router.parameters(), resumed.router.parameters())


def test_graphs_need_a_gpu():
    with pytest.raises(ConfigError, match="--cuda-graph must come with --device cuda"):
        TrainConfig(cuda_graph=True)
    assert TrainConfig(cuda_graph=True, device="cuda:1").cuda_graph


@pytest.mark.cuda
@pytest.mark.parametrize("settings", [{}, {"sampling": "hierarchical", "precision": "bf16"}, {"precision": "fp16"}])
def test_replayed_steps_are_the_steps_themselves(tmp_path, scene, settings):
    """The same seeds, the same draws: the losses of a graphed run and of a plain one agree."""
    losses = []
    for graphed in (False, True):
        trainer = Trainer(small(tmp_path / str(graphed), device="cuda", cuda_graph=graphed, **settings), scene)
        losses.append([])
        for trainer.step in range(12):
            losses[-1].append(float(trainer.train_step()))
    torch.testing.assert_close(torch.tensor(losses[1]), torch.tensor(losses[0]), rtol=0.02, atol=1e-4)


def test_pictures_through_a_grid_of_a_run_that_was_graphed(tmp_path, scene):
    trainer = Trainer(small(tmp_path, steps=2, cells=()), scene)
    trainer.run()
    config = replace(trainer.config, device="cuda", cuda_graph=True)
    assert make_picture_grid(config, scene, trainer.renderer).occupied.any()
