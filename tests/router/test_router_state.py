"""State of a module outside of parameters and buffers: layers in lists, kept results, counters, other attributes."""

from __future__ import annotations

import collections
import copy
import functools
import math
import types
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch
from router_loop import Built, masked_loop, uniform
from torch import Tensor, nn

from voronerf import VoronoiRouter

CENTRES = torch.rand(4, 3, generator=torch.Generator().manual_seed(1)) * 2 - 1
WAYS: list[dict[str, Any]] = [{}, {"way": "loop"}, {"fuse": True}]
every_way = pytest.mark.parametrize("options", WAYS, ids=str)


class Blocks(nn.Module):
    """N-BEATS of philipperemy: blocks in lists, whose parameters a ParameterList registers."""

    def __init__(self, keep: Callable[[list[nn.Module]], Any]) -> None:
        super().__init__()
        blocks = [nn.Sequential(nn.Linear(3, 8), nn.Tanh(), nn.Linear(8, 3)) for _ in range(4)]
        self.blocks = keep(blocks)
        self.weights = nn.ParameterList([p for block in blocks for p in block.parameters()])

    def forward(self, x: Tensor) -> Tensor:
        held = self.blocks
        held = list(held.values()) if isinstance(held, dict) else getattr(held, "blocks", held)
        for block in (block for part in held for block in (part if type(part) is list else [part])):
            x = x + block(x)
        return x


KEPT: dict[str, Callable[[list[nn.Module]], Any]] = {
    "list": list,
    "lists in a list": lambda blocks: [blocks[:2], blocks[2:]],
    "dict": lambda blocks: dict(enumerate(blocks)),
    "object": lambda blocks: types.SimpleNamespace(blocks=blocks),
}


@pytest.mark.parametrize(
    ("keep", "options"), [*(("list", way) for way in WAYS), *((keep, WAYS[2]) for keep in list(KEPT)[1:])], ids=str
)
def test_layers_in_lists_train_for_each_cell(keep: str, options: dict[str, Any]) -> None:
    router = VoronoiRouter.from_modules([Blocks(KEPT[keep]) for _ in CENTRES], CENTRES, coords="first3", **options)
    optimizer = torch.optim.SGD(router.parameters(), 0.1)
    for _ in range(3):
        x = uniform((50,))
        modules = [router.cell(i) for i in range(4)]
        actual, (expected,) = router(x), masked_loop(router, x, modules=modules)
        torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-5)
        optimizer.zero_grad()
        actual.square().mean().backward()
        expected.square().mean().backward()
        for name, parameter in router.module.named_parameters():
            slopes = torch.stack([m.get_parameter(name).grad for m in modules])
            torch.testing.assert_close(parameter.grad, slopes, rtol=1e-3, atol=1e-4)
        optimizer.step()
    assert len(list(router.parameters())) == 16 and router.module.weights[0].shape == (4, 8, 3)
    cell = router.cell(2)
    torch.testing.assert_close(cell(x), copy.deepcopy(cell)(x))
    router.load_cell(1, cell)
    torch.testing.assert_close(router.cell(1)(x), cell(x))
    router.subdivide(2, points=uniform((200,)))
    torch.testing.assert_close(router(x), masked_loop(router, x)[0], rtol=1e-4, atol=1e-5)


class Keeps(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.net, self.outputs, self.inner = nn.Linear(3, 2), dict[str, Tensor](), {"lists": list[Tensor]()}

    def forward(self, x: Tensor) -> Tensor:
        self.outputs["y"] = y = self.net(x)
        self.inner["lists"].append(y)
        return y.tanh()


@every_way
@pytest.mark.filterwarnings("ignore:VoronoiRouter.*restored after the call")
def test_a_module_that_keeps_results_in_containers(options: dict[str, Any]) -> None:
    field = Keeps()
    field(uniform((5,)))  # leaves results that require gradients
    router = VoronoiRouter(field, CENTRES, coords="first3", **options)
    optimizer = torch.optim.SGD(router.parameters(), 0.1)
    for _ in range(6):
        optimizer.zero_grad()
        router(x := uniform((40,))).square().sum().backward()
        optimizer.step()
    assert len(router.module.inner["lists"]) == 1 and len(router.module.outputs) == 1, "no call leaves items"
    for copied in (copy.deepcopy(router), router.part([0, 1, 2, 3])):
        torch.testing.assert_close(copied(x), router(x))
    assert router.cell(0)(x).shape == (40, 2)


class Caches(nn.Linear):
    def __init__(self) -> None:
        super().__init__(3, 2)
        self.cache = dict[str, Tensor]()

    def forward(self, x: Tensor) -> Tensor:
        if "table" not in self.cache:
            self.cache["table"] = torch.linspace(0, 1, 2)
        return super().forward(x) * self.cache["table"].to(x)


@every_way
def test_a_cache_that_the_first_call_fills_needs_no_warning(options: dict[str, Any]) -> None:
    router, x = VoronoiRouter(Caches(), CENTRES, coords="first3", **options), uniform((40,))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(2):
            torch.testing.assert_close(router(x), masked_loop(router, x)[0])


class Carries(nn.Linear):
    def __init__(self) -> None:
        super().__init__(3, 2)
        self.register_buffer("calls", torch.zeros(()))

    def forward(self, x: Tensor) -> Tensor:
        self.calls = self.calls + 1
        return super().forward(x) * self.calls


@every_way
def test_an_assigned_buffer_does_not_reach_the_next_cell(options: dict[str, Any]) -> None:
    router, x = VoronoiRouter(Carries(), CENTRES, coords="first3", **options), uniform((40,))
    for _ in range(3):
        torch.testing.assert_close(router(x), masked_loop(router, x)[0])
    assert router.module.calls == 0


class Counter(nn.Linear):
    step, size = 0, 0

    def __init__(self) -> None:
        super().__init__(3, 2)
        self.step, self.size = 0, 0

    def forward(self, x: Tensor) -> Tensor:
        self.size = len(x)  # written before it is read
        self.step += 1
        return super().forward(x) * min(1.0, 0.1 * self.step) + 0 * self.size


@every_way
def test_a_schedule_that_forward_advances_warns_once_with_its_line(options: dict[str, Any]) -> None:
    router = VoronoiRouter(Counter(), CENTRES, coords="first3", **options)
    with pytest.warns(UserWarning, match=r"Counter.forward changes Counter.step \(test_router_state.py:\d+: self.step"):
        router(uniform((40,)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        router(uniform((40,)))


@every_way
def test_a_result_that_counts_samples_counts_all_samples(options: dict[str, Any]) -> None:
    sized = Built(lambda net, x: {"y": net.fc(x), "sizes": [len(x), 2 * len(x), 37]}, fc=(3, 2))
    router = VoronoiRouter(sized, CENTRES, coords="first3", **options)
    for n in (50, 37, 41, 1, 0, 50):
        assert router(uniform((n,)))["sizes"] == [n, 2 * n, 37]


def test_another_number_among_the_results_warns() -> None:
    mean = Built(lambda net, x: (net.fc(x), float(x.detach().mean())), fc=(3, 2))
    router = VoronoiRouter(mean, CENTRES, coords="first3")
    with pytest.warns(UserWarning, match="returns a number in '.1' that depends on the samples of a cell"):
        router(uniform((40,)))


class Sine(nn.Module):
    def __init__(self, frequency: Any = 30.0, act: Any = None, **more: Any) -> None:
        super().__init__()
        self.fc, self.frequency, self.act = nn.Linear(3, 4), frequency, act
        for name, value in more.items():
            setattr(self, name, value)

    def forward(self, x: Tensor) -> Tensor:
        return torch.sin(self.fc(x) * self.frequency)


class Scale:
    __slots__ = ("factor",)

    def __init__(self, factor: float) -> None:
        self.factor = factor

    def apply(self, x: Tensor) -> Tensor:
        return x * self.factor


def with_buffer(value: float) -> nn.Module:
    module = Sine()
    module.register_buffer("buffer", torch.tensor([value, math.nan]), persistent=False)
    return module


def nested(value: Any) -> Any:
    for _ in range(9):
        value = [value]
    return value


OTHERS: dict[str, tuple[Callable[[], nn.Module], Callable[[], nn.Module]]] = {
    "frequency": (Sine, lambda: Sine(10.0)),
    "act, a Tanh instead of a ReLU,": (lambda: Sine(act=nn.ReLU()), lambda: Sine(act=nn.Tanh())),
    "act.negative_slope": (lambda: Sine(act=nn.LeakyReLU(0.1)), lambda: Sine(act=nn.LeakyReLU(0.2))),
    "mask": (lambda: Sine(mask=torch.ones(3)), lambda: Sine(mask=torch.zeros(3))),
    "bands": (lambda: Sine(bands=[1, {"a": 2.0}]), lambda: Sine(bands=[1, {"a": 3.0}])),
    "call": (lambda: Sine(call=torch.sin), lambda: Sine(call=torch.cos)),
    "part": (lambda: Sine(part=functools.partial(torch.add, 1)), lambda: Sine(part=functools.partial(torch.add, 2))),
    "scale": (lambda: Sine(scale=lambda x: 2 * x), lambda: Sine(scale=lambda x: 3 * x)),
    "extra": (Sine, lambda: Sine(extra=1)),
    "buffer": (lambda: with_buffer(1.0), lambda: with_buffer(2.0)),
    "method": (lambda: Sine(method=Scale(1.0).apply), lambda: Sine(method=Scale(2.0).apply)),
    "queue": (lambda: Sine(queue=collections.deque([1])), lambda: Sine(queue=collections.deque([2]))),
    "nested": (lambda: Sine(nested=nested(1)), lambda: Sine(nested=nested(2))),
    "kept": (lambda: Sine(kept=types.SimpleNamespace(a=1)), lambda: Sine(kept=types.SimpleNamespace(a=2))),
    "class, a Sigmoid instead of a Tanh,": (nn.Tanh, nn.Sigmoid),
}


@pytest.mark.parametrize("name", OTHERS)
def test_modules_that_differ_in_more_than_parameters_are_refused_by_name(name: str) -> None:
    make, other = OTHERS[name]
    with pytest.raises(ValueError, match=rf"modules\[1\]: module's {name} must equal the router's"):
        VoronoiRouter.from_modules([make(), other()])
    assert VoronoiRouter.from_modules([make(), make()]).num_cells == 2
    router = VoronoiRouter(make(), 2)
    with pytest.raises(ValueError, match=rf"load_cell: module's {name} must equal the router's"):
        router.load_cell(0, other())
    router.load_cell(0, make())


def test_modules_that_keep_different_results_are_one_network_for_each_cell() -> None:
    modules = [Keeps() for _ in CENTRES]
    for module in modules[1:]:
        module.last = module(uniform((7,)))
    router = VoronoiRouter.from_modules(modules, CENTRES, coords="first3")
    x = uniform((9,))
    torch.testing.assert_close(router(x), masked_loop(router, x)[0])
    cell = router.cell(1)
    with torch.no_grad():
        cell(x)  # leaves results without gradients
    router.load_cell(2, cell)


class Block(nn.Module):
    def __init__(self, store: Any) -> None:
        super().__init__()
        self.layer, self.store = nn.Linear(3, 3), store

    def forward(self, x: Tensor) -> Tensor:
        y = self.layer(x)
        self.store["losses"].append(y.square().sum(1))
        return y * self.store["scale"]


class Sharing(nn.Module):
    """Blocks that exchange values through one dict, which also contains itself, and a schedule in a dict."""

    def __init__(self) -> None:
        super().__init__()
        self.store: dict[str, Any] = {"losses": [], "steps": 0}
        self.store["self"] = self.store
        self.blocks = nn.ModuleList([Block(self.store) for _ in range(2)])

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        self.store["scale"], self.store["losses"][:] = x[:, :1].exp(), []
        self.store["steps"] += 1
        y = self.blocks[1](self.blocks[0](x)) * self.store["steps"]  # 1 in every cell
        return y, torch.stack(self.store["losses"], 1).sum(1)


@every_way
def test_submodules_that_share_a_container(options: dict[str, Any]) -> None:
    router = VoronoiRouter.from_modules([Sharing() for _ in CENTRES], CENTRES, coords="first3", **options)
    with pytest.warns(UserWarning, match="changes the items of Sharing.store, which are restored after the call"):
        router(uniform((40,)))
    for n in (40, 3):
        x = uniform((n,))
        expected = masked_loop(router, x)
        for actual, right in zip(router(x), expected, strict=True):
            torch.testing.assert_close(actual, right, rtol=1e-4, atol=1e-5)
    assert router.module.store.keys() == {"losses", "steps", "self"} and router.module.store["steps"] == 0
    assert router.module.store["self"] is router.module.blocks[1].store is router.module.store


class Turning(nn.Module):
    """A module whose attributes choose paths that differ in neither the functions nor, for 3 samples, the sizes."""

    def __init__(self) -> None:
        super().__init__()
        self.layer, self.scale = nn.Linear(3, 12), nn.Parameter(torch.rand(4))
        self.dim, self.joined = 0, False

    def forward(self, x: Tensor) -> Tensor:
        n = len(x)
        if self.joined:  # entries of a sample that are not adjacent
            a, b = self.layer(torch.cat([x, -x])).chunk(2)
            return a + b
        h = self.layer(x).view(n, 3, 4).transpose(0, self.dim) * self.scale
        return h.transpose(0, self.dim).sum(1)


def test_steps_of_other_paths_are_recorded_and_compared_with_the_loop() -> None:
    modules = [Turning() for _ in CENTRES]
    router = VoronoiRouter.from_modules(modules, CENTRES, coords="first3", way="grouped")
    for _ in range(2):
        for dim, joined, n in (
            (0, False, 50),
            (1, False, 3),
            (0, False, 4),
            (1, False, 4),
            (0, True, 50),
            (1, False, 50),
        ):
            router.module.dim, router.module.joined, x = dim, joined, uniform((n,))
            expected = masked_loop(router, x)
            torch.testing.assert_close(router(x), expected[0], rtol=1e-4, atol=1e-5)


class Masked(nn.Module):
    """BARF's schedule by a whole number: encoded features from ``bands`` on are 0."""

    def __init__(self, use: Callable[[Any, Tensor], Tensor]) -> None:
        super().__init__()
        self.layer, self.out, self.bands, self.use = nn.Linear(12, 6), nn.Linear(6, 2), 2, [use]

    def forward(self, x: Tensor) -> Tensor:
        e = torch.cat([x, x.sin(), x.cos(), x.square()], 1)
        return self.out(torch.tanh(self.layer(self.use[0](self, e))))


def masked(net: Any, e: Tensor) -> Tensor:
    mask = torch.ones_like(e)
    mask[:, net.bands :] = 0
    return e * mask


INDICES: dict[str, Callable[[Any, Tensor], Tensor]] = {
    "a mask": masked,
    "a slice": lambda net, e: torch.cat([e[:, : net.bands], 0 * e[:, net.bands :]], 1),
    "a dimension": lambda net, e: e.view(-1, 12, 1, 1).transpose(1, net.bands % 3 + 1).flatten(1),
    "a column": lambda net, e: e + e[:, net.bands : net.bands + 1],
}


@pytest.mark.filterwarnings("ignore:VoronoiRouter.*no longer fused")
@pytest.mark.parametrize("name", INDICES)
def test_a_number_that_is_an_index_is_followed(name: str) -> None:
    router = VoronoiRouter.from_modules([Masked(INDICES[name]) for _ in CENTRES], CENTRES, coords="first3", fuse=True)
    for bands in (2, 3, 5, 8, 4, 6, 7):
        router.module.bands, x = bands, uniform((30,))
        expected = masked_loop(router, x)
        torch.testing.assert_close(router(x), expected[0], rtol=1e-4, atol=1e-5)
