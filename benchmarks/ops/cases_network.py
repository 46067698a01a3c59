"""Cases of grouped_linear, grouped_mlp and routed_mlp. n samples, k cells."""

from __future__ import annotations

import functools
from typing import Any

import torch

from ops.alternatives import alternatives, ours
from ops.case import BACKWARD, FORWARD, Case, Work
from ops.networks import LAYERS, NETS, cost, make_batch, network_error
from ops.route import route_work

FULL, HALF = torch.float32, torch.bfloat16
BASE = 1 << 18
TOLERANCE = {(FULL, FORWARD): 1e-4, (FULL, BACKWARD): 0.02, (HALF, FORWARD): 0.05, (HALF, BACKWARD): 0.9}
"""Largest error of an alternative. If rounding switches a ReLU unit near 0, gradients change by some percent, in
bfloat16 by half of the largest gradient. Missing gradients have an error of 1."""
BOTH = ("native", "reference")

# (network, n, k, dtype, direction). For each small network, dtype and direction, the first row also runs the reference.
MLP_ROWS: tuple[tuple[str, int, int, torch.dtype, str], ...] = (
    *[("w64d4", n, 16, FULL, FORWARD) for n in (BASE, 1 << 10, 1 << 14, 1 << 20)],
    *[("mlp32", BASE, k, FULL, FORWARD) for k in (256, 1, 16, 64, 512, 4096)],
    *[(net, BASE, 16, FULL, FORWARD) for net in ("nerf64", "nerf128", "nerf256")],
    ("nerf256", BASE, 1, FULL, FORWARD),
    *[("w64d4", n, 16, HALF, FORWARD) for n in (BASE, 1 << 10, 1 << 14, 1 << 20)],
    *[("mlp32", BASE, k, HALF, FORWARD) for k in (256, 16, 4096)],
    *[(net, BASE, 16, HALF, FORWARD) for net in ("nerf64", "nerf128", "nerf256")],
    ("nerf256", BASE, 1, HALF, FORWARD),
    *[("w64d4", n, 16, FULL, BACKWARD) for n in (BASE, 1 << 10, 1 << 14, 1 << 20)],
    *[("mlp32", BASE, k, FULL, BACKWARD) for k in (256, 16, 4096)],
    ("nerf64", BASE, 16, FULL, BACKWARD),
    *[(net, 1 << 14, 16, FULL, BACKWARD) for net in ("nerf128", "nerf256")],
    ("nerf256", 1 << 14, 1, FULL, BACKWARD),
    ("w64d4", BASE, 16, HALF, BACKWARD),
    *[("mlp32", BASE, k, HALF, BACKWARD) for k in (256, 4096)],
    ("nerf64", BASE, 16, HALF, BACKWARD),
    *[(net, 1 << 14, 16, HALF, BACKWARD) for net in ("nerf128", "nerf256")],
    ("nerf256", 1 << 14, 1, HALF, BACKWARD),
)
MLP_QUICK = {
    ("w64d4", BASE, 16, FULL, FORWARD),
    ("w64d4", 1 << 10, 16, FULL, FORWARD),
    ("mlp32", BASE, 256, FULL, FORWARD),
    ("w64d4", BASE, 16, HALF, FORWARD),
    ("w64d4", BASE, 16, FULL, BACKWARD),
}

ROUTE_ROWS: tuple[tuple[str, int, int, torch.dtype, str], ...] = (
    *[("w64d4", n, 16, FULL, FORWARD) for n in (BASE, 1 << 10, 1 << 14, 1 << 20)],
    *[("w64d4", n, 16, FULL, BACKWARD) for n in (BASE, 1 << 10)],
    *[("w64d4", n, 16, FULL, direction) for n in (1, 16, 256) for direction in (FORWARD, BACKWARD)],
    *[("w64d4", BASE, 16, HALF, direction) for direction in (FORWARD, BACKWARD)],
    *[("mlp32", BASE, 256, dtype, direction) for dtype in (FULL, HALF) for direction in (FORWARD, BACKWARD)],
    ("mlp32", BASE, 4096, FULL, FORWARD),
    *[("nerf64", BASE, 16, FULL, direction) for direction in (FORWARD, BACKWARD)],
)
ROUTE_QUICK = {("w64d4", BASE, 16, FULL, FORWARD), ("w64d4", 1 << 14, 16, FULL, FORWARD)}

# (layer, n, k)
LINEAR_ROWS = (("64-64", BASE, 16), ("63-64", BASE, 256), ("256-256", BASE, 16))


def cases() -> list[Case]:
    """Returns the cases of these ops."""
    rows, seen = [], set()
    for layer, n, k in LINEAR_ROWS:
        for dtype in (FULL, HALF):
            for direction in (FORWARD, BACKWARD):
                first = (layer, n) == ("64-64", BASE)
                quick = first and dtype == FULL
                work = functools.partial(_linear_work, layer, n, k, dtype, direction)
                shown = BOTH if first else ("native",)
                name = f"{layer} n={n} k={k}"
                rows.append(Case("grouped_linear", name, dtype, direction, n, k, work, shown, quick))
    for row in MLP_ROWS:
        net, n, k, dtype, direction = row
        shown = ("native",) if (net, dtype, direction) in seen or net in ("nerf128", "nerf256") else BOTH
        seen.add((net, dtype, direction))
        work = functools.partial(_mlp_work, row)
        name = f"{net} n={n} k={k}"
        rows.append(Case("grouped_mlp", name, dtype, direction, n, k, work, shown, row in MLP_QUICK))
    for row in ROUTE_ROWS:
        net, n, k, dtype, direction = row
        work = functools.partial(route_work, *row, TOLERANCE[dtype, direction])
        shown = BOTH if (net, n, k, dtype) == ("w64d4", BASE, 16, FULL) else ("native",)
        rows.append(Case("routed_mlp", f"{net} n={n} k={k}", dtype, direction, n, k, work, shown, row in ROUTE_QUICK))
    return rows


def _linear_work(layer: str, n: int, k: int, dtype: torch.dtype, direction: str, device: torch.device) -> Work:
    features, net = LAYERS[layer]
    batch = make_batch(net, n, k, dtype, direction, device, features=features)
    price = cost(net, features)
    return _work(batch, price.forward + (price.backward if direction == BACKWARD else 0.0), None)


def _mlp_work(row: tuple[str, int, int, torch.dtype, str], device: torch.device) -> Work:
    name, n, k, dtype, direction = row
    net = NETS[name]
    batch, price = make_batch(net, n, k, dtype, direction, device), cost(net)
    if direction == FORWARD:
        return _work(batch, price.forward, None)
    useful = price.forward + price.backward
    return _work(batch, useful, useful + price.again)


def _work(batch: Any, flops: float, executed: float | None) -> Work:
    """Builds the case of a batch; ``flops`` and ``executed`` are operations per sample."""
    return Work(
        functools.partial(ours, batch),
        alternatives(batch),
        network_error(batch),
        TOLERANCE[batch.dtype, batch.direction],
        flops * batch.n,
        str(batch.dtype).removeprefix("torch."),
        None if executed is None else executed * batch.n,
    )
