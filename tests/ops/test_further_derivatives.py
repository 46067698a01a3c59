"""Losses on second derivatives, such as a curvature, whose gradients need third derivatives of the ops."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from op_cases import need, offsets_of
from torch import Tensor

from voronerf import ops
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS, Layer

COUNTS = [4, 0, 5]
N, K = sum(COUNTS), len(COUNTS)
Call = Callable[..., Tensor]


def draw(*shape, seed):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed)) * 2 - 1


def linear(backend, x, weight, bias):
    return ops.grouped_linear(x, offsets_of(COUNTS, x.device), weight, bias, activation="sine", backend=backend)


NETWORK = MLP((Layer((POSITIONS,), 6, "sine"), Layer((0,), 2, "sigmoid")), (1,), position_octaves=2)


def network(backend, x, first, second):
    offsets = offsets_of(COUNTS, x.device)
    return ops.grouped_mlp(x, offsets, [first, second], [None, None], layers=NETWORK, backend=backend)


def routed(backend, x, first, second):
    cells = torch.tensor([0, 2, 2, 0, 2, 0, 2, 0, 2], dtype=torch.int32, device=x.device)
    return ops.routed_mlp(x, [first, second], [None, None], layers=NETWORK, cells=cells, backend=backend)[0]


SPHERICAL = MLP(
    (Layer((DIRECTIONS, POSITIONS), 6, "sine"), Layer((0,), 2, "sigmoid")),
    (1,),
    direction_encoding="spherical",
    direction_degree=4,
)


def seen(backend, directions, x, first, second):
    offsets, weights = offsets_of(COUNTS, x.device), [first, second]
    return ops.grouped_mlp(x, offsets, weights, [None, None], layers=SPHERICAL, directions=directions, backend=backend)


def frequencies(backend, x):
    return ops.frequency_encode(x, 2, backend=backend)


def gaussians(backend, x, variances):
    return ops.integrated_encode(x, variances.square(), 2, backend=backend)


def harmonics(backend, x):
    return ops.spherical_harmonics(x, 4, backend=backend)


def rays(backend, x, sigma):
    depths = torch.linspace(1, 2, N).to(x)
    deltas = torch.full((N,), 0.3).to(x)
    offsets = torch.tensor([0, 4, N], dtype=torch.int32, device=x.device)
    density = sigma.square() + x.square().sum(-1)
    return ops.composite(density, x.sigmoid(), depths, deltas, ray_offsets=offsets, backend=backend).colour


CASES: dict[str, tuple[Call, list[Tensor]]] = {
    "grouped_linear": (linear, [draw(N, 3, seed=1), draw(K, 4, 3, seed=2), draw(K, 4, seed=3)]),
    "grouped_mlp": (network, [draw(N, 3, seed=1), draw(K, 6, 15, seed=2), draw(K, 2, 6, seed=3)]),
    "routed_mlp": (routed, [draw(N, 3, seed=1), draw(K, 6, 15, seed=2), draw(K, 2, 6, seed=3)]),
    "directions": (
        seen,
        [draw(N, 3, seed=4), draw(N, 3, seed=1), draw(K, 6, 19, seed=2), draw(K, 2, 6, seed=3)],
    ),
    "frequency_encode": (frequencies, [draw(N, 3, seed=1)]),
    "integrated_encode": (gaussians, [draw(N, 3, seed=1), draw(N, 3, seed=2)]),
    "spherical_harmonics": (harmonics, [draw(N, 3, seed=1)]),
    "composite": (rays, [draw(N, 3, seed=1), draw(N, seed=2)]),
}


def gradients(call, backend, values, device, dtype):
    """Returns the gradients of a loss on values, slopes, and derivatives of a nonlinear function of the slopes."""
    leaves = [value.to(device, dtype).requires_grad_() for value in values]
    y = call(backend, *leaves)
    weights = draw(*y.shape, seed=9).to(y)
    (slope,) = torch.autograd.grad((y * weights).sum(), leaves[0], create_graph=True)
    (bend,) = torch.autograd.grad((slope * (1 + slope)).sum(), leaves[0], create_graph=True)
    assert bend.requires_grad
    loss = bend.square().mean() + slope.square().mean() + y.square().mean()
    return list(torch.autograd.grad(loss, leaves))


@pytest.mark.parametrize("name", CASES)
def test_a_loss_on_second_derivatives(name, device, backend):
    need("grouped_mlp" if name == "directions" else name, backend, device, torch.float32)
    call, values = CASES[name]
    expected = gradients(call, "reference", values, torch.device("cpu"), torch.float64)
    actual = gradients(call, backend, values, device, torch.float32)
    for a, b in zip(actual, expected, strict=True):
        torch.testing.assert_close(a.double().cpu(), b, rtol=2e-3, atol=2e-4 * float(b.abs().max()))


@pytest.mark.op("grouped_mlp")
def test_slopes_of_no_samples_by_frozen_networks(device, backend):
    """A loss on normals needs these derivatives of zero samples if a march finds only empty space."""
    need("grouped_mlp", backend, device, torch.float32)
    x = torch.zeros(0, 3, device=device, requires_grad=True)
    weights = [draw(K, 6, 15, seed=2).to(device), draw(K, 2, 6, seed=3).to(device)]
    offsets = offsets_of([0] * K, device)
    y = ops.grouped_mlp(x, offsets, weights, [None, None], layers=NETWORK, backend=backend)
    (slope,) = torch.autograd.grad(y.sum(), x, create_graph=True)
    slope.square().sum().backward()
    assert x.grad is None or x.grad.shape == (0, 3)
