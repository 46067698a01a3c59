"""Edge cases of routing: module hooks, fields that do more than their table, unusual arguments, threads, failures."""

from __future__ import annotations

import copy
import threading
from typing import Any

import pytest
import torch
import torch.utils.checkpoint
from ops.foreign_kinds import TRUNCATED
from torch import Tensor, nn

from voronerf import NeRF, VoronoiRouter
from voronerf.ops._core import backends
from voronerf.ops._core.backends import BackendUnavailable
from voronerf.router import rules


def network() -> nn.Sequential:
    return nn.Sequential(nn.Linear(5, 8), nn.ReLU(), nn.Linear(8, 3))


def samples(n: int = 40) -> Tensor:
    return torch.rand(n, 5, generator=torch.Generator().manual_seed(n)) * 2 - 1


def centres(k: int = 4) -> Tensor:
    return torch.rand(k, 3, generator=torch.Generator().manual_seed(k)) * 2 - 1


def close(actual: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-5)


# Hooks ----------------------------------------------------------------------------------------------------------------


def test_hooks_of_the_module_itself_run() -> None:
    module = network()
    router, x = VoronoiRouter(module, centres(), coords="first3"), samples()
    for _ in range(3):
        close(router(x), module(x))
    handle = router.module.register_forward_hook(lambda m, arguments, out: 2 * out)
    for _ in range(3):
        close(router(x), 2 * module(x))
    handle.remove()
    router.module.register_forward_pre_hook(lambda m, arguments: (arguments[0] + 1,))
    close(router(x), module(x + 1))


# Fields with a layer table --------------------------------------------------------------------------------------------


class Moved(NeRF):
    """A field whose forward does more than its table says."""

    def forward(self, positions: Tensor, directions: Tensor | None = None, ray_index: Tensor | None = None) -> Any:
        return super().forward(positions * 2 + 0.1, directions, ray_index)


def directions(n: int) -> Tensor:
    return nn.functional.normalize(torch.randn(n, 3, generator=torch.Generator().manual_seed(1)), dim=-1)


@pytest.mark.filterwarnings("ignore:.*runs cell by cell")
def test_such_fields_as_the_renderer_calls_them() -> None:
    field, x = Moved(width=16, depth=2), samples()[:, :3]
    rays, index = directions(10), (torch.arange(40) % 10).int()
    router = VoronoiRouter(field, centres())
    expected = field(x, rays, index)
    by_rule = VoronoiRouter(field, centres(), coords=lambda p, d, i: p.flip(-1))
    arguments = {"directions": rays, "ray_index": index}
    for actual in (
        router(x, rays, index),
        router(x, **arguments),
        router(x, rays, ray_index=index),
        by_rule(x, rays, index),
    ):
        for part, whole in zip(actual, expected, strict=True):
            close(part, whole)
    compiled = torch.compile(router, backend="eager")
    for part, whole in zip(compiled(x, rays, index), expected, strict=True):
        close(part, whole)


@pytest.mark.filterwarnings("ignore:.*runs cell by cell")
def test_hooks_and_weight_norm_of_a_field_with_a_table() -> None:
    field, x = NeRF(width=16, depth=2), samples()[:, :3]
    router = VoronoiRouter(field, centres())
    close(router(x, directions(40))[0], field(x, directions(40))[0])
    for module in (router.module, field):
        module.register_forward_hook(lambda m, arguments, out: (out[0] * 0.5, out[1]))
    close(router(x, directions(40))[0], field(x, directions(40))[0])
    field = NeRF(width=16, depth=2)
    torch.nn.utils.parametrizations.weight_norm(field.trunk[1])
    close(VoronoiRouter(field, centres())(x, directions(40))[0], field(x, directions(40))[0])


@pytest.mark.parametrize("rule", ["function", "slice", "at the call"])
def test_coords_of_a_field_with_a_table(rule: str) -> None:
    """The ``coords`` rule decides the cell, not the position itself."""
    module = NeRF(width=16, depth=2, position_encoding="integrated") if rule == "slice" else NeRF(width=16, depth=2)
    x = samples()[:, :3]
    if rule == "slice":
        x = torch.cat((x, x.abs() * 1e-2), 1)
    where = {"function": lambda p, *_: p.flip(-1), "slice": slice(3, 6), "at the call": None}[rule]
    router = VoronoiRouter(module, centres(), coords=where)
    with torch.no_grad():
        for parameter in router.module.parameters():
            parameter += 0.2 * torch.randn_like(parameter)
    at = x[:, 3:] if rule == "slice" else x.flip(-1)
    actual = router(x, directions(40), coords=at) if rule == "at the call" else router(x, directions(40))
    cells = router.diagram.locate(at)
    assert cells.unique().numel() > 1 or rule == "slice"
    for cell in cells.unique().tolist():
        rows = cells == cell
        for part, expected in zip(actual, router.cell(cell)(x[rows], directions(40)[rows]), strict=True):
            close(part[rows], expected)


# Arguments ------------------------------------------------------------------------------------------------------------


class NamesCoords(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.net = network()

    def forward(self, coords: Tensor) -> Tensor:
        return self.net(coords)


def test_an_argument_that_is_called_coords() -> None:
    module, x = NamesCoords(), samples()
    router = VoronoiRouter(module, centres(), coords="first3")
    for _ in range(3):
        close(router(coords=x), module(x))
        close(router(x), module(x))
    with pytest.raises(ValueError, match="coords must name the positions"):
        VoronoiRouter(module, centres())(coords=x)


# Failures -------------------------------------------------------------------------------------------------------------


def test_a_backend_that_is_not_there_is_no_reason_for_a_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backends, "missing", lambda backend, device: "it is not here" if backend == "warp" else None)
    backends._choose_once.cache_clear()
    router = VoronoiRouter(network(), centres(), coords="first3", backend="warp")
    with pytest.raises(BackendUnavailable, match="warp"):
        router(samples())


def test_memory_that_ran_out_once_is_no_reason_for_a_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    router, x = VoronoiRouter(network(), centres(), coords="first3"), samples()
    expected = router(x)

    def full(*_: Any, **__: Any) -> Tensor:
        raise torch.OutOfMemoryError("out of memory")

    def full_cpu(*_: Any, **__: Any) -> Tensor:
        return torch.empty(1 << 60)

    for function, error in ((full, torch.OutOfMemoryError), (full_cpu, RuntimeError)):
        with monkeypatch.context() as patched:
            patched.setattr(rules, "grouped_linear", function)
            with pytest.raises(error, match="memory"):
                router(x)
        close(router(x), expected)
        assert router.explain() == "forward: grouped"


def test_state_that_is_loaded_in_inference_mode() -> None:
    router, x = VoronoiRouter(network(), centres(), coords="first3"), samples()
    other = VoronoiRouter(network(), centres(6), coords="first3")
    expected = other(x)
    with torch.inference_mode():
        router.load_state_dict(other.state_dict())
        for _ in range(3):
            close(router(x), expected)
    for _ in range(3):
        close(router(x), expected)
    with torch.inference_mode():
        close(VoronoiRouter(other.cell(0), centres(), coords="first3")(x), other.cell(0)(x))


def test_networks_traced_in_two_threads_leave_custom_functions_as_they_were() -> None:
    before = torch.autograd.Function.apply
    routers = [VoronoiRouter(TRUNCATED.make(), centres(), coords="first3", fuse=True)]
    routers.append(copy.deepcopy(routers[0]))
    x, results = torch.rand(60, 3), {}
    start = threading.Barrier(2)

    def call(i: int) -> None:
        start.wait(20)
        results[i] = routers[i](x)["sigma"]

    threads = [threading.Thread(target=call, args=(i,)) for i in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    close(results[0], results[1])
    close(results[0], routers[0].cell(0)(x)["sigma"])
    assert torch.autograd.Function.apply == before


def test_centres_go_where_the_module_is(device: torch.device) -> None:
    """Centres move from the CPU to the module's device, even a single centre, which no look-up needs."""
    router, x = VoronoiRouter(network().to(device), torch.zeros(1, 3), coords="first3"), samples().to(device)
    router.generator = torch.Generator(device).manual_seed(3)
    coarse = router(x)
    router.subdivide(3, points=x[:, :3], weights=torch.ones(40, device=device))
    assert router.diagram.centres.device.type == device.type and router.num_cells == 3
    close(router(x), coarse)
