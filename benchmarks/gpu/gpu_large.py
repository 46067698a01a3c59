"""Networks at full size, on some rows against the reference, and gradients against those of float32 products.

The small cases are one tile of rows a task on a device with 132 multiprocessors. Here a task walks over many tiles, the
last of them short, and sums are added up over tiles and tasks.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

N = 1 << 22
"""Samples, at which every loop of the kernels is walked several times."""
SUBSET = 1 << 12
"""Rows of each cell, at most, that the reference computes in float64."""
ALLOWED = {"float32": 2e-4, "bfloat16": 4e-2, "float16": 2e-2}
"""Norm of a difference in norms of what is right; of gradients, to which a rounding beside a kink matters, thrice."""


def large_cases(device: str, n: int = N) -> list[tuple[str, Callable[[], str]]]:
    """Names and checks, which raise, or say how far results are from what is right."""
    return [
        (f"{name} {precision}", functools.partial(compare, device, name, precision, n))
        for name in ("w64d4", "nerf64", "hash32")
        for precision in ALLOWED
    ]


def compare(device: str, name: str, precision: str, n: int) -> str:
    """Outputs beside those in float64, gradients beside those of products in float32."""
    import torch

    given = batch(device, name, precision, n)
    found = evaluate(given)
    assert all(bool(part.isfinite().all()) for part in found), "not finite"
    exact, rows = in_float64(given)
    apart = [distance(found[0][rows], exact)]
    assert apart[0] <= ALLOWED[precision], f"outputs are {apart[0]:.1e} from float64"
    if precision != "float32":
        wide = [weight.detach().float().requires_grad_() for weight in given["weights"]]
        for number, (one, other) in enumerate(zip(found[1:], evaluate({**given, "weights": wide})[1:]), start=1):
            apart.append(distance(one, other))
            assert apart[-1] <= 3 * ALLOWED[precision], f"part {number} is {apart[-1]:.1e} from float32"
    if device == "cuda":
        torch.cuda.empty_cache()
    return f"outputs {apart[0]:.1e}" + f", gradients {max(apart[1:]):.1e}" * (len(apart) > 1)


def distance(one: Any, other: Any) -> float:
    """Norm of the difference, in norms of the second."""
    one, other = one.double(), other.double()
    return float((one - other).norm() / other.norm().clamp_min(1e-30))


def batch(device: str, name: str, precision: str, n: int) -> dict[str, Any]:
    """Samples of nine cells: the first has half of them, one has none and one a single sample."""
    import torch
    from ops.networks import NETS

    import voronerf
    from voronerf.ops._core.layers import MLP, POSITIONS, Layer

    generator = torch.Generator().manual_seed(0)
    layers = NETS.get(name)
    if layers is None:
        rest = MLP((Layer((POSITIONS,), 32, "relu"), Layer((0,), 32, "relu"), Layer((1,), 4)), (2,))
        grid = voronerf.HashGrid(levels=8, features=2, log2_entries=15, finest=512)
        layers = replace(rest, position_encoding="hash", grid=grid)
    share = (n - n // 2 - 1) // 6
    counts = [n // 2, 0, *[share] * 5, 1, n - n // 2 - 1 - 5 * share]
    k, kind = len(counts), getattr(torch, precision)

    def drawn(*shape: int) -> Any:
        return torch.randn(*shape, generator=generator)

    leaves = [(drawn(k, o, i) / i**0.5).to(device, kind).requires_grad_() for o, i in layers.weight_shapes(3)]
    table = drawn(*layers.grid.table_shape).to(device).requires_grad_() if layers.grid is not None else None
    rays = max(1, n // 64)
    return {
        "positions": torch.rand(n, 3, generator=generator).to(device),
        "offsets": torch.tensor([0, *counts], dtype=torch.int32).cumsum(0).int().to(device),
        "counts": counts,
        "weights": leaves,
        "layers": layers,
        "features": table,
        "directions": torch.nn.functional.normalize(drawn(rays, 3), dim=1).to(device)
        if layers.uses_directions
        else None,
        "index": (torch.arange(n, dtype=torch.int32) // 64).clamp(max=rays - 1).to(device),
        "gradient": drawn(n, layers.out_features).to(device),
    }


def call(given: dict[str, Any], positions: Any, offsets: Any, index: Any, weights: Any, **rest: Any) -> Any:
    """The network on some of the rows."""
    import voronerf

    directed = given["directions"] is not None
    return voronerf.grouped_mlp(
        positions,
        offsets,
        weights,
        [None] * len(weights),
        layers=given["layers"],
        directions=rest.pop("directions", given["directions"]),
        direction_index=index if directed else None,
        **rest,
    )


def evaluate(given: dict[str, Any]) -> list[Any]:
    """Outputs, and gradients of all parameters."""
    import torch

    weights, table = given["weights"], given["features"]
    arguments = given["positions"], given["offsets"], given["index"], weights
    out = call(given, *arguments, features=table, backend="native")
    leaves = [*weights, *([] if table is None else [table])]
    return [out.detach(), *torch.autograd.grad(out, leaves, given["gradient"].to(out.dtype))]


def in_float64(given: dict[str, Any]) -> tuple[Any, Any]:
    """Outputs of the last rows of every cell by the reference, and which rows these are."""
    import torch

    rows, counts, begin = [], [], 0
    for count in given["counts"]:
        counts.append(min(count, SUBSET))
        rows.append(torch.arange(begin + count - counts[-1], begin + count))
        begin += count
    chosen = torch.cat(rows).to(given["positions"].device)
    offsets = torch.tensor([0, *counts], dtype=torch.int32).cumsum(0).int().to(chosen.device)
    table, directions = given["features"], given["directions"]
    with torch.no_grad():
        exact = call(
            given,
            given["positions"][chosen].double(),
            offsets,
            given["index"][chosen],
            [weight.double() for weight in given["weights"]],
            features=None if table is None else table.double(),
            directions=None if directions is None else directions.double(),
            backend="reference",
        )
    return exact, chosen
