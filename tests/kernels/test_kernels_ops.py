"""The Warp kernels as PyTorch ops: more cases than in tests/ops, which tests every backend."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from voronerf import MLP, Layer, grouped_mlp

pytestmark = pytest.mark.warp
ROWS = 64  # the rows of a tile


def gradients(width: int, counts: list[int], backend: str) -> list[Tensor]:
    """Returns the output and gradients of three layers with a skip; the cells have ``counts`` rows."""
    generator = torch.Generator().manual_seed(0)
    layers = (Layer(("positions",), width, "relu"), Layer((0, "positions"), width, "softplus"), Layer((1,), 3, "sine"))
    table = MLP(layers, outputs=(2, 0), position_octaves=2)
    n, k = sum(counts), len(counts)
    arguments = [torch.rand(n, 3, generator=generator)]
    for o, i in table.weight_shapes(3):
        arguments += [torch.randn(k, o, i, generator=generator) / i**0.5, torch.randn(k, o, generator=generator)]
    positions, *parameters = [tensor.requires_grad_() for tensor in arguments]
    offsets = torch.tensor([0, *counts], dtype=torch.int32).cumsum(0, dtype=torch.int32)
    out = grouped_mlp(positions, offsets, parameters[::2], parameters[1::2], layers=table, backend=backend)
    return [out, *torch.autograd.grad(out.square().sum(), (positions, *parameters))]


@pytest.mark.parametrize("width", [1, 15, 16, 17, 256, 270])
def test_a_network_of_any_width(width: int) -> None:
    for actual, right in zip(gradients(width, [70, 3], "warp"), gradients(width, [70, 3], "reference"), strict=True):
        torch.testing.assert_close(actual, right, rtol=1e-4, atol=1e-4 * float(right.detach().abs().max()))


@pytest.mark.parametrize(
    "counts", [[0, 0], [ROWS], [ROWS + 1, 0, ROWS - 1], [0, 2 * ROWS, 0, 1, 0], [1] * 70, [300, *[0] * 40]], ids=str
)
def test_cells_of_any_size(counts: list[int]) -> None:
    for actual, right in zip(gradients(20, counts, "warp"), gradients(20, counts, "reference"), strict=True):
        torch.testing.assert_close(actual, right, rtol=1e-4, atol=1e-5)


def test_what_a_step_needs_is_loaded_before_it() -> None:
    kernels = pytest.importorskip("voronerf.kernels")
    loads = kernels.loads(torch.device("cpu"), torch.float32)
    assert len(loads) == 10
    for load in loads:
        load()
