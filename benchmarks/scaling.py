"""A router over ranks: how much faster two are than one, what they send, how even their work is, what more would do.

    python benchmarks/scaling.py --samples runs/lego/samples/level-1.npz runs/ship/samples/level-1.npz --json FILE

Measured on two ranks of one thread each, over gloo: steps of a sharded router (forward, backward, Adam) on samples that
a training has kept, against one process of one and of two threads; bytes sent, counted and by formula; and how evenly
diagrams of different makes share work out. A model then says what more ranks would do at stated speeds of a link. It is
compared with the two ranks that were measured; everything beyond them is extrapolated.
"""

from __future__ import annotations

import json
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
import tyro
from balance import load_samples
from harness import metadata
from torch import Tensor

from voronerf import NeRF, VoronoiDiagram, VoronoiRouter
from voronerf.diagram.balance import balance
from voronerf.files import write_text
from voronerf.router.exchange import deal_cells

WAYS = ("one process, one thread", "one process, two threads", "two ranks, strong", "two ranks, weak")
MODELLED = (8, 64, 512, 4096)


@dataclass(frozen=True)
class Options:
    """What is measured."""

    samples: tuple[Path, ...]
    """Files with points [m, 3] and importance [m] (.npz), as a training writes them for its split."""
    count: int = 32_768
    """Samples of a step; of each rank where the scaling is weak."""
    cells: int = 16
    """Cells of the router that is timed."""
    width: int = 64
    """Of its networks."""
    ray: int = 32
    """Samples of a ray, for figures of rays."""
    rounds: int = 9
    """Timings of each way, which take turns; medians are reported."""
    parts: tuple[int, ...] = (2, 4, 8)
    """Numbers of ranks between which diagrams of four cells a rank share the work."""
    links: tuple[float, ...] = (25, 100, 450)
    """Modelled speeds of a rank's link, in GB/s."""
    faster: float = 1000
    """Modelled speed of a rank, in units of the measured thread: about that of a GPU."""
    batch: int = 1 << 20
    """Modelled samples of a step of such a rank."""
    message: float = 1e-6
    """Modelled seconds that a rank needs to begin a message to one other rank."""
    json: Path | None = None
    """Where the results go; default: printed only."""


# Two ranks ------------------------------------------------------------------------------------------------------------


class Counted:
    """Stands for ``torch.distributed.all_to_all_single``; counts what goes to other ranks, and the time inside."""

    def __init__(self, exchange: Callable[..., Any]) -> None:
        self.exchange, self.bytes, self.seconds, self.calls = exchange, 0, 0.0, 0

    def __call__(self, output: Tensor, given: Tensor, came: list[int], there: list[int], **options: Any) -> Any:
        others = sum(there) - there[dist.get_rank()]
        self.bytes, self.calls = self.bytes + others * given.element_size(), self.calls + 1
        begin = time.perf_counter()
        result = self.exchange(output, given, came, there, **options)
        self.seconds += time.perf_counter() - begin
        return result


def measure_rank(rank: int, folder: str, options: Options) -> None:
    """All ways in turn, on one of two ranks; rank 1 waits where there is one process."""
    torch.set_num_threads(1)
    dist.init_process_group("gloo", store=dist.FileStore(f"{folder}/store", 2), rank=rank, world_size=2)
    counted = dist.all_to_all_single = Counted(dist.all_to_all_single)
    points, importance = load_samples(options.samples[0])
    diagram = diagrams(points, importance, options.cells)["transport"]
    generator = torch.Generator().manual_seed(rank)
    positions = points[torch.randint(len(points), (options.count,), generator=generator)]
    directions = torch.nn.functional.normalize(torch.randn(len(positions), 3, generator=generator), dim=1)
    torch.manual_seed(0)
    whole = VoronoiRouter(NeRF(width=options.width, depth=2), diagram)
    shared = VoronoiRouter(NeRF(width=options.width, depth=2), diagram)
    shared.shard(weights=load(diagram, points))
    optimizers = {id(router): torch.optim.Adam(router.parameters(), lr=1e-3) for router in (whole, shared)}

    def step(router: VoronoiRouter, n: int) -> None:
        colour, density = router(positions[:n], directions[:n])
        optimizers[id(router)].zero_grad()
        (colour.square().mean() + density.square().mean()).backward()
        optimizers[id(router)].step()

    ways: dict[str, tuple[VoronoiRouter, int, int]] = {
        WAYS[0]: (whole, options.count, 1),
        WAYS[1]: (whole, options.count, 2),
        WAYS[2]: (shared, options.count // 2, 1),
        WAYS[3]: (shared, options.count, 1),
    }
    rows: list[dict[str, Any]] = []
    for turn in range(options.rounds + 1):
        for way, (router, n, threads) in ways.items():
            dist.barrier()
            if router is whole and rank == 1:
                continue
            torch.set_num_threads(threads)
            counted.bytes, counted.seconds, counted.calls = 0, 0.0, 0
            wall, cpu = time.perf_counter(), time.process_time()
            step(router, n)
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            torch.set_num_threads(1)
            entry = {"way": way, "samples": n, "seconds": wall, "cpu": cpu, "exchange": counted.seconds}
            rows += [{**entry, "bytes": counted.bytes, "messages": counted.calls}] if turn else []
        dist.barrier()
        rows += [{"way": "exchange alone", **exchange_alone(options)}] if turn else []
    Path(folder, f"{rank}.json").write_text(json.dumps(rows))
    dist.destroy_process_group()


def exchange_alone(options: Options) -> dict[str, float]:
    """Seconds of an exchange of as many bytes as positions and directions of a strong step have, and of almost none."""
    found = {}
    for name, size in (("seconds", options.count // 4 * 24), ("empty", 1)):
        message = torch.zeros(2 * size, dtype=torch.uint8)
        dist.barrier()
        begin = time.perf_counter()
        dist.all_to_all_single(torch.empty_like(message), message, [size] * 2, [size] * 2)
        found[name] = time.perf_counter() - begin
    return {**found, "bytes": options.count // 4 * 24}


def measure(options: Options) -> dict[str, Any]:
    """Medians over the turns, of both ranks together."""
    with tempfile.TemporaryDirectory() as folder:
        torch.multiprocessing.start_processes(measure_rank, (folder, options), nprocs=2, start_method="spawn")
        ranks = [json.loads(Path(folder, f"{rank}.json").read_text()) for rank in range(2)]
    found: dict[str, Any] = {}
    for way in WAYS:
        every = [[row for row in rows if row["way"] == way] for rows in ranks]
        turns = [list(rows) for rows in zip(*[rows for rows in every if rows], strict=True)]
        samples = sum(row["samples"] for row in turns[0])
        sent = sum(row["bytes"] for row in turns[0])
        found[way] = {
            "samples": samples,
            "milliseconds": 1e3 * statistics.median(max(row["seconds"] for row in turn) for turn in turns),
            "cpu_milliseconds": 1e3 * statistics.median(sum(row["cpu"] for row in turn) for turn in turns),
            "exchange_milliseconds": 1e3 * statistics.median(max(row["exchange"] for row in turn) for turn in turns),
            "bytes_a_sample": sent / samples,
            "bytes_a_ray": sent / samples * options.ray,
            "exchanges": turns[0][0]["messages"],
        }
    for row in found.values():
        row["samples_a_second"] = 1e3 * row["samples"] / row["milliseconds"]
        row["cpu_nanoseconds_a_sample"] = 1e6 * row["cpu_milliseconds"] / row["samples"]
    alone = [row for row in ranks[0] if row["way"] == "exchange alone"]
    full, empty = (statistics.median(row[name] for row in alone) for name in ("seconds", "empty"))
    found["link"] = {
        "gigabytes_a_second": alone[0]["bytes"] / max(full - empty, 1e-9) / 1e9,
        "empty_milliseconds": 1e3 * empty,
    }
    return found


def bytes_by_formula(away: float, backward: bool = True) -> float:
    """Bytes that a sample sends if a share ``away`` of samples is of other ranks' cells.

    Positions and directions there, four outputs back, and their gradients; no gradients of positions.
    """
    return away * (12 + 12 + 16 + (16 if backward else 0))


# Shares of work -------------------------------------------------------------------------------------------------------


def diagrams(points: Tensor, importance: Tensor, k: int, seed: int = 0) -> dict[str, VoronoiDiagram]:
    """Diagrams of k cells by name; k is a power of two, for the grid."""
    found = {}
    for method in ("transport", "published"):
        moved = balance(points, importance, k, method=method, generator=torch.Generator().manual_seed(seed))
        found[method] = VoronoiDiagram(moved.centres, weights=moved.power)
    low, high = points.amin(0), points.amax(0)
    sides = [1, 1, 1]
    while sides[0] * sides[1] * sides[2] < k:
        sides[int((torch.tensor(sides) / (high - low)).argmin())] *= 2
    axes = [low[i] + (torch.arange(n) + 0.5) / n * (high[i] - low[i]) for i, n in enumerate(sides)]
    found["regular grid"] = VoronoiDiagram(torch.cartesian_prod(*axes))
    generator = torch.Generator().manual_seed(seed)
    found["random"] = VoronoiDiagram(low + torch.rand(k, 3, generator=generator) * (high - low))
    return found


def load(diagram: VoronoiDiagram, points: Tensor, importance: Tensor | None = None) -> Tensor:
    """[k], the samples in each cell, or their importance."""
    weights = torch.ones(len(points)) if importance is None else importance.float()
    return torch.zeros(diagram.num_cells).index_add_(0, diagram.locate(points.float()).long(), weights)


def heaviest(loads: Tensor, bounds: tuple[int, ...]) -> float:
    """The load of the heaviest rank in units of the mean."""
    shares = torch.stack([part.sum() for part in loads.split(torch.tensor(bounds).diff().tolist())])
    return float(shares.max() / shares.mean())


def imbalance(options: Options) -> list[dict[str, Any]]:
    """Of diagrams with four cells a rank, medians over three seeds: as many cells for each rank, or by their load."""
    rows = []
    for path in options.samples:
        points, importance = load_samples(path)
        for ranks in options.parts:
            made = [diagrams(points, importance, 4 * ranks, seed) for seed in range(3)]
            for name in made[0]:
                row: dict[str, Any] = {"samples": path.parent.parent.name, "ranks": ranks, "diagram": name}
                for what, weights in (("samples", None), ("importance", importance)):
                    loads = [load(diagrams[name], points, weights) for diagrams in made]
                    even, dealt = deal_cells(torch.ones(4 * ranks), ranks), [deal_cells(own, ranks) for own in loads]
                    row[f"{what}, even"] = statistics.median(heaviest(own, even) for own in loads)
                    row[f"{what}, dealt"] = statistics.median(map(heaviest, loads, dealt))
                rows.append(row)
    return rows


# Model ----------------------------------------------------------------------------------------------------------------


def modelled(
    ranks: int, samples: int, seconds: tuple[float, float], uneven: float, cells: int, link: float, message: float
) -> dict[str, float]:
    """A step with so many samples on each rank.

    Args:
        ranks: Of them.
        samples: Of each rank.
        seconds: What a rank needs for each sample: to compute, and to sort, pack and unpack.
        uneven: The load of the heaviest rank in units of the mean.
        cells: Of all ranks; each call says how many samples each gets.
        link: Bytes a second that a rank sends.
        message: Seconds that it needs to begin a message to one other.
    """
    away = (ranks - 1) / ranks
    sent = samples * uneven * bytes_by_formula(away) + 8 * (cells + 2 * ranks) * away
    step = samples * uneven * sum(seconds) + sent / link + 4 * (ranks - 1) * message
    return {"milliseconds": 1e3 * step, "percent": 100 * samples * seconds[0] / step, "megabytes": sent / 1e6}


def model(options: Options, measured: dict[str, Any], shares: list[dict[str, Any]]) -> dict[str, Any]:
    """What the measured ranks should take, and what more of them would; packing is told from the weak steps."""
    compute, weak = (1e-9 * measured[way]["cpu_nanoseconds_a_sample"] for way in (WAYS[0], WAYS[3]))
    seconds, checked = (compute, weak - compute), []

    def check(way: str, expected: float, known: float) -> None:
        checked.append({"way": way, "modelled": expected, "measured": known, "ratio": known / expected})

    check("two ranks, strong, CPU time", 1e3 * options.count * weak, measured[WAYS[2]]["cpu_milliseconds"])
    link, empty = 1e9 * measured["link"]["gigabytes_a_second"], 1e-3 * measured["link"]["empty_milliseconds"]
    for way, n in ((WAYS[2], options.count // 2), (WAYS[3], options.count)):
        step = modelled(2, n, seconds, 1, options.cells, link, empty)
        check(f"{way}, clock", step["milliseconds"], measured[way]["milliseconds"])
    transport = [row for row in shares if row["diagram"] == "transport" and row["ranks"] == max(options.parts)]
    uneven = statistics.mean(row["samples, dealt"] for row in transport)
    faster = compute / options.faster, (weak - compute) / options.faster
    rows = []
    for gigabytes in options.links:
        for ranks in MODELLED:
            step = modelled(ranks, options.batch, faster, uneven, 4 * ranks, 1e9 * gigabytes, options.message)
            rows.append({"ranks": ranks, "link": gigabytes, "uneven": uneven, **step})
    return {"checked": checked, "extrapolated": rows}


def main(options: Options) -> None:
    """Measures, models, prints and stores."""
    measured = measure(options)
    shares = imbalance(options)
    rows = [{"way": way, **row} for way, row in measured.items()]
    results = {"measured": rows, "imbalance": shares, **model(options, measured, shares)}
    for name, entries in results.items():
        print(name, *entries, sep="\n  ")
    if options.json is not None:
        samples = [path.parent.parent.name for path in options.samples]
        given = {"count": options.count, "cells": options.cells, "width": options.width, "samples": samples}
        assumed = {"faster": options.faster, "batch": options.batch, "message": options.message}
        facts = metadata(benchmark="scaling", **given, modelled=assumed, load=os.getloadavg())
        write_text(options.json, json.dumps({"metadata": facts, "results": results}, indent=1) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options))
