"""A router's module never changes during a call, so other threads can save, copy and call it meanwhile.

What a call caches is complete as soon as other calls can see it, also after an interrupt in this call.
"""

from __future__ import annotations

import copy
import functools
import io
import itertools
import pickle
import sys
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Any

import pytest
import torch
from ops.foreign_kinds import TRUNCATED
from router_loop import masked_loop, uniform
from torch import Tensor, nn

from voronerf import NeRF, VoronoiRouter
from voronerf.router import optimizers
from voronerf.router.program import CellProgram

CENTRES = torch.rand(5, 3, generator=torch.Generator().manual_seed(1)) * 2 - 1


class Field(nn.Module):
    """A field that lets other threads run in ``forward``. ``Distances`` has no rule and runs cell by cell."""

    def __init__(self, last: nn.Module) -> None:
        super().__init__()
        self.net, self.last = nn.Sequential(nn.Linear(3, 16), nn.ReLU(), nn.Linear(16, 3)), last

    def forward(self, x: Tensor) -> Tensor:
        time.sleep(0)  # releases the GIL
        h = self.net(x)
        time.sleep(0)
        return self.last(h)


class Distances(nn.Linear):
    def forward(self, x: Tensor) -> Tensor:
        return torch.cdist(x, self.weight)


def shapes(module: nn.Module) -> dict[str, tuple[int, ...]]:
    return {name: tuple(value.shape) for name, value in module.state_dict().items()}


def saved_by_torch(router: VoronoiRouter) -> VoronoiRouter:
    file = io.BytesIO()
    torch.save(router, file)
    file.seek(0)
    return torch.load(file, weights_only=False)


READERS: dict[str, Callable[[VoronoiRouter], dict[str, Any]]] = {
    "state_dict": shapes,
    "deepcopy": lambda router: shapes(copy.deepcopy(router)),
    "pickle": lambda router: shapes(pickle.loads(pickle.dumps(router))),
    "torch.save": lambda router: shapes(saved_by_torch(router)),
    "named_parameters": lambda router: {name: tuple(p.shape) for name, p in router.named_parameters()},
    "cell": lambda router: shapes(router.cell(3)),
}


@pytest.mark.filterwarnings("ignore:VoronoiRouter")
@pytest.mark.parametrize(("last", "way"), [(Distances(3, 2), "cell by cell"), (nn.Linear(3, 2), "grouped")])
def test_reading_beside_calls(last: nn.Module, way: str) -> None:
    router, x = VoronoiRouter(Field(last), CENTRES, coords="first3"), uniform((300,))
    expected, wanted = router(x), {name: read(router) for name, read in READERS.items()}
    assert router.explain().startswith(f"forward: {way}")
    stop, calls = threading.Event(), [0, 0]

    def call(i: int) -> None:
        while not stop.is_set():
            torch.testing.assert_close(router(x), expected)
            calls[i] += 1

    def read_all() -> None:
        try:
            until, rounds = time.monotonic() + 0.5, 0
            while time.monotonic() < until or rounds < 5:
                rounds += 1
                for name, read in READERS.items():
                    assert read(router) == wanted[name], name
        finally:
            stop.set()

    assert not together([lambda: call(0), lambda: call(1), read_all])
    assert min(calls) > 0


class Itself(nn.Linear):
    """A layer whose ``forward`` changes the layer itself by ``act``."""

    def __init__(self, act: Callable[[Any], Any]) -> None:
        super().__init__(3, 2)
        self.act, self.calls = [act], 0

    def forward(self, x: Tensor) -> Tensor:
        self.act[0](self)
        return super().forward(x)


def adds(net: nn.Module) -> None:
    net.late = nn.Parameter(torch.zeros(2))


def removes(net: nn.Module) -> None:
    weight = net.weight
    del net.weight
    net.weight = weight * 1


def replaces(net: nn.Module) -> None:
    weight = net.weight
    del net.weight
    net.register_parameter("weight", nn.Parameter(torch.zeros(weight.shape)))


def resets(net: nn.Module) -> None:
    nn.init.zeros_(net.weight)


@pytest.mark.parametrize("n", [60, 5])
@pytest.mark.parametrize(
    ("act", "says"),
    [
        (adds, "must not add or remove parameters, but does so with 'late'"),
        (removes, "must not add or remove parameters, but does so with 'weight'"),
        (replaces, "must not replace parameters, but does so with 'weight'"),
        (resets, "must not write into its parameters, but does so with 'weight'"),
    ],
)
def test_what_forward_does_to_its_parameters_is_refused_and_changes_nothing(act: Any, says: str, n: int) -> None:
    router = VoronoiRouter(Itself(act), CENTRES, coords="first3")
    before = copy.deepcopy(router.state_dict())
    for _ in range(2):
        with pytest.raises(TypeError, match=f"VoronoiRouter: Itself.forward {says}"):
            router(uniform((n,)))
        result = router.state_dict()
        assert result.keys() == before.keys() and all(torch.equal(result[name], before[name]) for name in before)


def keeps(net: Any) -> None:
    net.kept, net.calls = net.weight, net.calls + 1


def test_attributes_are_of_one_run() -> None:
    router, x = VoronoiRouter(Itself(keeps), CENTRES, coords="first3"), uniform((60,))
    result = router(x)
    torch.testing.assert_close(result, masked_loop(router, x)[0])
    assert router.module.calls == 0 and not hasattr(router.module, "kept")


class Caches(nn.Linear):
    made: Any = None

    def forward(self, x: Tensor) -> Tensor:
        if self.made is None:
            self.made = self.weight.exp()
        return x @ self.made.T


@pytest.mark.parametrize("k", [1, 5])
def test_what_is_made_of_one_cells_parameters_is_not_for_another(k: int) -> None:
    router, x = VoronoiRouter(Caches(3, 2), CENTRES[:k], coords="first3"), uniform((60,))
    with torch.no_grad():
        router.module.weight += torch.rand(k, 2, 3)
    for _ in range(2):
        torch.testing.assert_close(router(x), masked_loop(router, x)[0])
        with torch.no_grad():
            router.module.weight *= 2


class Helper:
    def __init__(self, layer: nn.Module) -> None:
        self.layer = layer

    def __call__(self, x: Tensor) -> Tensor:
        return self.layer(x)


class Indirect(nn.Module):
    """A module that reaches layers by lists, dicts, objects, methods, partials and a child's link to its parent."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.b, self.c, self.d = (nn.Linear(3, 3) for _ in range(4))
        self.listed, self.named, self.helper = [self.a, 1], {"b": (self.b,)}, Helper(self.c)
        self.step, self.part = self.last, functools.partial(self.last, again=2)
        object.__setattr__(self.d, "parent", self)

    def last(self, x: Tensor, again: int = 1) -> Tensor:
        for _ in range(again):
            x = self.d(x)
        return x

    def forward(self, x: Tensor) -> Tensor:
        x = self.named["b"][0](self.listed[0](x))
        return self.d.parent.a(self.part(self.step(self.helper(x))))


@pytest.mark.parametrize("fuse", [False, True])
def test_parts_are_found_by_all_ways(fuse: bool) -> None:
    router, x = VoronoiRouter(Indirect(), CENTRES, coords="first3", fuse=fuse), uniform((60,))
    with torch.no_grad():
        for parameter in router.parameters():
            parameter += torch.rand(parameter.shape) - 0.5
    torch.testing.assert_close(router(x), masked_loop(router, x)[0])
    assert router.explain().startswith("forward: fused" if fuse else "forward: grouped")


class Scaled(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.a, self.b = nn.Linear(3, 4), nn.Linear(4, 2)
        self.register_buffer("scale", torch.tensor(2.0))

    def density(self, x: Tensor) -> Tensor:
        return self.b(torch.tanh(self.a(x)) * self.scale)

    def forward(self, x: Tensor) -> Tensor:
        return self.density(x) * 2


def scaled(**options: Any) -> VoronoiRouter:
    torch.manual_seed(0)
    return VoronoiRouter(Scaled(), CENTRES[:3], coords="first3", methods=["density"], **options)


def radiance_field() -> VoronoiRouter:
    torch.manual_seed(0)
    return VoronoiRouter(NeRF(width=8, depth=2, view_directions=False), CENTRES[:3])


def call_again(router: VoronoiRouter) -> None:
    """Compares calls with the loop over masks, before and after changes of a buffer and of the centres."""
    x = uniform((60,))
    for _ in range(2):
        for method in ("forward", *router.methods):
            expected = masked_loop(router, x, method=method)
            torch.testing.assert_close(list(getattr(router, method)(x).unsqueeze(0)), expected)
        router.module.scale.mul_(3)
        router.diagram.centres.mul_(0.5)
    bias = router.module.b.bias
    router.module.b.bias = nn.Parameter(torch.zeros(2, 2))
    with pytest.raises(ValueError, match=r"parameters of module must be \[3, ...\]"):
        router(x)
    router.module.b.bias = bias
    router(x)


def ask_again(router: VoronoiRouter) -> None:
    x = uniform((60,))
    assert isinstance(router.program(x), CellProgram)
    expected = masked_loop(router, x)
    torch.testing.assert_close(list(router(x)), expected)


#: Functions that make what is cached.
CACHING = {
    *("_look", "with_activation", "_check_parameters", "module_dependencies", "find", "evaluate", "_plan", "_group"),
    *("changed", "snapshot", "index"),
}


def interrupted(function: Callable[[], Any], at: int) -> bool:
    """Calls a function; raises KeyboardInterrupt in it at one line of CACHING. Returns whether the line was reached."""
    lines = itertools.count()

    def trace(frame: FrameType, event: str, value: Any) -> Any:
        if frame.f_code.co_name not in CACHING:
            return None
        if event == "line" and next(lines) == at:
            raise KeyboardInterrupt
        return trace

    old = sys.gettrace()
    sys.settrace(trace)
    try:
        function()
    except KeyboardInterrupt:
        return True
    finally:
        sys.settrace(old)
    return False


FIRST: dict[str, tuple[Callable[[], VoronoiRouter], Callable[[VoronoiRouter], Any], Callable[..., None]]] = {
    "fused": (lambda: scaled(fuse=True), lambda router: router(uniform((60,))), call_again),
    "grouped": (lambda: scaled(way="grouped"), lambda router: router(uniform((60,))), call_again),
    "program": (radiance_field, lambda router: router.program(uniform((60,))), ask_again),
}


@pytest.mark.filterwarnings("ignore:VoronoiRouter")
@pytest.mark.parametrize("name", FIRST)
def test_an_interrupted_first_call_caches_nothing_by_halves(name: str) -> None:
    make, first, again = FIRST[name]
    faults = list[str]()
    for at in itertools.count(0, 5):  # every fifth line, to save time
        router = make()
        if not interrupted(lambda: first(router), at):  # noqa: B023
            break
        try:
            again(router)
        except BaseException as error:
            faults.append(f"line {at}: {type(error).__name__}: {error}")
    assert at > 20 and not faults, f"{len(faults)} of {at}: {faults[0]}"


def together(functions: list[Callable[[], Any]]) -> list[str]:
    """Calls functions in a thread each, at the same time; returns their errors."""
    start, faults = threading.Barrier(len(functions)), list[str]()

    def run(function: Callable[[], Any]) -> None:
        start.wait(60)
        try:
            function()
        except Exception as error:
            faults.append(f"{type(error).__name__}: {error}")

    threads = [threading.Thread(target=run, args=(function,)) for function in functions]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    return faults


def test_programs_that_threads_ask_for_together() -> None:
    faults, x, interval = list[str](), uniform((8,)), sys.getswitchinterval()
    sys.setswitchinterval(1e-6)  # Python changes threads as often as it can
    try:
        for _ in range(40):
            router = radiance_field()
            faults += together([lambda: router.program(x)] * 3)  # noqa: B023
    finally:
        sys.setswitchinterval(interval)
    assert not faults


def test_cells_may_be_frozen_while_an_optimizer_lists_frozen_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    routers, list_parameters = [scaled(), scaled()], optimizers.cell_parameters
    others = [router.module for router in routers]
    frozen = scaled()
    frozen.freeze([1], optimizer=(optimizer := torch.optim.SGD(frozen.parameters(), 1e-3)))

    def meanwhile(module: nn.Module) -> list[nn.Parameter]:
        if others:  # as another thread may do
            optimizers.freeze_cells(others.pop(), torch.tensor([True, False, False]))
        return list_parameters(module)

    monkeypatch.setattr(optimizers, "cell_parameters", meanwhile)
    optimizer.step()
    assert not others and len(optimizers.trained_parts([*frozen.parameters()])) == 4


def test_networks_traced_in_two_threads_leave_custom_functions_as_they_were() -> None:
    before, x = torch.autograd.Function.apply, torch.rand(60, 3)
    routers = [VoronoiRouter(TRUNCATED.make(), CENTRES, coords="first3", fuse=True)]
    routers.append(copy.deepcopy(routers[0]))
    results: list[Tensor] = []
    assert not together([lambda router=router: results.append(router(x)["sigma"]) for router in routers])
    for result in results:
        torch.testing.assert_close(result, routers[0].cell(0)(x)["sigma"], rtol=1e-4, atol=1e-5)
    assert len(results) == 2 and torch.autograd.Function.apply == before
