"""The fused network's CUDA kernels on the CPU: every type of product, shape of block and size of shared memory."""

from __future__ import annotations

import pytest
import torch
from emulated import emulated, module
from torch import Tensor

import voronerf
from voronerf import _native_mlp
from voronerf.layers import DIRECTIONS, MLP, POSITIONS, Layer

KIB = 1024
# Relative error, in the Frobenius norm, of what is multiplied so.
ALLOWED = {"float32": 3e-6, "tf32": 3e-3, "float16": 3e-3, "bfloat16": 2.5e-2}

# Smooth, so that a rounding does not move a sample across a kink; every kind of source, and outputs in the middle.
BRANCHED = MLP(
    (
        Layer((POSITIONS,), 24, "sine"),
        Layer((0,), 33, "softplus"),
        Layer((1, POSITIONS), 32, "sigmoid"),
        Layer((2,), 1, "softplus"),
        Layer((2, DIRECTIONS), 17, "softplus"),
        Layer((0,), 5, "relu"),  # dead
        Layer((4,), 3, "sigmoid"),
    ),
    (6, 3),
    position_octaves=2,
    direction_octaves=1,
)
WIDE = MLP((Layer((POSITIONS,), 130, "sine"), Layer((0, POSITIONS), 70, "sigmoid"), Layer((1,), 4)), (2,))
GAUSSIANS = MLP((Layer((POSITIONS,), 16, "sigmoid"), Layer((0,), 2)), (1,), 3, position_encoding="integrated")


def case(layers: MLP, counts: list[int], d: int, dtype: torch.dtype = torch.float32) -> dict:
    """Arguments in float64, the values those of `dtype`."""
    n, k = sum(counts), len(counts)
    directions = torch.rand(4, 3) if layers.uses_directions else None
    shapes = layers.weight_shapes(d, 3 if directions is not None else 0)
    parts = {
        "positions": torch.rand(n, d),
        "weights": [torch.randn(k, o, i) / i**0.5 for o, i in shapes],
        "biases": [torch.randn(k, o) / 4 if index % 3 != 1 else None for index, (o, _) in enumerate(shapes)],
        "directions": directions,
    }

    def rounded(value):
        if isinstance(value, list):
            return [rounded(entry) for entry in value]
        return None if value is None else value.to(dtype).double()

    given = {name: rounded(value) for name, value in parts.items()}
    given["offsets"] = torch.tensor([0, *counts]).cumsum(0).to(torch.int32)
    given["direction_index"] = None if directions is None else torch.randint(0, 4, (n,), dtype=torch.int32)
    return given


def run(given: dict, layers: MLP, dtype: torch.dtype, backend: str) -> list[Tensor]:
    """Output and gradients of everything."""
    leaves: list[Tensor] = []

    def leaf(value):
        if isinstance(value, list):
            return [leaf(entry) for entry in value]
        if value is None:
            return None
        leaves.append(value.to(dtype).requires_grad_())
        return leaves[-1]

    named = {name: leaf(given[name]) for name in ("positions", "weights", "biases", "directions")}
    out = voronerf.grouped_mlp(
        named["positions"],
        given["offsets"],
        named["weights"],
        named["biases"],
        layers=layers,
        directions=named["directions"],
        direction_index=given["direction_index"],
        backend=backend,
    )
    gradient = torch.linspace(-1, 1, out.numel()).reshape(out.shape).sin().to(dtype)
    return [out, *torch.autograd.grad(out, leaves, gradient, allow_unused=True, materialize_grads=True)]


def check(layers: MLP, counts: list[int], d: int, precision: str) -> None:
    dtype = torch.float32 if precision in ("float32", "tf32") else getattr(torch, precision)
    given = case(layers, counts, d, dtype)
    before = torch.backends.cuda.matmul.fp32_precision
    try:
        torch.backends.cuda.matmul.fp32_precision = "tf32" if precision == "tf32" else "ieee"
        found = run(given, layers, dtype, "native")
    finally:
        torch.backends.cuda.matmul.fp32_precision = before
    for part, exact in zip(found, run(given, layers, torch.float64, "reference")):
        difference, scale = (part.double() - exact).norm().item(), exact.norm().item()
        assert part.isfinite().all()
        assert difference <= ALLOWED[precision] * max(scale, 1e-6), (list(part.shape), difference / max(scale, 1e-6))


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


def test_values_beyond_float16_stay_finite() -> None:
    layers = MLP((Layer((POSITIONS,), 16, "relu"), Layer((0,), 16), Layer((1,), 2)), (2,))
    given = case(layers, [20], 3, torch.float16)
    given["weights"][0] = torch.full_like(given["weights"][0], 3e4)
    given["weights"][1] = torch.full_like(given["weights"][1], 1.0)
    given["weights"][2] = torch.full_like(given["weights"][2], 2.0**-12)
    with emulated():
        for part in run(given, layers, torch.float16, "native"):
            assert not part.isnan().any()


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


def test_weight_gradients_are_the_same_in_every_order() -> None:
    given = case(BRANCHED, [170, 30], 3)
    results = []
    for seed in (1, 2, 3):
        with emulated(seed=seed):
            results.append(run(given, BRANCHED, torch.float32, "native"))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))


def test_what_does_not_fit_is_refused() -> None:
    layers = MLP((Layer((POSITIONS,), 257), Layer((0,), 2)), (1,))
    given = case(layers, [4], 3)
    rule = r"grouped_mlp: a layer must have at most 256 features on CUDA; use backend='reference'"
    with emulated(), pytest.raises(ValueError, match=rule):
        run(given, layers, torch.float32, "native")


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
                    rows, tasks, bytes_shared = module().grouped_mlp_plan(table, precision, n, k, backward)
                    assert rows % 16 == 0 and 0 < bytes_shared <= shared
                    assert tasks >= sum(-(-part // rows) for part in (n // k,) * (k - 1) + (n - n // k * (k - 1),))
                    assert tasks >= (k if n >= k else n)
