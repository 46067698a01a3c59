"""The CUDA kernels that run a network layer by layer, on the CPU: where it is wide, or a device's memory small."""

from __future__ import annotations

import pytest
import torch
from emulated import emulated, module
from emulated_networks import ALLOWED, BRANCHED, BROAD, DENSE, GAUSSIANS, KIB, WIDE, case, check, run

import voronerf
from voronerf.layers import DIRECTIONS, MLP, POSITIONS, Layer
from voronerf.native import grouped_mlp as _native_mlp

SMALL = 1 * KIB
"""Shared memory that no fused network fits."""


def plan(layers: MLP, n: int, k: int, *, precision: str = "bfloat16", backward: bool = True) -> dict:
    """What the launches would be on the emulated device."""
    seen = torch.zeros(1, 3) if layers.uses_directions else None
    d = 6 if layers.integrated else 3
    weights = [torch.zeros(1, o, i) for o, i in layers.weight_shapes(d, 3)]
    given = _native_mlp.network(torch.zeros(1, d), weights, [None] * len(weights), layers, seen)
    table = _native_mlp._numbers(given.table, given.positions, given.weights, given.directions)
    return module().grouped_mlp_plan(table, list(_native_mlp._OPERANDS).index(precision), n, k, backward)


def nerf(width: int, depth: int) -> MLP:
    """The architecture of the original, in any size."""
    trunk = tuple(Layer((index - 1,) if index else (POSITIONS,), width, "relu") for index in range(depth))
    heads = (Layer((depth - 1,), 1), Layer((depth - 1,), width), Layer((depth + 1, DIRECTIONS), width // 2, "relu"))
    return MLP((*trunk, *heads, Layer((depth + 2,), 3)), (depth + 3, depth), 10, 4)


@pytest.mark.parametrize("precision", ALLOWED)
def test_branched_network(precision: str) -> None:
    """In several slabs, of which cells begin and end in the middle."""
    for seed in (1, 2):
        with emulated(seed=seed, shared_bytes=SMALL):
            found = plan(BRANCHED, 621, 4, precision=precision)
            assert found["by_layers"] and found["slabs"] == 2
            check(BRANCHED, [70, 0, 401, 150], 3, precision)


@pytest.mark.parametrize("precision", ALLOWED)
def test_broad_network(precision: str) -> None:
    with emulated():
        assert plan(BROAD, 70, 2, precision=precision)["by_layers"]
        check(BROAD, [66, 4], 3, precision)


@pytest.mark.parametrize("layers", [DENSE, WIDE, GAUSSIANS], ids=["dense", "wide", "gaussians"])
def test_other_networks(layers: MLP) -> None:
    with emulated(shared_bytes=SMALL):
        check(layers, [37, 3], 6 if layers is GAUSSIANS else 7, "float32")


@pytest.mark.parametrize("precision", ["bfloat16", "float16"])
def test_before_ampere(precision: str) -> None:
    with emulated(capability=75, shared_bytes=SMALL):
        check(BRANCHED, [70, 5], 3, precision)


def test_splits_of_a_cell_are_summed_in_order() -> None:
    """Many multiprocessors: the rows of a cell are shared out, and the sums are the same in every order of blocks."""
    given, results = case(BRANCHED, [600, 30], 3), []
    loaded = module()
    loaded.multiprocessors(16)
    try:
        for seed in (1, 2):
            with emulated(seed=seed, shared_bytes=SMALL):
                assert plan(BRANCHED, 630, 2, precision="float32")["splits"] > 1
                results.append(run(given, BRANCHED, torch.float32, "native"))
    finally:
        loaded.multiprocessors(2)
    assert all(torch.equal(a, b) for a, b in zip(*results))
    for part, exact in zip(results[0], run(given, BRANCHED, torch.float64, "reference")):
        assert (part.double() - exact).norm() <= 3e-6 * max(exact.norm().item(), 1e-6)


def test_rows_of_no_cell_and_unsound_offsets() -> None:
    layers = MLP((Layer((POSITIONS,), 8, "relu"), Layer((0,), 2)), (1,))
    given = case(layers, [20, 13], 3)
    for offsets, strays in (([3, 20, 30], [*range(3), *range(30, 33)]), ([0, 40, 50], []), ([5, 2, 33], [])):
        leaves = [given["positions"].float().requires_grad_(), *(w.float().requires_grad_() for w in given["weights"])]
        with emulated(shared_bytes=SMALL):
            index = torch.tensor(offsets, dtype=torch.int32)
            out = voronerf.grouped_mlp(leaves[0], index, leaves[1:], [None, None], layers=layers, backend="native")
            gradients = torch.autograd.grad(out.sum(), leaves)
        assert (out[strays] == 0).all() and (gradients[0][strays] == 0).all()
        assert all(gradient.isfinite().all() for gradient in gradients)


def test_no_rows() -> None:
    with emulated(shared_bytes=SMALL):
        check(BRANCHED, [0, 0], 3, "float32")


def test_only_what_cannot_be_summed_is_refused() -> None:
    layers = MLP((Layer((POSITIONS,), 2), Layer((0,) * 65, 2)), (1,))
    rule = r"grouped_mlp: a layer must have at most 64 sources on CUDA; use backend='reference'"
    with emulated(), pytest.raises(ValueError, match=rule):
        run(case(layers, [4], 3), layers, torch.float32, "native")
    layers = MLP((Layer((POSITIONS,), 2),), (0,) * 9)
    with emulated(shared_bytes=SMALL), pytest.raises(ValueError, match="among the outputs at most 8 times"):
        run(case(layers, [4], 3), layers, torch.float32, "native")


def test_which_way_a_network_goes() -> None:
    """What the issue measures is fused; a network of the published width is fused forward and goes by layers back."""
    with emulated():
        for layers in (nerf(64, 8), nerf(32, 2), nerf(128, 8)):
            assert (
                not plan(layers, 1 << 22, 16)["by_layers"]
                and not plan(layers, 1 << 22, 16, backward=False)["by_layers"]
            )
        assert not plan(nerf(256, 8), 1 << 22, 16, backward=False)["by_layers"]
        assert plan(nerf(256, 8), 1 << 22, 16)["by_layers"]
        assert plan(nerf(512, 8), 1 << 22, 16, backward=False)["by_layers"]


@pytest.mark.parametrize(("capability", "compiled"), [(90, 120), (75, 120), (90, 75), (80, 80)])
def test_what_is_multiplied_is_what_the_kernels_were_compiled_for(capability: int, compiled: int) -> None:
    """A newer device runs code for an older one, which does not have the newer one's instructions."""
    modern = min(capability, compiled) >= 80
    expected = {"float32": 0, "bfloat16": 1 if modern else 0, "float16": 2, "tf32": 3 if modern else 0}
    for shared in (64 * KIB, SMALL):
        with emulated(capability=capability, compiled=compiled, shared_bytes=shared):
            for precision, number in expected.items():
                found = plan(BRANCHED, 100, 3, precision=precision)
                assert found["precision"] == number and found["by_layers"] == (shared == SMALL)
            check(BRANCHED, [30, 5], 3, "bfloat16")


def test_splits_fill_the_device_within_their_memory() -> None:
    """A slab of sorted rows has few of the cells, whatever their number."""
    loaded, most = module(), 512 << 20
    loaded.multiprocessors(132)
    try:
        with emulated():
            found = {k: plan(nerf(256, 8), 1 << 22, k) for k in (1, 16, 4096)}
    finally:
        loaded.multiprocessors(2)
    # Blocks of the largest gradient, 256 x (256 + 63): 4 x 3 tiles a cell, in two cells of a slab.
    assert found[1]["splits"] == 64 and -(-8 * 132 // (16 * 12)) < found[16]["splits"] <= 8 * 132 // (2 * 12)
    for each in found.values():
        assert each["splits"] == 1 or each["splits"] * each["partial_bytes"] <= most
        assert each["splits"] * each["partial_bytes"] <= each["workspace"]
    assert found[4096]["splits"] == 1


@pytest.mark.parametrize("shared", [64, 99, 227])
def test_memory_is_bounded(shared: int) -> None:
    """Values of a slab keep within their share whatever the batch, and tiles cover any offsets."""
    with emulated(shared_bytes=shared * KIB):
        for width in (64, 300, 4096):
            for n, k in ((0, 1), (1, 1), (1000, 7), (4_000_000, 4096)):
                found = plan(nerf(width, 8), n, k)
                assert found["slab"] % 64 == 0 and found["slab"] * found["slabs"] >= n
                assert found["slab"] * found["bytes_of_row"] <= max(4 * 64 * KIB, 8 * 64 * found["bytes_of_row"])
                assert found["tiles"] >= found["slab"] // 64 + k and 1 <= found["splits"] <= 64
