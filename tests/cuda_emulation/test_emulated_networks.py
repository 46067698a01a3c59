"""Networks on the CUDA kernels, which run on the CPU: every way through them, type of product and size of memory."""

from __future__ import annotations

from typing import Any, NamedTuple

import pytest
import torch
from emulated import emulated, module
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
from helpers import refuses, same
from network_plans import PRECISIONS, plain, plan, way

import voronerf
from voronerf.nerf.fields import NeRF
from voronerf.ops._core.layers import MLP, POSITIONS, Layer
from voronerf.ops.grouped_mlp import network as layer_table
from voronerf.ops.grouped_mlp.network import _choose_way, using_way

HALVES = ("bfloat16", "float16")
FUSED = (227, 64, 40, 20)
"""KiB of shared memory: the smaller, the more warps share it, down to weights that pass through."""
SMALL = 1
"""KiB that no fused network fits, so that it goes layer by layer."""
DEEP = MLP((Layer((POSITIONS,), 64, "relu"), Layer((0,), 2)), (1,), 16, position_encoding="integrated")


class Case(NamedTuple):
    layers: MLP
    counts: list[int]
    d: int
    precisions: tuple[str, ...]
    shared: tuple[int, ...] = (227,)
    way: str = "fused"
    """fused: chained where 16 bits are multiplied, in tiles elsewhere."""
    seeds: tuple[int, ...] = (0,)
    capability: int = 90


def of_width(width: int) -> Case:
    """Tiles and chunks, of a value that is held and of an output; raw features of that width."""
    layers = MLP((Layer((POSITIONS,), width, "relu"), Layer((0,), width), Layer((1,), width, "sigmoid")), (2, 0))
    return Case(layers, [50], width, HALVES[:1])


WIDTHS = (1, 8, 9, 17, 32, 33, 64, 65, 128)
EVERY = tuple(ALLOWED)
WHOLE = {
    "branched": Case(BRANCHED, [70, 0, 1, 150], 3, EVERY, FUSED[:-1], seeds=(1,)),
    "branched, little memory": Case(BRANCHED, [70, 0, 1, 150], 3, HALVES, FUSED[-1:], seeds=(2,)),
    "wide": Case(WIDE, [37, 3], 7, EVERY, (227, 99), "tiles"),
    "gaussians": Case(GAUSSIANS, [20, 33], 6, EVERY),
    "harmonics": Case(HARMONICS, [37, 3], 3, EVERY, way="tiles"),
    # sm_75 multiplies float16 on tensor cores, and everything else exactly; results are stored in 16 bits.
    "before Ampere": Case(BRANCHED, [70, 5], 3, ("bfloat16", "float16", "tf32"), (64,), capability=75),
    "layers, slabs that cells cross": Case(BRANCHED, [70, 0, 401, 150], 3, EVERY, (SMALL,), "layers", (1, 2)),
    "layers, broad": Case(BROAD, [66, 4], 3, EVERY, way="layers"),
    "layers, dense": Case(DENSE, [37, 3], 7, EVERY[:1], (SMALL,), "layers"),
    "layers, gaussians": Case(GAUSSIANS, [37, 3], 6, EVERY[:1], (SMALL,), "layers"),
    "layers, harmonics": Case(HARMONICS, [37, 3], 3, EVERY[:1], (SMALL,), "layers"),
    "layers, before Ampere": Case(BRANCHED, [70, 5], 3, HALVES, (SMALL,), "layers", capability=75),
    "layers, no rows": Case(BRANCHED, [0, 0], 3, EVERY[:1], (SMALL,), "layers"),
}
"""Output and gradients of smooth networks."""
CHAINED = {
    "skips": Case(SKIPS, [37, 290], 3, HALVES, (227, 120), seeds=(7,)),
    "weights that pass through": Case(THICK, [300], 3, HALVES[:1]),
    "gaussians": Case(GAUSSIANS, [20, 33], 6, HALVES[:1]),
    "deep gaussians": Case(DEEP, [20, 33], 6, HALVES[:1]),
    **{f"width {width}": of_width(width) for width in WIDTHS},
    "skips, little memory": Case(SKIPS, [37, 290], 3, HALVES, (64,), seeds=(7,)),
    "before Ampere": Case(SKIPS, [70, 5], 3, HALVES[1:], (64,), capability=75),
    "nerf64": Case(NeRF(width=64).layers, [300, 2], 3, HALVES[:1]),
    "narrow": Case(NARROW, [300, 2], 3, HALVES[:1]),
}
"""Outputs of chained networks."""


def each(cases: dict[str, Case]) -> list:
    """A parameter for every precision and memory of the cases."""
    return [
        pytest.param(case, precision, shared, id=f"{name}-{precision}-{shared}")
        for name, case in cases.items()
        for precision in case.precisions
        for shared in case.shared
    ]


@pytest.mark.parametrize(("case", "precision", "shared"), each(WHOLE))
def test_outputs_and_gradients(case: Case, precision: str, shared: int) -> None:
    expected = case.way
    if expected == "fused":
        chained = precision == "float16" or (precision == "bfloat16" and case.capability >= 80)
        expected = "chain" if chained else "tiles"
    for seed in case.seeds:
        with emulated(seed=seed, capability=case.capability, shared_bytes=shared * KIB):
            assert way(case.layers, precision, d=case.d) == expected
            if expected == "layers" and len(case.seeds) > 1:
                assert plan(case.layers, sum(case.counts), 4, precision=precision)["slabs"] == 2
            check(case.layers, case.counts, case.d, precision)


@pytest.mark.parametrize(("case", "precision", "shared"), each(CHAINED))
def test_outputs_of_chained_networks(case: Case, precision: str, shared: int) -> None:
    """Gradients of ReLU differ where a rounding moves a sample across its kink."""
    with emulated(seed=case.seeds[0], capability=case.capability, shared_bytes=shared * KIB):
        assert way(case.layers, precision, d=case.d) == "chain"
        check_forward(case.layers, case.counts, case.d, precision)


@pytest.mark.parametrize("integrated", [False, True])
@pytest.mark.parametrize(("octaves", "extent"), [(10, 4.0), (16, 3.0), (4, 1000.0), (12, 1e5)])
def test_encodings_are_exact_to_the_rounding_of_operands(octaves: int, extent: float, integrated: bool) -> None:
    """An identity shows them. The last extent has angles beyond those that are reduced fast, in some rows."""
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


@pytest.mark.parametrize("shared", [227, SMALL])
def test_rows_of_no_cell_and_unsound_offsets(shared: int) -> None:
    layers = MLP((Layer((POSITIONS,), 8, "relu"), Layer((0,), 2)), (1,))
    given = case(layers, [20, 13], 3)
    for offsets, strays in (([3, 20, 30], [*range(3), *range(30, 33)]), ([0, 40, 50], []), ([5, 2, 33], [])):
        leaves = [given["positions"].float().requires_grad_(), *(w.float().requires_grad_() for w in given["weights"])]
        with emulated(shared_bytes=shared * KIB):
            index = torch.tensor(offsets, dtype=torch.int32)
            out = voronerf.grouped_mlp(leaves[0], index, leaves[1:], [None, None], layers=layers, backend="native")
            gradients = torch.autograd.grad(out.sum(), leaves)
        assert (out[strays] == 0).all() and (gradients[0][strays] == 0).all()
        assert all(gradient.isfinite().all() for gradient in gradients)


def test_cells_that_overlap_stay_inside_the_workspace(monkeypatch) -> None:
    """They have more tasks than there are partial gradients; what lies behind those is no number, and is not read."""
    layers, n, beyond = MLP((Layer((POSITIONS,), 8, "relu"), Layer((0,), 2)), (1,)), 600, 1 << 20
    leaves = [leaf.requires_grad_() for leaf in (torch.rand(n, 3), torch.rand(5, 8, 3), torch.rand(5, 2, 8))]
    sizes = []
    with emulated() as loaded:
        new, size_of, backward = loaded.grouped_mlp_call, loaded.grouped_mlp_workspace, loaded.grouped_mlp_backward

        def call(table, n: int, k: int, backward: bool, parameters: bool, precision: str, *others):
            plan = module().grouped_mlp_plan(table, PRECISIONS.index(precision), n, k, backward)
            assert not plan["by_layers"] and 3 * -(-n // plan["task_rows"]) > plan["tasks"]
            return new(table, n, k, backward, parameters, precision, *others)

        def larger(call) -> int:
            sizes.append(size_of(call) + beyond)
            return sizes[-1]

        def poisoned(*given: Any) -> None:
            given[-2].fill_(0xFF)
            backward(*given)

        monkeypatch.setattr(loaded, "grouped_mlp_call", call)
        monkeypatch.setattr(loaded, "grouped_mlp_workspace", larger)
        monkeypatch.setattr(loaded, "grouped_mlp_backward", poisoned)
        offsets = torch.tensor([0, n, 0, n, 0, n], dtype=torch.int32)
        out = voronerf.grouped_mlp(leaves[0], offsets, leaves[1:], [None, None], layers=layers, backend="native")
        gradients = torch.autograd.grad(out.sum(), leaves)
    assert len(sizes) == 2 and all(gradient.isfinite().all() for gradient in gradients)


@pytest.mark.parametrize(("shared", "multiprocessors"), [(227, 2), (SMALL, 16)])
def test_weight_gradients_are_the_same_in_every_order(shared: int, multiprocessors: int) -> None:
    """Many multiprocessors share out the rows of a cell where it goes layer by layer."""
    given, results, loaded = case(BRANCHED, [600, 30], 3), [], module()
    loaded.multiprocessors(multiprocessors)
    try:
        for seed in (1, 2, 3):
            with emulated(seed=seed, shared_bytes=shared * KIB):
                found = plan(BRANCHED, 630, 2, precision="float32")
                assert found["splits"] > 1 and found["by_layers"] == (shared == SMALL)
                results.append(run(given, BRANCHED, torch.float32, "native"))
    finally:
        loaded.multiprocessors(2)
    assert same(results[0], results[1]) and same(results[0], results[2])
    for part, exact in zip(results[0], run(given, BRANCHED, torch.float64, "reference")):
        assert (part.double() - exact).norm() <= 3e-6 * max(exact.norm().item(), 1e-6)


def test_tensors_that_are_not_aligned() -> None:
    """Rows of four features are read whole where they begin at multiples of 16 bytes."""
    layers = MLP((Layer((POSITIONS,), 8),), (0,))
    weights, offsets = [torch.rand(1, 8, 8).bfloat16()], torch.tensor([0, 40], dtype=torch.int32)
    x, off = torch.rand(40, 8), torch.empty(1 + 40 * 8)
    off[1:] = x.flatten()
    with emulated():
        aligned, shifted = (
            voronerf.grouped_mlp(rows, offsets, weights, [None], layers=layers, backend="native")
            for rows in (x, off[1:].view(40, 8))
        )
    assert off[1:].data_ptr() % 16 and torch.equal(aligned, shifted)


def test_numbers_that_are_none_stay_in_their_rows() -> None:
    given = case(plain(64, 2), [40], 3, torch.bfloat16)
    given["positions"][5, 1], given["positions"][9, 0] = torch.nan, torch.inf
    with emulated():
        out = run(given, plain(64, 2), torch.bfloat16, "native")[0]
    assert out.isnan().any(1).nonzero().flatten().tolist() == [5, 9]


def test_rows_are_gathered_and_scattered_and_every_order_of_threads_gives_the_same() -> None:
    """routed_mlp: samples lie anywhere, directions belong to rays."""
    layers = NeRF(width=32, depth=2).layers
    given = case(layers, [60, 1, 39], 3, torch.bfloat16)
    centres = torch.rand(3, 3)

    def routed(dtype: torch.dtype, parameters: torch.dtype, backend: str) -> tuple[torch.Tensor, torch.Tensor]:
        weights = [weight.bfloat16().to(parameters) for weight in given["weights"]]
        biases = [None if bias is None else bias.bfloat16().to(parameters) for bias in given["biases"]]
        options = {"centres": centres.to(dtype), "directions": given["directions"].to(dtype)}
        options |= {"direction_index": given["direction_index"], "layers": layers, "backend": backend}
        return voronerf.routed_mlp(given["positions"].to(dtype), weights, biases, **options)

    results = []
    for seed in range(3):
        with emulated(seed=seed):
            assert way(layers, "bfloat16") == "chain"
            results.append(routed(torch.float32, torch.bfloat16, "native"))
    assert same(results[0], results[1]) and same(results[0], results[2])
    exact = routed(torch.float64, torch.float64, "reference")
    assert torch.equal(results[0][1], exact[1])
    assert (results[0][0].double() - exact[0]).norm() <= 1.2e-2 * exact[0].norm()


def test_a_way_that_is_asked_for_is_taken_or_refused(monkeypatch) -> None:
    given, results = case(BRANCHED, [40, 5], 3, torch.bfloat16), []
    for name in ("chain", "tiles", "layers"):
        with emulated(), using_way(name):
            assert way(BRANCHED, "bfloat16", asked=name) == name
            results.append(run(given, BRANCHED, torch.bfloat16, "native")[0])
    for other in results[1:]:
        torch.testing.assert_close(other, results[0], rtol=2e-2, atol=2e-2)

    def asked(name: str, layers: MLP, d: int, **device: int) -> None:
        with emulated(**device), using_way(name):
            run(case(layers, [4], d, torch.bfloat16), layers, torch.bfloat16, "native")

    refuses("grouped_mlp: a layer must have at most 128 features on CUDA", asked, "chain", WIDE, 7)
    refuses("grouped_mlp: spherical harmonics must be computed by tiles or layers on", asked, "chain", HARMONICS, 3)
    many = MLP((Layer((POSITIONS,), 2), Layer((0,) * 65, 2)), (1,))
    rule = "grouped_mlp: a layer must have at most 64 sources on CUDA; use backend='reference'"
    refuses(rule, asked, "auto", many, 3)
    often = MLP((Layer((POSITIONS,), 2),), (0,) * 9)
    refuses("among the outputs at most 8 times", asked, "auto", often, 3, shared_bytes=SMALL * KIB)
    monkeypatch.setenv("VORONERF_CUDA_MLP", "tiles")
    assert _choose_way() == "tiles"
    monkeypatch.setenv("VORONERF_CUDA_MLP", "fast")
    rule = "must be one of auto, chain, tiles, layers, got 'fast'"
    refuses(rule, _choose_way)


@pytest.mark.parametrize(
    ("width", "dtype", "way", "inside"),
    [(32, torch.float32, "auto", True), (32, torch.bfloat16, "auto", True), (32, torch.bfloat16, "chain", False),
     (32, torch.float32, "layers", False), (300, torch.float32, "auto", False)],
)  # fmt: skip
def test_tiles_look_hash_grids_up_and_other_ways_encode_before(monkeypatch, width, dtype, way, inside):
    grid = voronerf.HashGrid(levels=2, features=2, log2_entries=10, finest=30)
    layers = MLP(
        (Layer((POSITIONS,), width, "relu"), Layer((0,), 4)), (1,), position_encoding="hash", grid=grid
    )  # fmt: skip
    weights = [torch.randn(2, o, i).to(dtype) / i**0.5 for o, i in layers.weight_shapes(3)]
    given = torch.rand(50, 3), torch.tensor([0, 30, 50], dtype=torch.int32), weights, [None] * 2
    options = {"layers": layers, "features": torch.randn(grid.table_shape)}
    expected = voronerf.grouped_mlp(*given, **options, backend="reference")
    calls = []
    encode = layer_table.hash_encode
    monkeypatch.setattr(layer_table, "hash_encode", lambda *a, **o: calls.append(1) or encode(*a, **o))
    with emulated(), using_way(way), torch.no_grad():
        found = voronerf.grouped_mlp(*given, **options, backend="native")
    assert len(calls) == (not inside)
    torch.testing.assert_close(found, expected, rtol=0.02, atol=0.02 if dtype == torch.bfloat16 else 1e-4)
