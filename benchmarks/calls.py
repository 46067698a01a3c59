"""Times small calls of ops, and routers compared with a single network, in turns on one thread.

    python benchmarks/calls.py --json benchmarks/results/calls.json

Ops: the public Python function and, for ``nearest_centre``, the C++ function that it calls. Routers: 16 cells with
``fuse=True``, compared with one such cell, one ``nn.Sequential`` and routing by hand (argmin, argsort, one padded
``baddbmm`` per layer, scatter). Networks on sorted rows: ``grouped_mlp``, compared with a padded ``baddbmm``. Times are
median wall times in microseconds.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from harness import Stopwatch, measure, metadata, threads
from torch import Tensor, nn

from voronerf import MLP, Layer, VoronoiRouter, grouped_mlp, nearest_centre
from voronerf.app.files import json_text, write_text
from voronerf.ops import rendered_gradient
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


def padded(x: Tensor, layers: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Applies layers of weights [k, i, o] and biases [k, 1, o] to rows [k, n, i], with ReLU between the layers."""
    for place, (weight, bias) in enumerate(layers):
        x = torch.baddbmm(bias, x, weight)
        if place < len(layers) - 1:
            x = x.relu()
    return x


def by_hand(x: Tensor, centres: Tensor, layers: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Routes rows with plain torch operations, as a user without the library would."""
    cells = torch.cdist(x, centres).argmin(1)
    order = cells.argsort()
    counts = cells.bincount(minlength=len(centres))
    rows = torch.arange(len(x)) - (counts.cumsum(0) - counts)[cells[order]]
    table = x.new_zeros(len(centres), int(counts.max()), 3)
    out = padded(table.index_put((cells[order], rows), x[order]), layers)[cells[order], rows]
    return torch.zeros_like(out).index_put((order,), out)


def rows() -> dict[str, dict[str, Callable[[int], Any]]]:
    """Returns the contenders of each row: row name -> contender name -> function."""
    contenders: dict[str, dict[str, Callable[[int], Any]]] = {}
    points, centres, cells, cpu = torch.rand(8, 3), torch.rand(4, 3), torch.empty(8, dtype=torch.int32), native.cpu()
    contenders["nearest_centre, 8 points"] = {
        "public": lambda _: nearest_centre(points, centres),
        "compiled": lambda _: native.compiled.nearest_centre(points, centres, None, cells, 8, 4, 3, 0, cpu),
    }
    raw, of_depth, offsets = torch.rand(2, 2, 4), torch.ones(1), torch.tensor([0, 2], dtype=torch.int32)
    along = torch.tensor([6.9, 1e3]), torch.tensor([1.0, 2]), torch.full((2,), 0.1), torch.full((2,), 0.5)
    contenders["rendered_gradient, 8 tensors"] = {
        "public": lambda _: rendered_gradient(*raw, *along, offsets, of_depth=of_depth, activated=True)
    }
    for n in (16, 256, 4096, 65536):
        plain, x = network(), torch.rand(n, 3)
        router, one = (VoronoiRouter(network(), torch.rand(k, 3), coords="first3", fuse=True) for k in (CELLS, 1))
        linears = [layer for layer in router.module if isinstance(layer, nn.Linear)]
        layers = [
            (copy.deepcopy(linear.weight).mT.detach().requires_grad_(), copy.deepcopy(linear.bias)[:, None].detach())
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
    table = MLP((Layer(("positions",), WIDTH, "relu"), Layer((0,), WIDTH, "relu"), Layer((1,), 4)), outputs=(2,))
    weights = [torch.randn(CELLS, o, i) / 5 for o, i in table.weight_shapes(3)]
    biases: list[Tensor | None] = [torch.zeros(CELLS, layer.width) for layer in table.layers]
    x, ends = torch.rand(1024, 3), torch.arange(0, 1025, 64, dtype=torch.int32)
    turned = [(w.mT.contiguous(), b[:, None]) for w, b in zip(weights, biases) if b is not None]
    contenders["1,024 sorted rows"] = {
        "grouped_mlp": lambda _: grouped_mlp(x, ends, weights, biases, layers=table),
        "baddbmm": lambda _: padded(x.view(CELLS, 64, 3), turned),
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
        if options.json is not None:
            write_text(options.json, json_text(metadata(benchmark="calls", results=results)))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
