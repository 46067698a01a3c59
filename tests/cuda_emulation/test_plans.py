"""How grouped_mlp runs on the GPUs there are, as a pure function: every launch can be made, and fits its workspace."""

from __future__ import annotations

import itertools

import pytest
import torch
from emulated import module
from emulated_networks import BRANCHED, GAUSSIANS, KIB, WIDE

from voronerf.fields import density_table, nerf_table
from voronerf.layers import MLP
from voronerf.native import grouped_mlp as _native_mlp

MIB = 1024 * KIB
# Capability, shared memory that a block may ask for, multiprocessors, second-level cache.
GPUS = {
    "GTX 1650": (75, 64 * KIB, 14, 1 * MIB),
    "RTX 2080 Ti": (75, 64 * KIB, 68, 5632 * KIB),
    "A100": (80, 163 * KIB, 108, 40 * MIB),
    "RTX 3090": (86, 99 * KIB, 82, 6 * MIB),
    "RTX 4090": (89, 99 * KIB, 128, 72 * MIB),
    "H200": (90, 227 * KIB, 132, 50 * MIB),
    "B200": (100, 227 * KIB, 148, 126 * MIB),
    "RTX 5090": (120, 99 * KIB, 170, 96 * MIB),
    "H200, code of sm_75": (75, 227 * KIB, 132, 50 * MIB),
}
NETWORKS = {
    "w64d4": nerf_table(64, depth=4, position_octaves=10, direction_octaves=4, view_directions=False),
    "mlp32": nerf_table(32, depth=2, position_octaves=10, direction_octaves=4, view_directions=True),
    "nerf64": nerf_table(64, depth=8, skips=(4,), position_octaves=10, direction_octaves=4, view_directions=True),
    "nerf256": nerf_table(256, depth=8, skips=(4,), position_octaves=10, direction_octaves=4, view_directions=True),
    "nerf1024": nerf_table(1024, depth=8, skips=(4,), position_octaves=10, direction_octaves=4, view_directions=True),
    "density": density_table(32, depth=2, position_octaves=6, position_encoding="frequency"),
    "branched": BRANCHED,
    "wide": WIDE,
    "gaussians": GAUSSIANS,
}
SIZES = [(0, 1), (1, 1), (1, 4096), (1000, 7), (4_000_000, 16), (4_000_000, 256), (4_000_000, 4096), (2**31 - 1, 16)]
PRECISIONS = ("float32", "bfloat16", "float16", "tf32")


def numbers(layers: MLP) -> list[int]:
    d = 6 if layers.integrated else 3
    weights = [torch.zeros(1, o, i) for o, i in layers.weight_shapes(d, 3)]
    seen = torch.zeros(1, 3) if layers.uses_directions else None
    given = _native_mlp.network(torch.zeros(1, d), weights, [None] * len(weights), layers, seen)
    return _native_mlp._numbers(given.table, given.positions, given.weights, given.directions)


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("gpu", GPUS)
def test_every_launch_can_be_made(gpu: str, network: str) -> None:
    table, device = numbers(NETWORKS[network]), GPUS[gpu]
    for (n, k), precision, backward in itertools.product(SIZES, range(4), (False, True)):
        plan = module().plan_for(table, precision, n, k, backward, device)
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
def test_workspaces_are_moderate(gpu: str) -> None:
    """Of 4 M rows: what is kept between layers does not grow with the batch, nor do partial gradients beyond 1 GiB."""
    device = GPUS[gpu]
    for network, k, backward in itertools.product(("w64d4", "mlp32", "nerf64", "nerf256"), (16, 256), (False, True)):
        plan = module().plan_for(numbers(NETWORKS[network]), 1, 4_000_000, k, backward, device)
        assert plan["bytes"] <= 2 * 1024 * MIB, (network, k, plan["sizes"])


@pytest.mark.parametrize("gpu", GPUS)
@pytest.mark.parametrize("network", ["w64d4", "mlp32", "nerf64"])
def test_networks_of_the_benchmarks_are_fused(network: str, gpu: str) -> None:
    """Forward, and chained, wherever tensor cores multiply them; backward where a block can hold a tile's values."""
    table, device = numbers(NETWORKS[network]), GPUS[gpu]
    precision = PRECISIONS.index("bfloat16" if device[0] >= 80 else "float16")
    assert module().plan_for(table, precision, 1 << 22, 16, False, device)["chained"]
    if device[1] >= 163 * KIB:
        assert not module().plan_for(table, precision, 1 << 22, 16, True, device)["by_layers"]
