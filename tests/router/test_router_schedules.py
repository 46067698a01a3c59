"""Fused networks in loops whose numbers, attributes, buffers and parameters change between calls."""

from __future__ import annotations

import types
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from helpers import refuses
from router_loop import equals_loop, perturb, randomised, uniform
from torch import Tensor, nn
from torch.nn.utils import parametrizations, parametrize, prune

from voronerf import VoronoiRouter
from voronerf.router import probe
from voronerf.router.fused import Fused

K = 4
X = uniform((90,))


class Scheduled(nn.Module):
    """A module that may read numbers of many kinds besides its arguments; ``use`` is a function that reads some."""

    progress = 0.25  # an attribute of the class until an instance sets it

    def __init__(self, use: Callable[..., Tensor]) -> None:
        super().__init__()
        self.a, self.b, self.use = nn.Linear(3, 8), nn.Linear(8, 2), [use]
        self.codes = nn.Embedding(12, 8)
        self.level, self.fine, self.bands, self.act = 1, False, [1.0, 2.0], nn.ReLU()
        self.bent = nn.LeakyReLU()
        self.options = types.SimpleNamespace(gain=1.0)
        self.register_buffer("scalar", torch.tensor(1.0))
        self.register_buffer("scale", torch.ones(8))
        self.plain, self.listed = torch.ones(8), [torch.tensor(1.0)]

    def forward(self, x: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        return self.b(self.use[0](self, torch.tanh(self.a(x)), *args, **kwargs))


def routed(use: Callable[..., Tensor], **options: Any) -> VoronoiRouter:
    router = VoronoiRouter(randomised(Scheduled(use)), uniform((K,)), coords="first3", fuse=True, **options)
    return perturb(router, torch.Generator().manual_seed(1))


def check(router: VoronoiRouter, *args: Any) -> None:
    """Checks that values and parameter gradients equal the loop over cells for the module's current state."""
    equals_loop(router, X, *args)


@pytest.fixture
def traces(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Collects the inputs of each trace."""
    results: list[Any] = []

    class Counted(Fused):
        def __init__(self, call: Any, arguments: Any, inputs: Any) -> None:
            results.append(inputs.sources)
            super().__init__(call, arguments, inputs)

    monkeypatch.setattr(probe, "Fused", Counted)
    return results


NUMBERS: dict[str, tuple[Callable[..., Tensor], list[Any]]] = {
    "a factor": (lambda net, h, it: h * (it / 10), [0, 3, 5, 9, 4]),
    "a slope": (lambda net, h, it: torch.nn.functional.leaky_relu(h, it), [0.1, 0.2, 0.3, 0.7]),
    "a limit": (lambda net, h, it: h.clamp(max=it) * torch.full_like(h, it), [0.1, 0.2, 0.3, 0.7]),
    "a window": (lambda net, h, it: h * torch.clamp(it * 8 - torch.arange(8), 0.0, 1.0), [0.1, 0.2, 0.3, 0.7]),
    "a frame": (lambda net, h, it: h + net.codes(torch.tensor([it])), [0, 3, 5, 11, 7]),
    "a row of a parameter": (lambda net, h, it: h + net.codes.weight[it], [0, 3, 5, 11, 7]),
    "in a dict": (lambda net, h, opts: h * opts["weights"][0], [{"weights": [w]} for w in (0.1, 0.2, 0.3, 0.5)]),
}


@pytest.mark.filterwarnings("ignore:VoronoiRouter.*no longer fused")
@pytest.mark.parametrize("name", NUMBERS)
def test_a_number_that_changes_becomes_an_input(name: str, traces: list[Any]) -> None:
    """All values give correct results: a few traces serve all values, or the module runs grouped in the end."""
    use, values = NUMBERS[name]
    router = routed(use)
    for value in values:
        check(router, value)
    assert "fused" in router.explain()
    if name not in ("a slope", "a limit"):  # the arguments of these functions must be Python numbers
        assert len(traces) <= 4 and traces[-1]
    count = len(traces)
    for value in values:
        check(router, value)
    assert len(traces) == count  # the second pass makes no new trace


def test_a_number_that_chooses_a_path_ends_grouped(traces: list[Any]) -> None:
    router = routed(lambda net, h, it: h * min(1.0, it / 20))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for it in range(30):
            check(router, it)
    said = [str(w.message) for w in caught if "VoronoiRouter" in str(w.message)]
    rule = "Scheduled.forward is no longer fused, since argument 1 changes between calls but is a constant of the trace"
    assert len(said) == 1 and rule in said[0] and "test_router_schedules.py" in said[0]
    assert router.explain().startswith("forward: grouped: no longer fused") and len(traces) == 11


def written(net: Any, name: str, value: Any) -> None:
    with torch.no_grad():
        getattr(net, name).copy_(torch.as_tensor(value))


SCHEDULES: dict[str, tuple[Callable[..., Tensor], Callable[[Any, float], None]]] = {
    "an attribute": (lambda net, h: h * net.level, lambda net, v: setattr(net, "level", v)),
    "an attribute of the class": (lambda net, h: h * net.progress, lambda net, v: setattr(net, "progress", v)),
    "a scalar buffer, written": (lambda net, h: h * net.scalar, lambda net, v: written(net, "scalar", v)),
    "a scalar buffer, replaced": (
        lambda net, h: h * net.scalar,
        lambda net, v: setattr(net, "scalar", torch.tensor(v)),
    ),
    "a scalar buffer, written by .data": (lambda net, h: h * net.scalar, lambda net, v: net.scalar.data.fill_(v)),
    "a buffer, written": (lambda net, h: h * net.scale, lambda net, v: written(net, "scale", v)),
    "a function of a buffer": (lambda net, h: h * (net.scale * 2).sin(), lambda net, v: written(net, "scale", v)),
    "a tensor, replaced": (lambda net, h: h * net.plain, lambda net, v: setattr(net, "plain", torch.full((8,), v))),
    "an item of a list, written": (lambda net, h: h * net.listed[0], lambda net, v: net.listed[0].data.fill_(v)),
    "a list": (lambda net, h: h * net.bands[1], lambda net, v: net.bands.__setitem__(1, v)),
    "an object": (lambda net, h: h * net.options.gain, lambda net, v: setattr(net.options, "gain", v)),
    "a part": (lambda net, h: net.act(h), lambda net, v: setattr(net, "act", nn.LeakyReLU(v))),
    "an attribute of a part": (lambda net, h: net.bent(h), lambda net, v: setattr(net.bent, "negative_slope", v)),
    "a hook": (lambda net, h: net.act(h), lambda net, v: net.act.register_forward_hook(lambda *a: a[2] * v) and None),
}


@pytest.mark.filterwarnings("ignore:VoronoiRouter.*no longer fused")
@pytest.mark.parametrize("name", SCHEDULES)
def test_schedules_of_the_module_are_followed(name: str, traces: list[Any]) -> None:
    use, change = SCHEDULES[name]
    router = routed(use)
    check(router)
    for value in (0.5, 0.2, 0.8, 0.1):
        change(router.module, value)
        check(router)
        check(router)
    assert "fused" in router.explain()
    if "buffer" in name or "tensor" in name or name == "an attribute of the class":
        assert len(traces) == 2 and len(traces[1]) == 1
    for step in range(12 if len(traces) > 2 else 0):  # more values than traces
        change(router.module, step / 13)
        check(router)


def test_a_flag_that_comes_back_is_not_traced_again(traces: list[Any]) -> None:
    router = routed(lambda net, h: h.relu() if net.fine else h.sin())
    for step in range(6):
        router.module.fine = step % 2 == 1
        check(router)
    assert len(traces) == 2 and router.explain() == "forward: fused"


def test_an_attribute_of_the_module_is_not_set_on_the_router() -> None:
    router = routed(lambda net, h: h * net.level)
    with pytest.raises(AttributeError, match=r"level belongs to Scheduled; set router\.module\.level"):
        router.level = 2
    router.note = "of my own"
    assert router.note == "of my own"


class Twice(nn.Module):
    def forward(self, weight: Tensor) -> Tensor:
        return 2 * weight


GONE: dict[str, Callable[[nn.Module], Any]] = {
    "weight_norm": parametrizations.weight_norm,
    "the old weight_norm": nn.utils.weight_norm,
    "a parametrization": lambda layer: parametrize.register_parametrization(layer, "weight", Twice()),
    "pruning": lambda layer: prune.l1_unstructured(layer, "weight", 0.3),
}


@pytest.mark.filterwarnings("ignore:.*weight_norm")
@pytest.mark.parametrize("way", ["fused", "grouped", "loop"])
@pytest.mark.parametrize("name", GONE)
def test_a_parametrization_after_wrapping_is_refused(name: str, way: Any) -> None:
    router = routed(lambda net, h: h, way=way)
    router(X)
    GONE[name](router.module.a)
    for x in (X, X[:30]):
        with pytest.raises(TypeError, match=r"with, but 'a\.weight' is gone; change a module .* before it is wrapped"):
            router(x)


@pytest.mark.parametrize("way", ["fused", "grouped", "loop"])
def test_parameters_of_other_shapes_are_refused_or_followed(way: Any) -> None:
    router = routed(lambda net, h: h, way=way)
    check(router)
    weight, bias = router.module.b.weight.data, router.module.b.bias.data
    router.module.b.weight.data, router.module.b.bias.data = weight[:, :1], bias[:, :1]
    check(router)  # each cell has one output
    router.module.b.weight.data = weight[:1, :1]
    refuses("must be [4, ...], one for each cell, but 'b.weight' is [1, 1, 8]", router, X)
    router.module.b = nn.Linear(8, 2)
    refuses("one for each cell, but 'b.weight' is [2, 8]", router, X)


def test_memory_that_was_freed_is_refused() -> None:
    router = routed(lambda net, h: h, way="grouped")
    router(X)
    router.module.a.weight.untyped_storage().resize_(0)
    with pytest.raises((TypeError, RuntimeError)):
        router(X)


class Encoder:
    """An encoder of a NeRF codebase: a callable object that is no module."""

    def __init__(self) -> None:
        self.alpha = 1.0

    def __call__(self, x: Tensor) -> Tensor:
        return x + self.alpha * torch.sin(4 * x)


def scaled(factors: list[float], x: Tensor) -> Tensor:
    return factors[0] * x


class Deep(nn.Module):
    """A module whose forward reads a number that its attribute holds several levels deep."""

    def __init__(self, held: Any, read: Callable[[Any, Tensor], Tensor]) -> None:
        super().__init__()
        self.layer, self.held, self.read = nn.Linear(3, 2), held, read

    def forward(self, x: Tensor) -> Tensor:
        return self.layer(self.read(self.held, x))


@pytest.mark.parametrize(
    ("held", "read", "change"),
    [
        (Encoder(), lambda held, x: held(x), lambda held: setattr(held, "alpha", 0.0)),
        (Encoder().__call__, lambda held, x: held(x), lambda held: setattr(held.__self__, "alpha", 0.0)),
        (partial(torch.mul, other=2.0), lambda held, x: held(x), lambda held: held.keywords.update(other=0.5)),
        (partial(Encoder()), lambda held, x: held(x), lambda held: setattr(held.func, "alpha", 0.0)),
        (partial(scaled, [2.0]), lambda held, x: held(x), lambda held: held.args[0].__setitem__(0, 0.5)),
        ({"a": {"b": 2.0}}, lambda held, x: held["a"]["b"] * x, lambda held: held["a"].update(b=0.5)),
        ([[2.0]], lambda held, x: held[0][0] * x, lambda held: held[0].__setitem__(0, 0.5)),
        (types.SimpleNamespace(a=[torch.ones(1)]), lambda held, x: held.a[0] * x, lambda held: held.a[0].mul_(3)),
        (torch.distributions.Normal(0, 2), lambda held, x: held.scale * x, lambda held: setattr(held, "scale", 0.5)),
    ],
    ids=["object", "method", "partial", "partial object", "partial list", "dicts", "lists", "tensor", "library"],
)
def test_numbers_deep_in_an_attribute_are_followed(held: Any, read: Any, change: Any) -> None:
    router, x = VoronoiRouter(Deep(held, read), 2, fuse=True), torch.rand(40, 3)
    cells = torch.arange(40) % 2
    before = router(x, cells=cells)
    change(router.module.held)
    after = router(x, cells=cells)
    expected = torch.stack([router.cell(int(cell))(row) for cell, row in zip(cells, x, strict=True)])
    assert router.explain() == "forward: fused" and not torch.allclose(before, after)
    torch.testing.assert_close(after, expected)
