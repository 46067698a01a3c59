"""How cell_sort and grouped_mlp run on the GPUs there are: every launch can be made, and fits its workspace."""

import itertools

import pytest
from emulated import emulated, module
from emulated_networks import BRANCHED, GAUSSIANS, KIB, WIDE, check
from helpers import refuses
from network_plans import PRECISIONS, nerf, plan, table

from voronerf.nerf.fields import HashGridField, NeRF

MIB = 1024 * KIB
# Capability, shared memory that a block may ask for, multiprocessors, second-level cache.
GPUS = {
    "GTX 1650": (75, 64 * KIB, 14, 1 * MIB),
    "A100": (80, 163 * KIB, 108, 40 * MIB),
    "RTX 4090": (89, 99 * KIB, 128, 72 * MIB),
    "H200": (90, 227 * KIB, 132, 50 * MIB),
    "RTX 5090": (120, 99 * KIB, 170, 96 * MIB),
    "H200, code of sm_75": (75, 227 * KIB, 132, 50 * MIB),
}
OCTAVES = {"position_octaves": 10, "direction_octaves": 4}
NETWORKS = {
    "w64d4": NeRF(64, depth=4, view_directions=False, **OCTAVES).layers,
    "mlp32": NeRF(32, depth=2, view_directions=True, **OCTAVES).layers,
    **{f"nerf{w}": NeRF(w, depth=8, skips=(4,), view_directions=True, **OCTAVES).layers for w in (64, 256, 1024)},
    "branched": BRANCHED,
    "wide": WIDE,
    "gaussians": GAUSSIANS,
}
SIZES = [(0, 1), (1, 1), (1000, 7), (4_000_000, 4096), (1, 4096), (4_000_000, 16), (4_000_000, 256), (2**31 - 1, 16)]


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("gpu", GPUS)
def test_every_launch_can_be_made(gpu, network):
    layers, device = table(NETWORKS[network]), GPUS[gpu]
    for (n, k), precision, backward in itertools.product(SIZES, range(4), (False, True)):
        plan = module().plan_for(layers, precision, n, k, backward, device)
        x, y, z = plan["grid"]
        assert 0 < x < 2**31 and 0 < y < 65_536 and 0 < z < 65_536
        ends = [*plan["starts"][1:], plan["bytes"]]
        for start, size, end in zip(plan["starts"], plan["sizes"], ends):
            assert start % 256 == 0 and 0 <= start <= start + size <= end
        # What is multiplied is what such a device can.
        exact = device[0] < 80 and PRECISIONS[precision] != "float16"
        assert plan["precision"] == (0 if exact else precision)
        if plan["by_layers"]:
            assert plan["slab"] % 64 == 0 and plan["slab"] * plan["slabs"] >= n
            assert plan["tiles"] * 64 >= plan["slab"] + 63 * k, "cells end where they like"
            # A few times the cache, or what it takes to fill the device.
            assert plan["values"] <= max(4 * device[3], 4 * device[2] * 64 * plan["row_bytes"])
        else:
            assert 0 < plan["shared_bytes"] <= device[1]
            assert plan["threads"] in ((32, 64, 128, 256, 384, 512) if plan["chained"] else (32, 64, 128))
            assert plan["task_rows"] % plan["block_rows"] == 0
            assert x * plan["task_rows"] >= n and x >= n // plan["task_rows"] + k, "cells end where they like"


@pytest.mark.parametrize("gpu", GPUS)
def test_workspaces_are_moderate(gpu):
    """Of 4 M rows: what is kept between layers does not grow with the batch, nor do partial gradients beyond 1 GiB."""
    device = GPUS[gpu]
    for network, k, backward in itertools.product(("w64d4", "mlp32", "nerf64", "nerf256"), (16, 256), (False, True)):
        plan = module().plan_for(table(NETWORKS[network]), 1, 4_000_000, k, backward, device)
        assert plan["bytes"] <= 2 * 1024 * MIB, (network, k, plan["sizes"])


@pytest.mark.parametrize("gpu", GPUS)
@pytest.mark.parametrize("network", ["w64d4", "mlp32", "nerf64"])
def test_networks_of_the_benchmarks_are_fused(network, gpu):
    """Forward, and chained, wherever tensor cores multiply them; backward where a block can hold a tile's values."""
    layers, device = table(NETWORKS[network]), GPUS[gpu]
    precision = PRECISIONS.index("bfloat16" if device[0] >= 80 else "float16")
    assert module().plan_for(layers, precision, 1 << 22, 16, False, device)["chained"]
    if device[1] >= 163 * KIB:
        assert not module().plan_for(layers, precision, 1 << 22, 16, True, device)["by_layers"]


LEAST_WARPS = {
    "H200": {"hash32": (12, 8, 12, 8), "w64d4": (12, 8, 12, 8), "nerf64": (4, 2, 12, 4)},
    "A100": {"hash32": (12, 8, 12, 8), "w64d4": (8, 4, 12, 8), "nerf64": (4, 2, 12, 4)},
    "RTX 4090": {"hash32": (8, 8, 12, 8), "w64d4": (4, 2, 12, 4), "nerf64": (2, 0, 12, 0)},
}
"""Warps of a multiprocessor in float32 forward and backward, then in bfloat16; 0: layer by layer. They go up only."""


@pytest.mark.parametrize("gpu", LEAST_WARPS)
def test_multiprocessors_have_their_warps(gpu):
    """By the shared memory of the plans, and the registers that __launch_bounds__ of the kernels leave."""
    device, found = GPUS[gpu], {}
    for network in LEAST_WARPS[gpu]:
        layers = HashGridField(32).layers if network == "hash32" else NETWORKS[network]
        warps = []
        for precision, backward in itertools.product((0, 1), (False, True)):
            plan = module().plan_for(table(layers), precision, 1 << 20, 16, backward, device)
            if plan["by_layers"]:
                warps.append(0)
                continue
            block = plan["threads"] // 32
            most = 8 if backward else 12
            by_memory = (device[1] + KIB) // (plan["shared_bytes"] + KIB)
            warps.append(block * min(by_memory, most // block))
        found[network] = tuple(warps)
    for network, least in LEAST_WARPS[gpu].items():
        assert all(warps >= known for warps, known in zip(found[network], least, strict=True)), found


@pytest.mark.parametrize(("capability", "compiled"), [(90, 120), (75, 120), (90, 75), (80, 80)])
def test_what_is_multiplied_is_what_the_kernels_were_compiled_for(capability, compiled):
    """A newer device runs code for an older one, which does not have the newer one's instructions."""
    modern = min(capability, compiled) >= 80
    expected = {"float32": 0, "bfloat16": 1 if modern else 0, "float16": 2, "tf32": 3 if modern else 0}
    for shared in (64 * KIB, KIB):
        with emulated(capability=capability, compiled=compiled, shared_bytes=shared):
            for precision, number in expected.items():
                found = plan(BRANCHED, 100, 3, precision=precision)
                assert found["precision"] == number and found["by_layers"] == (shared == KIB)
            check(BRANCHED, [30, 5], 3, "bfloat16")


def test_splits_fill_the_device_within_their_memory():
    """A slab of sorted rows has few of the cells, whatever their number."""
    loaded, most = module(), 512 << 20
    loaded.multiprocessors(132)
    try:
        with emulated():
            found = {k: plan(nerf(256, 8), k=k) for k in (1, 16, 4096)}
    finally:
        loaded.multiprocessors(2)
    # Blocks of the largest gradient, 256 x (256 + 63): 4 x 3 tiles a cell, in two cells of a slab.
    assert found[1]["splits"] == 64 and -(-8 * 132 // (16 * 12)) < found[16]["splits"] <= 8 * 132 // (2 * 12)
    for each in found.values():
        assert each["splits"] == 1 or each["splits"] * each["partial_bytes"] <= most
        assert each["splits"] * each["partial_bytes"] <= each["workspace"]
    assert found[4096]["splits"] == 1


AUTOMATIC, COUNTING, RADIX = range(3)
MOST = 2**31 - 1
SORTED_ROWS = (0, 1, 2047, 2048, 2049, 4_000_000, MOST)
CELLS = (1, 2, 254, 255, 510, 511, 1022, 1023, 4096, 65_534, 65_535, 1 << 20, MOST - 2)


@pytest.mark.parametrize("k", CELLS)
def test_few_cells_are_counted_and_many_sorted_by_radix(k):
    for n in SORTED_ROWS:
        assert module().cell_sort_plan(n, k, AUTOMATIC, 0)["radix"] == (k > 1022)
        assert module().cell_sort_plan(n, k, RADIX, 0)["radix"]
    if k > 1022:
        refuses("too many cells to be counted", module().cell_sort_plan, 1, k, COUNTING, 0, error=RuntimeError)


@pytest.mark.parametrize("k", CELLS)
def test_keys_have_exactly_the_bits_of_the_buckets(k):
    plan = module().cell_sort_plan(100, k, RADIX, 0)
    assert plan["bits"] == (k + 1).bit_length(), "the largest bucket is k + 1"
    assert plan["key_bytes"] == (2 if plan["bits"] <= 16 else 4)


@pytest.mark.parametrize(("way", "k"), [(AUTOMATIC, k) for k in CELLS] + [(RADIX, k) for k in CELLS])
def test_parts_of_the_workspace_lie_side_by_side(way, k):
    for n, temporary in itertools.product(SORTED_ROWS, (0, 12_345)):
        plan = module().cell_sort_plan(n, k, way, temporary)
        if plan["radix"]:
            sizes = [n * plan["key_bytes"], n * plan["key_bytes"], 4 * n, temporary]
        else:
            # Whole blocks of eight chunks, and none of no rows.
            assert plan["chunks"] % 8 == 0 and plan["chunks"] * plan["chunk_rows"] >= n
            assert n > (plan["chunks"] - 8) * plan["chunk_rows"]
            counts = plan["chunks"] * (k + 2)
            assert 4096 * plan["tiles"] >= counts
            sizes = [4 * counts, 4 * plan["tiles"]]
            assert 2 * counts <= n + 16 * max(k + 2, 512), "histograms stay a fraction of the rows"
        ends = [*plan["parts"][1:], plan["bytes"]]
        for start, size, end in zip(plan["parts"], sizes, ends):
            assert start % 256 == 0 and start + size <= end < start + size + 256
        assert plan["bytes"] == ends[-2] + sizes[-1]
