"""Gradients that PyTorch leaves None: of detached layers, of layers under ``no_grad``, and of unused results."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from router_loop import uniform
from torch import Tensor, nn

from voronerf import VoronoiRouter

K = 4


def under_no_grad(net: Any, x: Tensor) -> Tensor:
    with torch.no_grad():
        h = torch.relu(net.encoder(x))
    return net.a(h)


FORWARDS: dict[str, Callable[[Any, Tensor], Any]] = {
    "an encoder under no_grad": under_no_grad,
    "a detached encoder": lambda net, x: net.a(net.between(net.encoder(x)).detach()),
    "a detached weight": lambda net, x: net.a(net.between(x @ net.encoder.weight.detach().t() + net.encoder.bias)),
    "a detached argument": lambda net, x: net.a(net.between(net.encoder(x.detach()))),
    "two heads": lambda net, x: (net.a(h := net.between(net.encoder(x))), net.b(h)),
    "a detached head": lambda net, x: (net.a(h := net.between(net.encoder(x))), net.b(h).detach()),
    "a detached part": lambda net, x: net.a(net.between(net.encoder(x)) + net.c(x).detach()),
    "a mask": lambda net, x: net.a(net.between(net.encoder(x))) * (net.b(x) > 0).to(x.dtype),
    "a condition": lambda net, x: torch.where(net.b(x) > 0, net.a(net.between(net.encoder(x))), 0.0),
    "a sign": lambda net, x: net.a(torch.sign(net.between(net.encoder(x))) + torch.floor(net.c(x))),
}
RUNS = torch.cosh  # no step of a program


class Network(nn.Module):
    def __init__(self, name: str, between: Callable[[Tensor], Tensor] = torch.relu) -> None:
        super().__init__()
        self.encoder, self.c = nn.Linear(3, 6), nn.Linear(3, 6)
        self.a, self.b = nn.Linear(6, 2), nn.Linear(3 if name in ("a mask", "a condition") else 6, 2)
        self.returns, self.functions = [FORWARDS[name]], [between]

    def between(self, h: Tensor) -> Tensor:
        return self.functions[0](h)

    def forward(self, x: Tensor) -> Any:
        return self.returns[0](self, x)

    def both(self, x: Tensor) -> Any:
        return self(x)


def missing(network: nn.Module, call: Callable[[Tensor], Any], twice: bool = True) -> list[list[bool]]:
    """Returns, for each of three calls, which first and second gradients by x and the parameters are None.

    Then follows whether each further result requires a gradient.
    """
    result = []
    for _ in range(3):
        x = uniform((50,)).requires_grad_()
        out = call(x)
        first, *rest = out if isinstance(out, tuple) else (out,)
        wanted = [x, *network.parameters()]
        gradients = torch.autograd.grad(first.square().sum(), wanted, create_graph=twice, allow_unused=True)
        if twice:
            penalty = sum(g.square().sum() for g in gradients[1:] if g is not None)
            gradients += torch.autograd.grad(penalty, wanted, allow_unused=True)
        result.append([g is None for g in gradients] + [out.requires_grad for out in rest])
    return result


@pytest.mark.parametrize("between", [torch.relu, RUNS], ids=["whole", "in runs"])
@pytest.mark.parametrize("name", FORWARDS)
def test_gradients_are_none_where_the_loop_gives_none(name: str, between: Callable[[Tensor], Tensor]) -> None:
    """First and second gradients are None in the first call and in later calls, which are cached."""
    results, reasons = [], []
    for way in ("loop", "fused"):
        torch.manual_seed(0)
        router = VoronoiRouter(Network(name, between), torch.rand(K, 3), coords="first3", fuse=True, way=way)
        results.append(missing(router.module, router))
        reasons.append(router.explain())
    assert results[0] == results[1]
    in_runs = between is RUNS and name != "an encoder under no_grad"
    assert reasons[1].startswith("forward: fused in runs" if in_runs else "forward: fused")


@pytest.mark.parametrize("options", [{"share": ["encoder.*", "b.*"]}, {"methods": ["both"]}, {"labels": True}], ids=str)
def test_shared_parameters_methods_and_labels(options: dict[str, Any]) -> None:
    results, labels = [], {"cells": torch.arange(50) % K} if options.pop("labels", False) else {}
    for way in ("loop", "fused"):
        torch.manual_seed(0)
        centres, coords = (K, None) if labels else (torch.rand(K, 3), "first3")
        router = VoronoiRouter(Network("two heads"), centres, coords=coords, **options, fuse=True, way=way)
        call = router.both if "methods" in options else router
        results.append(missing(router.module, lambda x, call=call: call(x, **labels)))
    assert results[0] == results[1]


@pytest.mark.parametrize("name", ["an encoder under no_grad", "two heads", "a detached head"])
def test_a_compiled_call(name: str) -> None:
    router = VoronoiRouter(Network(name), torch.rand(K, 3), coords="first3", fuse=True)
    router(uniform((50,)).requires_grad_())
    cell = router.cell(0)  # a head that is not used gets zeros if it is compiled
    call = torch.compile(cell, backend="aot_eager") if name == "two heads" else cell
    expected = missing(cell, call, twice=False)
    assert missing(router.module, torch.compile(router, backend="aot_eager"), twice=False) == expected
