from __future__ import annotations

import functools
import math

import pytest
import torch
from helpers import all_pairs
from op_cases import HALVES, compared, need, refusals, refused
from tolerances import assert_as_exact

from voronerf import HashGrid
from voronerf.ops import hash_encode
from voronerf.ops.hash_encode.reference import hash_encode as reference

pytestmark = pytest.mark.op("hash_encode")

BOX = ((-1.0, 0.0, 2.0), (1.0, 3.0, 2.5))
GRIDS = {
    "dense": HashGrid(levels=2, features=2, base=3, finest=8),
    "hashed": HashGrid(levels=3, features=2, log2_entries=10, base=20, finest=300),
    "both": HashGrid(levels=8, features=2, log2_entries=12, base=4, finest=128, box=BOX),
    "one level": HashGrid(levels=1, features=1, log2_entries=10, base=7, finest=7),
    "one feature": HashGrid(levels=5, features=1, log2_entries=11, base=2, finest=100),
    "four features": HashGrid(levels=4, features=4, log2_entries=10, finest=64, box=BOX),
    "eight features": HashGrid(levels=3, features=8, log2_entries=10, base=8, finest=64),
    "many levels": HashGrid(levels=24, features=2, log2_entries=10, base=16, finest=2**19),
    "asked for ahead": HashGrid(levels=2, features=2, log2_entries=17, base=60, finest=200),
    "torch-ngp": HashGrid(levels=6, features=2, log2_entries=12, base=5, finest=77, convention="torch-ngp"),
    "nerfstudio": HashGrid(levels=6, features=2, log2_entries=12, base=5, finest=77, convention="nerfstudio"),
}


def points(n, grid, dtype=torch.float32):
    """Returns points from a range that exceeds the box by 5% on each side."""
    low, high = torch.tensor(grid.box, dtype=torch.float64)
    return (low + (high - low) * (1.1 * torch.rand(n, 3, dtype=torch.float64) - 0.05)).to(dtype)


def features(grid, dtype=torch.float32):
    return torch.randn(grid.table_shape, dtype=torch.float64).to(dtype)


def peer(place, table, *, convention, levels, features, log2_entries, base, finest):
    """Encodes one point in 0..1, number by number, as the sources of other libraries do, with the names used there.

    tiny-cuda-nn: grid.h, grid_scale, grid_resolution, grid_index. torch-ngp: gridencoder.cu, get_grid_index, and
    grid.py. nerfstudio: field_components/encodings.py, HashEncoding.pytorch_fwd.
    """
    encoded, offset = [], 0
    growth = math.exp((math.log(finest) - math.log(base)) / (levels - 1))
    for level in range(levels):
        table_size = 2**log2_entries
        if convention == "nerfstudio":
            scaled = [x * float(torch.floor(base * growth ** torch.arange(levels))[level]) for x in place]
            low, side = [math.floor(x) for x in scaled], None
        else:
            scale = base * growth**level - 1
            resolution = math.ceil(scale - 1e-4) + 1
            side = resolution if convention == "tiny-cuda-nn" else resolution + 1
            table_size = min(table_size, 8 * math.ceil(side**3 / 8))
            scaled = [x * scale + 0.5 for x in place]
            low = [math.floor(x) for x in scaled]
        fraction = [x - i for x, i in zip(scaled, low)]
        total = [0.0] * features
        for corner in range(8):
            weight, local = 1.0, []
            for dim in range(3):
                upper = corner >> dim & 1
                weight *= fraction[dim] if upper else 1 - fraction[dim]
                local.append(low[dim] + upper)
            index, stride = 0, 1
            for dim in range(3):
                if side is None or stride > table_size:
                    break
                index += local[dim] * stride
                stride *= side
            if side is None or table_size < stride:
                index = 0
                for x, prime in zip(local, (1, 2654435761, 805459861)):
                    index ^= (x * prime) % 2**32
            row = table[offset + index % table_size]
            total = [t + weight * float(value) for t, value in zip(total, row)]
        encoded += total
        offset += table_size
    return encoded


@pytest.mark.parametrize("convention", ["tiny-cuda-nn", "torch-ngp", "nerfstudio"])
@pytest.mark.parametrize(
    "sizes",
    [
        {"levels": 8, "features": 2, "log2_entries": 12, "base": 4, "finest": 128},
        {"levels": 4, "features": 1, "log2_entries": 10, "base": 5, "finest": 9},
        {"levels": 16, "features": 2, "log2_entries": 14, "base": 16, "finest": 1000},
    ],
)
def test_reads_the_tables_of_other_libraries(convention, sizes):
    grid = HashGrid(**sizes, convention=convention)
    table, places = features(grid, torch.float64), torch.rand(30, 3, dtype=torch.float64)
    expected = [peer(place, table, convention=convention, **sizes) for place in places.tolist()]
    actual = hash_encode(places, table, grid)
    # tiny-cuda-nn and torch-ngp compute their scales in float32.
    torch.testing.assert_close(actual, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-3)


@compared("hash_encode")
@pytest.mark.parametrize(*all_pairs({"name": GRIDS, "n": [0, 1, 17, 300], "dtype": [torch.float32, *HALVES]}))
def test_matches_the_reference(device, backend, name, n, dtype):
    need("hash_encode", backend, device, dtype)
    grid = GRIDS[name]
    x, table = points(n, grid), features(grid, dtype)
    exact = reference(x.double(), table.double(), grid)
    actual = hash_encode(x.to(device), table.to(device), grid, backend=backend)
    assert actual.dtype == torch.promote_types(dtype, torch.float32)
    assert_as_exact(actual, reference(x, table, grid), exact)


def derivatives(encode, grid, x, table, cells, dtype):
    """Returns features, their gradients, and the derivatives of these gradients along random directions."""
    generator = torch.Generator().manual_seed(1)
    leaves = [x.to(torch.promote_types(dtype, torch.float32)).requires_grad_(), table.to(dtype).requires_grad_()]
    out = encode(*leaves, grid, cells=cells)
    arriving, *cotangents = (
        torch.randn(like.shape, generator=generator).bfloat16().to(like) for like in (out, *leaves)
    )
    arriving.requires_grad_()
    first = torch.autograd.grad(out, leaves, arriving, create_graph=True)
    return [out, *first, *torch.autograd.grad(first, (arriving, *leaves), cotangents)]


def assert_near(actual, plain, exact):
    """Compares norms, since rounding may move a point near a grid corner to the cell on the other side."""
    for a, b, c in zip(actual, plain, exact, strict=True):
        floor = 2 * torch.finfo(a.dtype).eps + 1e-6
        assert (a.cpu().double() - c).norm() <= 2 * (b.double() - c).norm() + floor * c.norm()


@compared("hash_encode")
@pytest.mark.parametrize("name", GRIDS)
def test_gradients_of_two_orders(device, backend, name):
    grid = GRIDS[name]
    x, table = points(40, grid), features(grid)
    run = functools.partial(hash_encode, backend=backend)
    actual = derivatives(run, grid, x.to(device), table.to(device), None, torch.float32)
    plain, exact = (derivatives(reference, grid, x, table, None, dtype) for dtype in (torch.float32, torch.float64))
    assert_near(actual, plain, exact)


def test_a_table_for_each_cell(device, backend):
    grid = GRIDS["both"]
    tables = torch.randn(3, *grid.table_shape, device=device)
    x, cells = points(50, grid).to(device), torch.randint(3, (50,), dtype=torch.int32, device=device)
    result = hash_encode(x, tables, grid, cells=cells, backend=backend)
    for cell, table in enumerate(tables):
        rows = cells == cell
        torch.testing.assert_close(result[rows], hash_encode(x[rows], table, grid, backend=backend), rtol=0, atol=1e-6)


def test_gradients_of_a_half_table_are_summed_in_float32(device, backend):
    grid = GRIDS["one level"]
    table = features(grid, torch.bfloat16).to(device).requires_grad_()
    need("hash_encode", backend, device, torch.bfloat16)
    places = torch.zeros(1000, 3, device=device)
    out = hash_encode(places, table, grid, backend=backend)
    (result,) = torch.autograd.grad(out.sum(), table)
    assert float(result.float().sum()) == pytest.approx(1000, rel=0.01), "bfloat16 counts to 256"


def test_outside_of_the_box_and_nan(device, backend):
    grid = HashGrid(levels=2, base=4, finest=8, box=BOX)
    table = features(grid).to(device)
    x = torch.tensor([[-9.0, 1, 2.2], [-1, 1, 2.2], [0, torch.inf, 2.2], [0, 3, 2.2]], device=device).requires_grad_()
    encoded = hash_encode(x, table, grid, backend=backend)
    torch.testing.assert_close(encoded[::2], encoded[1::2], rtol=0, atol=0)
    (gradient,) = torch.autograd.grad(encoded.sum(), x)
    assert gradient[0, 0] == 0 and gradient[2, 1] == 0 and gradient[0, 1] != 0
    assert hash_encode(x * torch.nan, table, grid, backend=backend).isnan().all()


def test_errors(backend):
    grid = GRIDS["dense"]
    x, table = torch.rand(4, 3), features(grid)
    refuses = refusals(hash_encode, positions=x, table=table, grid=grid, backend=backend)
    refuses(f"table must have shape [{len(table)}, 2], got [{len(table) - 1}, 2]", table=table[1:])
    message = f"table must have shape [k, {len(table)}, 2], got [{len(table)}, 2]"
    refuses(message, cells=torch.zeros(4, dtype=torch.int32))
    two, cells = table.expand(2, -1, -1), torch.tensor([0, 2, 0, 0], dtype=torch.int32)
    refuses("cells must lie in 0 to 1, got values from 0 to 2", table=two, cells=cells)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"levels": 25}, "HashGrid: levels must be an integer from 1 to 24, got 25"),
        ({"log2_entries": 9}, "HashGrid: log2_entries must be an integer from 10 to 24, got 9"),
        ({"features": 3}, "HashGrid: features must be 1, 2, 4 or 8, got 3"),
        ({"base": 64, "finest": 32}, "HashGrid: base and finest must be 1 <= base <= finest <= 2^20, got 64 and 32"),
        ({"finest": math.nan}, "HashGrid: base and finest must be 1 <= base <= finest <= 2^20, got 16 and nan"),
        ({"box": ((0, 0, 0), (1, 0, 1))}, "HashGrid: box must be two corners, ... got ((0, 0, 0), (1, 0, 1))"),
        ({"convention": "ngp"}, "HashGrid: convention must be one of tiny-cuda-nn, ... nerfstudio, got 'ngp'"),
    ],
)
def test_grids_that_cannot_be(change, message):
    with refused(ValueError, message):
        HashGrid(**change)


def test_a_grid_is_text():
    for grid in GRIDS.values():
        assert HashGrid.parse(grid.text) == grid


FEATURES = ["both", "one feature", "four features", "eight features"]
KINDS = {"name": FEATURES, "dtype": [torch.float32, *HALVES], "isa": ["portable", "neon", "avx2", "avx512"]}


@pytest.mark.native
@pytest.mark.parametrize(*all_pairs({**KINDS, "several": [False, True]}), indirect=["isa"])
def test_every_instruction_set(isa, poisoned, name, dtype, several):
    grid, n = GRIDS[name], 131
    x, cells = points(n, grid), torch.randint(3, (n,), dtype=torch.int32) if several else None
    table = torch.randn((3, *grid.table_shape) if several else grid.table_shape).to(dtype)
    actual = derivatives(functools.partial(hash_encode, backend="native"), grid, x, table, cells, dtype)
    plain, exact = (derivatives(reference, grid, x, table, cells, wide) for wide in (torch.float32, torch.float64))
    assert_near(actual, plain, exact)


def test_third_derivatives(backend):
    need("hash_encode", backend, torch.device("cpu"), torch.float32)
    grid = HashGrid(levels=2, features=2, log2_entries=10, base=3, finest=20, box=BOX)
    x, table, v = points(20, grid), features(grid), torch.randn(20, 3)

    def third(encode, dtype):
        leaves = [x.to(dtype).requires_grad_(), table.to(dtype).requires_grad_()]
        slopes = encode(*leaves, grid).square().sum()
        for _ in range(2):
            (slopes,) = torch.autograd.grad(slopes, leaves[0], create_graph=True)
            slopes = (slopes * v.to(dtype)).sum()
        return torch.autograd.grad(slopes, leaves)

    result = third(functools.partial(hash_encode, backend=backend), torch.float32)
    assert_near(result, third(reference, torch.float32), third(reference, torch.float64))
