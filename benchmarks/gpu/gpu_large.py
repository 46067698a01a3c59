"""Networks at full size against the reference on some rows, and their gradients in 16 bits against those in float32.

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
ALLOWED = {"bfloat16": (2e-2, 0.25), "float32": (2e-4, 3e-2)}
"""Norm of a difference in norms of what is right, of outputs and of gradients: a rounding beside a kink of ReLU matters
to these, .12 in bfloat16 and .011 behind a hash grid on a CPU."""


def large_cases(device: str, n: int = N) -> list[tuple[str, Callable[[], str]]]:
    """Names and checks, which raise, or say how far results are from what is right."""
    return [
        (f"{name} {precision}", functools.partial(compare, device, name, precision, n))
        for precision in ALLOWED
        for name in ("w64d4", "hash32", "nerf64")
    ]


def compare(device: str, name: str, precision: str, n: int) -> str:
    """Outputs beside those in float64; gradients beside those of products in float32, and those of float32 of some rows
    beside float64."""
    import torch

    given = batch(device, name, precision, n)
    found = evaluate(given)
    assert all(bool(part.isfinite().all()) for part in found), "not finite"
    exact, rows = in_float64(given)
    pairs = [(found[0][rows], exact[0])]
    if precision == "float32":
        seen = torch.zeros_like(given["gradient"]).index_copy_(0, rows, given["gradient"][rows])
        pairs += zip(evaluate({**given, "gradient": seen})[1:], exact[1:], strict=True)
    else:
        wide = [weight.detach().float().requires_grad_() for weight in given["weights"]]
        pairs += zip(found[1:], evaluate({**given, "weights": wide})[1:], strict=True)
    apart = [distance(*pair) for pair in pairs]
    of_outputs, of_gradients = ALLOWED[precision]
    assert apart[0] <= of_outputs, f"outputs are {apart[0]:.1e} from float64"
    worst = max(range(1, len(apart)), key=apart.__getitem__)
    assert apart[worst] <= of_gradients, f"part {worst} of the gradients is {apart[worst]:.1e} from right"
    if device == "cuda":
        torch.cuda.empty_cache()
    return f"outputs {apart[0]:.1e}, gradients {apart[worst]:.1e}"


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

    generator = torch.Generator(device).manual_seed(0)  # the processor would draw for seconds
    layers = NETS.get(name)
    if layers is None:
        rest = MLP((Layer((POSITIONS,), 32, "relu"), Layer((0,), 32, "relu"), Layer((1,), 4)), (2,))
        grid = voronerf.HashGrid(levels=8, features=2, log2_entries=15, finest=512)
        layers = replace(rest, position_encoding="hash", grid=grid)
    share = (n - n // 2 - 1) // 6
    counts = [n // 2, 0, *[share] * 5, 1, n - n // 2 - 1 - 5 * share]
    k, kind = len(counts), getattr(torch, precision)

    def drawn(*shape: int) -> Any:
        return torch.randn(*shape, generator=generator, device=device)

    leaves = [(drawn(k, o, i) / i**0.5).to(kind).requires_grad_() for o, i in layers.weight_shapes(3, 3)]
    table = drawn(*layers.grid.table_shape).requires_grad_() if layers.grid is not None else None
    rays = max(1, n // 64)
    return {
        "positions": torch.rand(n, 3, generator=generator, device=device),
        "offsets": torch.tensor([0, *counts], dtype=torch.int32).cumsum(0).int().to(device),
        "counts": counts,
        "weights": leaves,
        "layers": layers,
        "features": table,
        "directions": torch.nn.functional.normalize(drawn(rays, 3), dim=1) if layers.uses_directions else None,
        "index": (torch.arange(n, dtype=torch.int32, device=device) // 64).clamp(max=rays - 1),
        "gradient": drawn(n, layers.out_features),
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


def in_float64(given: dict[str, Any]) -> tuple[list[Any], Any]:
    """Outputs of rows all over every cell, its last one included, by the reference; the gradients that these rows make;
    and which rows they are."""
    import torch

    rows, counts, begin = [], [], 0
    for count in given["counts"]:
        counts.append(min(count, SUBSET))
        rows.append(begin + (torch.arange(counts[-1]) + 1) * count // max(counts[-1], 1) - 1)
        begin += count
    chosen = torch.cat(rows).to(given["positions"].device)
    offsets = torch.tensor([0, *counts], dtype=torch.int32).cumsum(0).int().to(chosen.device)
    directions = given["directions"]
    weights = [weight.detach().double().requires_grad_() for weight in given["weights"]]
    table = None if given["features"] is None else given["features"].detach().double().requires_grad_()
    out = call(
        given,
        given["positions"][chosen].double(),
        offsets,
        given["index"][chosen],
        weights,
        features=table,
        directions=None if directions is None else directions.double(),
        backend="reference",
    )
    leaves = [*weights, *([] if table is None else [table])]
    return [out.detach(), *torch.autograd.grad(out, leaves, given["gradient"][chosen].double())], chosen
