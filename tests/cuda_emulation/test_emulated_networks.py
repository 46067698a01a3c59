"""Tests of layer tables on the emulated CUDA kernels, with every kind of product and three sizes of shared memory."""

from __future__ import annotations

import itertools

import pytest
import torch
from emulated import emulated
from emulated_networks import (
    ALLOWED,
    BRANCHED,
    BROAD,
    DENSE,
    GAUSSIANS,
    HARMONICS,
    KIB,
    NARROW,
    SKIPS,
    THICK,
    WIDE,
    case,
    check,
    check_forward,
    run,
)

import voronerf
from voronerf.nerf.fields import NeRF
from voronerf.ops._core.layers import MLP, POSITIONS, Layer

TILES = (227, 40, 12)
"""KiB of shared memory. Where it suffices, each warp has its own rows. Otherwise, four warps share rows or, if even
these rows do not fit, values are in the workspace (device memory)."""
FLOATS = [("float32", kib) for kib in TILES]
SMOOTH = {
    "branched": (BRANCHED, [70, 0, 1, 150], 3, [*itertools.product(ALLOWED, TILES)]),
    "wide": (WIDE, [37, 3], 7, [*FLOATS, ("tf32", 40)]),
    "gaussians": (GAUSSIANS, [20, 33], 6, [("float16", 227), ("float32", 40), ("float16", 12)]),
    "harmonics": (HARMONICS, [37, 3], 3, [("bfloat16", 227), ("tf32", 40), ("bfloat16", 12)]),
    "broad": (BROAD, [66, 4], 3, FLOATS),
    "dense": (DENSE, [37, 3], 7, FLOATS),
}
"""Networks whose gradients are compared too, since rounding switches no units, with precisions and shared memory."""
RELU = {
    "skips": (SKIPS, [37, 150], 3, "float16"),
    "thick": (THICK, [150], 3, "bfloat16"),
    "nerf64": (NeRF(width=64).layers, [150, 2], 3, "bfloat16"),
    "narrow": (NARROW, [150, 2], 3, "bfloat16"),
}
"""Networks with more rows in a cell than the 128 of a block's tile."""


@pytest.mark.parametrize(
    ("name", "precision", "shared"), [(name, *pair) for name, row in SMOOTH.items() for pair in row[3]]
)
def test_outputs_and_gradients(name: str, precision: str, shared: int) -> None:
    layers, counts, d, _ = SMOOTH[name]
    with emulated(seed=shared, shared_bytes=shared * KIB):
        check(layers, counts, d, precision)


@pytest.mark.parametrize("name", RELU)
def test_outputs_of_networks_with_kinks(name: str) -> None:
    layers, counts, d, precision = RELU[name]
    for shared in TILES:
        with emulated(seed=7, shared_bytes=shared * KIB):
            check_forward(layers, counts, d, precision, differentiates=shared == TILES[0])


@pytest.mark.parametrize("integrated", [False, True])
@pytest.mark.parametrize(("octaves", "extent"), [(10, 4.0), (16, 3.0), (4, 1000.0), (12, 1e5)])
def test_encodings_are_exact_to_the_rounding_of_operands(octaves: int, extent: float, integrated: bool) -> None:
    """Reads encodings through an identity layer. The last extent has some angles that need the slow range reduction."""
    encoding = "integrated" if integrated else "frequency"
    width = 6 * octaves + (0 if integrated else 3)
    layers = MLP((Layer((POSITIONS,), width),), (0,), octaves, position_encoding=encoding)
    positions = (2 * torch.rand(50, 3) - 1) * extent
    positions[::7] /= extent
    positions = torch.cat([positions, 1e-4 * torch.rand(50, 3)], dim=1) if integrated else positions
    offsets, identity = torch.tensor([0, 50], dtype=torch.int32), torch.eye(width)[None]

    def encoded(dtype: torch.dtype, backend: str, x: torch.Tensor) -> torch.Tensor:
        out = voronerf.grouped_mlp(x, offsets, [identity.to(dtype)], [None], layers=layers, backend=backend)
        return out[:, width % 6 :].double()

    exact = encoded(torch.float64, "reference", positions.double())
    for dtype in (torch.float16, torch.bfloat16, torch.float32):
        with emulated():
            found = encoded(dtype, "native", positions)
        rounding = (exact.to(dtype).double() - exact).abs().max()
        assert (found - exact).abs().max() <= 1.01 * rounding + 2e-7


WHOLE = {
    "two parts": MLP((Layer((POSITIONS,), 40, "relu"), Layer((0,), 70, "relu"), Layer((1, 0), 5)), (2,)),
    # Values of one or two chunks stay in registers from layer to layer. A layer is the sum of at most three products.
    # Some values are read both by the next and by a later layer.
    "in registers": MLP(
        (
            *(Layer((POSITIONS,), 64, "relu"), Layer((0,), 64, "relu"), Layer((1,), 32, "relu")),
            *(Layer((2,), 20, "relu"), Layer((3,), 48, "relu"), Layer((POSITIONS, 4), 33, "relu")),
            *(Layer((5,), 9), Layer((POSITIONS, 3, 6), 17, "relu"), Layer((7, 5), 5)),
        ),
        (8,),
    ),
}


@pytest.mark.parametrize(
    ("precision", "kib"), [*itertools.product(("bfloat16", "tf32"), TILES), ("float16", 227), ("float16", 12)]
)
@pytest.mark.parametrize("name", WHOLE)
def test_gradients_of_relu_are_exact_in_whole_numbers(name: str, precision: str, kib: int) -> None:
    """Uses small integers and sparse weights, so that no rounding occurs."""
    layers, most, likely = WHOLE[name], *((2, 2) if name == "two parts" else (1, 4))
    dtype, draw = torch.float32 if precision == "tf32" else getattr(torch, precision), torch.Generator().manual_seed(1)

    def whole(*shape: int, few: bool = False) -> torch.Tensor:
        numbers = torch.randint(-most, most + 1, shape, generator=draw).double()
        return numbers * (torch.rand(shape, generator=draw) < likely / shape[-1]) if few else numbers

    counts = [130, 0, 40]
    given = case(layers, counts, 3)
    given |= {
        "positions": whole(sum(counts), 3),
        "weights": [whole(len(counts), *shape, few=True) for shape in layers.weight_shapes(3)],
        "biases": [whole(len(counts), o) for o, _ in layers.weight_shapes(3)],
    }
    gradient, before = whole(sum(counts), 5), torch.backends.cuda.matmul.fp32_precision
    with emulated(shared_bytes=kib * KIB):
        try:
            torch.backends.cuda.matmul.fp32_precision = "tf32" if precision == "tf32" else "ieee"
            found = run(given, layers, dtype, "native", gradient)
        finally:
            torch.backends.cuda.matmul.fp32_precision = before
    for part, exact in zip(found, run(given, layers, torch.float64, "reference", gradient), strict=True):
        assert exact.abs().max() > 3 and torch.equal(part, exact.to(dtype))
