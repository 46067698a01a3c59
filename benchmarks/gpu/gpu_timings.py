"""Timings of ``gpu_parts.py``: kernels at full size, beside the machine's own limits and what else does their work."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gpu_cases import has_wgmma
from gpu_journal import Again, Case, Journal, one_by_one, settling

N = 1 << 22
"""Samples of the timings, as the targets have them."""
HASHED = 1 << 20
"""Samples at most of a hash grid: torch holds some kilobytes for each of them."""
CALLS = 8
"""Of a timing, in one graph."""
SETS = 4
"""Of the points of look-ups, and a quarter of those of sorts: with the results more than the caches of a GPU hold."""

Run = Callable[[], Any]


class Rows:
    """The rows of a part, each a case of its own; the limits of the machine are measured by its first process."""

    def __init__(self, out: Path, part: str, again: Again, device: str) -> None:
        import torch
        from harness import Stopwatch, _cuda_peak

        self.device, self.again = torch.device(device), again
        self.journal = Journal(out, part, begun=again.start > 0)
        if not again.start:
            kinds = ("bfloat16", "float32", "copy")
            self.journal.put("limits", {kind: _cuda_peak(kind, self.device) for kind in kinds})
            told = (f"{kind} {value / 1e12:.2f} T/s" for kind, value in self.journal.found["limits"].items())
            print("limits: " + ", ".join(told), flush=True)
        self.stopwatch = Stopwatch(self.device)
        self.cases: list[Case] = []

    def add(
        self,
        name: str,
        prepare: Callable[[], Run],
        limit: str,
        work: float | Callable[[], float],
        aim: float | None = None,
        *,
        captured: bool = True,
    ) -> None:
        """Times what ``prepare()`` returns, against ``work`` operations or bytes at the machine's ``limit``."""

        def case() -> str:
            run = prepare()
            amount = work() if callable(work) else work
            times = clock(run, self.stopwatch, captured=captured)
            floor = amount / self.journal.found["limits"][limit]
            share = floor / times["seconds"]
            row = {"name": name, **times, "limit": limit, "work": amount, "floor": floor, "share": share, "aim": aim}
            self.journal.add("rows", row)
            aimed = "" if aim is None else f", aimed at {100 * aim:.0f} %: {'reached' if share >= aim else 'MISSED'}"
            alone = f"({1e3 * times['launched']:.3f} launched, {times['graph']})"
            least = f"{amount / 1e6:.1f} M{'B' if limit == 'copy' else 'op'}, at the least {1e3 * floor:.3f} ms"
            return f"{1e3 * times['seconds']:.3f} ms {alone}, {100 * share:.1f} % of {limit} ({least}){aimed}"

        self.cases.append((name, case))

    def measure(self) -> int:
        """Every row; the number of those that failed."""
        return one_by_one(self.cases, self.again, settling(self.device.type), self.journal)


def clock(run: Run, stopwatch: Any, repeats: int = 7, *, captured: bool = True) -> dict[str, Any]:
    """Seconds of a call on the device, several replayed as one graph, and of one that the host launches.

    A kernel of some microseconds waits longer for the host than it takes. Where calls are not ``captured``, or cannot
    be, the reason is kept, and both are seconds of a call that is launched.
    """
    import torch

    def middle(work: Run, calls: int) -> float:
        times = [stopwatch(lambda _: work(), 0, 1) / calls for _ in range(repeats + 2)]
        return sorted(times[2:])[repeats // 2]

    launched = middle(run, 1)
    found = {"seconds": launched, "launched": launched, "graph": "no graph" if stopwatch.cuda else "not on CUDA"}
    if not stopwatch.cuda or not captured:
        return found
    try:
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            run()
        torch.cuda.current_stream().wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            for _ in range(CALLS):
                run()
        return {"seconds": middle(graph.replay, CALLS), "launched": launched, "graph": "captured"}
    except Exception as error:
        return {**found, "graph": f"{type(error).__name__}: {error}"[:200]}


def roofs(out: Path, again: Again, device: str = "cuda", n: int = N) -> int:
    """Milliseconds at full size, what that is of the machine's own limit, and what was aimed at."""
    import torch
    from ops.case import BACKWARD
    from ops.networks import NETS, cost, make_batch

    import voronerf
    from voronerf.ops.cell_sort.native import sort as sort_cells
    from voronerf.ops.grouped_mlp.native import using_way

    rows = Rows(out, "roofs", again, device)
    where, row = rows.device, rows.add

    def find(k: int) -> Run:
        centres = torch.rand(k, 3, device=where)
        sets = itertools.cycle([torch.rand(n, 3, device=where) for _ in range(SETS)])
        return lambda: voronerf.nearest_centre(next(sets), centres, backend="native")

    def sort(k: int, way: str) -> Run:
        sets = [torch.randint(0, k, (n,), dtype=torch.int32, device=where) for _ in range(4 * SETS)]
        if way == "torch.sort":
            kind = torch.uint8 if k <= 256 else torch.int16 if k <= 1 << 15 else torch.int32
            keys = itertools.cycle([cells.to(kind) for cells in sets])
            return lambda: torch.sort(next(keys), stable=True)
        order, offsets = torch.empty_like(sets[0]), sets[0].new_empty(k + 1)
        given = itertools.cycle(sets)
        return lambda: sort_cells(next(given), order, offsets, "cell_sort", way)

    def network(name: str, k: int, backward: bool, way: str = "auto") -> Run:
        if where.type == "cuda":
            torch.cuda.empty_cache()
        batch = make_batch(NETS[name], n, k, torch.bfloat16, BACKWARD, where)
        options = {"layers": batch.net, "directions": batch.directions, "direction_index": batch.direction_index}
        given = batch.positions[0], batch.offsets, batch.weights, batch.biases

        def run() -> None:
            with torch.set_grad_enabled(backward), using_way(way):
                result = voronerf.grouped_mlp(*given, **options, backend="native")
                if backward:
                    torch.autograd.grad(result, [*batch.weights, *batch.biases], batch.gradients[1])

        return run

    for k, limit, work, aim in ((16, "copy", 16.0 * n, 0.6), (512, "float32", 8.0 * 512 * n, 0.5)):
        row(f"nearest_centre k={k}", functools.partial(find, k), limit, work, aim)
    # Which way is the faster where; beside it torch's sort of the shortest keys, with numbers of rows in 64 bits.
    for k in (16, 256, 1022, 4096, 65_536):
        for way in (*(("counting", "radix") if k <= 1022 else ("radix",)), "torch.sort"):
            row(f"cell_sort k={k} by {way}", functools.partial(sort, k, way), "copy", 8.0 * n)
    aims = {"w64d4": 0.4, "nerf64": 0.4, "mlp32": 0.25}
    for name, k in (("w64d4", 16), ("nerf64", 16), ("mlp32", 256), ("nerf128", 16), ("nerf256", 16)):
        price = cost(NETS[name])
        forward, both = (functools.partial(network, name, k, backward) for backward in (False, True))
        both_work, both_aim = (price.forward + price.backward) * n, 0.25 if name == "nerf64" else None
        row(f"{name} k={k} forward", forward, "bfloat16", price.forward * n, aims.get(name))
        if name != "nerf256":
            # Which is the fastest: values in registers, as above, in shared memory, or in registers with products of
            # four warps, which are to become the way by themselves where this shows that they pay.
            for way in ("tiles", "wgmma") if has_wgmma(device) else ("tiles",):
                other = functools.partial(network, name, k, False, way)
                row(f"{name} k={k} forward by {way}", other, "bfloat16", price.forward * n)
        row(f"{name} k={k} forward + backward", both, "bfloat16", both_work, both_aim)
    return rows.measure()


def step(out: Path, again: Again, device: str = "cuda", n: int = N) -> int:
    """What surrounds the networks in a training step, and a network on a hash grid: the bytes that must be moved, the
    milliseconds that a copy of as many takes, and the same work in plain torch."""
    import torch
    from ops.case import BACKWARD, FORWARD, Work
    from ops.cases_hash import hash_work, network_work
    from ops.cases_step import adam_work, loss_work, observe_work, pixel_work

    rows = Rows(out, "step", again, device)
    hashed, rays = min(n, HASHED), n >> 6

    @functools.lru_cache(maxsize=1)
    def built(build: Callable[[torch.device], Work]) -> Work:
        """One at a time: they are large."""
        if rows.device.type == "cuda":
            torch.cuda.empty_cache()
        return build(rows.device)

    def amount(build: Callable[[torch.device], Work]) -> float:
        work = built(build)
        return work.amount if work.moved is None else work.moved

    def contender(build: Callable[[torch.device], Work], name: str, half: bool) -> Run:
        work = built(build)
        run = (work.ours("native") if name == "native" else work.alternatives[name]()).run
        calls = itertools.count()

        def call() -> Any:
            with torch.autocast(rows.device.type, torch.bfloat16, enabled=half):
                return run(next(calls))

        return call

    def compare(name: str, build: Callable[[torch.device], Work], *others: str, half: bool = False) -> None:
        """A row of the kernels and one of each alternative, which may wait for the device and is not captured."""
        size = functools.partial(amount, build)
        rows.add(name, functools.partial(contender, build, "native", half), "copy", size)
        for other in others:
            prepare = functools.partial(contender, build, other, half)
            rows.add(f"{name} by {other}", prepare, "copy", size, captured=False)

    compare(f"pixel_rays b={n}", functools.partial(pixel_work, n), "torch, rays by matmul")
    compare(f"render_loss b={rays} m={n}", functools.partial(loss_work, rays, n), "torch, sums over all samples")
    compare(f"observe_occupancy m={n}", functools.partial(observe_work, n), "torch, as nerfacc")
    for entries, touched in ((n >> 4, 1.0), (n, 1 / 64)):
        name = f"sparse_adam {2 * entries} numbers, {touched:.0%} with a gradient"
        compare(name, functools.partial(adam_work, entries, touched), "torch.optim.Adam, fused")
    for direction in (FORWARD, BACKWARD):
        for log2_entries in (15, 19):
            name = f"hash_encode 8 x 2^{log2_entries} x 2 n={hashed} {direction}"
            encoded = functools.partial(hash_work, hashed, log2_entries, direction, False)
            compare(name, encoded, "torch, indexing", "torch, F.embedding_bag")
        inside = functools.partial(network_work, hashed, direction)
        for half in (False, True):
            name = f"hash + MLP n={hashed} {direction}{', bfloat16' * half}"
            compare(name, inside, "native, encoded before", "torch, indexing, sort + loop", half=half)
    return rows.measure()
