"""Routers inside of compiled and exported models."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from convention_harness import uniform
from torch import Tensor, nn

from voronerf import VoronoiRouter

CENTRES = torch.rand(6, 3, generator=torch.Generator().manual_seed(1)) * 2 - 1


class Net(nn.Module):
    """A density and a colour, as dict, tuple or one tensor."""

    def __init__(self, gives: str) -> None:
        super().__init__()
        self.a, self.b, self.gives = nn.Linear(3, 16), nn.Linear(16 + 3, 4), gives

    def density(self, x: Tensor) -> Tensor:
        return torch.relu(self.a(x))[..., 0]

    def forward(self, x: Tensor, d: Tensor | None = None, scale: float = 1.0) -> Any:
        raw = self.b(torch.cat([torch.relu(self.a(x)), torch.zeros_like(x) if d is None else d], -1))
        colour, sigma = scale * torch.sigmoid(raw[..., :3]), torch.relu(raw[..., 3])
        return {"dict": {"rgb": colour, "sigma": [sigma]}, "tuple": (colour, sigma), "one": raw}[self.gives]


class Model(nn.Module):
    def __init__(self, gives: str = "dict", **options: Any) -> None:
        super().__init__()
        options = {"fuse": True, "methods": ["density"], **options}
        self.router = VoronoiRouter(Net(gives), CENTRES, coords="first3", **options)
        self.before = nn.Linear(3, 3)

    def forward(self, x: Tensor) -> Tensor:
        x = torch.tanh(self.before(x))
        found = self.router(x, d=-x, scale=2.0)
        if isinstance(found, Tensor):
            return found.sum(-1)
        colour, sigma = (found["rgb"], found["sigma"][0]) if isinstance(found, dict) else found
        return (colour * sigma[..., None]).sum(-1) + self.router.density(x)


def step(model: Any, x: Tensor) -> list[Tensor]:
    result = model(x)
    parameters = list(model.parameters())
    return [result.detach(), *torch.autograd.grad(result.square().sum(), [x, *parameters], allow_unused=True)]


@pytest.mark.parametrize(("gives", "shape"), [("dict", (9, 7)), ("tuple", (60,)), ("one", (60,))])
def test_a_model_compiles_as_one_graph(gives: str, shape: tuple[int, ...]) -> None:
    torch.manual_seed(0)
    model, x = Model(gives), uniform(shape).requires_grad_()
    expected = step(model, x)
    torch._dynamo.reset()
    compiled = torch.compile(model, fullgraph=True, backend="aot_eager")
    for a, b in zip(step(compiled, x), expected, strict=True):
        torch.testing.assert_close(a, b)
    other = uniform((11, *shape[1:])).requires_grad_()
    for a, b in zip(step(compiled, other), step(model, other), strict=True):
        torch.testing.assert_close(a, b)
    with torch.no_grad():  # it follows its parameters
        model.router.module.a.weight += 0.3
        torch.testing.assert_close(compiled(x), model(x))


def test_copies_and_splits_compile_too() -> None:
    model, x = Model(), uniform((60,)).requires_grad_()
    step(model, x)
    copied = copy.deepcopy(model)
    copied.router.subdivide(2, points=uniform((300,)), weights=torch.ones(300), min_samples=1)
    with torch.no_grad():
        for parameter in copied.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    expected = step(copied, x)
    torch._dynamo.reset()
    for a, b in zip(step(torch.compile(copied, fullgraph=True, backend="aot_eager"), x), expected, strict=True):
        torch.testing.assert_close(a, b)


def test_a_model_is_exported() -> None:
    model, x = Model().eval(), uniform((60,))
    expected = model(x)
    program = torch.export.export(model, (x,))
    torch.testing.assert_close(program.module()(x), expected)
    assert any("routed" in str(node.target) for node in program.graph.nodes)


@pytest.mark.parametrize("options", [{"fuse": False}, {}])
def test_what_is_in_the_way_of_one_graph_is_said(options: Any) -> None:
    model, x = Model(**options), uniform((60,))
    if options:
        model(x)
    torch._dynamo.reset()
    with pytest.raises(Exception, match="a graph without breaks takes a router with fuse"):
        torch.compile(model, fullgraph=True, backend="eager")(x)
    torch._dynamo.reset()
    torch.testing.assert_close(torch.compile(model, backend="eager")(x), model(x))  # with breaks
