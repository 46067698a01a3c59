"""Tests of VoronoiRouter inside checkpoints, function transforms, tracers and compilers."""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers import all_pairs, refuses
from ops.foreign_fields import Heads
from router_loop import Built, perturb
from torch import Tensor, nn
from torch.autograd import forward_ad
from torch.func import functional_call, grad, hessian, jacfwd, jacrev, jvp, vjp, vmap
from torch.utils.checkpoint import checkpoint

from voronerf import NeRF, grouped_linear
from voronerf.router import VoronoiRouter

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::torch.jit.TracerWarning")

WAYS: dict[str, dict[str, Any]] = {
    "fused": {"fuse": True},
    "grouped": {"way": "grouped"},
    "loop": {"way": "loop"},
    "reference": {"way": "grouped", "backend": "reference"},
}


def look(module: Any, x: Tensor) -> Tensor:
    row = (x[:, 0] * 31).long().clamp(0, 31)
    return module.out(torch.cat([x, module.table(row) * module.table(31 - row)], -1))


def looked() -> nn.Module:
    """Returns a field with a table, looked up twice for each sample, and layers."""
    return Built(look, table=nn.Embedding(32, 4), out=nn.Sequential(nn.Linear(7, 16), nn.Tanh(), nn.Linear(16, 3)))


def net() -> nn.Module:
    return nn.Sequential(nn.Linear(3, 32), nn.Softplus(), nn.Linear(32, 32), nn.Tanh(), nn.Linear(32, 4))


def router_of(module: nn.Module, generator: torch.Generator, **options: Any) -> VoronoiRouter:
    options = {"coords": "first3", **options}
    return perturb(VoronoiRouter(module, torch.rand(8, 3, generator=generator), **options), generator)


def gradients(run: Callable[[Tensor], Tensor], router: VoronoiRouter, x: Tensor) -> list[Tensor]:
    x = x.clone().requires_grad_()
    return list(torch.autograd.grad(run(x).square().sum(), [x, *router.parameters()]))


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("make", [net, looked, lambda: nn.utils.parametrizations.weight_norm(nn.Linear(3, 4))])
def test_a_checkpoint_around_first_calls_and_new_sizes(
    way: str, make: Callable[[], nn.Module], generator: torch.Generator
) -> None:
    router = router_of(make(), generator, **WAYS[way])
    for n in (500, 5000, 40, 3):
        x = torch.rand(n, 3, generator=generator)
        result = gradients(lambda x: checkpoint(router, x, use_reentrant=False), router, x)
        torch.testing.assert_close(result, gradients(router, router, x), rtol=1e-4, atol=1e-5)


class Picky(nn.Module):
    """A module that cannot run grouped on batches with negative positions."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.b = nn.Linear(3, 8), nn.Linear(8, 2)

    def forward(self, x: Tensor) -> Tensor:
        h = torch.sin(self.a(x))
        if (x[:, 0] < 0).any():
            h = h * 1.5
        return self.b(h)


class Scaling(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.exp()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return gradient * ctx.saved_tensors[0].exp()


class Scaled(nn.Linear):
    def forward(self, x: Tensor) -> Tensor:
        return Scaling.apply(super().forward(x))


@pytest.mark.parametrize("options", [{"fuse": True}, {"way": "grouped"}, {"way": "loop"}])
def test_a_checkpoint_around_a_custom_function_that_saves_tensors(options: Any, generator: torch.Generator) -> None:
    router, x = router_of(Scaled(3, 2), generator, **options), torch.rand(60, 3, generator=generator)
    for _ in range(2):
        result = gradients(lambda x: checkpoint(router, x, use_reentrant=False), router, x)
        torch.testing.assert_close(result, gradients(router, router, x))
    way = options.get("way", "fused")
    assert router.explain().startswith(f"forward: {'cell by cell' if way == 'loop' else way}")


def test_a_checkpoint_around_batches_of_which_some_cannot_be_grouped(generator: torch.Generator) -> None:
    router = router_of(Picky(), generator, way="grouped")
    for sign in (1, -1, -1, 1, -1, 1, 1, -1):
        x = torch.rand(200, 3, generator=generator)
        x[::7, 0] *= sign
        result = gradients(lambda x: checkpoint(router, x, use_reentrant=False), router, x)
        torch.testing.assert_close(result, gradients(router, router, x), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(*all_pairs({"way": WAYS, "make": [net, looked], "cold": [True, False]}))
def test_func_grad_and_vjp_give_what_autograd_gives(
    way: str, make: Callable[[], nn.Module], cold: bool, generator: torch.Generator, recwarn: pytest.WarningsRecorder
) -> None:
    router, x = router_of(make(), generator, **WAYS[way]), torch.rand(300, 3, generator=generator)
    if not cold:
        router(x.clone().requires_grad_())
    parameters = dict(router.named_parameters())

    def loss(x: Tensor, parameters: dict[str, Tensor]) -> Tensor:
        return functional_call(router, parameters, (x,)).square().sum()

    by_x, by_parameters = grad(loss, argnums=(0, 1))(x, parameters)
    expected = gradients(router, router, x)
    torch.testing.assert_close([by_x, *by_parameters.values()], expected, rtol=1e-4, atol=1e-5)
    assert not recwarn.list, recwarn.list[0].message

    y, back = vjp(router, x)
    torch.testing.assert_close(y, router(x))
    torch.testing.assert_close(back(2 * y)[0], expected[0], rtol=1e-4, atol=1e-5)

    own = x.clone().requires_grad_()
    (first,) = torch.autograd.grad(router(own).square().sum(), own, create_graph=True)
    (second,) = torch.autograd.grad(first.square().sum(), own)
    twice = grad(lambda x: grad(lambda x: router(x).square().sum())(x).square().sum())(x)
    torch.testing.assert_close(twice, second, rtol=1e-4, atol=1e-5 * float(second.abs().max()))


CONTEXTS: dict[str, Callable[[VoronoiRouter, Tensor], Tensor]] = {
    "func": lambda router, x: grad(lambda x: router(x).square().sum())(x),
    "func twice": lambda router, x: grad(lambda x: grad(lambda x: router(x).square().sum())(x).sum())(x),
    "checkpoint": lambda router, x: by_autograd(checkpoint(router, x, use_reentrant=False), x),
    "hooks": lambda router, x: by_autograd(_on_cpu(router, x), x),
    "inference": lambda router, x: torch.inference_mode()(router)(x),
}


def by_autograd(y: Tensor, x: Tensor) -> Tensor:
    return torch.autograd.grad(y.square().sum(), x)[0]


def _on_cpu(router: VoronoiRouter, x: Tensor) -> Tensor:
    with torch.autograd.graph.save_on_cpu():
        y: Tensor = router(x)
    return y


@pytest.mark.parametrize(*all_pairs({"way": WAYS, "context": CONTEXTS, "n": [4, 300]}))
def test_first_calls_of_frozen_cells(way: str, context: str, n: int, generator: torch.Generator) -> None:
    router, x = router_of(net(), generator, **WAYS[way]), torch.rand(n, 3, generator=generator).requires_grad_()
    router.freeze([0, 1, 5])
    plain = copy.deepcopy(router)
    plain.way, plain.fuse = "loop", False
    actual = CONTEXTS[context](router, x)
    if context == "func twice":
        (first,) = torch.autograd.grad(plain(x).square().sum(), x, create_graph=True)
        expected = torch.autograd.grad(first.sum(), x)[0]
    else:
        expected = plain(x) if context == "inference" else by_autograd(plain(x), x)
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-4)


def test_func_grad_of_several_methods(generator: torch.Generator) -> None:
    router = router_of(Heads(), generator, methods=["density"], way="grouped")
    x = torch.rand(100, 3, generator=generator)
    result = grad(lambda x: router.density(x)["sigma"].sum() + router(x).sum())(x)
    own = x.clone().requires_grad_()
    (router.density(own)["sigma"].sum() + router(own).sum()).backward()
    torch.testing.assert_close(result, own.grad)
    assert router.density(x)["sigma"].shape == (100,)  # the router keeps no state of the transform


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("cold", [True, False])
def test_what_would_be_wrong_is_refused_in_one_line(way: str, cold: bool, generator: torch.Generator) -> None:
    router, x = router_of(net(), generator, **WAYS[way]), torch.rand(64, 3, generator=generator)
    if not cold:
        router(x)
    ones = torch.ones_like(x)
    for run, says in [
        (lambda: vmap(grad(lambda x: router(x[None]).sum()))(x), r"vmap.*call the router on the whole batch"),
        (lambda: vmap(router)(x.reshape(4, 16, 3)), "vmap"),
        (lambda: hessian(lambda x: router(x).sum())(x), "hessian"),
        (lambda: jacfwd(router)(x), "torch.autograd.grad"),
        (lambda: jvp(router, (x,), (ones,)), r"forward-mode.*torch.func.vjp"),
        (lambda: torch.jit.trace(router, (x,)), r"jit.trace.*router.cell\(i\)"),
        (lambda: torch.onnx.export(router, (x,), "/dev/null", dynamo=False), r"onnx.*router.cell\(i\)"),
    ]:
        with pytest.raises(NotImplementedError, match=says) as caught:
            run()
        assert "\n" not in str(caught.value)
    with forward_ad.dual_level(), pytest.raises(NotImplementedError, match="forward-mode"):
        router(forward_ad.make_dual(x, ones))
    torch.testing.assert_close(router(x), router(x))
    torch.jit.trace(router.cell(2), (x,))


@pytest.mark.parametrize("way", ["fused", "grouped"])
def test_batches_of_gradients_are_refused_in_one_line(way: str, generator: torch.Generator) -> None:
    router, x = router_of(net(), generator, **WAYS[way]), torch.rand(64, 3, generator=generator).requires_grad_()
    y = router(x)
    for context in (contextlib.nullcontext(), torch.device("cpu")):  # alone, and with a default device
        with context, pytest.raises(NotImplementedError, match=r"is_grads_batched=True.*once for each gradient"):
            torch.autograd.grad(router(x), x, torch.ones(2, *y.shape), is_grads_batched=True)
    with pytest.raises(NotImplementedError, match=r"vectorize=True.*once for each gradient"):
        torch.autograd.functional.jacobian(router, x.detach(), vectorize=True)
    with pytest.raises(NotImplementedError, match=r"jacrev.*once for each gradient"):
        jacrev(router)(x.detach())


def test_a_table_of_layers_and_an_op_refuse_tangents(generator: torch.Generator) -> None:
    router, x = VoronoiRouter(NeRF(width=16, depth=2), torch.rand(4, 3)), torch.rand(20, 3, generator=generator)
    offsets, weight = torch.tensor([0, 8, 20], dtype=torch.int32), torch.rand(2, 4, 3, generator=generator)
    d = nn.functional.normalize(x, dim=1)
    for run in (lambda x: router(x, d)[0], lambda x: grouped_linear(x, offsets, weight)):
        refuses("has no forward-mode derivative", jvp, run, (x,), (x,), error=NotImplementedError)
        own = x.clone().requires_grad_()
        run(own).square().sum().backward()
        result = grad(lambda x, run=run: run(x).square().sum())(x)
        torch.testing.assert_close(result, own.grad)


@pytest.mark.parametrize(("way", "cold"), [("fused", True), ("grouped", False)])
def test_a_graph_is_broken_around_the_router_or_refused(way: str, cold: bool, generator: torch.Generator) -> None:
    router, x = router_of(net(), generator, **WAYS[way]), torch.rand(64, 3, generator=generator)
    if not cold:
        router(x)
    torch._dynamo.reset()
    with pytest.raises(Exception, match=r"VoronoiRouter: a routed module runs eagerly.*omit fullgraph=True"):
        torch.compile(router, backend="eager", fullgraph=True)(x)
    compiled = torch.compile(router, backend="eager")
    torch.testing.assert_close(compiled(x), router(x))
    torch.testing.assert_close(gradients(compiled, router, x), gradients(router, router, x))
