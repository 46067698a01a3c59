"""The chained network's CUDA kernel on the CPU: which networks take it, its layouts, its plan, and its results."""

from __future__ import annotations

import itertools
import math
import random

import pytest
import torch
from emulated import emulated, module
from emulated_networks import BRANCHED, GAUSSIANS, KIB, SKIPS, THICK, WIDE, case, check, check_forward, run
from test_emulated_layers import nerf

import voronerf
from voronerf.fields import NeRF
from voronerf.layers import DIRECTIONS, MLP, POSITIONS, Layer
from voronerf.native import grouped_mlp as _native_mlp

HALVES = ("bfloat16", "float16")
HELD, STORED, IN_POSITIONS, IN_DIRECTIONS = range(4)
"""Numbers of MlpChainFrom."""


def numbers(layers: MLP, d: int = 3, q: int = 3) -> list[int]:
    """A table as the compiled module takes it."""
    seen = torch.zeros(1, q) if layers.uses_directions else None
    weights = [torch.zeros(1, o, i) for o, i in layers.weight_shapes(d, q if seen is not None else 0)]
    given = _native_mlp.network(torch.zeros(1, d), weights, [None] * len(weights), layers, seen)
    return _native_mlp._numbers(given.table, given.positions, given.weights, given.directions)


def chain(
    layers: MLP,
    *,
    d: int = 3,
    precision: str = "bfloat16",
    n: int = 1 << 22,
    k: int = 16,
    groups: bool = False,
    compiled: bool = True,
    **device: int,
) -> dict:
    """The plan, or the rule that the table breaks, on an H200 unless another device is given."""
    known = {"capability": 90, "shared_bytes": 227 * KIB, "multiprocessors": 132} | device
    operands = _native_mlp._OPERANDS.index(precision)
    return module().chain_plan(numbers(layers, d), operands, n, k, *known.values(), groups, compiled)


def way(layers: MLP, precision: str, *, n: int = 1 << 22, d: int = 3) -> str:
    """The way of a forward pass on the emulated device."""
    operands = _native_mlp._OPERANDS.index(precision)
    plan = module().grouped_mlp_plan(numbers(layers, d), operands, n, 16, False, _native_mlp._WAY)
    return _native_mlp.WAYS[plan["way"]]


def plain(width: int, depth: int) -> MLP:
    """ReLU layers and a head of four outputs."""
    hidden = [Layer((index - 1,) if index else (POSITIONS,), width, "relu") for index in range(depth)]
    return MLP((*hidden, Layer((depth - 1,), 4)), (depth,), position_octaves=10)


@pytest.mark.parametrize("pairs", [1, 2, 4])
@pytest.mark.parametrize("steps", [1, 2, 3, 8, 20])
def test_every_weight_has_one_place(pairs: int, steps: int) -> None:
    own = module()
    places = {}
    for output, column in itertools.product(range(16 * pairs), range(16 * steps)):
        place = own.chain_weight_place(pairs, output, column)
        assert (own.chain_weight_output(pairs, place), own.chain_weight_column(pairs, place)) == (output, column)
        places[place] = output, column
    assert sorted(places) == list(range(256 * pairs * steps))
    # Core matrices: 8 x 8 in 64 consecutive elements, by rows; two along the columns, two along the outputs, and so on.
    for place, (output, column) in places.items():
        matrix, inside = divmod(place, 64)
        assert (output % 8, column % 8) == divmod(inside, 8)
        assert (output // 8 % 2, column // 8 % 2) == divmod(matrix % 4, 2)


def test_every_feature_of_an_encoding_has_one_column() -> None:
    for octaves, features, integrated in itertools.product(range(-1, 17), (1, 2, 3, 4, 7), (False, True)):
        if integrated and octaves < 1:
            continue
        d, kind = (2 if integrated else 1) * features, "integrated" if integrated else "frequency"
        layers = MLP((Layer((POSITIONS,), 8),), (0,), None if octaves < 0 else octaves, position_encoding=kind)
        width = layers.source_width(POSITIONS, d)
        if width > 256:
            continue
        found = chain(layers, d=d)["layers"][0]["sources"][0]["features"]
        assert len(found) % 16 == 0 and sorted(f for f in found if f >= 0) == list(range(width))
        # No step more than the features need, but for the missing half of an odd octave's units.
        assert len(found) < width + 16 + 2 * features * (octaves % 2)
        # A sine's cosine is its neighbour, which share a register; so are the octaves that share an angle.
        for column, feature in enumerate(found):
            at = feature - (0 if integrated else features)
            if octaves > 0 and at >= 0 and at // features % 2 == 0:
                assert column % 2 == 0 and found[column + 1] == feature + features
                if at // features % 4 == 0 and at // features + 2 < 2 * octaves:
                    assert column % 16 < 8 and found[column + 8] == feature + 2 * features


def test_turns_of_large_angles() -> None:
    """Every exponent of a float32, with 1 / 2 pi to 400 bits."""
    # Machin: pi / 4 = 4 arctan(1 / 5) - arctan(1 / 239).
    one = 1 << 480
    quarter = sum(
        factor * (-1) ** i * (one // n ** (2 * i + 1) // (2 * i + 1))
        for factor, n in ((4, 5), (-1, 239))
        for i in range(220)
    )
    inverse = (one << 400) // (8 * quarter)  # of 2 pi
    draw = random.Random(0)
    for exponent in range(128):
        for mantissa in (1 << 23, (1 << 24) - 1, *(draw.getrandbits(23) | 1 << 23 for _ in range(20))):
            x = math.ldexp(mantissa, exponent - 23)
            turns = (mantissa << exponent) * inverse >> 23
            exact = (turns - (turns >> 400 << 400)) / 2.0**400
            found = module().turns_of_large(x)
            assert abs((found - exact + 0.5) % 1 - 0.5) < 2.0**-24 * abs(found) + 2.0**-30 and abs(found) <= 0.5
            assert module().turns_of_large(-x) == -found
    assert all(math.isnan(module().turns_of_large(x)) for x in (math.inf, -math.inf, math.nan))


def random_table(seed: int) -> MLP:
    draw = random.Random(seed)
    layers: list[Layer] = []
    for index in range(draw.randint(1, 12)):
        choices = [POSITIONS, DIRECTIONS, *range(index), *([index - 1] * 3 if index else [])]
        sources = tuple(draw.choice(choices) for _ in range(draw.randint(1, 4)))
        layers.append(Layer(sources, draw.choice([1, 8, 9, 16, 31, 32, 33, 48, 64, 65, 128])))
    outputs = tuple(draw.randrange(len(layers)) for _ in range(draw.randint(1, 3)))
    return MLP(tuple(layers), outputs, draw.choice([None, 1, 4]), draw.choice([None, 3]))


@pytest.mark.parametrize("shared", [227, 99, 64])
def test_every_source_is_where_the_plan_says(shared: int) -> None:
    """The plan walked through as the kernel does, with what lies in registers and in every place of shared memory."""
    planned = 0
    for seed in range(150):
        layers = random_table(seed)
        plan = chain(layers, shared_bytes=shared * KIB)
        if isinstance(plan, str):
            continue
        planned += 1
        assert plan["shared_bytes"] == plan["weights"] + plan["warps"] * plan["region"] <= shared * KIB
        held, places, packed, pieces = None, {}, 0, 0

        def write(region: int, value: object, bytes_: int, places: dict = places, plan: dict = plan) -> None:
            assert region % 16 == 0 and 0 <= region <= plan["region"] - bytes_
            for at in [at for at, (_, size) in places.items() if at < region + bytes_ and region < at + size]:
                del places[at]
            places[region] = value, bytes_

        for layer in plan["layers"]:
            table = layers.layers[layer["index"]]
            assert layer["piece"] == packed
            for chunk, (outputs, bytes_) in enumerate(layer["pieces"]):
                assert 64 * chunk + outputs >= min(table.width, 64 * chunk + 64)
                assert bytes_ <= plan["slot"]
                packed += bytes_
                pieces += 1
                column = 0
                for name, source in zip(table.inputs, layer["sources"], strict=True):
                    width = layers.source_width(name, 3, 3)
                    assert source["column"] == column and width == sum(f >= 0 for f in source["features"])
                    column += width
                    if isinstance(name, int):
                        assert source["from"] in (HELD, STORED)
                        found = held if source["from"] == HELD else places[source["region"]][0]
                        assert found == name
                    elif (source["compute"] and chunk == 0) or source["region"] < 0:
                        assert source["compute"]
                        if source["region"] >= 0:
                            write(source["region"], name, 64 * len(source["features"]))
                    else:
                        assert places[source["region"]][0] == name
            if layer["region"] >= 0:
                write(layer["region"], layer["index"], 64 * sum(outputs for outputs, _ in layer["pieces"]))
            held = layer["index"] if layer["held"] else held
            assert layer["among"] == (layer["index"] in layers.outputs)
        assert packed == plan["packed_bytes"] and pieces == plan["pieces"]
        assert plan["weights"] == (packed if plan["resident"] else 2 * plan["slot"])
    assert planned > 30


@pytest.mark.parametrize("capability", [75, 80, 86, 90, 120])
def test_workspaces_cover_any_offsets(capability: int) -> None:
    shared = {75: 64, 80: 163, 86: 99, 90: 227, 120: 99}[capability] * KIB
    for n, k in ((0, 1), (1, 1), (1000, 7), (4_000_000, 4096)):
        plan = chain(SKIPS, precision="float16", n=n, k=k, capability=capability, shared_bytes=shared)
        rows = plan["task_rows"]
        assert rows % (32 * plan["warps"]) == 0
        assert plan["tasks"] >= sum(-(-part // rows) for part in (n // k,) * (k - 1) + (n - n // k * (k - 1),))
        assert plan["tasks"] >= (k if n >= k else n) and plan["workspace"] >= k * plan["packed_bytes"] + 4 * (k + 1)


def test_which_networks_are_chained() -> None:
    """Those that the issue measures, in 16 bits; and what does not fit goes as before."""
    with emulated():
        for layers in (plain(64, 4), plain(32, 3), NeRF(width=64).layers, nerf(128, 8)):
            assert {precision: way(layers, precision) for precision in _native_mlp._OPERANDS} == {
                "float32": "tiles",
                "tf32": "tiles",
                "bfloat16": "chain",
                "float16": "chain",
            }
        assert way(nerf(129, 8), "bfloat16") == "tiles" and way(nerf(300, 8), "bfloat16") == "layers"
    with emulated(capability=75, shared_bytes=64 * KIB):
        assert way(plain(64, 4), "float16") == "chain" and way(plain(64, 4), "bfloat16") == "tiles"
    with emulated(shared_bytes=1 * KIB):
        assert way(plain(64, 4), "bfloat16") == "layers"


def test_what_stays_where() -> None:
    """The published network at width 64: weights resident, its skip's encoding kept, no value ever stored."""
    plan = chain(NeRF(width=64).layers)
    assert plan["width"] == 64 and plan["resident"] and plan["warps"] == 12 and plan["region"] == 4 * 2 * 512
    assert all(layer["region"] < 0 for layer in plan["layers"])
    assert [source["from"] for source in plan["layers"][9]["sources"]] == [HELD]  # past the density's head
    skip = plan["layers"][5]["sources"]
    assert [(source["from"], source["compute"]) for source in skip] == [(IN_POSITIONS, False), (HELD, False)]
    # Small networks in small blocks; where memory is short the encoding is computed again, or pieces pass through.
    assert chain(plain(64, 4))["warps"] == chain(plain(32, 3))["warps"] == 4 and chain(plain(64, 4))["region"] == 0
    short = chain(NeRF(width=64).layers, shared_bytes=99 * KIB)
    assert short["resident"] and short["region"] == 0
    assert not chain(nerf(128, 8))["resident"] and chain(nerf(128, 8))["warps"] == 8
    assert chain(plain(64, 4), precision="float32").startswith("products must be of 16 bits")
    assert chain(plain(130, 4)) == "a layer must have at most 128 features"


@pytest.mark.parametrize("precision", HALVES)
@pytest.mark.parametrize("shared", [227, 99, 40, 20])
def test_branched_network(precision: str, shared: int) -> None:
    """The smaller the memory, the more warps share it: down to pieces that pass through."""
    for seed in (1, 2):
        with emulated(seed=seed, shared_bytes=shared * KIB):
            assert way(BRANCHED, precision) == "chain"
            check(BRANCHED, [70, 0, 1, 150], 3, precision)


def right(layers: MLP, counts: list[int], d: int, precision: str) -> None:
    assert way(layers, precision, d=d) == "chain"
    check_forward(layers, counts, d, precision)


@pytest.mark.parametrize("precision", HALVES)
@pytest.mark.parametrize("shared", [227, 120, 64])
def test_skips(precision: str, shared: int) -> None:
    with emulated(seed=shared, shared_bytes=shared * KIB):
        right(SKIPS, [37, 290], 3, precision)


def test_weights_that_pass_through() -> None:
    with emulated():
        assert not chain(THICK)["resident"]
        right(THICK, [300], 3, "bfloat16")


def test_before_ampere() -> None:
    with emulated(capability=75, shared_bytes=64 * KIB):
        right(SKIPS, [70, 5], 3, "float16")


@pytest.mark.parametrize("width", [1, 8, 9, 16, 17, 32, 33, 48, 64, 65, 80, 128])
def test_widths(width: int) -> None:
    """Every number of tiles and chunks, of a value that is held and of an output; raw features of that width."""
    layers = MLP((Layer((POSITIONS,), width, "relu"), Layer((0,), width), Layer((1,), width, "sigmoid")), (2, 0))
    with emulated():
        right(layers, [50], width, "bfloat16")


def test_gaussians() -> None:
    deep = MLP((Layer((POSITIONS,), 64, "relu"), Layer((0,), 2)), (1,), 16, position_encoding="integrated")
    with emulated():
        for layers in (GAUSSIANS, deep):
            right(layers, [20, 33], 6, "bfloat16")


def test_tensors_that_are_not_aligned() -> None:
    """Rows of four features are read whole where they begin at multiples of 16 bytes."""
    layers = MLP((Layer((POSITIONS,), 8),), (0,))
    weights, offsets = [torch.rand(1, 8, 8).bfloat16()], torch.tensor([0, 40], dtype=torch.int32)
    x, off = torch.rand(40, 8), torch.empty(1 + 40 * 8)
    off[1:] = x.flatten()
    with emulated():
        options = {"layers": layers, "backend": "native"}
        aligned = voronerf.grouped_mlp(x, offsets, weights, [None], **options)
        shifted = voronerf.grouped_mlp(off[1:].view(40, 8), offsets, weights, [None], **options)
    assert off[1:].data_ptr() % 16 and torch.equal(aligned, shifted)


def test_numbers_that_are_none_stay_in_their_rows() -> None:
    layers = plain(64, 2)
    given = case(layers, [40], 3, torch.bfloat16)
    given["positions"][5, 1] = torch.nan
    given["positions"][9, 0] = torch.inf
    with emulated():
        out = run(given, layers, torch.bfloat16, "native")[0]
    assert out.isnan().any(1).nonzero().flatten().tolist() == [5, 9]


def test_rows_are_gathered_and_scattered_and_every_order_of_threads_gives_the_same() -> None:
    """routed_mlp: samples lie anywhere, directions belong to rays."""
    layers = NeRF(width=32, depth=2).layers
    given = case(layers, [60, 1, 39], 3, torch.bfloat16)
    weights = [weight.bfloat16() for weight in given["weights"]]
    biases = [None if bias is None else bias.bfloat16() for bias in given["biases"]]
    options = {
        "layers": layers,
        "centres": torch.rand(3, 3),
        "directions": given["directions"].float(),
        "direction_index": given["direction_index"],
    }
    results = []
    for seed in range(3):
        with emulated(seed=seed):
            assert way(layers, "bfloat16") == "chain"
            results.append(
                voronerf.routed_mlp(given["positions"].float(), weights, biases, backend="native", **options)
            )
    assert all(torch.equal(*parts) for other in results[1:] for parts in zip(results[0], other))
    exact = voronerf.routed_mlp(
        given["positions"],
        [weight.double() for weight in weights],
        [None if bias is None else bias.double() for bias in biases],
        backend="reference",
        **options | {"directions": given["directions"], "centres": options["centres"].double()},
    )
    assert torch.equal(results[0][1], exact[1])
    assert (results[0][0].double() - exact[0]).norm() <= 1.2e-2 * exact[0].norm()


def test_a_way_that_is_asked_for_is_taken_or_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    given = case(BRANCHED, [40, 5], 3, torch.bfloat16)
    results = []
    for name in ("chain", "tiles", "layers"):
        with emulated(), _native_mlp.taking(name):
            assert way(BRANCHED, "bfloat16") == name
            results.append(run(given, BRANCHED, torch.bfloat16, "native")[0])
    for other in results[1:]:
        torch.testing.assert_close(other, results[0], rtol=2e-2, atol=2e-2)
    rule = "grouped_mlp: a layer must have at most 128 features on CUDA"
    with emulated(), _native_mlp.taking("chain"), pytest.raises(ValueError, match=rule):
        run(case(WIDE, [4], 7, torch.bfloat16), WIDE, torch.bfloat16, "native")
    assert _native_mlp.WAYS[_native_mlp._WAY] == "auto"
    monkeypatch.setenv("VORONERF_CUDA_MLP", "tiles")
    assert _native_mlp.WAYS[_native_mlp._choose_way()] == "tiles"
    monkeypatch.setenv("VORONERF_CUDA_MLP", "fast")
    with pytest.raises(ValueError, match="must be one of auto, chain, tiles, layers, wgmma, got 'fast'"):
        _native_mlp._choose_way()
