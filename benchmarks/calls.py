"""Times a small call of an op, and routers compared with a single network, in turns on one thread.

    python benchmarks/calls.py --json benchmarks/results/calls.json

The op is ``nearest_centre``: the public Python function, and the C++ function that it calls. Routers: 16 cells with
``fuse=True``, compared with one such cell, one ``nn.Sequential`` and routing by hand (argmin, argsort, one padded
``baddbmm`` per layer, scatter). Times are median wall times in microseconds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from harness import Stopwatch, measure, threads, write_results
from torch import Tensor, nn

from voronerf import VoronoiRouter, nearest_centre
from voronerf.ops._core import native

CELLS, WIDTH = 16, 64


@dataclass(frozen=True)
class Options:
    """The settings of the benchmark."""

    seconds: float = 1.0
    """Seconds of measurement for each contender of a row."""
    json: Path | None = None
    """The JSON file of the results. Default: results are only printed."""


def network() -> nn.Sequential:
    """Returns a network of three linear layers."""
    return nn.Sequential(nn.Linear(3, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH), nn.ReLU(), nn.Linear(WIDTH, 4))


def by_hand(x: Tensor, centres: Tensor, layers: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Routes rows with plain torch operations, as a user without the library would.

    The layers have weights [k, i, o] and biases [k, 1, o].
    """
    cells = torch.cdist(x, centres).argmin(1)
    order = cells.argsort()
    counts = cells.bincount(minlength=len(centres))
    rows = torch.arange(len(x)) - (counts.cumsum(0) - counts)[cells[order]]
    table = x.new_zeros(len(centres), int(counts.max()), 3).index_put((cells[order], rows), x[order])
    for place, (weight, bias) in enumerate(layers):
        table = torch.baddbmm(bias, table, weight)
        if place < len(layers) - 1:
            table = table.relu()
    out = table[cells[order], rows]
    return torch.zeros_like(out).index_put((order,), out)


def rows() -> dict[str, dict[str, Callable[[int], Any]]]:
    """Returns the contenders of each row: row name -> contender name -> function."""
    contenders: dict[str, dict[str, Callable[[int], Any]]] = {}
    points, centres, cells, cpu = torch.rand(8, 3), torch.rand(4, 3), torch.empty(8, dtype=torch.int32), native.cpu()
    contenders["nearest_centre, 8 points"] = {
        "public": lambda _: nearest_centre(points, centres),
        "compiled": lambda _: native.compiled.nearest_centre(points, centres, None, cells, 8, 4, 3, 0, cpu),
    }
    for n in (16, 256, 4096, 65536):
        plain, x = network(), torch.rand(n, 3)
        router, one = (VoronoiRouter(network(), torch.rand(k, 3), coords="first3", fuse=True) for k in (CELLS, 1))
        linears = [layer for layer in router.module if isinstance(layer, nn.Linear)]
        layers = [
            (linear.weight.detach().mT.clone().requires_grad_(), linear.bias.detach()[:, None].clone().requires_grad_())
            for linear in linears
        ]
        ways: dict[str, Callable[[], Tensor]] = {
            "router": lambda router=router, x=x: router(x),
            "one cell": lambda one=one, x=x: one(x),
            "nn.Sequential": lambda plain=plain, x=x: plain(x),
            "by hand": lambda router=router, x=x, layers=layers: by_hand(x, router.diagram.centres, layers),
        }
        contenders[f"{n} rows, forward"] = {
            name: torch.no_grad()(lambda _, way=way: way()) for name, way in ways.items()
        }
        contenders[f"{n} rows, with backward"] = {
            name: lambda _, way=way: way().sum().backward() for name, way in ways.items()
        }
    return contenders


def main(options: Options) -> None:
    """Prints a line for each row and writes the results."""
    torch.manual_seed(0)
    results: list[dict[str, Any]] = []
    with threads(1):
        stopwatch = Stopwatch(torch.device("cpu"))
        for row, ways in rows().items():
            for way in ways.values():
                way(0)
            timings = measure(ways, dict.fromkeys(ways, options.seconds), stopwatch)
            microseconds = {name: round(timing.median_ms * 1e3, 2) for name, timing in timings.items()}
            results.append({"row": row, "microseconds": microseconds})
            print(f"{row:34s}" + "   ".join(f"{name} {us:.1f} us" for name, us in microseconds.items()), flush=True)
        write_results(options.json, results, benchmark="calls")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
