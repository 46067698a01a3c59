"""A router's module never changes during a call, so other threads can save, copy and call it meanwhile."""

from __future__ import annotations

import copy
import functools
import io
import pickle
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest
import torch
from convention_harness import uniform
from router_fields import masked_loop
from torch import Tensor, nn

from voronerf import VoronoiRouter

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
    stop, faults, calls = threading.Event(), list[str](), [0, 0]

    def call(i: int) -> None:
        while not stop.is_set():
            try:
                torch.testing.assert_close(router(x), expected)
                calls[i] += 1
            except Exception as error:
                faults.append(f"call: {error}")
                return

    threads = [threading.Thread(target=call, args=(i,)) for i in range(2)]
    for thread in threads:
        thread.start()
    until, reads = time.monotonic() + 0.5, 0
    while time.monotonic() < until or reads < 30:
        for name, read in READERS.items():
            reads += 1
            try:
                found = read(router)
            except Exception as error:
                found = {"error": repr(error)}
            if found != wanted[name]:
                faults.append(f"{name}: {found}")
    stop.set()
    for thread in threads:
        thread.join(60)
    assert not faults, f"{len(faults)} of {reads}, such as {faults[0]}"
    assert min(calls) > 0


# Modules that change themselves ---------------------------------------------------------------------------------------


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
    torch.testing.assert_close(result, masked_loop(router, router.diagram.locate(x), [x])[0][0])
    assert router.module.calls == 0 and not hasattr(router.module, "kept")


class Caches(nn.Linear):
    """A layer that caches a function of its weight and ignores later changes of the weight."""

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
        torch.testing.assert_close(router(x), masked_loop(router, router.diagram.locate(x), [x])[0][0])
        with torch.no_grad():
            router.module.weight *= 2


class Helper:
    """An object that holds a module, but is not a module."""

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
    torch.testing.assert_close(router(x), masked_loop(router, router.diagram.locate(x), [x])[0][0])
    assert router.explain().startswith("forward: fused" if fuse else "forward: grouped")
