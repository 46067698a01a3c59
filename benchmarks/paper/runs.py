"""The trainings behind the paper's tables and figures: their settings and their execution.

A training is named by a hash of its configuration: experiments share equal trainings, and trainings in the output
folder are reused. All missing trainings of a scene and a seed take turns of a few seconds in one process. An
interrupted training continues from its last turn. A failed training leaves its group and writes the error into its
result.json.

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
#: The settings of the published method.
AS_PUBLISHED = {"field": "nerf", "occupancy": False, "contraction": "none", "average": 0.0, "centres": "balanced"}
#: The number of latest batches whose samples are kept for a split, by field; other fields have the default. A smaller
#: number keeps more samples of each batch; KiloNeRF needs them, since its 512 cells are made after few batches.
BATCHES = {"kilonerf": 100}
#: The minimum values of the settings. ``samples`` is at least 2, because each of two passes needs a sample.
LEAST = {"downscale": 1, "seeds": 1, "rays": 1, "samples": 2, "evaluations": 1, "eval_views": 1, "cells": 2}


@dataclass(frozen=True)
class Settings:
    """The size of an experiment."""

    scene: tuple[str, ...] = ()
    """The scenes: folders, names in the data folder (VORONERF_DATA, else ../shared/data), or built-in scenes. Default:
    lego if it exists, else builtin; the tables by sampling and architecture use more scenes. Results are stored by
    scene name, so another scene of the same name needs another --out."""
    downscale: int = 4
    """The downscale factor of the published 400 x 400 images; the built-in scenes have 100 x 100 pixels at 4."""
    budget: float = 480.0
    """The training seconds of each variant."""
    seeds: int = 2
    """The runs of each variant, with seeds 0, 1, ..."""
    out: Path = Path("runs/paper")
    """The folder for runs, JSON, tables and pictures."""
    turn: float = 5.0
    """The seconds of a turn, after which the next variant trains."""
    clock: Literal["wall", "cpu"] = "wall"
    """The clock of the training time: wall time or, on a shared machine, process CPU time divided by threads."""
    rays: int = 1024
    """The number of rays per step."""
    samples: int = 64
    """The number of samples per ray; each of two passes has half of the samples."""
    evaluations: int = 8
    """The number of evaluations during the budget."""
    eval_views: int = 10
    """The number of test views in an evaluation during training."""
    final_views: int | None = None
    """The number of test views in the final evaluation. Default: all."""
    cells: int = 12
    """The number of cells in the comparison with one network."""
    backend: str = "auto"
    """The backend of the operations."""

    def __post_init__(self) -> None:
        for name, least in LEAST.items():
            if getattr(self, name) < least:
                raise ConfigError(f"--{name.replace('_', '-')} must be at least {least}, got {getattr(self, name)}")
        for name in ("budget", "turn"):
            if not 0 < getattr(self, name) < float("inf"):
                raise ConfigError(f"--{name} must be a positive number of seconds, got {getattr(self, name)}")


@dataclass(frozen=True)
class Variant:
    """A row of an experiment: its name and its changes to the configuration."""

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
        """The run directory."""
        assert self.config.out is not None
        return self.config.out

    @property
    def result(self) -> Path:
        """The file of the result, which exists once the training has ended."""
        return self.folder / "result.json"


def data_folder() -> Path:
    """Returns the folder of downloaded scenes."""
    return Path(os.environ.get("VORONERF_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))


def scene_source(name: str) -> str:
    """Returns the argument of `load_scene` for a scene's name.

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
    """Returns the first ``count`` available scenes of the paper, or else the built-in scene."""
    found = [name for name in ("lego", "ship", "drums") if (data_folder() / name).is_dir()]
    return tuple(found[:count]) or ("builtin",)


def factor(name: str, settings: Settings) -> int:
    """Returns the factor by which a scene's original images are downscaled."""
    if not is_builtin(name):
        return settings.downscale
    return max(1, settings.downscale * BUILTIN_SIZE // PUBLISHED_SIZE)


def open_scene(name: str, settings: Settings) -> Scene:
    """Loads a scene at the size of the settings."""
    return _loaded(scene_source(name), factor(name, settings))


@functools.lru_cache(maxsize=2)
def _loaded(source: str, downscale: int) -> Scene:
    return load_scene(source, downscale=downscale)


def make_run(variant: Variant, scene: str, seed: int, settings: Settings) -> Run:
    """Returns the training of a variant; its directory is named by the scene and a hash of the settings."""
    values = {name: getattr(settings, name) for name in ("budget", "evaluations", "eval_views", "rays", "backend")}
    values |= {"seed": seed, "data": scene_source(scene), "downscale": factor(scene, settings)}
    passes = SAMPLERS[variant.changes.get("sampling", "stratified")].passes  # several passes share the samples of one
    first = settings.samples // passes
    values["samples"] = (*[first] * (passes - 1), settings.samples - first * (passes - 1))
    config = TrainConfig(**{**values, **AS_PUBLISHED, **variant.changes})
    short, more = Path(scene).name, {"final_views": settings.final_views, "looks": looks.VERSION}
    text = json.dumps({**config.to_values(), "data": short, **more}, sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()[:12]
    out = settings.out / "runs" / f"{short}-{seed}-{digest}"
    return Run(variant, scene, seed, replace(config, out=out))


def train_missing(runs: Sequence[Run], settings: Settings, say: Callable[[str], None] = print) -> None:
    """Trains the runs that the output folder lacks; runs of the same scene and seed take turns."""
    unique = {run.folder: run for run in runs}
    missing = [run for run in unique.values() if not run.result.is_file()]
    say(f"{len(unique)} trainings, {len(unique) - len(missing)} of them finished; {settings.budget:g} s each")
    groups: dict[tuple[int, str], list[Run]] = {}
    for run in missing:
        groups.setdefault((run.seed, run.scene), []).append(run)
    for (seed, name), group in sorted(groups.items()):
        scene = open_scene(name, settings)
        say(f"{scene.name}, seed {seed}: {len(group)} trainings in turns of {settings.turn:g} s")
        train_group(group, scene, settings, say)


def train_group(group: Sequence[Run], scene: Scene, settings: Settings, say: Callable[[str], None] = print) -> None:
    """Trains runs of one scene in turns, resumes from checkpoints, and writes the results."""
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
    lpips = find_lpips(None, group[0].config.data, scene.test.cameras.smallest[::-1])

    def failed(training: Training, error: Exception) -> None:
        """Writes the error of a failed training in place of its result."""
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
    """Returns the results of trained runs, with variant, scene, seed and folder."""
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
    """Returns the error of a failed run, or None."""
    row = json.loads(run.result.read_text()) if run.result.is_file() else {}
    return (
        f"{run.variant.name} on {Path(run.scene).name}, seed {run.seed}: {row['failed']}" if "failed" in row else None
    )
