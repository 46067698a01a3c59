"""Scaling of training with CPU cores: measured step times, the cost of a parallel region, and a model for more cores.

    OMP_WAIT_POLICY=passive GOMP_SPINCOUNT=1000 python benchmarks/cores.py --data DATA --json FILE

It takes three minutes on two idle cores. DATA holds the scenes lego and bonsai. `voronerf train` sets the two
environment variables itself (docs/kernels.md). The measured trainings run the same steps, in turns: on one thread and
on all cores; replayed (voronerf/nerf/step.py) and eager; and at the same time as a second training in another process.
The first quarter of the turns is not counted, because the split into cells happens there. The last steps of a training
are not counted, either.

The model starts from the processor time of one thread. Calls of the compiled module are traced in separate steps of
each turn (csrc/common/trace.h). For teams of 2, 8, 16 and 32 threads, the model assigns each chunk of items of a
parallel region to the thread that becomes idle first. All time outside parallel regions is serial: Python, torch's
operations, and the compiled module's code around its regions. The modelled step time is the serial time, plus the fixed
cost of each region, plus the time of the busiest thread or the time to move the step's bytes through memory, whichever
is longer.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import statistics
import time
from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import torch
from harness import Parser, metadata, threads

from voronerf.app.files import write_text
from voronerf.app.scenes import load_scene
from voronerf.app.train import Callback, TrainConfig, build, train
from voronerf.app.train.state import State
from voronerf.nerf.schedule import GROUP
from voronerf.ops._core import native
from voronerf.ops._core.recording import Recording

TEAMS = (2, 8, 16, 32)
REST = "Python and torch"
BANDWIDTHS = {"40": 40e9, "80": 80e9}
TURN = GROUP, 2 * GROUP, 4 * GROUP
"""The numbers of steps after which, in each turn, the trace (if any) begins, the timing begins, and the turn ends. The
first steps are not counted, because `train` takes milliseconds to start."""
LINE, SAMPLE_BYTES, ENTRY_BYTES, TAUGHT_BYTES = 16, 450, 8, 24
"""LINE is the number of parameters in a cache line. The others are bytes that a step moves: SAMPLE_BYTES per sample
(all arrays from its position to its gradients), ENTRY_BYTES per parameter (its gradient, written and read), and
TAUGHT_BYTES per parameter in a cache line that has a nonzero gradient (the value and two moments, read and written)."""
CALLS, SERIAL_US, TRIALS = 100, 40, 5
"""The number of parallel regions in the measured recording (a sequence of compiled calls that is replayed without
Python), the microseconds of serial work before each region, and the number of measurements, of which the fastest
counts."""


class Case(NamedTuple):
    """A measured training."""

    data: str
    downscale: int
    settings: dict[str, Any]
    picture: int | None = None  # downscale factor of the rendered picture; None: no picture


CASES = {
    "default": Case("lego", 4, {"steps": 1500}, 1),
    "bonsai": Case("bonsai", 2, {"steps": 500}),
    "nerf": Case("lego", 4, {"steps": 300, "field": "nerf"}),
}
QUICK = {"quick": Case("builtin:32", 1, {"steps": TURN[-1] + 2}, 1)}


class Way(NamedTuple):
    """A way to run the steps of a training."""

    threads: int
    replayed: bool = True
    beside: int = 0  # threads of the simultaneous second training


def ways(cores: int) -> dict[str, Way]:
    """Returns the compared ways to run the steps, by name."""
    return {
        "one thread": Way(1),
        "all cores": Way(cores),
        "one thread, as it is": Way(1, False),
        "all cores, as it is": Way(cores, False),
        "two at once, one thread each": Way(1, True, 1),
        "two at once, all cores each": Way(cores, True, cores),
    }


class Other(Callback):
    """A second training in another process; it restarts when it ends, and pauses while it has no threads."""

    def __init__(self, case: Case) -> None:
        context = multiprocessing.get_context("spawn")
        self.wanted, self.works = context.Value("i", 0), context.Value("i", 1)
        self.process = context.Process(target=self._train, args=(case, self.wanted, self.works), daemon=True)
        self.process.start()
        self.work(0)

    def work(self, count: int) -> None:
        """Waits until the second training runs on ``count`` threads; 0 pauses it."""
        self.wanted.value = count
        while self.works.value != count:
            if not self.process.is_alive():
                raise RuntimeError("the other training has failed")
            time.sleep(1e-3)

    @staticmethod
    def _train(case: Case, wanted: Any, works: Any) -> None:
        torch.set_num_threads(1)
        scene = load(case)

        class Wait(Callback):
            group = GROUP

            def after_step(self, state: State) -> None:
                while not wanted.value:
                    works.value = 0
                    time.sleep(1e-3)
                works.value = wanted.value
                torch.set_num_threads(wanted.value)

        while True:
            train(build(config(case), scene), [Wait()])


class Training(Callback):
    """A training that runs in turns, in one of the compared ways (`Way`)."""

    group = GROUP

    def __init__(self, case: Case, scene: Any, way: Way) -> None:
        self.way, self.state = way, build(config(case), scene)
        if not way.replayed:
            self.state.training_step._standing_obstacle = lambda: "it is timed"  # type: ignore[method-assign]
        self.ms: list[float] = []
        self.processor_ms: list[float] = []
        self.traced: list[dict[str, list[float]]] = []
        self._began, self._passed = 0, 0  # first step of the turn; number of passed marks of TURN
        self._since = 0, 0.0, 0.0  # step, wall and processor seconds at the last mark

    def turn(self, other: Other) -> None:
        """Runs the steps of a turn."""
        with threads(self.way.threads):
            other.work(self.way.beside)
            self._began, self._passed = self.state.step, 0
            self.state.clear_stop()
            train(self.state, [self])
            other.work(0)

    def after_step(self, state: State) -> None:
        """Stores the trace and the times of the turn's steps at the marks of TURN."""
        if state.step - self._began < TURN[self._passed]:
            return
        now = state.step, time.perf_counter(), time.process_time()
        steps, clock, processor = (to - at for to, at in zip(now, self._since, strict=True))
        if self._passed == 0:
            native.compiled.trace(self.way == Way(1, self.way.replayed))
        elif self._passed == 1:
            calls = native.compiled.trace(False)
            if calls:
                found = parts(processor, calls)
                self.traced.append({name: [value / steps for value in own] for name, own in found.items()})
        else:
            self.ms.append(1e3 * clock / steps)
            self.processor_ms.append(1e3 * processor / steps)
            state.stop()
        self._passed += 1
        self._since = state.step, time.perf_counter(), time.process_time()


def config(case: Case) -> TrainConfig:
    """Returns the settings of a training."""
    return TrainConfig(data=case.data, downscale=case.downscale, **case.settings)


def load(case: Case, downscale: int | None = None) -> Any:
    """Loads the scene of a training."""
    return load_scene(case.data, downscale=downscale or case.downscale)


def parts(seconds: float, calls: list[Any]) -> dict[str, list[float]]:
    """Returns the processor time of each compiled function, and of "Python and torch".

    Args:
        seconds: The processor seconds of some steps or of a picture.
        calls: The trace of the compiled calls in this time.

    Returns:
        For each name: total seconds, seconds in parallel regions, number of regions, and modelled total seconds on each
        team of TEAMS.
    """
    table: dict[str, list[float]] = defaultdict(lambda: [0.0] * (3 + len(TEAMS)))
    for name, whole, regions, inside, shared in calls:
        added = whole, inside, regions, *(whole - inside + columns for columns in shared)
        table[name] = [a + b for a, b in zip(table[name], added, strict=True)]
    rest = seconds - sum(columns[0] for columns in table.values())
    table[REST] = [rest, 0.0, 0.0, *[rest] * len(TEAMS)]
    return dict(table)


def model(groups: list[dict[str, list[float]]], moved: float, region_us: float) -> dict[str, Any]:
    """Returns the modelled speed-ups, and the microseconds of each part of a step (or of a picture).

    A part's time is its median over the groups. For "Python and torch", and for parts that occur in less than half of
    the groups, it is the mean.

    Args:
        groups: The result of :func:`parts` for each measured group of steps, divided by the number of steps.
        moved: The bytes that a step moves through memory.
        region_us: The microseconds that a parallel region costs.
    """
    table = {}
    for name in dict.fromkeys(name for each in groups for name in each):
        rows = [each.get(name, [0.0] * (3 + len(TEAMS))) for each in groups]
        seldom = name == REST or 2 * sum(name in each for each in groups) < len(groups)
        middle = statistics.mean if seldom else statistics.median
        table[name] = [middle(each) for each in zip(*rows, strict=True)]
    whole, inside, regions, *on = (sum(column) for column in zip(*table.values(), strict=True))
    serial, cost = whole - inside, 1e-6 * region_us * regions
    times = {}
    for team, seconds in zip(TEAMS, on, strict=True):
        for name, rate in BANDWIDTHS.items():
            on_team = serial + cost + max(seconds - serial, moved / rate)
            times[f"x on {team} cores at {name} GB/s"] = round(whole / on_team, 2)
    listed = {
        name: {"us": round(1e6 * each[0], 1), "serial_us": round(1e6 * (each[0] - each[1]), 1)}
        for name, each in table.items()
    }
    shown = {"traced_ms": round(1e3 * whole, 3), "serial_percent": round(100 * serial / whole, 1)}
    return {**shown, "regions": round(regions, 1), "bytes": moved, **times, "parts": listed}


def region(cores: int) -> dict[str, Any]:
    """Measures the cost in microseconds of an empty parallel region that follows serial work.

    Calls whose regions run on all cores are recorded, and replayed in two ways. A replay on all cores keeps one team of
    threads, which waits between the regions. A replay on one thread keeps no team, so each region wakes its own team.
    The time of the same calls with serial regions is subtracted from both times."""
    points, cells, share = torch.rand(2048, 3), torch.empty(2048, dtype=torch.int32), torch.tensor(0.5)
    pair = [torch.zeros(1), torch.zeros(1)], [torch.zeros(1), torch.zeros(1)]

    def record(k: int, count: int) -> Recording:
        centres = torch.rand(k, 3)
        with threads(count), Recording() as recording:
            n, machine = recording.count(lambda: len(points)), native.cpu()
            for _ in range(CALLS):
                native.compiled.nearest_centre(points, centres, None, cells, n, k, 3, 0, machine)  # one chunk: serial
                native.compiled.average(*pair, share, [1, 1], machine)  # a region of two chunks
        if recording.obstacle is not None:
            raise RuntimeError(recording.obstacle)
        return recording

    def microseconds(recording: Recording, count: int) -> float:
        began = time.perf_counter()
        recording.replay(count)
        return 1e6 * (time.perf_counter() - began) / CALLS

    tried = 256
    trial = record(tried, 1)
    k = max(1, round(tried * SERIAL_US / min(microseconds(trial, 1) for _ in range(8))))
    one, several = record(k, 1), record(k, cores)

    timings = [[microseconds(one, 1), microseconds(several, 1), microseconds(several, cores)] for _ in range(21)][1:]
    serial, alone, inside = (statistics.median(column) for column in zip(*timings, strict=True))
    shown = {"serial_us": serial, "own_team_us": alone - serial, "in_recording_us": inside - serial}
    return {"case": "a region", "threads": cores, **{name: round(value, 2) for name, value in shown.items()}}


def measure(name: str, case: Case, cores: int, region_us: float) -> list[dict[str, Any]]:
    """Returns the row of a training and, if ``case.picture`` is set, the row of rendering a view."""
    scene, other = load(case), Other(case)
    trainings = {way: Training(case, scene, how) for way, how in ways(cores).items()}
    turns = (case.settings["steps"] - 1) // TURN[-1]
    for number in range(turns):
        if number == turns // 4:  # counting starts here
            for training in trainings.values():
                for kept in (training.ms, training.processor_ms, training.traced):
                    kept.clear()
        for training in list(trainings.values())[:: 1 if number % 2 else -1]:
            training.turn(other)
    other.process.terminate()
    other.process.join()
    ms, processor_ms = (
        {way: round(statistics.median(getattr(training, kind)), 3) for way, training in trainings.items()}
        for kind in ("ms", "processor_ms")
    )
    one, as_it_is = trainings["one thread"], trainings["one thread, as it is"]
    state = one.state
    with threads(1):
        samples = state.training_step(state.rays).samples
    gradients = [
        p.grad.view(-1) for router in state.routers.values() for p in router.parameters() if p.grad is not None
    ]
    lines = sum(int((each[: len(each) // LINE * LINE].view(-1, LINE) != 0).any(1).sum()) for each in gradients)
    moved = SAMPLE_BYTES * samples + ENTRY_BYTES * state.parameter_count + TAUGHT_BYTES * LINE * lines
    settings = {"case": name, "scene": Path(case.data).name, "size": scene.train.cameras.size(0), **case.settings}
    counts = {"turns": len(one.ms), "rays": state.rays, "samples": samples, "parameters": state.parameter_count}
    row = {
        **settings,
        **counts,
        "explained": state.training_step.explain(),
        "ms": ms,
        "processor_ms": processor_ms,
        "x on all cores": round(ms["one thread"] / ms["all cores"], 2),
        "x on all cores, as it is": round(ms["one thread, as it is"] / ms["all cores, as it is"], 2),
        "python_percent": python_percent(one),
        "python_percent, as it is": python_percent(as_it_is),
        **model(one.traced, moved, region_us),
    }
    if case.picture is None:
        return [row]
    view = load(case, case.picture).train
    state.renderer.train(False)
    pictures = []
    with threads(1):
        for _ in range(3):
            native.compiled.trace(True)
            began = time.process_time()
            state.renderer.image(view.cameras, 0, near=scene.near, far=scene.far, box=scene.box, heaviest=False)
            pictures.append(parts(time.process_time() - began, native.compiled.trace(False)))
    return [row, {"case": f"picture, {name}", "size": view.cameras.size(0), **model(pictures, 0.0, region_us)}]


def python_percent(training: Training) -> float:
    """Returns the percentage of a step's processor time outside compiled calls."""
    rest_ms = 1e3 * statistics.mean(each[REST][0] for each in training.traced)
    return round(100 * rest_ms / statistics.median(training.processor_ms), 1)


def tables(results: list[dict[str, Any]]) -> str:
    """Returns the tables of docs/performance.md as Markdown."""
    names = list(ways(2))
    clock = [f"| by the clock, ms | {' | '.join(names)} | x | x, as it is | Python, % | as it is |"]
    clock.append("|" + "---|" * (len(names) + 5))
    models = [
        f"| model | one thread, ms | serial, % | regions | {' | '.join(f'{n} cores' for n in TEAMS)} | at 40 GB/s |"
    ]
    models.append("|" + "---|" * (len(TEAMS) + 5))
    for row in results[1:]:
        name = f"{row['case']}, {' x '.join(map(str, row['size']))}"
        if "ms" in row:
            shown = [f"{row['ms'][way]:.2f}" for way in names]
            shown += [f"{row[f'x on all cores{how}']:.2f}" for how in ("", ", as it is")]
            shown += [f"{row[f'python_percent{how}']:.1f}" for how in ("", ", as it is")]
            clock.append(f"| {name} | {' | '.join(shown)} |")
        fast, slow = ([row[f"x on {team} cores at {rate} GB/s"] for team in TEAMS] for rate in ("80", "40"))
        shown = [f"{row['traced_ms']:.2f}", f"{row['serial_percent']:.1f}", f"{row['regions']:.0f}"]
        models.append(f"| {name} | {' | '.join([*shown, *(f'{x:.2f} x' for x in (*fast, slow[2]))])} |")
    return "\n".join([*clock, "", *models])


def main(arguments: list[str] | None = None) -> None:
    """Prints the results and writes the JSON."""
    parser = Parser("cores", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--data", type=Path, help="the folder of the scenes")
    parser.add_argument("--case", choices=CASES, action="append", help="only these cases")
    parser.add_argument("--quick", action="store_true", help="a few steps of the built-in scene instead")
    parser.add_argument("--json", type=Path, metavar="FILE", help="a JSON file for the results")
    options: argparse.Namespace = parser.parse_args(arguments)
    if options.data is None and not options.quick:
        parser.error("--data must name the folder of the scenes")
    waiting = {name: os.environ.get(name) for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")}
    if waiting["OMP_WAIT_POLICY"] is None and not options.quick:
        parser.error("OMP_WAIT_POLICY must be set, to passive with GOMP_SPINCOUNT=1000 as voronerf train has it")
    cores = max(2, torch.get_num_threads())
    trials = [region(cores) for _ in range(TRIALS)]
    results = [min(trials, key=lambda row: sum(value for name, value in row.items() if name.endswith("_us")))]
    print(results[0])
    cases = QUICK if options.quick else {name: CASES[name] for name in options.case or CASES}
    for name, case in cases.items():
        if not options.quick:
            case = case._replace(data=str(options.data / case.data))
        for row in measure(name, case, cores, results[0]["in_recording_us"]):
            results.append(row)
            print(*(f"{key} {value}," for key, value in row.items() if key != "parts"), flush=True)
            for part, took in sorted(row["parts"].items(), key=lambda item: -item[1]["us"]):
                print(f"    {part:24} {took['us']:9.0f} us, serial {took['serial_us']:7.0f}")
    print(tables(results))
    if options.json is not None:
        with threads(cores):
            about = metadata(command="python benchmarks/cores.py --data DATA", benchmark="cores", seed=0, **waiting)
        write_text(options.json, json.dumps({"metadata": about, "results": results}, indent=2) + "\n")


if __name__ == "__main__":
    main()
