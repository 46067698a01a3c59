"""A plain loop over masks, the reference for routers, and random numbers for both."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.router import VoronoiRouter


def uniform(lead: tuple[int, ...], features: int = 3) -> Tensor:
    return torch.rand(*lead, features) * 2 - 1


def randomised(module: nn.Module) -> nn.Module:
    """Adds noise to every trainable parameter, so that none keeps an initial value of zero or one."""
    with torch.no_grad():
        for parameter in module.parameters():
            if parameter.requires_grad:
                parameter += 0.1 * torch.randn_like(parameter)
    return module


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
