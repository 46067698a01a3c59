"""Calls with a cached program: later calls of the same kind run in two operations, with the same bits."""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers import refuses
from ops.foreign_fields import Heads, LearnedSine
from router_loop import Built, masked_loop, perturb, tensors
from torch import Tensor, nn

from voronerf import NeRF, VoronoiDiagram, VoronoiRouter
from voronerf.router import dispatch
from voronerf.router.dispatch import Dispatch

Call = Callable[[VoronoiRouter], Any]


class Named(nn.Module):
    def __init__(self, columns: int = 6) -> None:
        super().__init__()
        self.layer, self.gain = nn.Linear(columns, 4), 1.0

    def forward(self, x: Tensor, d: Tensor) -> dict[str, Any]:
        y = self.layer(torch.cat([x, d], -1)) * self.gain
        return {"colour": y[..., :3].sigmoid(), "more": [y[..., 3].exp()]}

    def density(self, x: Tensor) -> Tensor:
        return self.layer(torch.cat([x, x], -1))[..., 3].exp()


def routed(module: nn.Module, d: int = 3, **options: Any) -> VoronoiRouter:
    generator = torch.Generator().manual_seed(3)
    centres = options.pop("diagram", None) or torch.rand(6, d, generator=generator)
    router = VoronoiRouter(module, centres, **{"coords": f"first{d}", "fuse": True, **options})
    return perturb(router, generator)


def rows(n: int, columns: int = 3, seed: int = 0) -> Tensor:
    return torch.rand(n, columns, generator=torch.Generator().manual_seed(seed))


def outcome(router: VoronoiRouter, call: Call, *leaves: Tensor) -> list[Tensor]:
    """Returns the results and gradients of a call."""
    torch.manual_seed(4)
    results = tensors(call(router))
    wanted = [p for p in (*router.parameters(), *leaves) if p.requires_grad]
    if not any(tensor.requires_grad for tensor in results):
        return results
    total = sum((tensor.float().square().sum() for tensor in results), torch.zeros(()))
    return results + list(torch.autograd.grad(total, wanted, allow_unused=True, materialize_grads=True))


@pytest.fixture
def ordinary(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[Tensor]]:
    """Returns a function that calls a router without cached programs."""

    def run(router: VoronoiRouter, call: Call, *leaves: Tensor) -> list[Tensor]:
        with monkeypatch.context() as patch:
            patch.setattr(Dispatch, "find", lambda *_: None)
            return outcome(router, call, *leaves)

    return run


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Collects the methods of calls without a cached program."""
    results: list[str] = []
    route = VoronoiRouter._route_as_it_is

    def noted(self: VoronoiRouter, method: str, /, *args: Any, **kwargs: Any) -> Any:
        results.append(method)
        return route(self, method, *args, **kwargs)

    for name in ("_route_as_it_is", "_route_uncompiled"):  # the second runs calls once torch's compiler is imported
        monkeypatch.setattr(VoronoiRouter, name, noted)
    return results


def net(columns: int = 3) -> nn.Module:
    return nn.Sequential(nn.Linear(columns, 64), nn.ReLU(), nn.Linear(64, 4))


def nested() -> VoronoiDiagram:
    return VoronoiDiagram(rows(2, seed=7)).refine({0: rows(3, seed=8)})[0]


KINDS: dict[str, tuple[Callable[[], VoronoiRouter], Call]] = {
    "rows": (lambda: routed(net()), lambda r: r(rows(64))),
    "rays": (lambda: routed(Named()), lambda r: r(rows(60).reshape(6, 10, 3), rows(60, seed=1).reshape(6, 10, 3))),
    "by name": (lambda: routed(Named()), lambda r: r(rows(40), d=rows(40, seed=1))),
    "flags": (lambda: routed(Heads()), lambda r: r(rows(40), rows(40, seed=1), density_only=True)),
    "one dimension": (lambda: routed(Heads()), lambda r: r(rows(40), None)),
    "a number all cells share": (lambda: routed(LearnedSine(), share=["frequency"]), lambda r: r(rows(40))),
    "weights of functions": (
        lambda: routed(nn.utils.parametrizations.weight_norm(nn.Linear(3, 4))),
        lambda r: r(rows(40)),
    ),
    "coords": (lambda: routed(net()), lambda r: r(rows(40), coords=rows(40, seed=2))),
    "coords by a function": (lambda: routed(net(), coords=lambda x: x.flip(-1)), lambda r: r(rows(40))),
    "one cell": (lambda: routed(net(), diagram=VoronoiDiagram(torch.zeros(1, 3))), lambda r: r(rows(40))),
    "two dimensions": (lambda: routed(net(2), 2), lambda r: r(rows(40, 2))),
    "four dimensions": (lambda: routed(net(5), 4), lambda r: r(rows(40, 5))),
    "half precision": (lambda: routed(net().bfloat16()), lambda r: r(rows(40).bfloat16())),
    "nested": (lambda: routed(net(), diagram=nested()), lambda r: r(rows(40))),
    "stochastic": (lambda: routed(net(), assignment="stochastic", temperature=1.0), lambda r: r(rows(40))),
}


@pytest.mark.parametrize("gradients", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_a_second_call_is_known_and_gives_the_same_bits(
    kind: str, gradients: bool, ordinary: Callable[..., list[Tensor]], calls: list[str]
) -> None:
    make, call = KINDS[kind]
    router = make()
    with torch.set_grad_enabled(gradients):
        first = outcome(router, call)
        assert calls == ["forward"] and router.explain() == "forward: fused"
        second, expected = outcome(router, call), ordinary(router, call)
    assert calls == ["forward", "forward"], "the first, and the last"
    for actual in (first, second):
        assert all(a.dtype == b.dtype and torch.equal(a, b) for a, b in zip(actual, expected, strict=True))
    assert all(tensor.is_contiguous() for tensor in second)


def test_autocast_rounds_alike(ordinary: Callable[..., list[Tensor]], calls: list[str]) -> None:
    router = routed(net())
    with torch.autocast("cpu", torch.bfloat16):
        for _ in range(2):
            actual = outcome(router, lambda r: r(rows(64)))
        assert calls == ["forward"] and actual[0].dtype is torch.bfloat16
        expected = ordinary(router, lambda r: r(rows(64)))
    assert all(map(torch.equal, actual, expected))
    assert outcome(router, lambda r: r(rows(64)))[0].dtype is torch.float32


def test_of_any_number_of_samples(ordinary: Callable[..., list[Tensor]], calls: list[str]) -> None:
    router, sizes = routed(net()), (64, 1, 2, 7, 513)
    results = [outcome(router, lambda r, n=n: r(rows(n))) for n in sizes]
    assert calls == ["forward"]
    for n, result in zip(sizes, results, strict=True):
        assert all(map(torch.equal, result, ordinary(router, lambda r, n=n: r(rows(n)))))
    assert router(rows(0)).shape == (0, 4)


LEADS = [(1,), (2,), (7,), (300,), (1, 5), (6, 1), (1, 40), (9, 40)]


@pytest.mark.parametrize("leads", [LEADS, LEADS[::-1]], ids=["small first", "large first"])
@pytest.mark.parametrize("fuse", [True, False])
def test_few_samples_are_as_well_known_as_many(
    leads: list[tuple[int, ...]], fuse: bool, monkeypatch: pytest.MonkeyPatch, calls: list[str]
) -> None:
    router, probes, probe = routed(Named(), fuse=fuse), list[Any](), dispatch.Probe
    monkeypatch.setattr(dispatch, "Probe", lambda *made_of: probes.append(made_of) or probe(*made_of))
    for turn in range(3):
        del calls[:], probes[:]
        for lead in leads:
            x, d = rows(math.prod(lead)), rows(math.prod(lead), seed=1)
            expected = masked_loop(router, x, d)
            for actual, flat in zip(tensors(router(x.reshape(*lead, 3), d.reshape(*lead, 3))), expected, strict=True):
                torch.testing.assert_close(actual.flatten(0, len(lead) - 1), flat)
        assert len(probes) == 0 if turn else len(probes) <= 6, "one a kind, and again for the first large batch"
    assert calls == [] or not fuse


def test_what_few_samples_have_shown_is_looked_at_again_with_more(monkeypatch: pytest.MonkeyPatch) -> None:
    router, probes, probe = routed(Named()), list[Any](), dispatch.Probe
    monkeypatch.setattr(dispatch, "Probe", lambda *made_of: probes.append(made_of) or probe(*made_of))
    for n, count in ((1, 1), (7, 1), (300, 2), (1, 2), (40, 2)):
        router(rows(n), rows(n))
        assert len(probes) == count, n


class Given(nn.Module):
    """A field that takes one vector for all samples, or one vector per ray."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(6, 4)

    def forward(self, x: Tensor, t: Tensor) -> Tensor:
        t = t[:, None] if t.dim() < x.dim() else t
        return self.layer(torch.cat([x, t.expand(*x.shape[:-1], -1)], -1))

    def chosen(self, x: Tensor, t: Tensor) -> Tensor:
        return self.layer(torch.cat([x, t[0].expand(len(x), -1)], -1))


@pytest.mark.parametrize("sizes", [(1, 300, 1, 3, 1), (300, 1, 3)])
@pytest.mark.parametrize("method", ["forward", "chosen"])
@pytest.mark.parametrize("fuse", [True, False])
def test_a_row_beside_one_sample_may_be_what_all_share(fuse: bool, method: str, sizes: tuple[int, ...]) -> None:
    router, t = routed(Given(), fuse=fuse, methods=["chosen"]), rows(1, seed=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for n in sizes:
            x = rows(n)
            actual = getattr(router, method)(x, t) if method != "forward" else router(x, t)
            expected = masked_loop(router, x, t.expand(n, 3))
            torch.testing.assert_close([actual], expected)


def test_a_row_beside_one_ray_is_of_that_ray_or_of_all_samples() -> None:
    router = routed(Given())
    for r, s, rays in [(1, 6, 1), (1, 1, 1), (5, 9, 5), (1, 9, 1), (5, 9, 1), (5, 1, 5), (5, 1, 1), (1, 9, 1)]:
        x, t = rows(r * s), rows(rays, seed=1)
        codes = t.expand(r, 3).repeat_interleave(s, 0)
        for arguments in (t, t[:, None])[rays < r :]:  # [1, f] beside several rays is refused
            expected = masked_loop(router, x, codes)[0].reshape(r, s, 4)
            torch.testing.assert_close(router(x.reshape(r, s, 3), arguments), expected)


@pytest.mark.filterwarnings("ignore:VoronoiRouter")
@pytest.mark.parametrize("fuse", [True, False])
def test_of_few_samples_a_module_that_mixes_them_runs_cell_by_cell(fuse: bool) -> None:
    router = routed(Built(lambda net, x: net.layer(x - x.mean(0)), layer=(3, 2)), fuse=fuse)
    for x in (torch.zeros(1, 3), rows(7), rows(2)):
        torch.testing.assert_close(router(x), masked_loop(router, x)[0])
    refuses("it mixes samples", router, rows(40), error=TypeError)
    assert router.explain() == "forward: cell by cell: first calls of fewer than 8 samples"


def test_gradients_to_arguments_and_second_derivatives(ordinary: Callable[..., list[Tensor]], calls: list[str]) -> None:
    router, x = routed(nn.Sequential(nn.Linear(3, 16), nn.Tanh(), nn.Linear(16, 1))), rows(64).requires_grad_()

    def eikonal(router: VoronoiRouter) -> list[Tensor]:
        y = router(x)
        return [y, *torch.autograd.grad(y.sum(), x, create_graph=True)]

    outcome(router, eikonal, x)
    result = outcome(router, eikonal, x)
    assert calls == ["forward"]
    assert all(map(torch.equal, result, ordinary(router, eikonal, x)))


def test_frozen_cells(ordinary: Callable[..., list[Tensor]], calls: list[str]) -> None:
    router = routed(net())
    router(rows(64))
    router.freeze([0, 2])
    actual, expected = outcome(router, lambda r: r(rows(64))), ordinary(router, lambda r: r(rows(64)))
    assert calls == ["forward", "forward"]
    assert torch.equal(actual[0], expected[0])
    for own, other in zip(actual[1:], expected[1:], strict=True):
        assert torch.equal(own, other) and not own[[0, 2]].any() and own[[1, 3]].any()
    x = rows(64).requires_grad_()  # if x has gradients, the backward pass skips frozen cells
    for _ in range(2):
        actual = outcome(router, lambda r: r(x), x)
    assert not actual[-1][torch.isin(router.assign(x), torch.tensor([0, 2]))].any()


@pytest.mark.parametrize(
    "change", [lambda c: c.mul_(0.5), lambda c: c.data.mul_(0.5), lambda c: setattr(c, "data", c * 0.5)]
)
@pytest.mark.parametrize("inside", [False, True])
def test_methods_find_new_cells_after_a_write_to_the_centres(change: Callable[[Tensor], Any], inside: bool) -> None:
    """Even a write that no version counter counts, or to centres made in inference mode, is noticed."""
    router, x = routed(Named(), methods=["density"]), rows(64)
    with torch.no_grad():
        router.module.layer.bias.add_(torch.arange(router.num_cells)[:, None])
    with torch.inference_mode(inside):
        router.diagram.centres = router.diagram.centres.clone()
        router(x, rows(64, seed=1))
        change(router.diagram.centres)
        (expected,) = masked_loop(router, x, method="density")
        torch.testing.assert_close(router.density(x), expected)


def test_positions_of_another_dtype_than_the_indexed_centres() -> None:
    """The search index is of float32 centres, so float64 positions are compared without it."""
    router, x, d = routed(Named(), fuse=True), rows(64), rows(64, seed=1)
    router.subdivide(VoronoiDiagram(rows(2048, seed=2)))
    for _ in range(2):
        found = router(x, d, coords=x.double())["colour"]
    assert torch.equal(found, router(x, d)["colour"])


def doubled(module: nn.Module) -> nn.Module:
    copied = copy.deepcopy(module)
    with torch.no_grad():
        for parameter in copied.parameters():
            parameter.mul_(2)
    return copied


CHANGES: dict[str, Callable[[VoronoiRouter], Any]] = {
    "an attribute": lambda r: setattr(r.module, "gain", 2.0),
    "a hook": lambda r: r.module.layer.register_forward_hook(lambda module, args, result: result * 2),
    "the mode": lambda r: r.eval(),
    "a parameter": lambda r: setattr(r.module.layer, "weight", nn.Parameter(r.module.layer.weight * 2)),
    "the module": lambda r: setattr(r, "module", doubled(r.module)),
    "a part": lambda r: setattr(r.module, "layer", doubled(r.module.layer)),
    "values": lambda r: r.module.layer.weight.data.mul_(2),
    "the memory": lambda r: setattr(r.module.layer.weight, "data", r.module.layer.weight.data * 2),
    "the dtype": lambda r: r.double(),
    "the backend": lambda r: setattr(r, "backend", "reference"),
    "the cells": lambda r: r.subdivide(*r.diagram.refine({1: rows(3, seed=9)})),
    "the rule": lambda r: setattr(r, "coords", lambda x, d: d),
}


@pytest.mark.parametrize(
    ("change", "share"),
    [(change, ()) for change in CHANGES]
    + [(change, ("layer.weight",)) for change in ("a parameter", "values", "the memory", "the dtype", "the cells")],
)
def test_changes_are_followed(change: str, share: tuple[str, ...], ordinary: Callable[..., list[Tensor]]) -> None:
    router, x, d = routed(Named(), share=share), rows(64), rows(64, seed=1)
    for _ in range(2):
        before = router(x, d)["colour"]
    CHANGES[change](router)
    x, d = (x.double(), d.double()) if change == "the dtype" else (x, d)
    found = [outcome(router, lambda r: r(x, d)) for _ in range(2)]
    expected = ordinary(router, lambda r: r(x, d))  # makes a new cached call
    for each in found:
        assert all(map(torch.equal, each, expected))
    same = change in ("the mode", "the backend", "the cells")
    assert torch.allclose(router(x, d)["colour"].float(), before, atol=1e-6) == (same or change == "the dtype")


@pytest.mark.parametrize("frozen", [(), (0,), (1, 2, 3, 4, 5)])
@pytest.mark.parametrize("where", ["first2", "first3", "labels"])
def test_networks_may_share_all_that_a_call_reads(
    where: str, frozen: tuple[int, ...], ordinary: Callable[..., list[Tensor]]
) -> None:
    d, rule = (2, where) if where == "first2" else (3, None if where == "labels" else where)
    module = Built(lambda net, x: net.a(x).relu(), a=(3, 4), b=(4, 2))
    router, x = routed(module, d, coords=rule, share=["a.*"]), rows(64)
    labels = {"cells": torch.arange(64) % 6} if where == "labels" else {}
    router.freeze(frozen)
    found = [outcome(router, lambda r: r(x, **labels)) for _ in range(3)]
    expected = ordinary(router, lambda r: r(x, **labels))
    for each in found:
        for actual, wanted in zip(each, expected, strict=True):
            torch.testing.assert_close(actual, wanted)


def test_cached_calls_release_computed_parameters() -> None:
    """``swap_tensors`` refuses parameters that a graph holds."""
    sliced = Built(lambda net, x: x @ net.weight[:3], weight=nn.Parameter(rows(6, 2)))
    router, x = routed(sliced), rows(64)
    for _ in range(3):
        router(x).sum().backward()
    router.zero_grad()
    torch.utils.swap_tensors(router.module.weight, nn.Parameter(torch.zeros_like(router.module.weight)))
    assert not router(x).any()


def test_arguments_unlike_those_of_before(calls: list[str]) -> None:
    router, x = routed(Named()), rows(64)
    router(x, rows(64, seed=1))
    refuses("d must be per sample", router, x, rows(63))
    refuses("must be floating-point", router, x.int(), x, error=TypeError)
    with torch.inference_mode():
        inside = rows(64)
    del calls[:]
    assert torch.equal(router(inside, inside)["colour"], router(inside.clone(), inside.clone())["colour"])
    assert calls == ["forward"], "tensors of inference mode are copied where gradients are kept"


@pytest.mark.parametrize("fuse", [True, False])
def test_what_samples_share_may_be_of_inference_mode(fuse: bool) -> None:
    with torch.inference_mode():
        t, module = rows(1, seed=1), Given()
        module.register_buffer("scale", 1 + rows(1, 6, seed=2))
    router = routed(module, fuse=fuse)
    router.module.layer.register_forward_pre_hook(lambda _, args: args[0] * router.module.scale)
    x = rows(40).requires_grad_()
    for argument in (t, rows(40)):
        for _ in range(3):
            actual = outcome(router, lambda r: r(x, argument), x)  # noqa: B023
        (expected,) = masked_loop(router, x, argument.clone().expand(40, 3))
        torch.testing.assert_close(actual[0], expected)
        torch.testing.assert_close(actual[-1], torch.autograd.grad(expected.square().sum(), x)[0])


def test_a_field_with_a_layer_table_explains_itself_as_any_other() -> None:
    arguments, traced = VoronoiRouter(NeRF(width=16, depth=2), rows(6)), routed(net())
    assert arguments.explain() == "forward: fused", "which is known beforehand"
    assert traced.explain() == "forward: not called yet"
    arguments(rows(40), nn.functional.normalize(rows(40, seed=1), dim=-1))
    traced(rows(40))
    assert arguments.explain() == traced.explain() == "forward: fused"


def test_known_calls_are_part_of_a_graph() -> None:
    router, args = routed(Named()), (rows(64),) * 2
    expected = outcome(router, lambda r: r(*args))
    torch._dynamo.reset()
    compiled = torch.compile(router, backend="aot_eager", fullgraph=True)
    assert all(map(torch.equal, outcome(router, lambda _: compiled(*args)), expected))
    with torch.no_grad():
        router.module.register_buffer("unused", torch.zeros(1))
        next(router.parameters()).mul_(2)
    assert all(map(torch.equal, outcome(router, lambda _: compiled(*args)), outcome(router, lambda r: r(*args))))


def test_one_graph_for_any_number_of_samples() -> None:
    router = routed(net())
    router(rows(64))
    torch._dynamo.reset()
    compiled = torch.compile(router, backend="eager", fullgraph=True, dynamic=True)
    for n in (64, 65, 200):
        assert torch.equal(compiled(rows(n)), router(rows(n)))


def test_a_known_call_is_exported_for_any_number_of_samples() -> None:
    router = routed(net())
    sizes = {0: torch.export.Dim("n", max=2**31 - 1)}
    with pytest.raises(RuntimeError, match=r"torch.export needs a forward that is fused whole and has run.*not called"):
        torch.export.export(router, (rows(64),), dynamic_shapes=((sizes,),))
    router(rows(64))
    exported = torch.export.export(router, (rows(64),), dynamic_shapes=((sizes,),)).module()
    for n in (64, 65, 700):
        assert torch.equal(exported(rows(n)), router(rows(n)))


def test_other_calls_break_a_graph_as_before() -> None:
    router = routed(nn.utils.parametrizations.weight_norm(nn.Linear(3, 4)))
    expected = router(rows(64))
    torch._dynamo.reset()
    with pytest.raises(Exception, match="or call a router with fuse=True once beforehand"):
        torch.compile(router, backend="eager", fullgraph=True)(rows(64))
    assert torch.equal(torch.compile(router, backend="eager")(rows(64)), expected)
