"""Timings of ``gpu_parts.py``: kernels at full size, beside the machine's own limits and what else does their work."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import itertools
import os
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

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

    def network(name: str, k: int, backward: bool, precision: str = "bfloat16") -> Run:
        if where.type == "cuda":
            torch.cuda.empty_cache()
        kind = torch.float32 if precision == "tf32" else getattr(torch, precision)
        batch = make_batch(NETS[name], n, k, kind, BACKWARD, where)
        options = {"layers": batch.net, "directions": batch.directions, "direction_index": batch.direction_index}
        given = batch.positions[0], batch.offsets, batch.weights, batch.biases

        def run() -> None:
            torch.backends.cuda.matmul.allow_tf32 = precision == "tf32"
            with torch.set_grad_enabled(backward):
                result = voronerf.grouped_mlp(*given, **options, backend="native")
                if backward:
                    torch.autograd.grad(result, [*batch.weights, *batch.biases], batch.gradients[1].to(result.dtype))

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
        row(f"{name} k={k} forward + backward", both, "bfloat16", both_work, both_aim)
    # The same programs in the other precisions; tensor cores multiply tf32 half as fast as 16 bits.
    price = cost(NETS["w64d4"])
    for precision, limit, factor in (("float16", "bfloat16", 1), ("tf32", "bfloat16", 2), ("float32", "float32", 1)):
        for backward in (False, True):
            run = functools.partial(network, "w64d4", 16, backward, precision)
            work = factor * (price.forward + price.backward * backward) * n
            row(f"w64d4 k=16 {precision} forward{' + backward' * backward}", run, limit, work)
    return rows.measure()


def products(n: int, k: int, where: Any, grouped: bool) -> Run:
    """The layers of w64d4 as torch's products, over cells of one size."""
    import torch
    from ops.networks import NETS

    share = n // k
    shapes = [(i + -i % 16, o + -o % 16) for o, i in NETS["w64d4"].weight_shapes(3)]  # multiples of 16 for _grouped_mm
    weights = [torch.randn(k, *shape, device=where, dtype=torch.bfloat16) for shape in shapes]
    first = torch.randn(k, share, shapes[0][0], device=where, dtype=torch.bfloat16)
    ends = torch.arange(1, k + 1, dtype=torch.int32, device=where) * share

    def run() -> Any:
        x = first.flatten(0, 1) if grouped else first
        for weight in weights:
            x = (torch._grouped_mm(x, weight, offs=ends) if grouped else torch.bmm(x, weight)).relu_()
        return x

    return run


def rivals(out: Path, again: Again, device: str = "cuda", n: int = 1 << 18) -> int:
    """The forward pass of w64d4 by other people's compilers and libraries; why one is left out, where it is."""
    import torch
    from ops.networks import NETS, cost

    rows = Rows(out, "rivals", again, device)
    where, work = rows.device, cost(NETS["w64d4"]).forward * n

    def compiled(options: dict[str, Any] | None) -> Run:
        return torch.compile(products(n, 16, where, False), options=options)

    def tiny() -> Run:
        shape = {"otype": "FullyFusedMLP", "activation": "ReLU", "output_activation": "None"}
        shape |= {"n_neurons": 64, "n_hidden_layers": 4}
        net = importlib.import_module("tinycudann").Network(64, 4, shape)
        x = torch.rand(n, 64, device=where).half()
        return torch.no_grad()(lambda: net(x))

    triton = {"max_autotune": True, "max_autotune_gemm_backends": "TRITON"}
    ways = (
        ("torch.compile", "triton", 16, functools.partial(compiled, None)),
        ("Triton", "triton", 16, functools.partial(compiled, triton)),
        ("tiny-cuda-nn", "tinycudann", 1, tiny),
    )
    for name, module, k, prepare in ways:
        title = f"w64d4 bfloat16 n={n} k={k} by {name}"
        reason = "not on CUDA" if where.type != "cuda" else f"no package {module}"
        if where.type == "cuda" and importlib.util.find_spec(module):
            rows.add(title, prepare, "bfloat16", work)
        elif not again.start:
            rows.journal.add("skipped", {"name": title, "reason": reason})
            print(f"left out  {title}: {reason}", flush=True)
    program = os.environ.get("VORONERF_TCNN")
    if program:  # a benchmark of tiny-cuda-nn that was built beforehand
        rows.cases.append(
            (program, lambda: subprocess.run([program], capture_output=True, text=True, check=True).stdout)
        )
    return rows.measure()


def sizes(
    out: Path,
    again: Again,
    device: str = "cuda",
    samples: Sequence[int] = (1 << 13, 1 << 15, 1 << 18, 1 << 22),
    cells: Sequence[int] = (1, 16, 256, 4096),
) -> int:
    """A network of four layers of 64 at many sizes, in all precisions; beside it the same layers as torch's products
    over cells of one size, which need neither a sort nor offsets."""
    import torch
    from ops.case import BACKWARD
    from ops.networks import NETS, cost, make_batch

    import voronerf

    rows = Rows(out, "sizes", again, device)
    where, net = rows.device, NETS["w64d4"]
    price = cost(net)

    def network(n: int, k: int, precision: str, backward: bool) -> Run:
        kind = torch.float32 if precision == "tf32" else getattr(torch, precision)
        batch = make_batch(net, n, k, kind, BACKWARD, where)
        given = batch.positions[0], batch.offsets, batch.weights, batch.biases

        def run() -> None:
            torch.backends.cuda.matmul.allow_tf32 = precision == "tf32"
            with torch.set_grad_enabled(backward):
                result = voronerf.grouped_mlp(*given, layers=net, backend="native")
                if backward:
                    torch.autograd.grad(result, [*batch.weights, *batch.biases], batch.gradients[1].to(result.dtype))

        return run

    for n in samples:
        for k in cells:
            for precision in ("bfloat16", "float16", "tf32", "float32") if k == 16 else ("bfloat16", "float32"):
                limit = "float32" if precision == "float32" else "bfloat16"
                for backward in (False, True):
                    name = f"w64d4 {precision} n={n} k={k}{' + backward' * backward}"
                    work = (price.forward + price.backward * backward) * n
                    rows.add(name, functools.partial(network, n, k, precision, backward), limit, work)
            ours = f"w64d4 bfloat16 n={n} k={k}"
            plain, grouped = (functools.partial(products, n, k, where, of) for of in (False, True))
            rows.add(f"{ours} by torch.bmm", plain, "bfloat16", price.forward * n)
            if where.type == "cuda" and hasattr(torch, "_grouped_mm"):
                rows.add(f"{ours} by torch._grouped_mm", grouped, "bfloat16", price.forward * n)
    return rows.measure()


def profile(out: Path, again: Again, device: str = "cuda", steps: int = 10) -> int:
    """Launches of a default step, the share of the time in which the device works, and how often the host waits."""
    import time
    import warnings

    import torch
    from torch.profiler import ProfilerActivity
    from torch.profiler import profile as profiled

    from voronerf.app.scenes import load_scene
    from voronerf.app.train import TrainConfig, build
    from voronerf.app.train import train as steps_of
    from voronerf.nerf.schedule import WARMUP_STEPS

    journal, cuda = Journal(out, "profile", begun=again.start > 0), device == "cuda"
    scene = load_scene("builtin")

    def train(name: str, options: dict[str, Any]) -> str:
        config = TrainConfig(device=device, steps=10_000, cells=(16,), evaluations=1, **options)
        state, settle = build(config, scene), settling(device)

        def train_steps(count: int) -> None:
            """A second of this clock is a step."""
            steps_of(state, until=state.seconds + count, clock=itertools.count().__next__)

        train_steps(WARMUP_STEPS + 2 * steps)  # until the grid learns
        settle()
        with warnings.catch_warnings(record=True) as waits:
            warnings.simplefilter("always")
            if cuda:
                torch.cuda.set_sync_debug_mode("warn")
            begin = time.perf_counter()
            train_steps(steps)
            if cuda:
                torch.cuda.set_sync_debug_mode("default")
            settle()
            seconds = (time.perf_counter() - begin) / steps
        with profiled(activities=[ProfilerActivity.CUDA if cuda else ProfilerActivity.CPU]) as seen:
            train_steps(steps)
            settle()
        kernels = [event for event in seen.events() if event.device_type == torch.autograd.DeviceType.CUDA]
        row = {
            "name": name,
            "seconds": seconds,
            "nanoseconds": 1e9 * seconds / (state.rays * state.config.samples[0]),
            "launches": len(kernels) // steps,
            "waits": sum("synchroniz" in str(warning.message) for warning in waits) // steps,
            "busy": sum(event.device_time for event in kernels) / 1e6 / steps / seconds,
            "kernels": sorted({event.name for event in kernels}),
        }
        journal.add("steps", row)
        return (
            f"{1e3 * seconds:.3f} ms, {row['launches']} launches, {row['waits']} waits, busy {100 * row['busy']:.0f} %"
        )

    kinds: dict[str, dict[str, Any]] = {"default": {}, "default, 4,096 rays": {"rays": 4096}}
    kinds["default, 4,096 rays, bf16"] = {"rays": 4096, "precision": "bf16"}
    if not cuda:
        kinds = {"default": {"rays": 32, "samples": (8,), "width": 16}}
    cases: list[Case] = [(name, functools.partial(train, name, options)) for name, options in kinds.items()]
    return one_by_one(cases, again, settling(device), journal)


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
    compare(f"render_loss b={rays} m={n}", functools.partial(loss_work, rays, n), "activations, composite, mse_loss")
    compare(f"observe_occupancy m={n}", functools.partial(observe_work, n), "torch, as nerfacc")
    for entries, touched in ((n >> 4, 1.0), (n, 1 / 64)):
        name = f"adam {2 * entries} numbers, {touched:.0%} with a gradient"
        compare(name, functools.partial(adam_work, entries, touched), "torch.optim.Adam, fused")
    for direction in (FORWARD, BACKWARD):
        for log2_entries in (15, 19):
            name = f"hash_encode 8 x 2^{log2_entries} x 2 n={hashed} {direction}"
            encoded = functools.partial(hash_work, hashed, log2_entries, direction, False)
            compare(name, encoded, "torch, indexing", "torch, F.embedding_bag")
        inside = functools.partial(network_work, hashed, direction)
        for half in (False, True):
            name = f"hash + MLP n={hashed} {direction}{', bfloat16' * half}"
            compare(name, inside, "native, encoded before", half=half)
    return rows.measure()


def warp(out: Path, again: Again, device: str = "cuda", n: int = 1 << 18) -> int:
    """Every op that Warp has a kernel of, at n rows: native, then Warp, which must give the same; both are launched.

    The first call of a file of kernels compiles it.
    """
    import torch
    from torch import Tensor
    from torch.utils._pytree import tree_leaves, tree_map_only

    from voronerf import ops
    from voronerf.ops._core import backends
    from voronerf.ops._core.cases import Draw, cases

    rows = Rows(out, "warp", again, device)

    @functools.lru_cache(maxsize=1)
    def given(op: str) -> dict[str, Any]:
        case = cases()[op]
        made = case.make(Draw(n, **next(iter(case.kinds.values()))), n)
        return {name: tree_map_only(Tensor, lambda part: part.to(device), part) for name, part in made.items()}

    def tensors(found: Any) -> list[Tensor]:
        return [part for part in tree_leaves(found) if isinstance(part, Tensor)]

    def prepare(op: str, backend: str) -> Run:
        call = functools.partial(getattr(ops, cases()[op].call or op), **given(op), backend=backend)
        if backend == "warp" and not cases()[op].in_place:
            for part, right in zip(tensors(call()), tensors(call.func(**{**call.keywords, "backend": "native"}))):
                size = float(right.abs().max()) if right.is_floating_point() and right.numel() else 0.0
                torch.testing.assert_close(part, right, rtol=1e-3, atol=1e-3 * size)
        return call

    def size(op: str) -> float:
        return float(sum(part.nbytes for part in tensors(given(op))))

    for op in cases():
        if "warp" in backends.implemented(op):
            for backend in ("native", "warp"):
                name = f"{op} n={n}" + " by Warp" * (backend == "warp")
                prepared = functools.partial(prepare, op, backend)
                rows.add(name, prepared, "copy", functools.partial(size, op), captured=False)
    return rows.measure()
