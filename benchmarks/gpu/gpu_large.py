"""Checks networks at full size: some rows against the reference, and 16-bit gradients against float32 gradients.

A task is a range of rows of one cell that a thread block processes tile by tile (csrc/network/cuda/program_cuda.cu).
With 132 multiprocessors, a task of a small case has one tile. Here a task has many tiles, the last one partial, and the
sums of gradients run over tiles and tasks.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

N = 1 << 22
"""The number of samples: so large that every loop of the kernels runs several times."""
SUBSET = 1 << 12
"""The most rows per cell that the reference computes in float64."""
ALLOWED = {"bfloat16": (2e-2, 0.25), "float32": (2e-4, 3e-2)}
"""Allowed relative errors (by norm) of outputs and of gradients. Rounding switches some ReLU units, which changes
gradients: on a CPU by 0.12 in bfloat16, and by 0.011 with a hash grid."""


def large_cases(device: str, n: int = N) -> list[tuple[str, Callable[[], str]]]:
    """Returns (name, check) pairs; a check raises, or returns a text with the relative errors."""
    return [
        (f"{name} {precision}", functools.partial(compare, device, name, precision, n))
        for precision in ALLOWED
        for name in ("w64d4", "hash32", "nerf64")
    ]


def compare(device: str, name: str, precision: str, n: int) -> str:
    """Compares outputs with float64, 16-bit gradients with float32, and float32 gradients with float64."""
    import torch

    inputs = batch(device, name, precision, n)
    results = evaluate(inputs)
    assert all(bool(part.isfinite().all()) for part in results), "not finite"
    exact, rows = in_float64(inputs)
    pairs = [(results[0][rows], exact[0])]
    if precision == "float32":
        seen = torch.zeros_like(inputs["gradient"]).index_copy_(0, rows, inputs["gradient"][rows])
        pairs += zip(evaluate({**inputs, "gradient": seen})[1:], exact[1:], strict=True)
    else:
        wide = [weight.detach().float().requires_grad_() for weight in inputs["weights"]]
        pairs += zip(results[1:], evaluate({**inputs, "weights": wide})[1:], strict=True)
    apart = [distance(*pair) for pair in pairs]
    of_outputs, of_gradients = ALLOWED[precision]
    assert apart[0] <= of_outputs, f"outputs are {apart[0]:.1e} from float64"
    worst = max(range(1, len(apart)), key=apart.__getitem__)
    assert apart[worst] <= of_gradients, f"part {worst} of the gradients is {apart[worst]:.1e} from right"
    if device == "cuda":
        torch.cuda.empty_cache()
    return f"outputs {apart[0]:.1e}, gradients {apart[worst]:.1e}"


def distance(one: Any, other: Any) -> float:
    """Returns the norm of the difference, relative to the norm of the second tensor."""
    one, other = one.double(), other.double()
    return float((one - other).norm() / other.norm().clamp_min(1e-30))


def batch(device: str, name: str, precision: str, n: int) -> dict[str, Any]:
    """Draws samples of nine cells: the first has half of the samples, one is empty and one has a single sample."""
    import torch
    from ops.networks import NETS

    import voronerf
    from voronerf.ops._core.layers import MLP, POSITIONS, Layer

    generator = torch.Generator(device).manual_seed(0)  # drawing on the CPU would take seconds
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


def call(inputs: dict[str, Any], positions: Any, offsets: Any, index: Any, weights: Any, **rest: Any) -> Any:
    """Runs the network on some rows."""
    import voronerf

    directed = inputs["directions"] is not None
    return voronerf.grouped_mlp(
        positions,
        offsets,
        weights,
        [None] * len(weights),
        layers=inputs["layers"],
        directions=rest.pop("directions", inputs["directions"]),
        direction_index=index if directed else None,
        **rest,
    )


def evaluate(inputs: dict[str, Any]) -> list[Any]:
    """Returns outputs and the gradients of all parameters."""
    import torch

    weights, table = inputs["weights"], inputs["features"]
    arguments = inputs["positions"], inputs["offsets"], inputs["index"], weights
    out = call(inputs, *arguments, features=table, backend="native")
    leaves = [*weights, *([] if table is None else [table])]
    return [out.detach(), *torch.autograd.grad(out, leaves, inputs["gradient"].to(out.dtype))]


def in_float64(inputs: dict[str, Any]) -> tuple[list[Any], Any]:
    """Returns the reference's results for some rows (outputs and gradients), and the indices of the rows.

    The rows are evenly spaced in every cell and include its last row."""
    import torch

    rows, counts, begin = [], [], 0
    for count in inputs["counts"]:
        counts.append(min(count, SUBSET))
        rows.append(begin + (torch.arange(counts[-1]) + 1) * count // max(counts[-1], 1) - 1)
        begin += count
    chosen = torch.cat(rows).to(inputs["positions"].device)
    offsets = torch.tensor([0, *counts], dtype=torch.int32).cumsum(0).int().to(chosen.device)
    directions = inputs["directions"]
    weights = [weight.detach().double().requires_grad_() for weight in inputs["weights"]]
    table = None if inputs["features"] is None else inputs["features"].detach().double().requires_grad_()
    out = call(
        inputs,
        inputs["positions"][chosen].double(),
        offsets,
        inputs["index"][chosen],
        weights,
        features=table,
        directions=None if directions is None else directions.double(),
        backend="reference",
    )
    leaves = [*weights, *([] if table is None else [table])]
    return [out.detach(), *torch.autograd.grad(out, leaves, inputs["gradient"][chosen].double())], chosen
