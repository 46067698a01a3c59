"""Small modules of many kinds, and a plain loop over masks, the reference for their routers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from voronerf.router import VoronoiRouter


class SkipNet(nn.Module):
    """A network of the classic shape: a list of layers with a skip, split inputs, two heads."""

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
    """A network with sines of scaled layers, a learned frequency and a residual block."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.b, self.out = nn.Linear(3, 8), nn.Linear(8, 8), nn.Linear(8, 2, bias=False)
        self.frequency = nn.Parameter(torch.tensor(3.0))
        self.scale = nn.Parameter(torch.rand(8) + 0.5)

    def forward(self, x: Tensor) -> Tensor:
        h = torch.sin(self.frequency * self.a(x))
        h = h + torch.sin(self.b(h)) * self.scale
        return self.out(h)


class Heads(nn.Module):
    """A field that returns a dict, with some 1-D results, and takes flags and an optional argument."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(3, 8), nn.SiLU(), nn.Linear(8, 5))
        self.colour = nn.Sequential(nn.Linear(4 + 3, 6, bias=False), nn.ReLU(inplace=True), nn.Linear(6, 3))
        self.register_buffer("bands", 2.0 ** torch.arange(2))

    def density(self, x: Tensor) -> dict[str, Tensor]:
        h = self.net(x)
        return {"sigma": torch.exp(h[..., 0].clamp(max=4)), "features": h[..., 1:]}

    def forward(self, x: Tensor, d: Tensor | None = None, density_only: bool = False) -> Any:
        result = self.density(x)
        if density_only or d is None:
            return result["sigma"]
        return torch.sigmoid(self.colour(torch.cat([d, result["features"]], -1))), result["sigma"]


def perturb(router: VoronoiRouter, generator: torch.Generator, size: float = 0.2) -> VoronoiRouter:
    """Adds noise to the parameters, so that the cells differ."""
    with torch.no_grad():
        for parameter in router.parameters():
            parameter += size * torch.randn(parameter.shape, generator=generator).to(parameter)
    return router


def tensors(value: Any) -> list[Tensor]:
    """Returns the tensors of a result, in order."""
    if isinstance(value, Tensor):
        return [value]
    items = value.values() if isinstance(value, dict) else value if isinstance(value, (list, tuple)) else []
    return [tensor for item in items for tensor in tensors(item)]


def masked_loop(
    router: VoronoiRouter, cells: Tensor, args: Sequence[Any], method: str = "forward"
) -> tuple[list[Tensor], list[nn.Module]]:
    """Returns the results of a loop over masks, and the cells' modules; tensors in ``args`` are flat, [n, ...]."""
    modules = [router.cell(i) for i in range(router.num_cells)]
    results: list[Tensor] = []
    for i, module in enumerate(modules):
        mask = cells == i
        if not mask.any():
            continue
        part = [value[mask] if isinstance(value, Tensor) and value.dim() else value for value in args]
        outputs = tensors(getattr(module, method)(*part))
        if not results:
            results = [part.new_zeros(len(cells), *part.shape[1:]) for part in outputs]
        index = mask.nonzero()[:, 0]
        results = [whole.index_copy(0, index, part) for whole, part in zip(results, outputs, strict=True)]
    return results, modules
