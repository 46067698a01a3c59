"""Modules from published fields that run for all cells at once, against a loop over masks."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from router_loop import masked_loop, perturb, uniform
from torch import Tensor, nn

from voronerf import VoronoiRouter


class FiLM(nn.Module):
    """pi-GAN: a network maps a code (a parameter here) to frequencies and phases of the layers."""

    def __init__(self) -> None:
        super().__init__()
        self.code, self.mapping = nn.Parameter(torch.randn(1, 4)), nn.Linear(4, 16)
        self.layers, self.out = nn.ModuleList([nn.Linear(3, 8), nn.Linear(8, 8)]), nn.Linear(8, 2)

    def forward(self, x: Tensor) -> Tensor:
        freq, phase = self.mapping(self.code).chunk(2, -1)
        for layer in self.layers:
            x = layer(x)
            x = torch.sin((1 + freq).expand_as(x) * x + phase.expand_as(x))
        return self.out(x)


class Added(nn.Module):
    """Layers written as ``addmm``."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.b = nn.Parameter(torch.randn(3, 8)), nn.Parameter(torch.randn(8, 2))
        self.shift, self.constant = nn.Parameter(torch.randn(8)), torch.ones(2)

    def forward(self, x: Tensor) -> Tensor:
        return torch.addmm(self.constant, torch.tanh(torch.addmm(self.shift, x, self.a)), self.b)


class TensorVM(nn.Module):
    """nerfstudio's TensoRF: one parameter stacks three planes, another stacks three lines."""

    def __init__(self, padding: str = "zeros", align: bool = True) -> None:
        super().__init__()
        self.plane_coef = nn.Parameter(0.3 * torch.randn(3, 4, 9, 7))
        self.line_coef = nn.Parameter(0.3 * torch.randn(3, 4, 8, 1))
        self.basis, self.padding, self.align = nn.Linear(12, 2, bias=False), padding, align

    def forward(self, x: Tensor) -> Tensor:
        plane = torch.stack([x[..., [0, 1]], x[..., [0, 2]], x[..., [1, 2]]])
        line = torch.stack([x[..., 2], x[..., 1], x[..., 0]])
        line = torch.stack([torch.zeros_like(line), line], dim=-1)
        options: Any = {"align_corners": self.align, "padding_mode": self.padding}
        planes = F.grid_sample(self.plane_coef, plane.view(3, -1, 1, 2), **options)
        lines = F.grid_sample(self.line_coef, line.view(3, -1, 1, 2), **options)
        return self.basis((planes * lines).view(12, *x.shape[:-1]).moveaxis(0, -1))


class BARF(nn.Module):
    """Coarse-to-fine weights of frequencies, computed from a parameter that is read through ``.data``."""

    def __init__(self) -> None:
        super().__init__()
        self.progress, self.net = nn.Parameter(torch.tensor(0.4)), nn.Linear(3 + 24, 2)

    def forward(self, x: Tensor) -> Tensor:
        spectrum = x[..., None] * 2.0 ** torch.arange(4) * math.pi
        encoded = torch.stack([spectrum.sin(), spectrum.cos()], dim=-2).view(*x.shape[:-1], -1)
        alpha = (self.progress.data - 0.1) / 0.4 * 4
        weight = (1 - (alpha - torch.arange(4, dtype=torch.float32)).clamp_(min=0, max=1).mul_(math.pi).cos_()) / 2
        shape = encoded.shape
        encoded = (encoded.view(-1, 4) * weight).tile(int(encoded.numel() / encoded.view(-1, 4).numel())).view(shape)
        return self.net(torch.cat([x, encoded], dim=-1))


class Gabor(nn.Module):
    """WIRE: complex layers after a real layer."""

    def __init__(self, bias: bool = True) -> None:
        super().__init__()
        self.first, self.omega = nn.Linear(3, 8), nn.Parameter(torch.tensor([3.0]))
        self.scale = nn.Parameter(torch.tensor([1.0]))
        self.layers = nn.ModuleList(nn.Linear(8, 8, bias=bias, dtype=torch.cfloat) for _ in range(2))
        self.out = nn.Linear(8, 2, dtype=torch.cfloat)

    def forward(self, x: Tensor) -> Tensor:
        x = self.first(x)
        x = torch.exp(1j * self.omega * x - (self.scale * x).abs().square())
        for layer in self.layers:
            x = layer(x)
            x = torch.exp(1j * x - x.abs().square())
        return self.out(x).real


class Spectrum(Gabor):
    """The layers of :class:`Gabor` with complex results."""

    def forward(self, x: Tensor) -> Tensor:
        return torch.exp(1j * self.layers[0](self.first(x).cfloat())) @ self.out.weight.T


MODULES: dict[str, Callable[[], nn.Module]] = {
    "addmm": Added,
    "FiLM": FiLM,
    "stacked planes": TensorVM,
    "stacked planes, border": lambda: TensorVM("border"),
    "stacked planes, not aligned": lambda: TensorVM(align=False),
    "stacked planes, border, not aligned": lambda: TensorVM("border", align=False),
    "stacked planes, reflection": lambda: TensorVM("reflection"),
    "data of a parameter": BARF,
    "complex layers": Gabor,
    "complex results": Spectrum,
}


def real(tensor: Tensor) -> Tensor:
    return torch.view_as_real(tensor) if tensor.is_complex() else tensor


@pytest.mark.parametrize("fuse", [True, False])
def test_complex_layers_stay_complex_under_autocast(fuse: bool) -> None:
    """Autocast does not change complex layers; it rounds real layers before them, and results of fused layers."""
    generator = torch.Generator().manual_seed(3)
    centres = torch.rand(5, 3, generator=generator) * 2 - 1
    torch.manual_seed(0)
    way = {"fuse": True} if fuse else {"way": "grouped"}
    router = perturb(VoronoiRouter(Gabor(), centres, coords="first3", **way), generator)
    x = uniform((300,)).requires_grad_()
    expected = router(x)
    (slope,) = torch.autograd.grad(expected.sum(), x)
    with torch.autocast("cpu", torch.bfloat16):
        actual = router(x)
    assert actual.dtype == torch.float32 and ("fused in runs" if fuse else "grouped") in router.explain()
    torch.testing.assert_close(actual, expected, rtol=0.1, atol=0.1)
    torch.testing.assert_close(torch.autograd.grad(actual.sum(), x)[0].norm(), slope.norm(), rtol=0.1, atol=0.1)


@pytest.mark.parametrize("n", [60, 6000])  # look-ups of few samples use another algorithm
@pytest.mark.parametrize("name", MODULES)
def test_results_and_gradients_are_those_of_the_loop(name: str, n: int) -> None:
    generator = torch.Generator().manual_seed(3)
    centres = torch.rand(5, 3, generator=generator) * 2 - 1
    torch.manual_seed(0)
    router = perturb(VoronoiRouter(MODULES[name](), centres, coords="first3", way="grouped"), generator)
    x = (uniform((n,)) * 1.1).requires_grad_()
    (expected,), modules = masked_loop(router, router.diagram.locate(x), [x])
    actual = router(x)
    assert router.explain() == "forward: grouped"
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-5)

    weights = torch.randn(real(actual).shape, generator=generator)
    ours = torch.autograd.grad((real(actual) * weights).sum(), x, create_graph=True)[0]
    theirs = torch.autograd.grad((real(expected) * weights).sum(), x, create_graph=True)[0]
    torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-4)

    (ours.square().sum() + (real(actual) * weights).sum()).backward()
    (theirs.square().sum() + (real(expected) * weights).sum()).backward()
    for path, parameter in router.module.named_parameters():
        own = [module.get_parameter(path) for module in modules]
        gradient = torch.stack([torch.zeros_like(p) if p.grad is None else p.grad for p in own])
        if parameter.grad is None:
            assert not gradient.any(), path
        else:
            torch.testing.assert_close(parameter.grad, gradient, rtol=2e-3, atol=2e-3 * float(gradient.abs().max()))


class Normed(nn.Module):
    """Layer norms in six spellings, with and without weights; if ``on`` is False, none runs."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.b, self.out = nn.Linear(3, 8), nn.Linear(8, 8), nn.Linear(8, 1)
        self.norm, self.scale, self.on = nn.LayerNorm(8), nn.Parameter(torch.rand(8)), False

    def forward(self, x: Tensor) -> Tensor:
        if not self.on:
            return self.out(torch.tanh(self.a(x)))
        x = torch.tanh(self.norm(self.a(x)))
        x = torch.sin(F.layer_norm(self.b(x), (8,), self.scale))
        y = x * F.layer_norm(x, normalized_shape=(8,)) + torch.layer_norm(x, (8,), None, None, 1e-3, False)
        y = y + torch.layer_norm(input=x.sin(), normalized_shape=[8], cudnn_enable=False)
        return self.out(y * torch.native_layer_norm(x.cos(), [8], None, None, 1e-4)[0])


@pytest.mark.parametrize("n", [1, 40])
@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize("way", ["fused", "grouped", "loop"])
def test_third_derivatives_of_layer_norms_are_right_in_every_way(way: Any, k: int, n: int) -> None:
    generator = torch.Generator().manual_seed(3)
    torch.manual_seed(0)
    centres = torch.rand(k, 3, generator=generator)
    router = perturb(VoronoiRouter(Normed().double(), centres, coords="first3", fuse=True, way=way), generator)
    x = torch.rand(n, 3, dtype=torch.float64, generator=generator).requires_grad_()
    router(x)  # a call without norms decides nothing for later calls
    router.module.on = True
    leaves = [x, *router.parameters()]
    along = [torch.randn(leaf.shape, generator=generator).double() * 1e-6 for leaf in leaves]

    def laplacian() -> Tensor:
        (slope,) = torch.autograd.grad(router(x).sum(), x, create_graph=True)
        second = [torch.autograd.grad(slope[:, i].sum(), x, create_graph=True)[0][:, i] for i in range(3)]
        return torch.stack(second).square().sum()

    def moved(sign: int) -> Tensor:
        with torch.no_grad():
            for leaf, step in zip(leaves, along, strict=True):
                leaf += sign * step
        value = laplacian().detach()
        with torch.no_grad():
            for leaf, step in zip(leaves, along, strict=True):
                leaf -= sign * step
        return value

    gradients = torch.autograd.grad(laplacian(), leaves, allow_unused=True, materialize_grads=True)
    result = sum((g * step).sum() for g, step in zip(gradients, along, strict=True))
    torch.testing.assert_close(result, (moved(1) - moved(-1)) / 2, rtol=1e-5, atol=0)
