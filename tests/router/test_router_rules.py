"""Modules from published fields that run for all cells at once, against a loop over masks."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from ops.foreign_kinds import CORNERS
from router_loop import Built, gradients, masked_loop, perturb, uniform
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


def added(net: Any, x: Tensor) -> Tensor:
    return torch.addmm(net.constant, torch.tanh(torch.addmm(net.shift, x, net.a)), net.b)


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
    def forward(self, x: Tensor) -> Tensor:
        return torch.exp(1j * self.layers[0](self.first(x).cfloat())) @ self.out.weight.T


MODULES: dict[str, Callable[[], nn.Module]] = {
    "addmm": lambda: Built(
        added,
        a=nn.Parameter(torch.randn(3, 8)),
        b=nn.Parameter(torch.randn(8, 2)),
        shift=nn.Parameter(torch.randn(8)),
        constant=torch.ones(2),
    ),
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
def test_complex_layers_stay_complex_under_autocast(fuse: bool, generator: torch.Generator) -> None:
    """Autocast does not change complex layers; it rounds real layers before them, and results of fused layers."""
    centres = torch.rand(5, 3, generator=generator) * 2 - 1
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


@pytest.mark.parametrize(
    ("name", "n"),  # look-ups of few samples use another algorithm
    [(name, n) for name in MODULES for n in ((60, 6000) if name.startswith("stacked planes") else (60,))],
)
def test_results_and_gradients_are_those_of_the_loop(name: str, n: int, generator: torch.Generator) -> None:
    centres = torch.rand(5, 3, generator=generator) * 2 - 1
    router = perturb(VoronoiRouter(MODULES[name](), centres, coords="first3", way="grouped"), generator)
    x = (uniform((n,)) * 1.1).requires_grad_()
    (expected,), actual = masked_loop(router, x), router(x)
    assert router.explain() == "forward: grouped"
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-5)

    weights, slopes = torch.randn(real(actual).shape, generator=generator), []
    for y in (actual, expected):
        loss = (real(y) * weights).sum()
        (slope,) = torch.autograd.grad(loss, x, create_graph=True)
        loss = slope.square().sum() + loss
        wanted = [*router.parameters()]
        slopes.append([slope, *torch.autograd.grad(loss, wanted, allow_unused=True, materialize_grads=True)])
    torch.testing.assert_close(slopes[0][0], slopes[1][0], rtol=1e-3, atol=1e-4)
    for own, other in zip(*slopes, strict=True):
        torch.testing.assert_close(own, other, rtol=2e-3, atol=2e-3 * float(other.abs().max()))


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
def test_third_derivatives_of_layer_norms_are_right_in_every_way(way: Any, k: int, n: int, generator: Any) -> None:
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


def tabled(module: nn.Module, k: int) -> VoronoiRouter:
    return perturb(VoronoiRouter(module, uniform((k,)), coords="first3"), torch.Generator().manual_seed(k), 1)


def test_indices_outside_of_a_table_are_refused() -> None:
    router = tabled(CORNERS.make(), 3)
    x = torch.rand(40, 3)
    router(x)
    x[7, 0] = 2.4
    with pytest.raises(IndexError):
        router(x)


def test_pieces_cut_large_cells_and_join_small_ones() -> None:
    """A wide network runs in pieces of 1,024 rows: a large cell is cut into several, small cells share one."""
    torch.manual_seed(3)
    router = tabled(nn.Sequential(nn.Linear(3, 1100), nn.ReLU(), nn.Linear(1100, 2)), 40)
    x = torch.cat([torch.rand(2500, 3) * 0.1, torch.rand(1500, 3) * 2 - 1])[torch.randperm(4000)]
    cells = router.assign(x)
    assert cells.bincount(minlength=40).max() > 2048, "one cell of three pieces"
    actual, (expected,) = router(x), masked_loop(router, x)
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-4 * float(expected.detach().abs().max()))
    leaves = list(router.parameters())
    for a, b in zip(gradients(actual, leaves), gradients(expected, leaves), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-3 * float(b.abs().max()))
