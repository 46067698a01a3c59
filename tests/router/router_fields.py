"""Small modules of many makes, and the plain loop over masks that a router of any of them has to equal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from voronerf.router import VoronoiRouter


class SkipNet(nn.Module):
    """The classic shape: a list of layers with a skip, split inputs, two heads."""

    def __init__(self, depth: int = 4, width: int = 12, skip: int = 2, points: int = 9, views: int = 6) -> None:
        super().__init__()
        self.points, self.views_in, self.skip = points, views, skip
        first = [nn.Linear(points, width)]
        rest = [nn.Linear(width + points if i == skip else width, width) for i in range(depth - 1)]
        self.trunk = nn.ModuleList(first + rest)
        self.feature, self.alpha = nn.Linear(width, width), nn.Linear(width, 1)
        self.views = nn.ModuleList([nn.Linear(views + width, width // 2)])
        self.rgb = nn.Linear(width // 2, 3)

    def forward(self, x: Tensor) -> Tensor:
        points, views = torch.split(x, [self.points, self.views_in], dim=-1)
        h = points
        for i, layer in enumerate(self.trunk):
            h = F.relu(layer(h))
            if i == self.skip:
                h = torch.cat([points, h], -1)
        alpha = self.alpha(h)
        h = torch.cat([self.feature(h), views], -1)
        for layer in self.views:
            h = F.relu(layer(h))
        return torch.cat([self.rgb(h), alpha], -1)


class Sine(nn.Module):
    """Sines of scaled layers, a learned frequency, a residual block."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.b, self.out = nn.Linear(3, 8), nn.Linear(8, 8), nn.Linear(8, 2, bias=False)
        self.frequency = nn.Parameter(torch.tensor(3.0))
        self.scale = nn.Parameter(torch.rand(8) + 0.5)

    def forward(self, x: Tensor) -> Tensor:
        h = torch.sin(self.frequency * self.a(x))
        h = h + torch.sin(self.b(h)) * self.scale
        return self.out(h)


class ByHand(nn.Module):
    """Weights read as attributes: F.linear, @, addmm, einsum, matmul on columns."""

    def __init__(self) -> None:
        super().__init__()
        self.one, self.two = nn.Linear(3, 7), nn.Linear(7, 7)
        self.matrix = nn.Parameter(torch.randn(7, 5) / 3)
        self.shift = nn.Parameter(torch.randn(5))
        self.cube = nn.Parameter(torch.randn(4, 5) / 3)
        self.left = nn.Parameter(torch.randn(6, 4) / 3)

    def forward(self, x: Tensor) -> Tensor:
        h = F.linear(x, self.one.weight, self.one.bias).relu()
        h = F.softplus(h @ self.two.weight.t() + self.two.bias)
        h = torch.addmm(self.shift, h, self.matrix).tanh()
        h = torch.einsum("ni,oi->no", h, self.cube)
        return (self.left @ h.unsqueeze(-1)).squeeze(-1) * 2.0


class Norms(nn.Module):
    """Normalisation, PReLU, a gate and an embedding that is looked up by a feature."""

    def __init__(self) -> None:
        super().__init__()
        self.lift = nn.Linear(3, 8)
        self.norm, self.rms, self.group = nn.LayerNorm(8), nn.RMSNorm(8), nn.GroupNorm(2, 8)
        self.act, self.one = nn.PReLU(8), nn.PReLU()
        self.table = nn.Embedding(5, 4)
        self.out = nn.Linear(12, 3)
        for parameter in (self.norm.weight, self.norm.bias, self.group.weight, self.rms.weight, self.act.weight):
            nn.init.normal_(parameter)

    def forward(self, x: Tensor) -> Tensor:
        h = self.act(self.norm(self.lift(x[:, :3])))
        h = self.one(self.group(self.rms(h)))
        return self.out(torch.cat([h, self.table(x[:, 3].long())], dim=1))


class Heads(nn.Module):
    """Several results in a dict, 1-D ones among them; flags and an optional argument."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(3, 8), nn.SiLU(), nn.Linear(8, 5))
        self.colour = nn.Sequential(nn.Linear(4 + 3, 6, bias=False), nn.ReLU(inplace=True), nn.Linear(6, 3))
        self.register_buffer("bands", 2.0 ** torch.arange(2))

    def density(self, x: Tensor) -> dict[str, Tensor]:
        h = self.net(x)
        return {"sigma": torch.exp(h[..., 0].clamp(max=4)), "features": h[..., 1:]}

    def forward(self, x: Tensor, d: Tensor | None = None, density_only: bool = False) -> Any:
        found = self.density(x)
        if density_only or d is None:
            return found["sigma"]
        return torch.sigmoid(self.colour(torch.cat([d, found["features"]], -1))), found["sigma"]


class Pair(NamedTuple):
    colour: Tensor
    normal: Tensor | None


class Gradient(nn.Module):
    """Normals by a gradient taken inside of forward; a named tuple."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(3, 8), nn.Softplus(), nn.Linear(8, 4))

    def forward(self, x: Tensor) -> Pair:
        with torch.enable_grad():
            x = x.requires_grad_(True) if not x.requires_grad else x
            h = self.net(x)
            normal = torch.autograd.grad(h[:, 0].sum(), x, create_graph=True)[0]
        return Pair(h[:, 1:], F.normalize(normal, dim=-1))


class Tied(nn.Module):
    """One layer used twice under two names, and a norm of weights."""

    def __init__(self) -> None:
        super().__init__()
        self.a = nn.Linear(3, 3)
        self.b = self.a
        self.c = nn.utils.parametrizations.weight_norm(nn.Linear(3, 2))
        self.d = nn.Linear(2, 2)
        self.d.weight = self.out_weight = nn.Parameter(torch.randn(2, 2))

    def forward(self, x: Tensor) -> Tensor:
        h = self.c(self.b(torch.relu(self.a(x)).view(-1, 3)))
        return self.d(h) @ self.out_weight / self.out_weight.norm(dim=1)


class Convolved(nn.Module):
    """Layers without a grouped form: a convolution over features and a bilinear one."""

    def __init__(self) -> None:
        super().__init__()
        self.conv, self.bilinear = nn.Conv1d(1, 2, 2), nn.Bilinear(4, 3, 2)

    def forward(self, x: Tensor) -> Tensor:
        return self.bilinear(self.conv(x[:, None]).flatten(1).relu(), x)


class Reads(nn.Module):
    """Reads a parameter's value: one call for each cell."""

    def __init__(self) -> None:
        super().__init__()
        self.lin, self.gain = nn.Linear(3, 2), nn.Parameter(torch.tensor(1.5))

    def forward(self, x: Tensor) -> Tensor:
        return self.lin(x) * (2.0 if self.gain.item() > 1.0 else 0.5)


class Masked(nn.Module):
    """Evaluates the samples inside of a box alone."""

    def __init__(self) -> None:
        super().__init__()
        self.lin = nn.Linear(3, 4)

    def forward(self, x: Tensor) -> Tensor:
        inside = (x.abs() < 1).all(-1)
        out = torch.zeros(x.shape[0], 4, dtype=x.dtype)
        out[inside] = torch.tanh(self.lin(x[inside]))
        return out


class Encoded(nn.Module):
    """An encoder inside, rows of higher rank, a view by its own sizes."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("scales", 2 ** torch.arange(3))
        self.low, self.high = nn.Parameter(torch.zeros(3) - 2), nn.Parameter(torch.zeros(3) + 2)
        self.lin, self.small = nn.Linear(21, 12), nn.Linear(3, 2)

    def forward(self, x: Tensor) -> Tensor:
        x = (x - self.low) / (self.high - self.low)
        waves = (x[..., None, :] * self.scales[:, None]).reshape(*x.shape[:-1], 9)
        h = self.lin(torch.cat([x, torch.sin(waves), torch.cos(waves)], -1)).view(-1, 4, 3)
        weights = torch.softmax(self.small(h), dim=1)
        return (weights[..., :1] * h).sum(1) + torch.cumsum(h, 1)[:, -1]


def first3(n: int, dtype: torch.dtype, generator: torch.Generator) -> tuple[Tensor, ...]:
    return (torch.randn(n, 3, generator=generator, dtype=dtype),)


def with_views(n: int, dtype: torch.dtype, generator: torch.Generator) -> tuple[Tensor, ...]:
    return (torch.randn(n, 15, generator=generator, dtype=dtype),)


def with_index(n: int, dtype: torch.dtype, generator: torch.Generator) -> tuple[Tensor, ...]:
    x = torch.randn(n, 4, generator=generator, dtype=dtype)
    return (torch.cat([x[:, :3], torch.randint(5, (n, 1), generator=generator).to(dtype)], 1),)


def with_directions(n: int, dtype: torch.dtype, generator: torch.Generator) -> tuple[Tensor, ...]:
    return tuple(torch.randn(n, 3, generator=generator, dtype=dtype) for _ in range(2))


Inputs = Callable[[int, torch.dtype, torch.Generator], tuple[Tensor, ...]]

ONE_PASS: list[tuple[type[nn.Module], Inputs]] = [
    (SkipNet, with_views),
    (Sine, first3),
    (ByHand, first3),
    (Norms, with_index),
    (Heads, with_directions),
    (Gradient, first3),
    (Tied, first3),
    (Convolved, first3),
    (Encoded, first3),
]
BY_CELL: list[tuple[type[nn.Module], Inputs]] = [(Reads, first3), (Masked, first3)]


def perturb(router: VoronoiRouter, generator: torch.Generator, size: float = 0.2) -> VoronoiRouter:
    """Makes the cells differ."""
    with torch.no_grad():
        for parameter in router.parameters():
            parameter += size * torch.randn(parameter.shape, generator=generator).to(parameter)
    return router


def tensors(value: Any) -> list[Tensor]:
    """The tensors of a result, in order."""
    if isinstance(value, Tensor):
        return [value]
    items = value.values() if isinstance(value, dict) else value if isinstance(value, (list, tuple)) else []
    return [tensor for item in items for tensor in tensors(item)]


def masked_loop(
    router: VoronoiRouter, cells: Tensor, args: Sequence[Any], method: str = "forward"
) -> tuple[list[Tensor], list[nn.Module]]:
    """What a router stands for: a mask and a module for each cell; flat arguments [n, ...]."""
    modules = [router.cell(i) for i in range(router.num_cells)]
    results: list[Tensor] = []
    for i, module in enumerate(modules):
        mask = cells == i
        if not mask.any():
            continue
        part = [value[mask] if isinstance(value, Tensor) and value.dim() else value for value in args]
        found = tensors(getattr(module, method)(*part))
        if not results:
            results = [part.new_zeros(len(cells), *part.shape[1:]) for part in found]
        index = mask.nonzero()[:, 0]
        results = [whole.index_copy(0, index, part) for whole, part in zip(results, found, strict=True)]
    return results, modules


def gradients(
    results: Sequence[Tensor], factors: Sequence[Tensor], inputs: Sequence[Tensor], second: bool
) -> list[Tensor]:
    """Gradients of a weighted sum of results, or of the squares of its gradients, with respect to inputs."""
    total = sum((result * factor).sum() for result, factor in zip(results, factors, strict=True))
    found = torch.autograd.grad(total, inputs, create_graph=second, allow_unused=True, materialize_grads=True)
    if second:
        total = sum(gradient.square().sum() for gradient in found)
        found = torch.autograd.grad(total, inputs, allow_unused=True, materialize_grads=True)
    return list(found)
