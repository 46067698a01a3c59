"""Compares settings, and Instant NGP: PSNR over training seconds, and seconds to 26, 28, 30 and 32 dB.

    python benchmarks/time_to_quality.py --data builtin --budget 60
    python benchmarks/time_to_quality.py --data LEGO --downscale 4 --seeds 3 --common="--field hashgrid --occupancy"
    python benchmarks/time_to_quality.py --data LEGO --downscale 4 \
        --sides "hash grid: --field hashgrid --occupancy" "4 cells, wide: --cells 4 --width 128" "rival: ngp"
    python benchmarks/time_to_quality.py --data LEGO --budget 15 --clock cpu --evaluations 4 --eval-views 2 \
        --common="--samples 256" --sides "2e-4: --lr 2e-4" "1e-3: --lr 1e-3" "0.02: --lr 0.02"

All sides train one scene for the same time. They take turns of a few seconds in one process, so that the noise of a
shared machine affects all sides alike. All sides are evaluated at the same times on the same views. Evaluation does not
count as training time. A side that has learnt nothing scores as ``one_colour``, the PSNR of one-colour pictures.
"""

from __future__ import annotations

import dataclasses
import math
import shlex
import statistics
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import tyro
from harness import write_results
from rival_ngp import Rival, RivalConfig
from turns import CLOCKS, Training, take_turns

from voronerf.app.cli.program import EXPECTED
from voronerf.app.evaluate.plots import plot_curves
from voronerf.app.scenes import Scene, load_scene
from voronerf.app.train.callbacks import one_colour_psnr
from voronerf.app.train.config import ConfigError, TrainConfig

#: The first word of a side that trains the rival, Instant NGP.
RIVAL = "ngp"
#: The settings of `voronerf train` that this benchmark sets for all sides.
GIVEN = ("data", "downscale", "out", "seed", "steps", "budget", "evaluations", "eval_views")
#: The qualities (PSNR in dB) whose training times are printed.
QUALITIES = (26, 28, 30, 32)


@dataclass(frozen=True)
class Options:
    """The compared sides, their scene and their training time."""

    data: str = "builtin"
    """A scene folder or a built-in scene."""
    downscale: int = 1
    """The factor by which the images are downscaled on load."""
    sides: tuple[str, ...] = ("cells:", "one network: --cells", "regular grid: --centres uniform", f"rival: {RIVAL}")
    """The compared sides. Each is "NAME: OPTIONS" with options of `voronerf train`, or "NAME: ngp OPTIONS" for Instant
    NGP in pure PyTorch, with options of `rival_ngp.py`."""
    common: str = ""
    """Default options of `voronerf train` for all sides but the rival: --common="OPTIONS"."""
    budget: float = 60.0
    """Training seconds of every side."""
    clock: Literal["wall", "cpu"] = "wall"
    """The clock of the training time: wall time or, on a shared machine, process CPU time divided by threads."""
    seeds: int = 1
    """The number of runs of each side, with seeds 0, 1, ..."""
    turn: float = 5.0
    """The seconds of a turn, after which the next side trains."""
    evaluations: int = 12
    """The number of evaluations during the budget, evenly spaced."""
    eval_views: int = 20
    """The number of test views in each evaluation."""
    json: Path | None = None
    """The JSON file of the results. Default: results are only printed."""
    plot: Path | None = None
    """The file of the plot."""


def parse_side(text: str, common: str) -> tuple[str, TrainConfig | RivalConfig]:
    """Returns the name and the settings of an entry of ``--sides``.

    Raises:
        ConfigError: The entry has no name, or sets an option that is the same for all sides.
        SystemExit: The entry has an unknown option, which the parser reports.
    """
    name, colon, words = text.partition(":")
    if not colon or not name.strip():
        raise ConfigError(f'--sides must be "NAME: OPTIONS", got {text!r}')
    name, args = name.strip(), shlex.split(words)
    rival = args[:1] == [RIVAL]
    config: TrainConfig | RivalConfig = tyro.cli(
        RivalConfig if rival else TrainConfig,
        prog=name,
        args=args[1:] if rival else [*shlex.split(common), *args],
        config=(tyro.conf.OmitArgPrefixes,),
    )
    if isinstance(config, TrainConfig):
        default = TrainConfig()
        for setting in GIVEN:
            if getattr(config, setting) != getattr(default, setting):
                raise ConfigError(f"--sides must not set --{setting.replace('_', '-')}, got {text!r}")
    return name, config


def make_training(
    name: str, config: TrainConfig | RivalConfig, options: Options, scene: Scene, seed: int, out: Path
) -> Training | Rival:
    """Builds the training of one side with one seed."""
    clock = CLOCKS[options.clock]
    say: Callable[[str], None] = lambda line: print(f"{name:14} {line}", flush=True)  # noqa: E731
    common = {name: getattr(options, name) for name in ("budget", "evaluations", "eval_views")} | {"seed": seed}
    if isinstance(config, RivalConfig):
        return Rival(config, scene, clock=clock, on_event=say, **common)
    config = replace(config, data=options.data, downscale=options.downscale, out=out, **common)
    return Training(config, scene, on_event=say, clock=clock)


def compare(options: Options, folder: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Trains every side and seed in turns; returns the metadata and the results.

    The metadata have the errors of failed trainings, which have no results.
    """
    sides = dict(parse_side(text, options.common) for text in options.sides)
    if len(sides) < len(options.sides):
        raise ConfigError(f"--sides must have names of their own, got {', '.join(options.sides)}")
    scene = load_scene(options.data, downscale=options.downscale)
    trainings = {
        (name, seed): make_training(name, config, options, scene, seed, folder / f"{i}-{seed}")
        for i, (name, config) in enumerate(sides.items())
        for seed in range(options.seeds)
    }
    failed: list[str] = []

    def note_failure(training: Training | Rival, error: Exception) -> None:
        name, seed = next(key for key, each in trainings.items() if each is training)
        failed.append(f"{name}, seed {seed}: {error}")
        print(failed[-1], flush=True)
        del trainings[name, seed]

    take_turns(trainings.values(), budget=options.budget, turn=options.turn, on_failure=note_failure)
    results = []
    for (name, seed), training in trainings.items():
        summary = training.run()
        if isinstance(training, Training):
            curve, settings = training.scores.metrics, training.state.config.to_values()
        else:
            curve, settings = training.metrics, dataclasses.asdict(training.config)
        settings |= {"data": Path(options.data).name, "out": None}  # paths are meaningless on other machines
        reached = {str(quality): seconds_to(quality, curve) for quality in QUALITIES}
        row = {"side": name, "seed": seed, **summary, "seconds_to": reached, "curve": curve, "settings": settings}
        results.append(row)
    about = dataclasses.asdict(options) | {"data": scene.name, "sides": list(options.sides)}
    for path in ("json", "plot"):
        about.pop(path)
    return about | {"one_colour": one_colour_psnr(scene), "failed": failed}, results


def seconds_to(quality: float, curve: Sequence[dict[str, Any]]) -> float | None:
    """Returns the training seconds at which a curve first reaches a PSNR, interpolated between evaluations.

    The earliest result is the time of the first evaluation. Returns None if the curve never reaches the PSNR.
    """
    before = None
    for now in curve:
        if now["psnr"] >= quality:
            if before is None:
                return float(now["seconds"])
            share = (quality - before["psnr"]) / (now["psnr"] - before["psnr"])
            return float(before["seconds"] + share * (now["seconds"] - before["seconds"]))
        before = now
    return None


def table(about: dict[str, Any], results: list[dict[str, Any]]) -> str:
    """Returns a Markdown table with a row for each side: PSNR at each evaluation and seconds to the qualities.

    Each cell is the median over the seeds.
    """
    runs: dict[str, list[dict[str, Any]]] = {}
    for result in results:
        runs.setdefault(result["side"], []).append(result)
    times = [about["budget"] * (i + 1) / about["evaluations"] for i in range(about["evaluations"])]
    head = ["side", "steps", "parameters", *(f"{t:.3g} s" for t in times), *(f"to {q} dB" for q in QUALITIES)]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for side, found in runs.items():
        row = [side, *(f"{statistics.median(r[name] for r in found):,.0f}" for name in ("steps", "parameters"))]
        for t in times:
            # A step longer than the time between two evaluations skips an evaluation.
            near = [[m["psnr"] for m in r["curve"] if abs(m["seconds"] - t) < times[0] / 2] for r in found]
            row.append(f"{statistics.median(values[0] for values in near):.2f}" if all(near) else "-")
        for quality in QUALITIES:
            all_seconds = [r["seconds_to"][str(quality)] for r in found]
            middle = statistics.median(math.inf if s is None else s for s in all_seconds)
            row.append(f"{middle:.1f} s" if middle < math.inf else "-")
        lines.append(f"| {' | '.join(row)} |")
    return "\n".join(lines)


def main(options: Options) -> None:
    """Runs the comparison, prints the table, and writes the requested files."""
    with tempfile.TemporaryDirectory() as folder:
        about, results = compare(options, Path(folder))
    print(table(about, results))
    write_results(options.json, results, benchmark="time_to_quality", **about)
    if options.plot is not None:
        several = len({r["seed"] for r in results}) > 1
        labels = {f"{r['side']}, seed {r['seed']}" if several else r["side"]: r for r in results}
        curves = {label: [(m["seconds"], m["psnr"]) for m in r["curve"]] for label, r in labels.items()}
        splits = {label: [s["started_at_second"] for s in r["stages"][1:]] for label, r in labels.items()}
        plot_curves(options.plot, curves, splits=splits, title=f"{about['data']}, equal training time")


if __name__ == "__main__":
    try:
        main(tyro.cli(Options, config=(tyro.conf.OmitArgPrefixes,)))
    except EXPECTED as error:
        sys.exit(f"time_to_quality: error: {error}")
