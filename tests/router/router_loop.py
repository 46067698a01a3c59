"""A plain loop over masks, the reference for routers, and random numbers for both."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from voronerf.router import VoronoiRouter


class Built(nn.Module):
    """A module whose ``forward`` is a function of the module and the arguments; a pair (i, o) is a linear layer."""

    def __init__(self, function: Callable[..., Any], **parts: Any) -> None:
        super().__init__()
        self.function = [function]
        for name, part in parts.items():
            setattr(self, name, nn.Linear(*part) if isinstance(part, tuple) else part)

    def forward(self, *args: Any) -> Any:
        return self.function[0](self, *args)


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
    router: VoronoiRouter,
    *args: Any,
    cells: Tensor | None = None,
    method: str = "forward",
    modules: Sequence[nn.Module] | None = None,
) -> list[Tensor]:
    """Returns the results of a loop over masks; tensors of samples in ``args`` are flat, [n, ...].

    Each cell's samples are evaluated by a copy of the module of its own, or by one of ``modules``. Results of the
    copies' ``forward`` have gradients with respect to the router's parameters.
    """
    if cells is None:
        cells = router.diagram.locate(args[0][:, : router.diagram.centres.shape[1]])
    results: list[Tensor] = []
    for i in range(router.num_cells):
        if not (mask := cells == i).any():
            continue
        part = tuple(v[mask] if isinstance(v, Tensor) and v.shape[:1] == cells.shape else v for v in args)
        module = router.cell(i) if modules is None else modules[i]
        if modules is None and method == "forward":
            own = router.module.named_parameters()
            own = {name: p[i] if p.dim() > module.get_parameter(name).dim() else p for name, p in own}
            outputs = tensors(functional_call(module, own, part))
        else:
            outputs = tensors(getattr(module, method)(*part))
        if not results:
            results = [part.new_zeros(len(cells), *part.shape[1:]) for part in outputs]
        index = mask.nonzero()[:, 0]
        results = [whole.index_copy(0, index, part) for whole, part in zip(results, outputs, strict=True)]
    return results


def gradients(results: Any, wanted: Sequence[Tensor]) -> list[Tensor]:
    """Returns the gradients of a weighted sum of the results."""
    terms = [(y * torch.linspace(0.5, 1.5, y.numel()).view_as(y)).sum() for y in tensors(results)]
    return list(torch.autograd.grad(torch.stack(terms).sum(), wanted, allow_unused=True, materialize_grads=True))


def equals_loop(
    router: VoronoiRouter, *args: Any, by: Sequence[Tensor] = (), rtol: float = 1e-3, atol: float = 1e-4, **how: Any
) -> Any:
    """Checks that a call and its gradients by the parameters and ``by`` equal the loop's; returns the call's results.

    ``rtol`` and ``atol`` are for the gradients; ``how`` goes to the loop.
    """
    result, expected, wanted = router(*args), masked_loop(router, *args, **how), [*by, *router.parameters()]
    torch.testing.assert_close(tensors(result), expected, rtol=1e-4, atol=1e-5)
    ours, theirs = gradients(result, wanted), gradients(expected, wanted)
    torch.testing.assert_close(ours, theirs, rtol=rtol, atol=atol)
    return result
