"""The chained network's layouts and its plan: which networks take it, and where its weights and values are."""

import itertools
import math
import random

import pytest
from emulated import emulated, module
from emulated_networks import KIB, THICK
from network_plans import PRECISIONS, chain, nerf, plain, plan, way

from voronerf.nerf.fields import NeRF
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS, Layer

HELD, STORED, IN_POSITIONS, IN_DIRECTIONS = range(4)
"""Numbers of MlpChainFrom."""


@pytest.mark.parametrize("pairs", [1, 2, 4])
@pytest.mark.parametrize("steps", [1, 2, 3, 8, 20])
def test_every_weight_has_one_place(pairs, steps):
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


def test_every_feature_of_an_encoding_has_one_column():
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


def test_turns_of_large_angles():
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


def random_table(seed):
    draw = random.Random(seed)
    layers = []
    for index in range(draw.randint(1, 12)):
        choices = [POSITIONS, DIRECTIONS, *range(index), *([index - 1] * 3 if index else [])]
        sources = tuple(draw.choice(choices) for _ in range(draw.randint(1, 4)))
        layers.append(Layer(sources, draw.choice([1, 8, 9, 16, 31, 32, 33, 48, 64, 65, 128])))
    outputs = tuple(draw.randrange(len(layers)) for _ in range(draw.randint(1, 3)))
    return MLP(tuple(layers), outputs, draw.choice([None, 1, 4]), draw.choice([None, 3]))


@pytest.mark.parametrize("shared", [227, 99, 64])
def test_every_source_is_where_the_plan_says(shared):
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

        def write(region, value, bytes_, places=places, plan=plan):
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


def test_which_way_a_network_goes():
    """Chained are those of the benchmarks, in 16 bits; what does not fit goes in tiles, and what is wide by layers."""
    with emulated():
        for layers in (plain(64, 4), plain(32, 3), NeRF(width=64).layers, nerf(128, 8)):
            assert [way(layers, precision) for precision in PRECISIONS] == ["tiles", "chain", "chain", "tiles"]
        assert way(nerf(129, 8), "bfloat16") == "tiles" and way(nerf(300, 8), "bfloat16") == "layers"
        # A network of the published width is fused forward and goes by layers back.
        for width, forward, backward in ((32, False, False), (128, False, False), (256, False, True)):
            layers = nerf(width, 8)
            found = [plan(layers, backward=back)["by_layers"] for back in (False, True)]
            assert found == [forward, backward]
        assert plan(nerf(512, 8), backward=False)["by_layers"]
    with emulated(capability=75, shared_bytes=64 * KIB):
        assert way(plain(64, 4), "float16") == "chain" and way(plain(64, 4), "bfloat16") == "tiles"
    with emulated(shared_bytes=1 * KIB):
        assert way(plain(64, 4), "bfloat16") == "layers"


def test_what_stays_where():
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
    assert not chain(nerf(128, 8))["resident"] and chain(nerf(128, 8))["warps"] == 8 and not chain(THICK)["resident"]
    assert chain(plain(64, 4), precision="float32").startswith("products must be of 16 bits")
    assert chain(plain(130, 4)) == "a layer must have at most 128 features"
