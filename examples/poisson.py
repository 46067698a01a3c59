"""Solves a Poisson equation with one network per cell: -div grad u = f in the unit square, u = 0 at the border.

The networks of two cells need not agree at their face. If the loss covers only the equation and the border, each cell
finds its own solution, which is wrong in spite of a small loss. Further conditions, as in XPINNs (Jagtap and
Karniadakis 2020), make values and normal derivatives equal on both sides of each face. ``--alone`` omits these
conditions.
"""

from __future__ import annotations

import argparse
import math

import torch
from torch import Tensor, nn

from voronerf import VoronoiRouter

ASIDE = 1e-4  # offset from a face into a cell, for evaluation


def points_on_faces(centres: Tensor, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Returns points [m, d] on faces of cells in the unit cube, and unit normals [m, d]; m is at most ``count``."""
    x = torch.rand(count, centres.shape[1], generator=generator)
    near = torch.cdist(x, centres).topk(2, largest=False).indices
    a, b = centres[near[:, 0]], centres[near[:, 1]]
    normal = nn.functional.normalize(b - a, dim=1)
    x = x + (((a + b) / 2 - x) * normal).sum(1, keepdim=True) * normal  # projection onto the bisecting plane
    distances = torch.cdist(x, centres)
    on_face = distances.amin(1) > (x - a).norm(dim=1) - 1e-6  # no third centre is nearer
    inside = ((x > 0) & (x < 1)).all(1)
    return x[on_face & inside], normal[on_face & inside]


def slopes(u: Tensor, x: Tensor) -> Tensor:
    """Returns the gradients [n, d] of values [n, 1] at points [n, d]."""
    return torch.autograd.grad(u.sum(), x, create_graph=True)[0]


def solve(*, cells: int = 6, steps: int = 2000, joined: bool = True, seed: int = 0) -> float:
    """Solves the equation; returns the relative error of u in the L2 norm."""
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    field = nn.Sequential(nn.Linear(2, 32), nn.Tanh(), nn.Linear(32, 32), nn.Tanh(), nn.Linear(32, 1))
    centres = torch.rand(cells, 2, generator=generator)
    router = VoronoiRouter(field, centres, coords="first2", fuse=True)
    with torch.no_grad():  # each cell starts with different weights
        for parameter in router.parameters():
            parameter.mul_(1 + 0.1 * torch.randn(parameter.shape, generator=generator))
    optimizer = torch.optim.Adam(router.parameters(), lr=5e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)

    for _ in range(steps):
        x = torch.rand(512, 2, generator=generator).requires_grad_()
        slope = slopes(router(x), x)
        curved = sum(slopes(slope[:, i : i + 1], x)[:, i] for i in range(2))
        loss = (curved + 2 * math.pi**2 * solution(x.detach())).square().mean() / 100

        border = torch.rand(256, 2, generator=generator)
        side, end = torch.randint(2, (2, 256), generator=generator)
        border[torch.arange(256), side] = end.float()
        loss = loss + 10 * router(border).square().mean()

        if joined:
            on_face, normal = points_on_faces(centres, 512, generator)
            both = torch.cat([on_face - ASIDE * normal, on_face + ASIDE * normal]).requires_grad_()
            u = router(both)
            across = (slopes(u, both) * normal.repeat(2, 1)).sum(1)
            jump, bend = (part[: len(on_face)] - part[len(on_face) :] for part in (u, across))
            loss = loss + 10 * jump.square().mean() + bend.square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()

    x = torch.cartesian_prod(*[torch.linspace(0, 1, 101)] * 2)
    exact = solution(x)
    return float((router(x)[:, 0].detach() - exact).norm() / exact.norm())


def solution(x: Tensor) -> Tensor:
    """Returns the exact solution u [n] at points [n, 2]; its Laplacian is -2 pi^2 u."""
    return torch.sin(math.pi * x).prod(1)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=6)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--alone", action="store_true", help="without the conditions on faces")
    options = parser.parse_args()
    error = solve(cells=options.cells, steps=options.steps, joined=not options.alone)
    print(f"{options.cells} cells, {options.steps} steps: relative error {error:.4f}")
