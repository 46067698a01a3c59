"""Repeats tables and figures of "Adaptive Voronoi NeRFs" (Elsner et al. 2023) by name, at an adjustable size.

    python benchmarks/paper.py sampling --scene lego --downscale 4 --budget 480 --seeds 2
    python benchmarks/paper.py split-kinds title --scene builtin --budget 60
    python benchmarks/paper.py --budget 20 --downscale 8        # all experiments: `make paper`

All variants of an experiment train for the same time. Each experiment writes NAME.json ({metadata, results}) and
pictures into --out; report.md in that folder collects all experiments. A finished training with the same settings is
reused, and an interrupted training is continued. Trainings of one command take turns of a few seconds.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import tyro
from harness import write_results

from paper import balance
from paper.experiments import EXPERIMENTS
from paper.report import ABOUT, write_report
from paper.runs import Run, Settings, default_scenes, failure, results, train_missing
from voronerf.app.train.config import ConfigError


def say(line: str) -> None:
    """Prints progress with the time of day."""
    print(f"{time.strftime('%H:%M:%S')}  {line}", flush=True)


def trainings(name: str, settings: Settings) -> list[Run]:
    """Returns the trainings of an experiment."""
    if name == "balance":
        return balance.runs(settings)
    return EXPERIMENTS[name].runs(settings) if name in EXPERIMENTS else []


def finish(name: str, runs: Sequence[Run], settings: Settings) -> None:
    """Writes an experiment's JSON from its trainings."""
    described: dict[str, Any] = {"experiment": name, "budget_seconds": settings.budget, "seeds": settings.seeds}
    if name == "balance":
        described["scenes"] = list(settings.scene or default_scenes())
        rows = balance.measure(runs, settings.backend, say)
    else:
        rows = results(runs)
        described |= {
            "scenes": list(dict.fromkeys(row["scene"] for row in rows)),
            "size": rows[0]["size"] if rows else None,
            "rays": settings.rays,
            "samples": settings.samples,
            "failed": [why for run in runs if (why := failure(run))],
        }
    write_results(settings.out / f"{name}.json", rows, benchmark="paper", **described)


def repeat(settings: Settings, names: tyro.conf.Positional[tuple[str, ...]] = ()) -> None:
    """Repeats experiments of the paper.

    Args:
        settings: The size of the experiments.
        names: The names of the experiments. Default: all.
    """
    if unknown := [name for name in names if name not in ABOUT]:
        raise ConfigError(f"experiments are {', '.join(ABOUT)}, got {', '.join(unknown)}")
    started = time.perf_counter()
    runs = {name: trainings(name, settings) for name in names or ABOUT}
    # One call for all experiments, so that all trainings of a scene and a seed take turns.
    train_missing([run for group in runs.values() for run in group], settings, say)
    for name, group in runs.items():
        finish(name, group, settings)
        say(f"{name}: done")
    page = write_report(settings.out)
    say(f"wrote {page} after {(time.perf_counter() - started) / 60:.1f} minutes")


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command."""
    tyro.cli(
        repeat,
        prog="paper.py",
        description=(__doc__ or "").split("\n\n")[0],
        args=None if arguments is None else list(arguments),
        config=(tyro.conf.OmitArgPrefixes,),
    )
