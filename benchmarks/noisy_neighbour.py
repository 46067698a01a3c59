"""What a training loses to busy processes on the same cores, and what waiting threads have to do with it.

    python benchmarks/noisy_neighbour.py --json benchmarks/results/noisy_neighbour.json

Two trainings of the same scene take turns of half a second. The threads of one sleep while they wait for each other
(OMP_WAIT_POLICY=passive, what `voronerf train` sets); those of the other spin for some milliseconds first, as is
OpenMP's default. Each is alone in some turns, and in others beside one busy process, or one for each core, of the same
priority. A scheduler that is fair to threads makes a step take `fair` times as long as alone. Nothing else should run;
`others` says how many cores did.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from harness import Others, metadata

from voronerf.cli.main import EXPECTED
from voronerf.data import load_scene
from voronerf.files import write_text
from voronerf.training.config import TrainConfig
from voronerf.training.trainer import Trainer

# What the environment says of waiting threads.
WAITING = {"sleep": {"OMP_WAIT_POLICY": "passive"}, "spin": {}}
# Busy from one line of its input to the next; ends with it.
NEIGHBOUR = """
import os, select
while os.read(0, 1):
    while not select.select([0], [], [], 0)[0]:
        for _ in range(10_000): pass
    os.read(0, 1)
"""


@dataclass(frozen=True)
class Options:
    """Which training to disturb."""

    data: str = "builtin"
    """Scene folder or "builtin"."""
    downscale: int = 1
    """Factor by which the images are made smaller on load."""
    field: str = "hashgrid"
    """The networks, as for `voronerf train`."""
    rays: int = 512
    """Rays per step."""
    warm: int = 300
    """Steps before, the split in their middle."""
    rounds: int = 24
    """Turns of each training with each number of neighbours."""
    seconds: float = 0.5
    """Length of a turn."""
    json: Path | None = None
    """File for the result, {metadata, results}."""
    serve: bool = False
    """Train for as many seconds as each line of the input says; what the script starts itself with."""


def main() -> None:
    """Measures and prints."""
    options = tyro.cli(Options, description=__doc__)
    try:
        if options.serve:
            serve(options)
            return
        result = measure(options)
    except EXPECTED as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    for row in result["results"]:
        print("  ".join(f"{name} {value}" for name, value in row.items()))
    if options.json is not None:
        write_text(options.json, json.dumps(result, indent=2) + "\n")


def measure(options: Options) -> dict[str, Any]:
    """Metadata, and a row for each way of waiting and number of neighbours."""
    cores = len(os.sched_getaffinity(0))
    counts = (0, 1, cores) if cores > 1 else (0, 1)
    found: dict[tuple[str, int], list[dict[str, float]]] = {}
    with ExitStack() as stack:
        neighbours = [stack.enter_context(start([sys.executable, "-c", NEIGHBOUR])) for _ in range(cores)]
        command = [sys.executable, __file__, *sys.argv[1:], "--serve"]
        trainings = {name: stack.enter_context(start(command, given)) for name, given in WAITING.items()}
        for training in trainings.values():
            ask(training, 0.0)  # ready
        for _, count, (name, training) in itertools.product(range(options.rounds), counts, trainings.items()):
            for neighbour in neighbours[:count]:
                tell(neighbour, "b")
            found.setdefault((name, count), []).append(ask(training, options.seconds))
            for neighbour in neighbours[:count]:
                tell(neighbour, "e")
    described = dataclasses.asdict(options) | {"json": None}
    rows = [
        {"waiting": name, "neighbours": count, **row(found, name, count, cores, torch.get_num_threads())}
        for name, count in itertools.product(WAITING, counts)
    ]
    return {"metadata": metadata(benchmark="noisy_neighbour", options=described, cores=cores), "results": rows}


def row(
    found: dict[tuple[str, int], list[dict[str, float]]], name: str, count: int, cores: int, threads: int
) -> dict[str, Any]:
    """Medians of turns; ``times_alone`` compares turns of one round."""
    turns = found[name, count]
    ratios = [turn["ms"] / alone["ms"] for turn, alone in zip(turns, found[name, 0], strict=True)]
    return {
        "step_ms": round(statistics.median(turn["ms"] for turn in turns), 3),
        "least_step_ms": round(min(turn["ms"] for turn in turns), 3),
        "cpu_ms": round(statistics.median(turn["cpu_ms"] for turn in turns), 3),
        "times_alone": round(statistics.median(ratios), 3),
        "fair": round(max(threads + count, cores) / max(threads, cores), 3),
        "others": round(statistics.median(turn["others"] for turn in turns), 2),
    }


def start(command: list[str], given: dict[str, str] | None = None) -> subprocess.Popen[str]:
    """A process to talk to, which ends with its input."""
    kept = {name: value for name, value in os.environ.items() if name not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")}
    return subprocess.Popen(
        command, env=kept | (given or {}), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
    )


def tell(process: subprocess.Popen[str], word: str) -> None:
    """Writes to a process."""
    assert process.stdin is not None
    process.stdin.write(word)
    process.stdin.flush()


def ask(training: subprocess.Popen[str], seconds: float) -> dict[str, float]:
    """A turn of a training."""
    tell(training, f"{seconds}\n")
    assert training.stdout is not None
    answer = training.stdout.readline()
    if not answer:
        raise SystemExit("the training ended, see above")
    found: dict[str, float] = json.loads(answer)
    return found


def serve(options: Options) -> None:
    """Trains until the scene is split, then in turns."""
    with tempfile.TemporaryDirectory() as folder:
        config = TrainConfig(
            data=options.data,
            downscale=options.downscale,
            out=Path(folder),
            steps=10**9,
            split_at_steps=(options.warm // 2,),
            evaluations=1,
            field=options.field,
            rays=options.rays,
            checkpoint_every=float("inf"),
        )
        trainer = Trainer(config, load_scene(config.data, downscale=config.downscale))
        while trainer.step < options.warm:
            trainer.advance(trainer.seconds + 1e-9)
        for line in sys.stdin:
            print(json.dumps(turn(trainer, float(line))), flush=True)


def turn(trainer: Trainer, seconds: float) -> dict[str, float]:
    """Trains for some seconds: milliseconds of a step by the clock and of the processor, and the load of others."""
    others, first, used, started = Others(), trainer.step, time.process_time(), time.perf_counter()
    trainer.advance(trainer.seconds + seconds)
    wall, used, steps = time.perf_counter() - started, time.process_time() - used, max(trainer.step - first, 1)
    return {"ms": 1e3 * wall / steps, "cpu_ms": 1e3 * used / steps, "others": others.cores() or 0.0}


if __name__ == "__main__":
    main()
