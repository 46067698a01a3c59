"""Edge cases of routing: module hooks, fields that do more than their table, unusual arguments, threads, failures."""

from __future__ import annotations

from typing import Any

import pytest
import torch
import torch.utils.checkpoint
from helpers import refuses
from router_loop import masked_loop, perturb
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


def close(actual: Any, expected: Any) -> None:
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-5)


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
    named = router(x, directions=rays, ray_index=index)
    for actual in (router(x, rays, index), named, router(x, rays, ray_index=index), by_rule(x, rays, index)):
        close(actual, expected)


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
def test_coords_of_a_field_with_a_table(rule: str, generator: torch.Generator) -> None:
    """The ``coords`` rule decides the cell, not the position itself."""
    module = NeRF(width=16, depth=2, position_encoding="integrated") if rule == "slice" else NeRF(width=16, depth=2)
    x = samples()[:, :3]
    if rule == "slice":
        x = torch.cat((x, x.abs() * 1e-2), 1)
    where = {"function": lambda p, *_: p.flip(-1), "slice": slice(3, 6), "at the call": None}[rule]
    router = perturb(VoronoiRouter(module, centres(), coords=where), generator)
    at = x[:, 3:] if rule == "slice" else x.flip(-1)
    actual = router(x, directions(40), coords=at if rule == "at the call" else None)
    cells = router.diagram.locate(at)
    assert cells.unique().numel() > 1 or rule == "slice"
    close(list(actual), masked_loop(router, x, directions(40), cells=cells))


def test_an_argument_that_is_called_coords() -> None:
    class NamesCoords(nn.Linear):
        def forward(self, coords: Tensor) -> Tensor:
            return super().forward(coords)

    module, x = NamesCoords(5, 3), samples()
    router = VoronoiRouter(module, centres(), coords="first3")
    for _ in range(3):
        close(router(coords=x), module(x))
        close(router(x), module(x))
    refuses("coords must name the positions", VoronoiRouter(module, centres()), coords=x)


def test_a_backend_that_is_not_there_is_no_reason_for_a_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backends, "missing", lambda backend, device: "it is not here" if backend == "warp" else None)
    backends._choose_once.cache_clear()
    router = VoronoiRouter(network(), centres(), coords="first3", backend="warp")
    refuses("warp", router, samples(), error=BackendUnavailable)


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
            refuses("memory", router, x, error=error)
        close(router(x), expected)
        assert router.explain() == "forward: grouped"


def test_centres_go_where_the_module_is(device: torch.device) -> None:
    """Centres move from the CPU to the module's device, even a single centre, which no look-up needs."""
    router, x = VoronoiRouter(network().to(device), torch.zeros(1, 3), coords="first3"), samples().to(device)
    router.generator = torch.Generator(device).manual_seed(3)
    coarse = router(x)
    router.subdivide(3, points=x[:, :3], weights=torch.ones(40, device=device))
    assert router.diagram.centres.device.type == device.type and router.num_cells == 3
    close(router(x), coarse)
