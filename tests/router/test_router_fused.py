"""Networks that VoronoiRouter recognises and runs as one operation: the same numbers, and never a stale plan."""

from __future__ import annotations

from typing import Any

import pytest
import torch
import torch.nn.functional as F
from router_fields import SkipNet, gradients, masked_loop, perturb, tensors
from torch import Tensor, nn

from voronerf.router import VoronoiRouter
from voronerf.router.fusion import Plan


class Counted(nn.Module):
    """Counts the calls of its own forward."""

    calls = 0

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        type(self).calls += 1
        return self.run(*args, **kwargs)


class Skip(Counted, SkipNet):
    run = SkipNet.forward


class Bands(Counted):
    """An encoder and a flag inside; a density taken from the first of a layer's outputs; a dict."""

    def __init__(self) -> None:
        super().__init__()
        self.sigma_net = nn.ModuleList([nn.Linear(12, 8, bias=False), nn.Linear(8, 6, bias=False)])
        self.colour_net = nn.Sequential(nn.Linear(5 + 3, 8), nn.ReLU(inplace=True), nn.Dropout(0.5), nn.Linear(8, 3))
        self.register_buffer("bands", torch.tensor([1.0, 2.0]))
        self.sharp, self.gain = True, 1.0

    def run(self, x: Tensor, d: Tensor) -> dict[str, Tensor]:
        waves = (x[..., None] * self.bands).flatten(-2)
        h = torch.cat([waves.sin(), waves.cos()], -1)
        for i, layer in enumerate(self.sigma_net):
            h = layer(h)
            if i == 0:
                h = F.relu(h, inplace=True)
        density = F.softplus(h[..., 0]) if self.sharp else torch.exp(h[..., 0])
        colour = self.colour_net(torch.cat([d, h[..., 1:]], dim=-1))
        return {"density": density * self.gain, "colour": torch.sigmoid(colour)}


class Plain(Counted):
    """A Sequential whose activations are all in the table, a softplus head among them."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(3, 9), nn.Sigmoid(), nn.Linear(9, 7), nn.Softplus(), nn.Linear(7, 2))

    def run(self, x: Tensor) -> Tensor:
        return torch.sin(self.net(x))


def uniform(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.rand(shape, generator=generator) * 2 - 1


CASES = [(Skip, (15,)), (Bands, (3, 3)), (Plain, (3,))]


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(7)


def fused(make: type[Counted], generator: torch.Generator, *args: Tensor, **options: Any) -> VoronoiRouter:
    """A router that has seen two calls and recognised the network."""
    router = perturb(VoronoiRouter(make().eval(), uniform(generator, 6, 3), coords="first3", **options), generator)
    for _ in range(2):
        router(*args)
    assert [type(plan) for plan in router._memory.plans.values()] == [Plan], router._memory.plans
    make.calls = 0
    return router


@pytest.mark.parametrize(("make", "features"), CASES)
def test_fused_networks_equal_a_loop_over_masks(
    make: type[Counted], features: tuple[int, ...], generator: torch.Generator
) -> None:
    args = [uniform(generator, 50, d) for d in features]
    router = fused(make, generator, *args)
    args = [uniform(generator, 77, d).requires_grad_() for d in features]
    found = tensors(router(*args))
    assert make.calls == 0
    cells = router.diagram.locate(args[0][:, :3])
    expected, modules = masked_loop(router, cells, args)
    factors = [uniform(generator, *r.shape) for r in expected]
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5)
    for second in (False, True):
        names = [name for name, _ in router.module.named_parameters()]
        ours = gradients(found, factors, [*args, *router.module.parameters()], second)
        theirs = gradients(expected, factors, [*args, *(m.get_parameter(n) for n in names for m in modules)], second)
        for a, b in zip(ours[: len(args)], theirs[: len(args)], strict=True):
            torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)
        for i, gradient in enumerate(ours[len(args) :]):
            first = len(args) + i * len(modules)
            stacked = torch.stack(theirs[first : first + len(modules)])
            torch.testing.assert_close(gradient, stacked, rtol=1e-3, atol=2e-3 if second else 1e-4)
        found = tensors(router(*args))
        expected, modules = masked_loop(router, cells, args)


def test_rays_and_their_directions(generator: torch.Generator) -> None:
    x, d = uniform(generator, 5, 4, 3), uniform(generator, 5, 1, 3)
    router = fused(Bands, generator, x, d)
    found = router(x, d)
    assert Bands.calls == 0
    flat = router(x.reshape(-1, 3), d.expand(5, 4, 3).reshape(-1, 3))
    assert found["colour"].shape == (5, 4, 3) and found["density"].shape == (5, 4)
    torch.testing.assert_close(found["colour"].reshape(-1, 3), flat["colour"])
    torch.testing.assert_close(found["density"].reshape(-1), flat["density"])


def changes(field: Bands) -> dict[str, Any]:
    return {
        "flag": lambda: setattr(field, "sharp", False),
        "number": lambda: setattr(field, "gain", 3.0),
        "buffer": lambda: field.bands.mul_(2),
        "hook": lambda: field.sigma_net[0].register_forward_hook(lambda module, args, out: out * 2),
    }


@pytest.mark.parametrize("change", ["flag", "number", "buffer", "hook"])
def test_a_change_of_the_module_is_seen(generator: torch.Generator, change: str) -> None:
    args = uniform(generator, 40, 3), uniform(generator, 40, 3)
    router = fused(Bands, generator, *args)
    before = router(*args)
    changes(router.module)[change]()
    after = router(*args)
    assert Bands.calls == 1
    assert not torch.equal(after["density"], before["density"])
    expected = masked_loop(router, router.diagram.locate(args[0]), args)[0]
    for a, b in zip(tensors(after), expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5)


def test_training_mode_draws_its_dropout(generator: torch.Generator) -> None:
    args = uniform(generator, 40, 3), uniform(generator, 40, 3)
    router = fused(Bands, generator, *args)
    router.train()
    drawn = [router(*args)["colour"] for _ in range(4)]
    assert all(not torch.equal(a, drawn[0]) for a in drawn[1:])


def test_trained_and_replaced_parameters_are_used(generator: torch.Generator) -> None:
    x = uniform(generator, 60, 15)
    router = fused(Skip, generator, x)
    before = router(x)
    perturb(router, generator)
    assert not torch.allclose(router(x), before)
    finer, parents = router.diagram.refine({0: uniform(generator, 3, 3)})
    same = router(x)
    router.subdivide(finer, parents)
    torch.testing.assert_close(router(x), same)
    doubled = {name: value.double() for name, value in router.state_dict().items() if value.is_floating_point()}
    found = torch.func.functional_call(router, doubled, (x.double(),))
    assert found.dtype == torch.float64
    torch.testing.assert_close(found.float(), same)


class Moody(nn.Module):
    """Looks alike in two calls of three."""

    calls = 0

    def __init__(self, kind: str) -> None:
        super().__init__()
        self.kind, self.net = kind, nn.Linear(3, 2)

    def forward(self, x: Tensor) -> Tensor:
        type(self).calls += 1
        if self.kind == "noise":
            return self.net(x) + 1e-9 * torch.randn_like(x[:, :2])
        if self.kind == "global":
            return self.net(x) * float(type(self).calls)
        if self.kind == "no gradient":
            with torch.no_grad():
                x = x * 2
            return self.net(x)
        if self.kind == "value":
            return self.net(x) if not torch.isnan(x).any() else torch.zeros(x.shape[0], 2)
        self.last = self.net(x)
        return self.last


@pytest.mark.parametrize("kind", ["noise", "global", "no gradient", "value", "attribute"])
def test_what_is_not_its_steps_alone_is_not_fused(generator: torch.Generator, kind: str) -> None:
    x = uniform(generator, 30, 3)
    router = VoronoiRouter(Moody(kind), uniform(generator, 4, 3), coords="first3")
    Moody.calls = 0
    for _ in range(5):
        router(x)
    assert Moody.calls == 5
    assert not any(isinstance(plan, Plan) for plan in router._memory.plans.values())


def test_sizes_that_a_module_was_given_hold_for_them_alone(generator: torch.Generator) -> None:
    class Counts(Counted):
        def __init__(self) -> None:
            super().__init__()
            self.net = nn.Linear(4, 2)

        def run(self, x: Tensor) -> Tensor:
            return self.net(torch.cat([x, torch.ones(x.shape[0], 1)], 1)).view(x.shape[0], 2)

    x = uniform(generator, 600, 3)
    router = fused(Counts, generator, x)
    assert router(x).shape == (600, 2) and Counts.calls == 0
    assert router(x[:311]).shape == (311, 2) and Counts.calls == 1
