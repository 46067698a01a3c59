"""The trainings behind the paper's tables and figures: how large they are, and how they are made.

A training is named by its whole configuration: two experiments that need the same one share it, and one that is in the
output folder is not made again. All missing trainings of a scene and a seed take turns of a few seconds in one process.
An interrupted one continues from its last turn. One that fails leaves its group, and its result.json says why.

    OUT/runs/SCENE-SEED-HASH/   a run directory of `voronerf train`, with result.json and looks/
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from turns import CLOCKS, Training, take_turns

from paper import looks
from voronerf.app.evaluate.lpips import find_lpips
from voronerf.app.evaluate.scores import evaluate, mean_scores
from voronerf.app.files import write_text
from voronerf.app.scenes import BUILTIN_SIZE, Scene, is_builtin, load_scene
from voronerf.app.train import ConfigError, TrainConfig
from voronerf.app.train.checkpoint import checkpoint_paths
from voronerf.diagram.reservoir import SampleReservoir
from voronerf.nerf.samplers import SAMPLERS
from voronerf.nerf.split import RESERVOIR

Row = dict[str, Any]
PUBLISHED_SIZE = 400
#: The method as published.
AS_PUBLISHED = {"field": "nerf", "occupancy": False, "contraction": "none", "average": 0.0, "centres": "balanced"}
#: Latest batches that kept samples come from, where not as in `voronerf train`: 512 cells need samples of few steps.
BATCHES = {"kilonerf": 100}
#: Settings and the least that they may be; a table with two passes needs a sample in each.
LEAST = {"downscale": 1, "seeds": 1, "rays": 1, "samples": 2, "evaluations": 1, "eval_views": 1, "cells": 2}


@dataclass(frozen=True)
class Settings:
    """How large an experiment is."""

    scene: tuple[str, ...] = ()
    """Scenes: folders, names in the data folder (VORONERF_DATA, else ../shared/data), or built-in ones. Default: lego
    if it is there, else builtin; the tables by sampling and architecture take more. Results are kept by a scene's
    name: another scene of that name needs another --out."""
    downscale: int = 4
    """Factor on a scene's own images, 400 x 400 as published; the built-in scenes have 100 x 100 at 4."""
    budget: float = 480.0
    """Training seconds of every variant."""
    seeds: int = 2
    """Runs of every variant, seeds 0, 1, ..."""
    out: Path = Path("runs/paper")
    """Folder for runs, JSON, tables and pictures."""
    turn: float = 5.0
    """Seconds that a variant trains before the next one has its turn."""
    clock: Literal["wall", "cpu"] = "wall"
    """What counts as a second: wall time, or where others use the machine too, process CPU time / threads."""
    rays: int = 1024
    """Rays per step."""
    samples: int = 64
    """Samples per ray; with two passes half of them in each."""
    evaluations: int = 8
    """Evaluations during the budget."""
    eval_views: int = 10
    """Test views of an evaluation during training."""
    final_views: int | None = None
    """Test views of the final evaluation; default all."""
    cells: int = 12
    """Cells of the paper's comparison with one network."""
    backend: str = "auto"
    """Backend of the operations."""

    def __post_init__(self) -> None:
        for name, least in LEAST.items():
            if getattr(self, name) < least:
                raise ConfigError(f"--{name.replace('_', '-')} must be at least {least}, got {getattr(self, name)}")
        for name in ("budget", "turn"):
            if not 0 < getattr(self, name) < float("inf"):
                raise ConfigError(f"--{name} must be a positive number of seconds, got {getattr(self, name)}")


@dataclass(frozen=True)
class Variant:
    """A row of an experiment: its name and what it changes in the configuration."""

    name: str
    changes: Mapping[str, Any]


@dataclass(frozen=True)
class Run:
    """One training: a variant on a scene with a seed."""

    variant: Variant
    scene: str
    seed: int
    config: TrainConfig

    @property
    def folder(self) -> Path:
        """Its run directory."""
        assert self.config.out is not None
        return self.config.out

    @property
    def result(self) -> Path:
        """The file that says that it was made."""
        return self.folder / "result.json"


def data_folder() -> Path:
    """Where downloaded scenes are."""
    return Path(os.environ.get("VORONERF_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))


def scene_source(name: str) -> str:
    """What `load_scene` takes for a scene's name.

    Raises:
        ConfigError: There is no such scene.
    """
    if is_builtin(name):
        return name
    for folder in (Path(name), data_folder() / name):
        if folder.is_dir():
            return str(folder)
    raise ConfigError(f"--scene must be a folder, a name in {data_folder()} or builtin, got {name!r}")


def default_scenes(count: int = 1) -> tuple[str, ...]:
    """The first ``count`` scenes of the paper that are there, else the built-in one."""
    found = [name for name in ("lego", "ship", "drums") if (data_folder() / name).is_dir()]
    return tuple(found[:count]) or ("builtin",)


def factor(name: str, settings: Settings) -> int:
    """The factor by which a scene's own images are made smaller."""
    if not is_builtin(name):
        return settings.downscale
    return max(1, settings.downscale * BUILTIN_SIZE // PUBLISHED_SIZE)


def open_scene(name: str, settings: Settings) -> Scene:
    """Loads a scene at the size that the settings ask for."""
    return _loaded(scene_source(name), factor(name, settings))


@functools.lru_cache(maxsize=2)
def _loaded(source: str, downscale: int) -> Scene:
    return load_scene(source, downscale=downscale)


def make_run(variant: Variant, scene: str, seed: int, settings: Settings) -> Run:
    """The training that a variant stands for, with the directory that its settings and the scene's name give it."""
    values = {name: getattr(settings, name) for name in ("budget", "evaluations", "eval_views", "rays", "backend")}
    values |= {"seed": seed, "data": scene_source(scene), "downscale": factor(scene, settings)}
    passes = SAMPLERS[variant.changes.get("sampling", "stratified")].passes  # several share the samples of one
    first = settings.samples // passes
    values["samples"] = (*[first] * (passes - 1), settings.samples - first * (passes - 1))
    config = TrainConfig(**{**values, **AS_PUBLISHED, **variant.changes})
    short, more = Path(scene).name, {"final_views": settings.final_views, "looks": looks.VERSION}
    text = json.dumps({**config.to_values(), "data": short, **more}, sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()[:12]
    out = settings.out / "runs" / f"{short}-{seed}-{digest}"
    return Run(variant, scene, seed, replace(config, out=out))


def train_missing(runs: Sequence[Run], settings: Settings, say: Callable[[str], None] = print) -> None:
    """Trains what is not in the output folder, the runs of a scene and a seed in turns."""
    unique = {run.folder: run for run in runs}
    missing = [run for run in unique.values() if not run.result.is_file()]
    say(f"{len(unique)} trainings, {len(unique) - len(missing)} of them made already; {settings.budget:g} s each")
    groups: dict[tuple[int, str], list[Run]] = {}
    for run in missing:
        groups.setdefault((run.seed, run.scene), []).append(run)
    for (seed, name), group in sorted(groups.items()):
        scene = open_scene(name, settings)
        say(f"{scene.name}, seed {seed}: {len(group)} trainings in turns of {settings.turn:g} s")
        train_group(group, scene, settings, say)


def train_group(group: Sequence[Run], scene: Scene, settings: Settings, say: Callable[[str], None] = print) -> None:
    """Trains runs of one scene in turns, from their checkpoints if there are any, and writes their results."""
    trainings: dict[Path, Training] = {}
    names = {run.folder: f"{run.variant.name:28}" for run in group}
    for run in group:
        resume, name = bool(checkpoint_paths(run.folder)), names[run.folder]
        training = Training(
            run.config,
            scene,
            clock=CLOCKS[settings.clock],
            on_event=lambda line, name=name: say(f"{name} {line}"),
            resume=resume,
        )
        batches = BATCHES.get(run.config.field)
        if batches is not None and not resume:
            training.state.strategy.reservoir = SampleReservoir(RESERVOIR, batches)
        trainings[run.folder] = training
    lpips, source = find_lpips(None, group[0].config.data, scene.test.cameras.smallest[::-1])
    if lpips is None:
        say(source)

    def failed(training: Training, error: Exception) -> None:
        """Keeps why a training failed in place of its result."""
        message = str(error).removeprefix(f"{training.out}: ").removeprefix("SplitStrategy: ")
        say(f"{names[training.out]} failed: {message}")
        write_text(training.out / "result.json", json.dumps({"failed": message, "psnr": None}, indent=1) + "\n")
        del trainings[training.out]

    take_turns(
        trainings.values(),
        budget=settings.budget,
        turn=settings.turn,
        stops=lambda training: [second for _, second in looks.stops(training)],
        on_stop=looks.reached,
        after_turn=lambda training: training.save(),
        on_failure=failed,
    )
    for folder in list(trainings):
        training = trainings.pop(folder)
        summary, state = training.run(), training.state
        looks.look(training, settings.budget)
        with state.averaged():
            scores = evaluate(state.renderer, scene, views=settings.final_views, lpips=lpips)
        row: Row = {
            **summary,
            **mean_scores(scores),
            "views": len(scores),
            "lr": state.config.lr,
            "size": [scene.test.cameras.height, scene.test.cameras.width],
            "curve": training.scores.metrics,
            "looks": looks.numbers(folder),
        }
        write_text(folder / "result.json", json.dumps(row, indent=1) + "\n")


def results(runs: Sequence[Run]) -> list[Row]:
    """The results of runs that were trained, each with its variant's name, its scene, its seed and its folder."""
    return [
        {
            "variant": run.variant.name,
            "scene": Path(run.scene).name,
            "seed": run.seed,
            "run": run.folder.name,
            **json.loads(run.result.read_text()),
        }
        for run in runs
        if run.result.is_file() and not failure(run)
    ]


def failure(run: Run) -> str | None:
    """Why a run failed; None if it did not."""
    row = json.loads(run.result.read_text()) if run.result.is_file() else {}
    return (
        f"{run.variant.name} on {Path(run.scene).name}, seed {run.seed}: {row['failed']}" if "failed" in row else None
    )
