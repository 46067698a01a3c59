"""Ray samples to composite and results of `composite`, shared by the tests of its backends."""

from __future__ import annotations

import torch
from torch import Tensor

from voronerf.ops import composite

PARTS = ("colour", "opacity", "depth", "weights")


def scene(counts: list[int], c: int = 3, background: str = "ray", outside: tuple[int, int] = (0, 0)) -> dict:
    """Returns packed float64 arguments of `composite`.

    ``counts`` holds the number of samples of each ray, ``outside`` the numbers of samples that belong to no ray, before
    and after the samples of the rays.
    """
    m, r = sum(counts) + sum(outside), len(counts)
    double = torch.float64
    return {
        "sigma": 5 * torch.rand(m, dtype=double) * (torch.rand(m) > 0.3),
        "rgb": torch.rand(m, c, dtype=double),
        "depths": torch.rand(m, dtype=double),
        "deltas": torch.rand(m, dtype=double) / 2,
        "ray_offsets": torch.tensor([outside[0], *counts]).cumsum(0).int(),
        "background": {"ray": torch.rand(r, c, dtype=double), "all": torch.rand(c, dtype=double), "": None}[background],
    }


def dense(r: int, s: int, c: int = 3, background: str = "ray") -> dict:
    packed = scene([s] * r, c, background)
    shapes = {"sigma": (r, s), "rgb": (r, s, c), "depths": (r, s), "deltas": (r, s)}
    return {**packed, **{name: packed[name].view(shape) for name, shape in shapes.items()}, "ray_offsets": None}


def leaves_of(arguments: dict, dtype: torch.dtype) -> tuple[dict, list[Tensor]]:
    """Returns (arguments, list of the floating-point tensors); the tensors get the dtype and require gradients."""
    cast = {
        name: tensor.to(dtype).requires_grad_() if tensor is not None and tensor.is_floating_point() else tensor
        for name, tensor in arguments.items()
    }
    return cast, [tensor for tensor in cast.values() if tensor is not None and tensor.requires_grad]


def evaluate(arguments: dict, dtype: torch.dtype, backend: str, parts: tuple[str, ...] = PARTS) -> list[Tensor]:
    """Returns all outputs, followed by the gradients of a weighted sum of the outputs named by ``parts``."""
    cast, leaves = leaves_of(arguments, dtype)
    result = composite(**cast, backend=backend)
    chosen = [getattr(result, part) for part in parts]
    slopes = [torch.linspace(-1, 1.5, part.numel(), dtype=torch.float64).view_as(part).to(dtype) for part in chosen]
    gradients = torch.autograd.grad(chosen, leaves, slopes, allow_unused=True, materialize_grads=True)
    return [*(part.detach() for part in result), *gradients]
