"""Timings of ``gpu_parts.py``: kernels at full size, compared with peak rates and with torch's matrix products."""

from __future__ import annotations

import functools
import itertools
import statistics
import time
import warnings
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from gpu_journal import Case, Journal, settling

SECONDS = 1.5
"""The seconds of a row; a single slow call may take longer."""
MOST_CALLS, MOST_REPEATS = 8, 30
"""Maximum number of calls in a graph, and of timings of a row."""
LIMITS = ("bfloat16", "float32", "copy")
SETS = 4
"""The number of input sets of a lookup, which its calls use in turn; a sort has four times as many sets.

All sets together exceed a GPU's caches."""
HOPPER = {"bfloat16": 989e12, "float32": 67e12, "copy": 3.35e12, "issue": 4 * 132 * 1.98e9}
"""Peak rates of an H100 by its data sheet, used for the emulated device: operations, bytes, and warp instructions a
second."""

Run = Callable[[], Any]
Work = dict[str, float]
"""The operations or bytes of a call, by the name of the peak rate that they are compared with."""


def clock(run: Run, device: Any, seconds: float) -> dict[str, Any]:
    """Returns the seconds of a call on the device, both in a replayed graph of several calls and launched by the host.

    A short kernel runs faster than the host launches it, hence the graph. Slow calls, and calls that cannot be
    captured, are only launched. Times are medians of the timings within ``seconds``.
    """
    import torch
    from harness import Stopwatch

    from voronerf.ops._core.capture import Capture

    stopwatch = Stopwatch(device)

    def middle(work: Run, calls: int, budget: float) -> tuple[float, int]:
        times = [stopwatch(lambda _: work(), 0, 1)]
        for _ in range(min(MOST_REPEATS, max(0, int(budget / max(times[0], 1e-6)) - 1))):
            times.append(stopwatch(lambda _: work(), 0, 1))
        return statistics.median(times) / calls, len(times)

    run()  # the first call compiles and loads kernels
    launched, repeats = middle(run, 1, seconds / 3)
    timing: dict[str, Any] = {"seconds": launched, "launched": launched, "repeats": repeats}
    calls = min(MOST_CALLS, int(seconds / 12 / launched))
    if calls < 1:
        return timing
    graph = Capture(device, torch.Generator(device))
    graph.warm_up(run)
    if graph.obstacle is not None:
        return {**timing, "graph": graph.obstacle}
    graph.capture(lambda: [run() for _ in range(calls)])
    replayed, repeats = middle(lambda: graph.replay(1), calls, seconds / 2)
    return {**timing, "seconds": replayed, "repeats": repeats, "graph": f"{calls} calls"}


def rows(device: str, journal: Journal, n: int = 1 << 22, fewer: int = 1 << 18, seconds: float = SECONDS) -> list[Case]:
    """Returns the cases, the largest first: peak rates, networks, lookups, sorts, and the other ops of a step."""
    import torch
    from harness import _cuda_peak
    from ops.case import BACKWARD, FORWARD
    from ops.case import Work as Prepared
    from ops.cases_hash import hash_work, network_work
    from ops.cases_step import adam_work, loss_work
    from ops.networks import NETS, cost, make_batch

    import voronerf
    from voronerf.ops.cell_sort.native import sort as sort_cells

    where, cases = torch.device(device), list[Case]()

    def limits() -> str:
        """Measures operations and bytes a second in torch, and computes the peak rate of warp instructions."""
        rates = dict(HOPPER)
        if device == "cuda":
            card = torch.cuda.get_device_properties(where)
            rates = {kind: _cuda_peak(kind, where) for kind in LIMITS}
            rates["issue"] = 4 * card.multi_processor_count * 1e3 * card.clock_rate
        journal.put("limits", rates)
        return ", ".join(f"{kind} {value / 1e12:.2f} T/s" for kind, value in rates.items())

    def row(name: str, prepare: Callable[[], tuple[Run, Work]], counted: Work | None = None) -> None:
        """Adds a row; ``counted`` is the number of warp instructions, or of bytes that the kernels actually move."""

        def case() -> dict[str, Any]:
            if device == "cuda":
                torch.cuda.empty_cache()
            run, work = prepare()
            times, known = clock(run, where, seconds), journal.found.get("limits", {})
            found = {**times, "work": work, "counted": counted, "said": f"{1e3 * times['seconds']:.3f} ms"}
            floors = {limit: amount / known[limit] for limit, amount in work.items() if limit in known}
            if not floors:
                return found
            limit = max(floors, key=lambda kind: floors[kind])
            share = floors[limit] / times["seconds"]
            said = f"{found['said']} ({1e3 * times['launched']:.3f} launched), {100 * share:.1f} % of {limit}"
            most = None
            if counted is not None:
                most = floors[limit] / max(floors[limit], *(amount / known[of] for of, amount in counted.items()))
                said += f", at most {100 * most:.0f} % by count"
            return {**found, "limit": limit, "floor": floors[limit], "share": share, "most": most, "said": said}

        cases.append(Case("rows", name, case, 30.0))

    def network(name: str, k: int, m: int, precision: str, backward: bool) -> tuple[Run, Work]:
        kind = torch.float32 if precision == "tf32" else getattr(torch, precision)
        batch, price = make_batch(NETS[name], m, k, kind, BACKWARD, where), cost(NETS[name])
        options = {"layers": batch.net, "directions": batch.directions, "direction_index": batch.direction_index}
        arguments = batch.positions[0], batch.offsets, batch.weights, batch.biases

        def run() -> None:
            before = torch.backends.cuda.matmul.fp32_precision
            torch.backends.cuda.matmul.fp32_precision = "tf32" if precision == "tf32" else "ieee"
            try:
                with torch.set_grad_enabled(backward):
                    result = voronerf.grouped_mlp(*arguments, **options, backend="native")
                    if backward:
                        torch.autograd.grad(result, batch.parameters, batch.gradients[1].to(result.dtype))
            finally:
                torch.backends.cuda.matmul.fp32_precision = before

        # Tensor cores multiply tf32 at half the rate of 16 bits.
        operations = (price.forward + price.backward * backward) * m * (2 if precision == "tf32" else 1)
        moved = m * (12.0 + batch.net.out_features * kind.itemsize) * (1 + backward)
        return run, {"float32" if precision == "float32" else "bfloat16": operations, "copy": moved}

    def products(k: int, m: int, grouped: bool) -> tuple[Run, Work]:
        """Returns a function that computes w64d4's layers by torch's matrix products, and its work.

        Cells have equal sizes, and inputs are already sorted and encoded.
        """
        # Multiples of 16, for _grouped_mm.
        shapes = [(i + -i % 16, o + -o % 16) for o, i in NETS["w64d4"].weight_shapes(3)]
        options: dict[str, Any] = {"dtype": torch.bfloat16, "device": where}
        weights = [torch.randn(k, *shape, **options) / shape[0] ** 0.5 for shape in shapes]
        first = torch.rand(k, m // k, shapes[0][0], **options)
        ends = torch.arange(1, k + 1, dtype=torch.int32, device=where) * (m // k)

        def run() -> Any:
            x = first.flatten(0, 1) if grouped else first
            for weight in weights:
                x = (torch._grouped_mm(x, weight, offs=ends) if grouped else torch.bmm(x, weight)).relu_()
            return x

        # Every layer reads and writes its activations in memory.
        return run, {"bfloat16": cost(NETS["w64d4"]).forward * m, "copy": 2.0 * m * sum(map(sum, shapes))}

    def find(k: int, m: int, indexed: bool) -> tuple[Run, Work]:
        centres = torch.rand(k, 3, device=where)
        index = voronerf.ops.index_centres(centres) if indexed else None
        sets = itertools.cycle([torch.rand(m, 3, device=where) for _ in range(SETS)])
        work = {"copy": 16.0 * m} if indexed else {"float32": 8.0 * k * m, "copy": 16.0 * m}
        return lambda: voronerf.nearest_centre(next(sets), centres, index=index, backend="native"), work

    def sort(k: int, way: str) -> tuple[Run, Work]:
        sets = [torch.randint(0, k, (n,), dtype=torch.int32, device=where) for _ in range(4 * SETS)]
        order, offsets = torch.empty_like(sets[0]), sets[0].new_empty(k + 1)
        turns = itertools.cycle(sets)
        return lambda: sort_cells(next(turns), order, offsets, "cell_sort", way), {"copy": 8.0 * n}

    def prepared(build: Callable[[torch.device], Prepared]) -> tuple[Run, Work]:
        made, calls = build(where), itertools.count()
        run = made.ours("native").run
        work = {made.bound: made.amount, **({} if made.moved is None else {"copy": made.moved})}
        return lambda: run(next(calls)), work

    def networks(name: str, k: int, m: int, precision: str, counted: Work | None = None) -> None:
        title = f"{name} {precision} k={k} n={m}"
        row(title, functools.partial(network, name, k, m, precision, False), counted)
        row(f"{title} + backward", functools.partial(network, name, k, m, precision, True))

    def tiles(m: int) -> Work:
        """Returns the warp instructions of w64d4 in 16 bits: about 2,600 for 32 samples, by the machine code."""
        return {"issue": 2600.0 * m / 32}

    cases.append(Case("rows", "limits", limits, 30.0))
    networks("w64d4", 16, n, "bfloat16", tiles(n))
    row(f"w64d4 bfloat16 k=16 n={n} by torch.bmm", functools.partial(products, 16, n, False))
    for k in (512, 16):
        # A warp issues 101 instructions for 2 points and 4 centres in the loop, and about 60 per point outside it.
        row(f"nearest_centre k={k} n={n}", functools.partial(find, k, n, False), {"issue": (k * 101 / 8 + 60) * n / 32})
    for k in (4096, 65_536):
        row(f"nearest_centre k={k} n={fewer}", functools.partial(find, k, fewer, False))
        row(f"nearest_centre k={k} n={fewer} by index", functools.partial(find, k, fewer, True))
    # Counting sort reads the cells twice and writes row indices. Radix sort reads the cells, writes 2-byte keys and row
    # indices, reads the keys for a histogram, and then reads and writes keys and row indices once per 8-bit digit.
    for k, way, moved in ((16, "counting", 12), (16, "radix", 24), (4096, "radix", 36)):
        row(f"cell_sort k={k} n={n} by {way}", functools.partial(sort, k, way), {"copy": float(moved * n)})
    networks("w64d4", 16, fewer, "bfloat16", tiles(fewer))
    row(f"w64d4 bfloat16 k=16 n={fewer} by torch.bmm", functools.partial(products, 16, fewer, False))
    row(f"w64d4 bfloat16 k=16 n={fewer} by torch._grouped_mm", functools.partial(products, 16, fewer, True))
    for precision in ("tf32", "float32"):
        networks("w64d4", 16, fewer, precision)
    row(f"mlp32 bfloat16 k=256 n={fewer} + backward", functools.partial(network, "mlp32", 256, fewer, "bfloat16", True))
    nerf64 = functools.partial(network, "nerf64", 16, fewer, "bfloat16", True)
    row(f"nerf64 bfloat16 k=16 n={fewer} + backward", nerf64)
    for direction in (FORWARD, BACKWARD):
        name = f"hash_encode 8 x 2^19 x 2 n={4 * fewer} {direction}"
        row(name, functools.partial(prepared, functools.partial(hash_work, 4 * fewer, 19, direction, False)))
    for direction in (FORWARD, BACKWARD):
        name = f"hash + MLP n={fewer} {direction}"
        row(name, functools.partial(prepared, functools.partial(network_work, fewer, direction)))
    row(f"adam {32 * fewer} numbers", functools.partial(prepared, functools.partial(adam_work, 16 * fewer, 1.0)))
    rays = n >> 6
    row(f"render_loss b={rays} m={n}", functools.partial(prepared, functools.partial(loss_work, rays, n)))
    return cases


def counted(device: str, n: int = 1 << 18) -> list[tuple[str, Run, Run]]:
    """Returns the launches that ncu counts, one kernel each: (name, function that prepares the launch, launch)."""
    import torch
    from ops.case import BACKWARD
    from ops.networks import NETS, make_batch

    import voronerf

    where = torch.device(device)
    grid = voronerf.HashGrid(levels=8, features=2, log2_entries=19, base=16, finest=256)
    x = torch.rand(n, 3, device=where)
    table = torch.randn(grid.table_shape, device=where).requires_grad_()
    launches: list[tuple[str, Run, Run]] = []
    kinds = (("w64d4", torch.bfloat16, True), ("nerf64", torch.bfloat16, False), ("w64d4", torch.float32, False))
    for name, precision, backward in kinds:
        batch = make_batch(NETS[name], n, 16, precision, BACKWARD, where)
        options = {"layers": batch.net, "directions": batch.directions, "direction_index": batch.direction_index}
        arguments = batch.positions[0], batch.offsets, batch.weights, batch.biases
        forward = functools.partial(voronerf.grouped_mlp, *arguments, **options, backend="native")
        launches += _pair(f"{name} {precision}".replace("torch.", ""), forward, batch.parameters, backward)
    launches += _pair("hash_encode", lambda: voronerf.hash_encode(x, table, grid, backend="native"), [table], True)
    return launches


def _pair(name: str, forward: Run, leaves: list[Any], backward: bool) -> list[tuple[str, Run, Run]]:
    """Returns the launches of a forward pass, and of a backward pass prepared by another forward pass."""
    import torch

    held = list[Any]()

    def before() -> None:
        held[:] = [forward()]

    def back() -> Any:
        return torch.autograd.grad(held[0], leaves, torch.ones_like(held[0]), retain_graph=True)

    return [(name, before, forward), *([(f"{name}, backward", before, back)] if backward else [])]


def profile(scene: Any, device: str, seconds: float = 0.5, **small: Any) -> list[Case]:
    """Returns the cases that profile trainings: launches, device utilisation, host waits, and the slowest kernels."""
    kinds: dict[str, dict[str, Any]] = {"default": {}, "4,096 rays, bf16": {"rays": 4096, "precision": "bf16"}}
    return [
        Case("profile", name, functools.partial(_profile, scene, device, seconds, {**options, **small}), 30.0)
        for name, options in kinds.items()
    ]


def _profile(scene: Any, device: str, seconds: float, options: dict[str, Any]) -> dict[str, Any]:
    import torch
    from torch.profiler import ProfilerActivity
    from torch.profiler import profile as profiled

    from voronerf.app.train import TrainConfig, build, train
    from voronerf.nerf.schedule import WARMUP_STEPS

    cuda, settle = device == "cuda", settling(device)
    settings: dict[str, Any] = {"steps": 100_000, "cells": (16,), "split_at": (WARMUP_STEPS + 16,), "evaluations": 1}
    state = build(TrainConfig(device=device, **{**settings, **options}), scene)

    def more() -> tuple[float, int]:
        """Continues the training; returns seconds per step and the number of steps."""
        begin, before = time.perf_counter(), state.step
        train(state, until=state.seconds + seconds)
        settle()
        made = state.step - before
        return (time.perf_counter() - begin) / made, made

    while state.step < (WARMUP_STEPS + 64 if cuda else 1):  # until the occupancy grid learns and the cells are split
        more()
    seconds_a_step = more()[0]
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            watched = more()[1]
        finally:
            torch.cuda.set_sync_debug_mode("default")
    activities = [ProfilerActivity.CUDA if cuda else ProfilerActivity.CPU]
    # Steps run in a second thread, because steps in a profiled thread run eagerly. The profiler records the work that
    # all threads launch on the device.
    with profiled(activities=activities) as seen, ThreadPoolExecutor(1) as beside:
        steps = beside.submit(more).result()[1]
    times, counts = Counter[str](), Counter[str]()
    for event in seen.events():
        if event.device_type == torch.autograd.DeviceType.CUDA:
            times[event.name] += event.device_time
            counts[event.name] += 1
    waits = sum("synchroniz" in str(warning.message) for warning in told) / watched
    launches, busy = counts.total() / steps, sum(times.values()) / 1e6 / steps / seconds_a_step
    said = f"{1e3 * seconds_a_step:.3f} ms, {launches:.1f} launches, {waits:.2f} waits, busy {100 * busy:.0f} %"
    how = state.training_step.explain()
    kernels = [
        {"name": name, "microseconds": spent / steps, "launches": counts[name] / steps}
        for name, spent in times.most_common()
    ]
    found = {
        "seconds": seconds_a_step,
        "samples": state.rays * state.config.samples[0],
        "cells": state.router.num_cells,
    }
    found |= {"launches": launches, "waits": waits, "busy": busy, "kernels": kernels}
    return {**found, "explained": how, "said": f"{said}, {state.router.num_cells} cells, {how}"}
