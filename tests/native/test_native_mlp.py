"""The compiled `grouped_mlp` against the float64 reference."""

from __future__ import annotations

import pytest
import torch
from helpers import on_any_number_of_threads
from tolerances import assert_as_exact
from torch import Tensor

from voronerf.ops import grouped_mlp
from voronerf.ops._core.grids import HashGrid
from voronerf.ops._core.layers import MLP, Layer
from voronerf.ops._core.tolerances import agree_gradients

pytestmark = pytest.mark.native
native = pytest.importorskip("voronerf.ops._core.native")


def chain(width: int, depth: int, out: int = 4, activation: str = "softplus", octaves: int | None = 4) -> MLP:
    hidden = [Layer(("positions" if i == 0 else i - 1,), width, activation) for i in range(depth)]
    return MLP((*hidden, Layer((depth - 1 if depth else "positions",), out)), (depth,), octaves, None)


def nerf(width: int, depth: int, activation: str = "softplus") -> MLP:
    """Returns a NeRF with a skip after the first layer, a density head and a view branch."""
    trunk = [Layer(("positions",), width, activation), Layer(("positions", 0), width, activation)]
    trunk += [Layer((i - 1,), width, activation) for i in range(2, depth)]
    heads = [
        Layer((depth - 1,), 1),
        Layer((depth - 1,), width),
        Layer((depth + 1, "directions"), max(width // 2, 1), activation),
        Layer((depth + 2,), 3),
    ]
    return MLP((*trunk, *heads), (depth + 3, depth), 4, 2)


def hashed(layers: MLP, degree: int, **grid) -> MLP:
    """Returns the layers with a hash grid of positions and spherical harmonics of directions as inputs."""
    grid = HashGrid(log2_entries=10, base=4, **grid)
    return MLP(layers.layers, layers.outputs, None, None, "hash", grid, "spherical", degree)


NETWORKS = {
    "width 3": chain(3, 2, out=63, octaves=None),
    "width 32": chain(32, 3, octaves=10),
    "width 63": chain(63, 2, out=5),
    "width 200": chain(200, 1, out=48),
    "nerf 64": nerf(64, 3),
    "nerf 18": nerf(18, 2),
    "integrated": MLP(nerf(33, 2).layers, nerf(33, 2).outputs, 16, 2, "integrated"),
    "hashed 32": hashed(nerf(32, 2), 4, levels=8, features=2, finest=64),
    "hashed 17": hashed(nerf(17, 2), 3, levels=3, features=1, finest=9),
    "hashed 256": hashed(nerf(256, 2), 2, levels=5, features=8, finest=30, box=((-1, -1, -1), (0, 1, 2))),
    # Layers with few outputs: inputs fill whole vectors or are concatenations, and other layers read some outputs.
    "heads": MLP(
        (
            Layer(("positions",), 64, "softplus"),
            Layer((0,), 32, "sine"),
            Layer((0, 1, 0), 2, "sigmoid"),
            Layer((1, 2), 32, "softplus"),
            Layer((3, 1), 1, "softplus"),
            Layer((3, 4), 4),
            Layer((3, 0), 3),
        ),
        (6, 2, 5, 4),
        3,
    ),
    # Repeated sources, more sources than one product takes, outputs that other layers read, and an unread layer.
    "graph": MLP(
        (
            Layer(("positions", "directions", "positions"), 7, "sine"),
            Layer((0, 0, "directions"), 33, "softplus"),
            Layer((1,), 4, "sigmoid"),
            Layer((0, 1, 0, 1, "positions", 0, "directions", 1, 0, 0), 17, "softplus"),
            Layer((3, 0), 2, "sigmoid"),
        ),
        (4, 1, 4),
        1,
        None,
    ),
}


def arguments(
    layers: MLP, counts: list[int], rays: int = 0, bias: bool = True, p: int = 3, q: int = 3, own: bool = False
) -> dict:
    """Returns float64 arguments of `grouped_mlp`; the cells have ``counts`` rows.

    With ``rays=0`` each sample has a direction; with ``own`` each cell has its own hash grid.
    """
    n, k = sum(counts), len(counts)
    p = 6 if layers.integrated else p
    uniform = torch.distributions.Uniform(torch.tensor(-1.0, dtype=torch.float64), 1.0)
    shapes = layers.weight_shapes(p, q)
    call = {
        "positions": uniform.sample((n, p)),
        "offsets": torch.tensor([0, *counts]).cumsum(0).int(),
        "weights": [uniform.sample((k, o, i)) * (3 / i) ** 0.5 for o, i in shapes],
        "biases": [uniform.sample((k, o)) if bias else None for o, _ in shapes],
        "layers": layers,
    }
    if layers.integrated:
        call["positions"][:, 3:].square_()
    if layers.grid is not None:
        call["features"] = uniform.sample((*([k] if own else []), *layers.grid.table_shape))
    if layers.uses_directions:
        call["directions"] = uniform.sample((rays or n, q))
        call["direction_index"] = torch.randint(rays, (n,), dtype=torch.int32) if rays else None
    return call


def tensors(call: dict) -> list[Tensor]:
    """Returns the floating-point tensors of the arguments, in a fixed order."""
    parts = [call["positions"], call.get("directions"), call.get("features"), *call["weights"], *call["biases"]]
    return [tensor for tensor in parts if tensor is not None]


def cast(call: dict, dtype: torch.dtype) -> dict:
    def one(tensor: Tensor | None) -> Tensor | None:
        return None if tensor is None else tensor.detach().to(dtype).requires_grad_()

    changed = {key: one(call[key]) for key in ("positions", "directions", "features") if key in call}
    lists = {key: [one(tensor) for tensor in call[key]] for key in ("weights", "biases")}
    return {**call, **changed, **lists}


def evaluate(call: dict, dtype: torch.dtype, backend: str) -> list[Tensor]:
    """Returns the output and all gradients."""
    call = cast(call, dtype)
    out = grouped_mlp(**call, backend=backend)
    slopes = torch.linspace(-1, 1.5, out.numel(), dtype=torch.float64).view_as(out).to(dtype)
    return [out.detach(), *torch.autograd.grad(out, tensors(call), slopes, materialize_grads=True)]


def assert_close(call: dict, isas: tuple[str, ...] = ()) -> None:
    exact, plain = (evaluate(call, dtype, "reference") for dtype in (torch.float64, torch.float32))
    for isa in isas or (native.isa(),):
        with native.using_isa(isa):
            results = evaluate(call, torch.float32, "native")
        for got, usual, want in zip(results, plain, exact):
            assert_as_exact(got, usual, want)


@pytest.mark.parametrize("name", NETWORKS)
def test_matches_float64(name: str) -> None:
    assert_close(arguments(NETWORKS[name], [0, 61, 1, 0, 100, 7, 0]), native.SUPPORTED_ISAS)


@pytest.mark.parametrize("rows", [0, 1, 6, 7, 12, 13, 48, 49, 64, 65, 95, 96, 97, 2500])
def test_any_number_of_rows(rows: int) -> None:
    assert_close(arguments(nerf(16, 2), [rows], rays=5))
    assert_close(arguments(NETWORKS["hashed 17"], [rows], rays=5))
    assert_close(arguments(NETWORKS["hashed 17"], [3, 0, rows], own=True))
    call = arguments(nerf(33, 2), [rows], rays=5)
    for exact, stored in zip(evaluate(call, torch.float32, "native"), evaluate(call, torch.bfloat16, "native")):
        assert float((stored - exact).norm()) <= 0.2 * float(exact.norm())


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("name", ["heads", "nerf 64", "graph", "width 63", "hashed 32"])
def test_a_row_does_not_depend_on_its_place(name: str, dtype: torch.dtype, isa: str) -> None:
    call = cast(arguments(NETWORKS[name], [41]), dtype)
    together = grouped_mlp(**call, backend="native").detach()
    for row in (0, 3, 4, 17, 40):
        one = {**call, "positions": call["positions"][row : row + 1], "offsets": torch.tensor([0, 1]).int()}
        if "directions" in call:
            one["directions"] = call["directions"][row : row + 1]
        assert torch.equal(grouped_mlp(**one, backend="native")[0], together[row])


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_rows_without_a_gradient_add_nothing_to_weights(dtype: torch.dtype, isa: str) -> None:
    call = cast(arguments(nerf(17, 2), [900, 3, 0, 70], rays=9), dtype)
    slopes = torch.randn(973, 4).to(dtype)
    slopes[torch.arange(973) % 7 != 0] = -0.0
    slopes[14] = torch.tensor([0.0, -0.0, 0.0, 1e-3]).to(dtype)
    results = []
    for backend in ("native", "reference"):
        out = grouped_mlp(**call, backend=backend)
        results.append(torch.autograd.grad(out, [*call["weights"], *call["biases"]], slopes))
    assert agree_gradients(*results)


def test_relu_on_few_outputs(isa: str) -> None:
    layers = MLP((Layer(("positions",), 32, "softplus"), Layer((0,), 4, "relu"), Layer((0,), 1, "relu")), (1, 2), 2)
    call = arguments(layers, [50], bias=False)
    got, want = (grouped_mlp(**cast(call, torch.float32), backend=backend) for backend in ("native", "reference"))
    assert 0.2 < float((want > 0).float().mean()) < 0.8
    torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("counts", [[0, 0, 0], [3000, 1, 0, 2], [1] * 300, [0] * 150 + [2000] + [0, 3] * 70])
def test_any_imbalance(counts: list[int]) -> None:
    assert_close(arguments(nerf(20, 2), counts, rays=9))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("o", [2, 40])
def test_relu_stops_an_infinite_gradient_and_passes_what_is_not_a_number(o: int, dtype: torch.dtype, isa: str) -> None:
    weight = torch.ones(1, o, 1)
    weight[0, 1::2] = -1  # the ReLU is 0 for positive x
    x, offsets = torch.tensor([[1.0], [2.0], [torch.nan]]), torch.tensor([0, 3], dtype=torch.int32)
    slopes = torch.tensor([[torch.inf], [1.0], [1.0]])
    heads = torch.ones(1, 1, o)
    active = Layer(("positions",), o, "relu")
    # In the first network the ReLU is the last layer; in the second, another layer reads it.
    for layers, weights in ((MLP((active,), (0,)), [weight]), (MLP((active, Layer((0,), 1)), (1,)), [weight, heads])):
        results = []
        for backend in ("native", "reference"):
            leaves = [tensor.to(dtype).requires_grad_() for tensor in (x, weights[0], torch.zeros(1, o))]
            rest = [tensor.to(dtype) for tensor in weights[1:]]
            biases = [leaves[2], *[None] * len(rest)]
            y = grouped_mlp(leaves[0], offsets, [leaves[1], *rest], biases, layers=layers, backend=backend)
            results.append([y.detach(), *torch.autograd.grad(y, leaves, slopes.to(dtype).expand_as(y))])
        for got, want in zip(*results):
            torch.testing.assert_close(got, want, equal_nan=True)
        positions, bias = results[0][1], results[0][3][0]
        assert positions[0] == torch.inf and positions[1] == o // 2 and positions[2].isfinite()
        assert (bias[::2] == torch.inf).all() and (bias[1::2] == 1).all()


@pytest.mark.parametrize(
    ("network", "dtype"), [("nerf", torch.bfloat16), ("hashed", torch.bfloat16), ("own tables", torch.float32)]
)
def test_same_bits_for_any_number_of_threads(isa: str, network: str, dtype: torch.dtype) -> None:
    layers = nerf(40, 2) if network == "nerf" else NETWORKS["hashed 32"]
    call = arguments(layers, [5000, 3, 0, 900], rays=50, own=network == "own tables")
    on_any_number_of_threads(lambda: evaluate(call, dtype, "native"))


@pytest.mark.parametrize("where", ["positions", "weights", "directions"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 3e38])
def test_what_is_not_finite_stays_where_it_is(where: str, value: float) -> None:
    call = arguments(nerf(17, 2, activation="relu"), [20, 30, 10], rays=8)
    plain = grouped_mlp(**cast(call, torch.float32), backend="native")
    target = call["weights"][0] if where == "weights" else call[where]
    target[1].view(-1)[0] = value
    changed = cast(call, torch.float32)
    got, want = (grouped_mlp(**changed, backend=backend) for backend in ("native", "reference"))
    assert torch.equal(got.isnan(), want.isnan()) or value == 3e38
    rows = torch.arange(60)
    touched = {
        "weights": (rows >= 20) & (rows < 50),
        "positions": rows == 1,
        "directions": call["direction_index"] == 1,
    }
    assert torch.equal(got[~touched[where]], plain[~touched[where]])


def test_large_positions() -> None:
    call = arguments(chain(8, 1, octaves=10), [40])
    call["positions"] = (call["positions"] * 1000).float().double()
    call["positions"][3] = 1e20
    got, want = (evaluate(call, torch.float32, backend)[0] for backend in ("native", "reference"))
    torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-5 * float(want[:3].abs().max()))


@pytest.mark.parametrize("name", NETWORKS)
def test_bfloat16_storage(name: str) -> None:
    """Errors (Euclidean norm) are at most 1.5 times the errors of the reference with bfloat16 storage."""
    call = arguments(NETWORKS[name], [0, 61, 1, 0, 250, 7, 0])
    call = {**call, **{key: cast(call, torch.bfloat16)[key] for key in ("weights", "biases")}}
    exact, plain = (evaluate(call, dtype, "reference") for dtype in (torch.float64, torch.bfloat16))
    for isa in native.SUPPORTED_ISAS:
        with native.using_isa(isa):
            results = evaluate(call, torch.bfloat16, "native")
        for index, (want, usual, got) in enumerate(zip(exact, plain, results)):
            assert got.shape == want.shape and got.dtype == torch.bfloat16
            error, allowed = float((got - want).norm()), 1.5 * float((usual - want).norm()) + 2e-3 * float(want.norm())
            assert error <= allowed, f"{isa}, tensor {index}: error {error:.2e}, allowed {allowed:.2e}"


def test_bfloat16_keeps_what_is_not_finite_in_its_row() -> None:
    call = arguments(nerf(17, 2), [20, 30], rays=50)
    call["direction_index"] = torch.arange(50, dtype=torch.int32)
    call["positions"][3] = float("inf")
    call["directions"][30] = float("nan")
    out = grouped_mlp(**cast(call, torch.bfloat16), backend="native")
    spoiled = torch.zeros(50, dtype=torch.bool)
    spoiled[3] = True
    assert torch.equal(out[:, 3].isnan(), spoiled)
    spoiled[30] = True
    assert torch.equal(out[:, 0].isnan(), spoiled)


def test_float64_positions_are_encoded_in_float64() -> None:
    call = arguments(chain(8, 1, octaves=10), [40])
    call["positions"] += 100
    exact = evaluate(call, torch.float64, "reference")[0]
    mixed = {**cast(call, torch.float32), "positions": call["positions"]}
    got = grouped_mlp(**mixed, backend="native").detach()
    assert float((got - exact).abs().max()) <= 1e-5 * float(exact.abs().max())
