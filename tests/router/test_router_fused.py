"""Functions that become steps of a fused network, and functions that run between parts of the network."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from router_loop import Built, equals_loop, masked_loop, perturb, randomised, uniform
from torch import Tensor, nn

from voronerf import VoronoiRouter
from voronerf.router.axes import Axis
from voronerf.router.lower import Lowering, NotAStep

K = 4


def written(make: Callable[[Any], Tensor]) -> Callable[[Any, Tensor], Tensor]:
    """Returns a step that makes a tensor and writes into this tensor."""

    def step(net: Any, h: Tensor) -> Tensor:
        result = make(h)
        result[..., 0] = 1.5 * h[..., 1]
        result[..., 2:5] = h[..., 3:6]
        result[:, 5:].copy_(h[:, :3])
        result[:, 6] *= 2
        return result

    return step


STEPS: dict[str, Callable[[Any, Tensor], Tensor]] = {
    "maximum": lambda net, h: torch.maximum(h, h.roll(1, -1)),
    "minimum": lambda net, h: torch.min(h, h.roll(1, -1)),
    "maximum of equals": lambda net, h: torch.maximum(h.clamp(0, 0.1), h.roll(1, -1).clamp(0, 0.1)),
    "amax": lambda net, h: h - h.amax(-1, keepdim=True),
    "amin": lambda net, h: h - h[:, :5].amin(-1)[:, None],
    "softmax": lambda net, h: F.softmax(30 * h, -1),
    "log_softmax": lambda net, h: F.log_softmax(h, -1),
    "variance": lambda net, h: h / h.var(-1, keepdim=True),
    "deviation": lambda net, h: h / h.std(-1, unbiased=False, keepdim=True),
    "selu": lambda net, h: F.selu(h),
    "mish": lambda net, h: F.mish(h),
    "logsigmoid": lambda net, h: F.logsigmoid(h),
    "softsign": lambda net, h: F.softsign(h),
    "tanhshrink": lambda net, h: F.tanhshrink(3 * h),
    "atan, erf": lambda net, h: torch.atan(h) + torch.erf(h),
    "a power": lambda net, h: (h + 1.2) ** 2.4 + (h + 1.1) ** (1 / 3),
    "sign, ceil": lambda net, h: h * torch.sign(h) + (3 * h).ceil(),
    "addcmul, addcdiv": lambda net, h: torch.addcmul(h, h, h, value=0.5) + torch.addcdiv(h, h, h.exp()),
    "masks": lambda net, h: h.masked_fill((h > 0.2) | (h == 0.1), 0.0) * ((h != 0) & ~(h < -1)),
    "all, any": lambda net, h: h * ((h > -1).all(-1, keepdim=True) | (h > 0.3).any(-1, keepdim=True)),
    "cross": lambda net, h: torch.cat([torch.linalg.cross(h[:, :3], h[:, 3:6]), h[:, :5]], -1),
    "a norm": lambda net, h: F.normalize(h, dim=-1) + h.norm(p=1, dim=-1, keepdim=True),
    "a norm of zeros": lambda net, h: F.normalize(h.clamp(min=9) - 9, dim=-1) + (0 * h).norm(dim=-1, keepdim=True) + h,
    "small matrices": lambda net, h: torch.bmm(h.view(-1, 2, 4), h.view(-1, 4, 2)).flatten(1).repeat(1, 2),
    "a matrix and a vector": lambda net, h: h * (h @ net.gain)[:, None],
    "a parameter beside samples": lambda net, h: torch.cat([h[:, 2:], net.gain[None, :2].expand(len(h), 2)], 1),
    "some entries of a parameter": lambda net, h: h * net.gain.flip(0) + (h.unsqueeze(-1) * net.gain[1::2]).sum(-1),
    "a parameter without dimensions": lambda net, h: h * net.single,
    "a product added to one row": lambda net, h: torch.addmm(net.gain[None], h, net.a.weight @ net.a.weight.t()),
    "constants beside samples": lambda net, h: torch.cat([h[:, 2:], torch.arange(2.0).repeat(len(h), 1)], 1),
    "a transpose, flattened": lambda net, h: h.view(-1, 2, 4).tanh().transpose(1, 2).flatten(1),
    "writing into zeros": written(torch.zeros_like),
    "writing into new memory": written(lambda h: torch.empty(len(h), 8).fill_(0.5)),
    "writing into a mask": written(lambda h: torch.ones(h.shape, dtype=h.dtype)),
}


class Around(nn.Module):
    def __init__(self, step: Callable[[Any, Tensor], Tensor]) -> None:
        super().__init__()
        self.a, self.b, self.step = nn.Linear(3, 8), nn.Linear(8, 2), [step]
        self.gain, self.single = nn.Parameter(torch.ones(8)), nn.Parameter(torch.tensor(0.7))

    def forward(self, x: Tensor) -> Tensor:
        return self.b(self.step[0](self, torch.tanh(self.a(x))))


def both(make: Callable[[], nn.Module], x: Tensor, *args: Any) -> tuple[Any, Any, VoronoiRouter]:
    """Returns (router result, result of a loop over masks, router); each cell is a separate module."""
    modules = [randomised(make()) for _ in range(K)]
    centres = torch.rand(K, 3, generator=torch.Generator().manual_seed(3)) * 2 - 1
    router = VoronoiRouter.from_modules(modules, centres, coords="first3", fuse=True)
    return router(x, *args), masked_loop(router, x, *args)[0], router


ONCE = ("a norm of zeros",)  # its second derivative is NaN in PyTorch


def derivatives(y: Tensor, x: Tensor, router: VoronoiRouter, twice: bool = True) -> list[Tensor]:
    """Returns derivatives of ``y`` and, if ``twice``, of a penalty on its gradient, by x and the parameters."""
    weights = torch.linspace(0.5, 1.5, y.numel()).view_as(y)
    wanted = [x, *router.parameters()]
    first = torch.autograd.grad((y * weights).sum(), wanted, create_graph=twice, retain_graph=True, allow_unused=True)
    penalty = (first[0].norm(dim=-1) - 1).square().mean()
    second = torch.autograd.grad(penalty, wanted, allow_unused=True) if twice else ()
    return [torch.zeros(1) if g is None else g for g in (*first, *second)]


def equal(actual: Tensor, expected: Tensor, x: Tensor, router: VoronoiRouter, twice: bool = True) -> None:
    """Checks that values, first and second derivatives are equal."""
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-5)
    ours, theirs = (derivatives(y, x, router, twice) for y in (actual, expected))
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b if a.shape == b.shape else b.expand_as(a), rtol=2e-3, atol=2e-4)


@pytest.mark.parametrize("name", STEPS)
def test_a_step_of_the_program(name: str) -> None:
    x = uniform((90,)).requires_grad_()
    actual, expected, router = both(lambda: Around(STEPS[name]), x)
    assert router.explain() == "forward: fused"
    equal(actual, expected, x, router, twice=name not in ONCE)


SPECIAL: dict[str, Callable[[Tensor], Tensor]] = {
    "infinite": lambda x: x.relu() + ((1 / x).abs() == torch.inf),
    "not a number": lambda x: x.relu() + (x / x.abs() != x / x.abs()),
    "finite": lambda x: torch.where(torch.isfinite(1 / x), x, 0.0),
    "at least infinity": lambda x: x.relu() + (1 / x >= torch.inf) + (1 / x > -torch.inf),
    "at most infinity": lambda x: x.relu() + (1 / x <= -torch.inf) + (1 / x < torch.inf),
    "equal infinities": lambda x: x.relu() + (1 / x == 1 / x.abs()),
    "one bound": lambda x: (1 / x).clamp(min=0.5) + (1 / x).clamp(max=0.5),
    "relu6": lambda x: F.relu6(6 * x),
    "hardtanh": F.hardtanh,
    "amax": lambda x: x.amax(-1),
    "amin": lambda x: x.amin(-1, keepdim=True),
    "where the largest are": lambda x: (0.85 * x >= (0.85 * x).amax(-1, keepdim=True)) * x,
    "large entries": lambda x: (x * 7e37).amax(-1) * 1e-37,
    "or": lambda x: x.relu() + ((x >= 1) + (x <= 1)),
    "std": lambda x: x / (x.std(-1, keepdim=True) + 1),
    "expm1": lambda x: 1e8 * torch.expm1(1e-8 * x),
    "log1p": lambda x: 1e8 * torch.log1p(1e-8 * x),
    "a masked softmax": lambda x: x.masked_fill(x < 0.5, -torch.inf).softmax(-1),
    "a softmax masked by numbers": lambda x: torch.cat((x, x), -1).masked_fill(x[..., :1] < 1.5, -3e38).softmax(-1),
}
"""Functions whose values or gradients are special at infinities, bounds, equal entries or small numbers."""


@pytest.mark.parametrize("name", SPECIAL)
def test_special_numbers_of_a_step(name: str) -> None:
    class Scaled(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.gain = nn.Parameter(torch.ones(3))

        def forward(self, x: Tensor) -> Tensor:
            return SPECIAL[name](self.gain * x)

    rows = [[0, 1, -1], [1, 1, 1], [-1, -1, 0], [0.5, 2, 0.25], [1, 1, 0.3], [-0.0, 0.6, 0.9], [3, 3, 3], [0, 0, 1]]
    module, results = Scaled(), []
    router = VoronoiRouter(module, 2, fuse=True)
    for field, cells in ((router, {"cells": torch.arange(8) % 2}), (module, {})):
        x = torch.tensor(rows, requires_grad=True)
        y = field(x, **cells)
        y[y.isfinite()].sum().backward()
        results.append((y, x.grad))
    assert router.explain() == "forward: fused"
    torch.testing.assert_close(*results, rtol=1e-5, atol=1e-6, equal_nan=True)


class Parts(nn.Module):
    def __init__(self, forward: Callable[[Any, Tensor], Any]) -> None:
        super().__init__()
        self.a, self.out, self.c, self.returns = nn.Linear(3, 8), nn.Linear(8, 4), nn.Linear(3, 2), [forward]

    def raw(self, x: Tensor) -> Tensor:
        return self.out(torch.tanh(self.a(x)))

    def forward(self, x: Tensor) -> Any:
        return self.returns[0](self, x)


def named(net: Any, x: Tensor) -> Any:
    rgb, sigma = torch.split(net.raw(x), [3, 1], -1)
    return rgb, sigma


def used(net: Any, x: Tensor) -> Any:
    rgb, sigma = net.raw(x).split([3, 1], -1)
    return torch.sigmoid(rgb), F.softplus(sigma)[:, 0]


def layered(net: Any, x: Tensor) -> Any:
    hidden, sigma = net.raw(x).split([3, 1], -1)
    return net.c(hidden), sigma


PARTS: dict[str, Callable[[Any, Tensor], Any]] = {
    "a tuple": lambda net, x: torch.split(net.raw(x), [3, 1], -1),
    "a list": lambda net, x: list(torch.split(net.raw(x), 2, -1)),
    "a dict": lambda net, x: dict(zip("ab", torch.split(net.raw(x), [3, 1], -1))),
    "one part": lambda net, x: torch.split(net.raw(x), [3, 1], -1)[1],
    "parts by name": named,
    "parts that are used": used,
    "a part in a layer": layered,
    "parts of a part": lambda net, x: net.raw(x).split([3, 1], -1)[0].split([1, 2], -1),
    "chunk": lambda net, x: net.raw(x).chunk(2, -1),
    "unbind": lambda net, x: torch.unbind(net.raw(x), -1),
    "tensor_split": lambda net, x: torch.tensor_split(net.raw(x), 3, -1),
    "broadcast_tensors": lambda net, x: torch.broadcast_tensors(net.raw(x)[:, :3], x[:, :1]),
    "of an argument": lambda net, x: (net.raw(x), *x.split([1, 2], -1)),
    "of an argument, beside a layer": lambda net, x: torch.broadcast_tensors(x, net.raw(x)[:, :1]),
    "of what is joined": lambda net, x: torch.cat([x, net.raw(x)], -1).split([2, 5], -1),
    "columns of what is joined": lambda net, x: (net.raw(x), torch.cat([x, net.raw(x)], -1)[:, :2]),
    "of zeros": lambda net, x: (net.raw(x), *torch.zeros(len(x), 2).chunk(2, -1)),
    "of zeros, and a layer": lambda net, x: (*torch.zeros(len(x), 2).chunk(2, -1), net.raw(x)),
    "without columns": lambda net, x: (net.c(x.split([3, 0], -1)[0]), *net.raw(x).split([4, 0], -1)),
}
PARTS_BETWEEN: dict[str, Callable[[Any, Tensor], Any]] = {
    "of an argument": lambda net, x: (net.raw(x), torch.lgamma(x.chunk(3, -1)[1])),
    "of what torch computes": lambda net, x: net.c(torch.lgamma(net.raw(x) + 3).split([3, 1], -1)[0]),
    "of what is joined": lambda net, x: net.c(torch.lgamma(torch.cat([x, net.raw(x)], -1).split([3, 4], -1)[0] + 2)),
    "an argument's columns": lambda net, x: net.c(torch.lgamma(torch.cat([x, net.raw(x)], -1)[:, :3])),
}


@pytest.mark.parametrize(
    ("forward", "between"),
    [
        *(pytest.param(forward, False, id=name) for name, forward in PARTS.items()),
        *(pytest.param(forward, True, id=f"{name}, between") for name, forward in PARTS_BETWEEN.items()),
    ],
)
def test_parts_of_what_is_split(forward: Callable[[Any, Tensor], Any], between: bool) -> None:
    centres = torch.rand(K, 3) * 2 - 1
    router = VoronoiRouter(Parts(forward), centres, coords="first3", fuse=True)
    perturb(router, torch.Generator().manual_seed(1))
    x = uniform((90,)).requires_grad_()
    result = equals_loop(router, x, by=[x], rtol=2e-3, atol=2e-4)
    assert router.explain().startswith("forward: fused in runs" if between else "forward: fused")
    assert ("between" in router.explain()) == between and type(result) is type(router.cell(0)(x))


class FourierKAN(nn.Module):
    """A KAN of sines and cosines, with parameters only in products and sums, without layers."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.coefficients = nn.Parameter(torch.randn(2, outputs, inputs, 3) / 3)
        self.bias = nn.Parameter(torch.zeros(1, outputs))

    def forward(self, x: Tensor) -> Tensor:
        angle = torch.arange(1, 4) * x[:, None, :, None]
        y = torch.sum(torch.cos(angle) * self.coefficients[0:1], (-2, -1))
        y += torch.sum(torch.sin(angle) * self.coefficients[1:2], (-2, -1))
        y += self.bias
        return y


class Convolved(nn.Module):
    """Convolutions with kernel size 1 along samples or features, and one whose kernel covers all features."""

    def __init__(self, form: str) -> None:
        super().__init__()
        self.form, sides = form, {"lines": (3, 1), "covers": (3, 1, 1)}.get(form, (1,))
        make = {1: nn.Conv1d, 2: nn.Conv2d, 3: nn.Conv3d}[len(sides)]
        self.a = make(1 if form == "covers" else 3, 8, sides if len(sides) > 1 else 1)
        self.b = nn.Conv1d(8, 2, 1)

    def forward(self, x: Tensor) -> Tensor:
        if self.form == "covers":
            return self.b(F.relu(self.a(x[:, None, :, None, None]))[..., 0, 0]).squeeze(-1)
        if self.form == "lines":
            return self.b(F.relu(self.a(x[:, :, None, None].expand(-1, -1, 3, 1))).flatten(2)).squeeze(-1)
        if self.form == "over samples":
            return self.b(torch.tanh(self.a(x.t()[None])))[0].t()
        return self.b(torch.tanh(self.a(x[:, :, None]))).squeeze(-1)


class Recurrent(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.gru, self.rnn, self.lstm, self.out = nn.GRUCell(3, 4), nn.RNNCell(4, 4), nn.LSTMCell(4, 4), nn.Linear(4, 2)

    def forward(self, x: Tensor) -> Tensor:
        x = self.rnn(self.gru(x, self.gru(x)))
        h, c = self.lstm(x)
        return self.out(self.lstm(x, (c, h))[0])


class Sequence(nn.Module):
    """The function of ``nn.GRU`` or ``nn.LSTM`` over the columns of a sample, as a sequence of three numbers."""

    def __init__(self, name: str, bidirectional: bool = False, bias: bool = True) -> None:
        super().__init__()
        layer = getattr(nn, name)(1, 4, 2, bidirectional=bidirectional, bias=bias)
        self.weights, self.function = (
            nn.ParameterList(map(nn.Parameter, layer._flat_weights)),
            [getattr(torch, name.lower())],
        )
        self.out, self.options, self.states = nn.Linear(12 if not bidirectional else 24, 2), (bias, bidirectional), name

    def forward(self, x: Tensor) -> Tensor:
        bias, bidirectional = self.options
        h = x.new_zeros(4 if bidirectional else 2, len(x), 4)
        state = (h, h) if self.states == "LSTM" else h
        y = self.function[0](x[:, :, None], state, list(self.weights), bias, 2, 0.0, False, bidirectional, True)[0]
        return self.out(y.flatten(1))


class Masked(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.a, self.b = nn.Linear(3, 8), nn.Linear(8, 2)

    def forward(self, x: Tensor) -> Tensor:
        y = self.a(x) * 1.0
        y[y < -0.1] = 0.5
        y[x[:, 0] > 0.2] = -0.25
        return self.b(y)


class Shaped(Masked):
    """A network that computes sizes with tensors, and passes one size as a tensor and one as a number."""

    def forward(self, x: Tensor) -> Tensor:
        y = self.a(x.reshape(torch.prod(torch.tensor(x.shape[:-1])), -1))
        return self.b(torch.tanh(y)).reshape(int(torch.tensor(x.shape[:-1]).prod()), 2)


MODULES: dict[str, Callable[[], nn.Module]] = {
    "a shape in tensors": Shaped,
    "Fourier KAN": lambda: nn.Sequential(FourierKAN(3, 4), FourierKAN(4, 2)),
    **{
        f"convolution, {form}": lambda form=form: Convolved(form)
        for form in ("over samples", "behind", "covers", "lines")
    },
    "cells": Recurrent,
    "GRU": lambda: Sequence("GRU"),
    "LSTM": lambda: Sequence("LSTM"),
    "LSTM in both directions": lambda: Sequence("LSTM", bidirectional=True),
    "LSTM without biases": lambda: Sequence("LSTM", bias=False),
    "x[mask] = number": Masked,
}


@pytest.mark.parametrize("name", MODULES)
def test_a_module_that_is_one_program(name: str) -> None:
    x = uniform((90,)).requires_grad_()
    actual, expected, router = both(MODULES[name], x)
    assert router.explain() == "forward: fused"
    equal(actual, expected, x, router, twice=not name.startswith("LSTM"))  # PyTorch's LSTM has no second derivatives


def test_a_vector_alone() -> None:
    """A network of a vector alone reads nothing of the samples but their number."""

    def alone(net: Any, x: Tensor) -> Tensor:
        return net.out(torch.tanh(net.code.expand(len(x), 4)))

    x = uniform((90,)).requires_grad_()
    actual, expected, router = both(lambda: Built(alone, code=nn.Parameter(torch.randn(4)), out=(4, 2)), x)
    assert router.explain() == "forward: fused"
    torch.testing.assert_close(actual, expected)
    ours, theirs = (
        torch.autograd.grad(y.square().sum(), [*router.parameters(), x], allow_unused=True) for y in (actual, expected)
    )
    torch.testing.assert_close(ours[:-1], theirs[:-1])
    assert ours[-1] is None and theirs[-1] is None


def test_a_function_that_cannot_be_a_step_says_why() -> None:
    x = torch.rand(37, 17, 3)
    for function, args, reason in (
        (F.linear, (torch.rand(2, 3),), "a layer of 17 rows of each sample, more than 16"),
        (F.batch_norm, (None, None, None, None, True), "it mixes samples"),
        (F.batch_norm, (torch.zeros(17), torch.ones(17), None, None, True), "it mixes samples"),
    ):
        lowering = Lowering(37)
        entries = lowering.input(None, x.shape, Axis(0), 0)
        with pytest.raises(NotAStep, match=reason):
            lowering.run(function, (x, *args), {}, lambda tensor, entries=entries: entries if tensor is x else None)


class Exponential(torch.autograd.Function):
    """torch-ngp's ``trunc_exp``."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return torch.exp(x)

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> Tensor:
        return g * torch.exp(ctx.saved_tensors[0].clamp(-0.2, 0.2))


bound_early = Exponential.apply  # bound at import, as in some modules


def by_sum(net: Any, h: Tensor) -> Tensor:
    (gradient,) = torch.autograd.grad(net.a(h[:, :3]).square().sum(), h, create_graph=True)
    return gradient


def turned(net: Any, h: Tensor) -> Tensor:
    """Returns a view that is possible only because functions of PyTorch keep the strides of a transposed tensor."""
    y = torch.lgamma(h.view(-1, 2, 4).transpose(1, 2) + 1.5)
    return y.transpose(1, 2).contiguous().view(-1, 8)


class Slope(Around):
    """The gradient of the first output by ``torch.autograd.grad`` inside ``forward``, as in NeuS."""

    def forward(self, x: Tensor) -> Tensor:
        with torch.enable_grad():
            x.requires_grad_(True)
            y = super().forward(x)[:, :1]
            ones = torch.ones_like(y, requires_grad=False)
            (slope,) = torch.autograd.grad(y, x, ones, create_graph=True, retain_graph=True, only_inputs=True)
        return torch.cat([y, F.normalize(slope, dim=-1), self.b(self.a(slope))], -1)


class Field(Slope):
    """The gradient with respect to positions that ``forward`` computes, as in nerfstudio's SDFField."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x * 0.5 + 0.1)


BETWEEN: dict[str, tuple[Callable[[], nn.Module], str]] = {
    "a custom function bound early": (lambda: Around(lambda net, h: bound_early(h)), "Exponential.apply"),
    "a gradient": (lambda: Slope(lambda net, h: h.square()), "grad"),
    "a gradient by new positions": (lambda: Field(lambda net, h: h.square()), "grad"),
    "a gradient of a sum, by what was computed": (lambda: Around(by_sum), "sum, grad"),
    "a view of a transposed tensor": (lambda: Around(turned), "torch.lgamma"),
    "a view by PyTorch": (lambda: Around(lambda net, h: torch.cosh(turned(net, h))), "torch.lgamma"),
    "no gradient": (lambda: Around(lambda net, h: h * torch.no_grad()(torch.lgamma)(h + 1.5)), "torch.lgamma"),
}


@pytest.mark.parametrize("name", BETWEEN)
def test_what_runs_between_the_runs(name: str) -> None:
    """Values and derivatives equal the loop's if PyTorch computes one part, also under no_grad."""
    make, says = BETWEEN[name]
    x = uniform((90,)).requires_grad_()
    actual, expected, router = both(make, x)
    assert router.explain().startswith("forward: fused in runs") and says in router.explain()
    equal(actual, expected, x, router)
    if "by what was computed" not in name:
        with torch.no_grad():
            torch.testing.assert_close(router(x.detach()), expected.detach(), rtol=1e-4, atol=1e-5)
        assert "fused in runs" in router.explain()


class Timed(nn.Module):
    """torch-ngp's D-NeRF: layers encode a time that all samples share."""

    def __init__(self) -> None:
        super().__init__()
        self.time, self.a, self.b = nn.ModuleList([nn.Linear(1, 6), nn.Linear(6, 4)]), nn.Linear(7, 8), nn.Linear(8, 2)

    def forward(self, x: Tensor, t: Tensor) -> Tensor:
        code = self.time[1](F.relu(self.time[0](t), inplace=True))
        h = torch.cat([x, code.repeat(len(x), 1)], -1)
        return self.b(F.relu(self.a(h))) * t


def test_arguments_that_all_samples_share_are_those_of_each_call() -> None:
    x, t = uniform((90,)), torch.tensor([[0.2]], requires_grad=True)
    actual, expected, router = both(Timed, x, t)
    torch.testing.assert_close(actual, expected)
    modules = [router.cell(cell) for cell in range(K)]
    for value in (0.7, -2.0):
        t = torch.tensor([[value]], requires_grad=True)
        result, cells = router(x, t), router.assign(x)
        own = torch.stack([modules[cell](x[i : i + 1], t)[0] for i, cell in enumerate(cells.tolist())])
        torch.testing.assert_close(result, own)
        torch.testing.assert_close(torch.autograd.grad(result.sum(), t), torch.autograd.grad(own.sum(), t))
    assert router.explain() == "forward: fused"


def test_a_path_that_an_argument_chooses_is_refused() -> None:
    class Chooses(Timed):
        def forward(self, x: Tensor, t: Tensor) -> Tensor:
            return super().forward(x, t) if t > 0 else x[:, :2]

    router = VoronoiRouter(Chooses(), torch.randn(4, 3), coords="first3", fuse=True)
    with pytest.raises(ValueError, match=r"the truth value of a tensor is read \(.* if t > 0 .*depends on values"):
        router(uniform((90,)), torch.tensor([[0.2]]))


class Product(torch.autograd.Function):
    """A custom autograd function of samples and parameters, as in faster-KAN."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, grid: Tensor) -> Tensor:
        ctx.save_for_backward(x, grid)
        return x * grid

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor, Tensor]:
        x, grid = ctx.saved_tensors
        return g * grid, (g * x).sum(0)


@torch.jit.script
def bend(x: Tensor) -> Tensor:
    return torch.sin(x) * 2


def assigned(net: Any, h: Tensor) -> Tensor:
    h = h * 1.0
    h[h[:, 0] > 0] = h[h[:, 0] > 0] ** 2
    return h


class Scripted(Around):
    def forward(self, x: Tensor) -> Tensor:
        return self.b(bend(self.a(x)))


REFUSED: list[tuple[nn.Module, str]] = [
    (Scripted(assigned), r"a tensor was not computed .*\(.*\), perhaps bend, which torch.jit has compiled; use"),
    (
        Around(lambda net, h: h * torch.from_numpy(np.ones((len(h), 8), "f4"))),
        r"a tensor was not computed by a PyTorch function \(.*np.ones.*, write it",
    ),
    (
        Around(lambda net, h: h if int(torch.tensor(h.shape).sum()) > 3 else -h),
        r"__int__ is read \(.* so the module's control flow depends on values",
    ),
    (
        Around(lambda net, h: Product.apply(h, net.gain)),
        r"Product.apply \(.* is a custom function that takes parameters of cells; write it with functions",
    ),
    (Around(assigned), r"__getitem__ \(.* which has no row for each of 37 samples.*as torch.where does"),
    (Around(lambda net, h: h + torch.rand_like(h)), r"draws random numbers"),
    (Around(lambda net, h: F.dropout(h, 0.5)), r"torch.nn.functional.dropout draws random numbers"),
    (Around(lambda net, h: h if h.max() > 0 else -h), r"no row for each of 37 samples: it mixes or selects them"),
    (Around(lambda net, h: h if (h > 0).any() else -h), r"depends on values; write it with torch.where"),
    (Around(lambda net, h: torch.autograd.grad(h.sum(0)[None].sum(), h)[0]), "no row for each"),
]


@pytest.mark.parametrize(("module", "says"), REFUSED)
def test_what_cannot_be_fused_is_said(module: nn.Module, says: str) -> None:
    module.apply(lambda part: getattr(part, "reset_parameters", lambda: None)())  # by the test's seed, unlike at import
    for part in (module, nn.Sequential(module, nn.Linear(2, 2))):
        router = VoronoiRouter(part, torch.randn(4, 3), coords="first3", fuse=True)
        with pytest.raises(ValueError, match=rf"VoronoiRouter: fuse=True needs a network that .*\.forward.*{says}"):
            router(uniform((90,)))


class FastAttention(nn.Module):
    """The attention of nanoGPT; PyTorch's results have the layout [n, tokens, heads, width]."""

    def __init__(self) -> None:
        super().__init__()
        self.attend, self.project = nn.Linear(4, 12), nn.Linear(4, 4)

    def forward(self, x: Tensor) -> Tensor:
        x = x.view(len(x), -1, 4)
        size, tokens, width = x.size()
        q, k, v = (p.view(size, tokens, 2, 2).transpose(1, 2) for p in self.attend(x).split(width, dim=2))
        y = F.scaled_dot_product_attention(q, k, v, is_causal=True)
        return self.project(y.transpose(1, 2).contiguous().view(size, tokens, width)).flatten(1)


@pytest.mark.parametrize("tokens", [1, 3, 16])
def test_attention_over_the_tokens_of_a_sample(tokens: int) -> None:
    router = perturb(VoronoiRouter(FastAttention(), uniform((4,)), coords="first3", fuse=True), torch.Generator())
    for n in (50, 1, 16):
        x = uniform((n,), 4 * tokens)
        (expected,) = masked_loop(router, x)
        torch.testing.assert_close(router(x), expected, rtol=1e-4, atol=1e-5)
