"""The fused network's CUDA kernels on the CPU: every type of product, shape of block and size of shared memory."""

from __future__ import annotations

import ctypes

import pytest
import torch
from emulated import emulated, module
from emulated_networks import ALLOWED, BRANCHED, GAUSSIANS, KIB, WIDE, case, check, run

import voronerf
from voronerf.layers import MLP, POSITIONS, Layer
from voronerf.native import grouped_mlp as _native_mlp


@pytest.mark.parametrize("precision", ALLOWED)
@pytest.mark.parametrize("shared", [227, 99, 64, 40])
def test_branched_network(precision: str, shared: int) -> None:
    for seed in (1, 2):
        with emulated(seed=seed, shared_bytes=shared * KIB):
            check(BRANCHED, [70, 0, 1, 150], 3, precision)


@pytest.mark.parametrize("precision", ALLOWED)
@pytest.mark.parametrize("shared", [227, 99])
def test_wide_network(precision: str, shared: int) -> None:
    with emulated(shared_bytes=shared * KIB):
        check(WIDE, [37, 3], 7, precision)


@pytest.mark.parametrize("precision", ALLOWED)
def test_gaussians(precision: str) -> None:
    with emulated():
        check(GAUSSIANS, [20, 33], 6, precision)


@pytest.mark.parametrize("precision", ["bfloat16", "float16", "tf32"])
def test_before_ampere(precision: str) -> None:
    """sm_75 multiplies float16 on tensor cores, and everything else exactly; results are stored in 16 bits."""
    with emulated(capability=75, shared_bytes=64 * KIB):
        check(BRANCHED, [70, 5], 3, precision)


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
        return voronerf.grouped_mlp(x, offsets, [identity.to(dtype)], [None], layers=layers, backend=backend)

    exact = encoded(torch.float64, "reference", positions.double())[:, width % 6 :]
    for dtype in (torch.float16, torch.bfloat16, torch.float32):
        with emulated():
            found = encoded(dtype, "native", positions)[:, width % 6 :].double()
        rounding = (exact.to(dtype).double() - exact).abs().max()
        assert (found - exact).abs().max() <= 1.01 * rounding + 2e-7


def test_values_beyond_float16_stay_finite() -> None:
    layers = MLP((Layer((POSITIONS,), 16, "relu"), Layer((0,), 16), Layer((1,), 2)), (2,))
    given = case(layers, [20], 3, torch.float16)
    given["weights"][0] = torch.full_like(given["weights"][0], 3e4)
    given["weights"][1] = torch.full_like(given["weights"][1], 1.0)
    given["weights"][2] = torch.full_like(given["weights"][2], 2.0**-12)
    with emulated():
        for part in run(given, layers, torch.float16, "native"):
            assert not part.isnan().any()


@pytest.mark.parametrize("shared", [227, 1])
def test_gradients_beyond_float16_are_infinite(shared: int) -> None:
    """Fused and layer by layer: torch's GradScaler must see that it has scaled by too much."""
    layers = MLP((Layer((POSITIONS,), 16), Layer((0,), 16), Layer((1,), 2)), (2,))
    given = case(layers, [20], 3, torch.float16)
    given["weights"][0] *= 2.0**-10
    given["weights"][1] = torch.full_like(given["weights"][1], 2.0**-10)
    given["weights"][2] = torch.full_like(given["weights"][2], 6e4)
    given["biases"] = [None] * 3
    with emulated(shared_bytes=shared * KIB):
        out, _, first, second, third, *_ = run(given, layers, torch.float16, "native")
    assert out.isfinite().all() and third.isfinite().all()
    assert not first.isfinite().all() and not second.isfinite().all()


def test_rows_of_no_cell_and_unsound_offsets() -> None:
    layers = MLP((Layer((POSITIONS,), 8, "relu"), Layer((0,), 2)), (1,))
    given = case(layers, [20, 13], 3)
    for offsets, strays in (([3, 20, 30], [*range(3), *range(30, 33)]), ([0, 40, 50], []), ([5, 2, 33], [])):
        given["offsets"] = torch.tensor(offsets, dtype=torch.int32)
        with emulated():
            weights = [weight.float() for weight in given["weights"]]
            out = voronerf.grouped_mlp(
                given["positions"].float(),
                given["offsets"],
                weights,
                [None, None],
                layers=layers,
                backend="native",
            )
        assert (out[list(strays)] == 0).all()


def test_cells_that_overlap_stay_inside_the_workspace(monkeypatch: pytest.MonkeyPatch) -> None:
    """They have more tasks than there are partial gradients; what lies behind those is no number, and is not read."""
    layers, n, beyond = MLP((Layer((POSITIONS,), 8, "relu"), Layer((0,), 2)), (1,)), 600, 1 << 20
    leaves = [torch.rand(n, 3), torch.rand(5, 8, 3), torch.rand(5, 2, 8)]
    leaves = [leaf.requires_grad_() for leaf in leaves]
    sizes = []
    with emulated() as loaded:
        size_of, backward = loaded.grouped_mlp_workspace_cuda, loaded.grouped_mlp_backward_cuda

        def larger(numbers: list[int], precision: int, *others: int) -> int:
            plan = module().grouped_mlp_plan(numbers, precision, *others[:3])
            assert not plan["by_layers"] and 3 * -(-n // plan["task_rows"]) > plan["tasks"]
            sizes.append(size_of(numbers, precision, *others) + beyond)
            return sizes[-1]

        def poisoned(*given: object) -> None:
            ctypes.memset(given[-4], 0xFF, sizes[-1])
            backward(*given)

        monkeypatch.setattr(loaded, "grouped_mlp_workspace_cuda", larger)
        monkeypatch.setattr(loaded, "grouped_mlp_backward_cuda", poisoned)
        offsets = torch.tensor([0, n, 0, n, 0, n], dtype=torch.int32)
        out = voronerf.grouped_mlp(leaves[0], offsets, leaves[1:], [None, None], layers=layers, backend="native")
        gradients = torch.autograd.grad(out.sum(), leaves)
    assert len(sizes) == 2 and all(gradient.isfinite().all() for gradient in gradients)


def test_weight_gradients_are_the_same_in_every_order() -> None:
    given = case(BRANCHED, [170, 30], 3)
    results = []
    for seed in (1, 2, 3):
        with emulated(seed=seed):
            results.append(run(given, BRANCHED, torch.float32, "native"))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))


@pytest.mark.parametrize("capability", [75, 80, 86, 90, 120])
def test_workspaces_cover_any_offsets(capability: int) -> None:
    """There are at least as many tasks as the worst offsets make, whatever the sizes."""
    shared = {75: 64, 80: 163, 86: 99, 90: 227, 120: 99}[capability] * KIB
    weights = [torch.zeros(1, o, i) for o, i in BRANCHED.weight_shapes(3, 3)]
    given = _native_mlp.network(torch.zeros(1, 3), weights, [None] * len(weights), BRANCHED, torch.zeros(1, 3))
    table = _native_mlp._numbers(given.table, given.positions, given.weights, given.directions)
    with emulated(capability=capability, shared_bytes=shared):
        for n, k in ((0, 1), (1, 1), (1000, 7), (4_000_000, 4096)):
            for backward in (False, True):
                for precision in range(4):
                    plan = module().grouped_mlp_plan(table, precision, n, k, backward)
                    assert not plan["by_layers"]
                    rows, tasks, bytes_shared = plan["task_rows"], plan["tasks"], plan["shared_bytes"]
                    assert rows % 16 == 0 and 0 < bytes_shared <= shared
                    assert tasks >= sum(-(-part // rows) for part in (n // k,) * (k - 1) + (n - n // k * (k - 1),))
                    assert tasks >= (k if n >= k else n)
