"""The trainings behind the paper's tables and figures: made once, named by their settings, with snapshots on the way.

A training is identified by its whole configuration, so two experiments that need the same one share it, and one in
the output folder is not made again. All missing trainings of a scene and a seed take turns of a few
seconds in one process. An interrupted one continues from its last turn. One that fails leaves its group, and its
result.json says why. A long table is made in parts: settings say which of its trainings are made now, and a file keeps
the results of all sittings.

    OUT/runs/SCENE-SEED-HASH/   a run directory of `voronerf train`, with result.json and looks/
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import re
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from turns import take_turns

from paper import looks as paper_looks
from paper.records import changed_settings, forget, keep, made_on, read_result, restore
from paper.settings import Settings
from voronerf.data import BUILTIN, BUILTIN_SIZE, Scene, load_scene
from voronerf.evaluation.scores import evaluate, mean_scores
from voronerf.files import write_text
from voronerf.training.checkpoint import checkpoint_paths
from voronerf.training.config import RESUMABLE, ConfigError, TrainConfig
from voronerf.training.networks import resolve_config
from voronerf.training.run_directory import read_metrics
from voronerf.training.trainer import Trainer, TrainingError

Row = dict[str, Any]
PUBLISHED_SIZE = 400
#: Settings that came after results were kept: at their defaults they are left out of a training's name.
LATER = {
    "proposal_rounds": 1,
    "proposal_anneal": 0.0,
    "distortion": 0.0,
    "lr_split": 1.0,
    "temperature_final": 1.0,
    "uniform_scale": 1.0,
    "blend": 0.0,
    "field_options": [],
    "cell_tables": False,
    "average": 0.0,
    "format": "auto",
    "kind": "auto",
    "normalise": True,
    "ray_growth": 1.0,
    "lr_hold": 0.0,
    "gradient_scaling": True,
}
#: Of a run's settings, those that do not change what is learnt or how it is scored.
NOT_IDENTITY = RESUMABLE - {"budget", "steps", "evaluations", "eval_views", "final_views", "backend", "device", "blend"}


@dataclass(frozen=True)
class Variant:
    """A row of an experiment: its name and what it changes in the configuration."""

    name: str
    changes: Mapping[str, Any]


@dataclass(frozen=True)
class Run:
    """One training: a variant on a scene with a seed, at its learning rate times a factor."""

    variant: Variant
    scene: str
    seed: int
    rate: float
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

    def wanted(self, settings: Settings) -> bool:
        """Whether it is one of those to be made now."""
        of_seeds = not settings.only_seeds or self.seed in settings.only_seeds
        return settings.train and of_seeds and re.search(settings.variants, self.variant.name) is not None


def data_folder() -> Path:
    """Where downloaded scenes are."""
    return Path(os.environ.get("VORONERF_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))


def scene_source(name: str) -> str:
    """What `load_scene` takes for a scene's name.

    Raises:
        ConfigError: When there is no such scene.
    """
    if name in BUILTIN:
        return name
    for folder in (Path(name), data_folder() / name):
        if folder.is_dir():
            return str(folder)
    raise ConfigError(f"--scene must be a folder, a name in {data_folder()} or {', '.join(BUILTIN)}, got {name!r}")


def default_scenes(count: int = 1) -> tuple[str, ...]:
    """The first ``count`` scenes of the paper that are there, else the built-in one."""
    found = [name for name in ("lego", "ship", "drums") if (data_folder() / name).is_dir()]
    return tuple(found[:count]) or ("builtin",)


def factor(name: str, settings: Settings) -> int:
    """The factor by which a scene's own images are made smaller."""
    if name not in BUILTIN:
        return settings.downscale
    return max(1, settings.downscale * BUILTIN_SIZE // PUBLISHED_SIZE)


def open_scene(name: str, settings: Settings) -> Scene:
    """Loads a scene at the size that the settings ask for."""
    return _loaded(scene_source(name), factor(name, settings))


@functools.lru_cache(maxsize=2)
def _loaded(source: str, downscale: int) -> Scene:
    return load_scene(source, downscale=downscale)


def make_run(variant: Variant, scene: str, seed: int, settings: Settings, rate: float = 1.0) -> Run:
    """The training that a variant stands for, with the directory that its settings and the scene's name give it."""
    short = Path(scene).name
    values = {
        "data": scene_source(scene),
        "downscale": factor(scene, settings),
        "seed": seed,
        "budget": settings.budget,
        "evaluations": settings.evaluations,
        "eval_views": settings.eval_views,
        "final_views": settings.final_views,
        "rays": settings.rays,
        "samples": settings.samples,
        "backend": settings.backend,
        "checkpoint_every": 1e9,
        # The method as published.
        "field": "nerf",
        "occupancy": False,
        "occupancy_resolution": 64,
        "contraction": "none",
        "average": 0.0,
        "centres": "balanced",
        **settings.further,
        **variant.changes,
    }
    try:
        config = TrainConfig(**values)
    except TypeError as error:  # an option of another type
        raise ConfigError(
            f"--options must have values that their settings take, got {settings.options}: {error}"
        ) from None
    if rate != 1.0:
        usual = resolve_config(config, open_scene(scene, settings)).lr
        assert usual is not None
        config = replace(config, lr=rate * usual)
    known = {k: v for k, v in json.loads(config.to_json()).items() if k not in (*NOT_IDENTITY, "lpips")}
    known = {name: value for name, value in known.items() if name not in LATER or value != LATER[name]}
    if float(known["budget"]).is_integer():
        known["budget"] = int(known["budget"])  # 480 and 480.0 are one
    text = json.dumps({**known, "scene": short, "looks": paper_looks.VERSION}, sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()[:12]
    out = settings.out / "runs" / f"{short}-{seed}-{digest}"
    return Run(variant, scene, seed, rate, replace(config, out=out))


def train_missing(runs: Sequence[Run], settings: Settings, say: Callable[[str], None] = print) -> None:
    """Trains what is wanted now and neither in the output folder nor in the record, a scene and a seed in turns."""
    unique = {run.folder: run for run in runs}
    if settings.record is not None:
        count = restore(unique, settings.record)
        say(f"{count} results taken from {settings.record}")
    missing = [run for run in unique.values() if settings.again or not run.result.is_file()]
    made, left = len(unique) - len(missing), [run for run in missing if not run.wanted(settings)]
    missing = [run for run in missing if run.wanted(settings)]
    later = f", {len(left)} left for later" if left and not settings.again else ""
    say(f"{len(unique)} trainings, {made} of them made already{later}; {settings.budget:g} s each")
    if settings.again:
        # all before the first training: an interruption leaves no old result among new ones
        if settings.record is not None:
            forget([run.folder for run in missing], settings.record)
        for run in missing:
            clear(run.folder)
    groups: dict[tuple[int, str], list[Run]] = {}
    for run in missing:
        groups.setdefault((run.seed, run.scene), []).append(run)
    for (seed, name), group in sorted(groups.items()):
        scene = open_scene(name, settings)
        say(f"{scene.name}, seed {seed}: {len(group)} trainings in turns of {settings.turn:g} s")
        train_group(group, scene, settings, say)
        if settings.record is not None:
            keep([run.folder for run in group], settings.record)
    if settings.record is not None:
        keep(unique, settings.record)


def clear(folder: Path) -> None:
    """Deletes what a training left: its result, its checkpoints, its evaluations and its looks."""
    files = [folder / "result.json", *checkpoint_paths(folder), folder / "metrics.jsonl"]
    for file in (*files, *(folder / "looks").glob("*.npz")):
        file.unlink(missing_ok=True)


def train_group(group: Sequence[Run], scene: Scene, settings: Settings, say: Callable[[str], None] = print) -> None:
    """Trains runs of one scene in turns, from their checkpoints where there are, and writes their results."""
    trainers: dict[Path, Trainer] = {}
    names = {run.folder: f"{run.variant.name:28}" for run in group}
    for run in group:
        resume = bool(checkpoint_paths(run.folder))
        if not resume:
            clear(run.folder)
        config = replace(run.config, resume=resume)
        trainer = Trainer(config, scene, on_event=lambda line, name=names[run.folder]: say(f"{name} {line}"))
        trainers[run.folder] = trainer
        if trainer.lpips is None and len(trainers) == 1:
            say(trainer.lpips_source)
        paper_looks.forget_later(trainer)

    def failed(trainer: Trainer, error: TrainingError) -> None:
        """Keeps why a training failed in place of its result."""
        message = str(error).removeprefix(f"{trainer.out}: ")
        say(f"{names[trainer.out]} failed: {message}")
        row = {"failed": message, "psnr": None, "made_on": made_on()}
        write_text(trainer.out / "result.json", json.dumps(row, indent=1) + "\n")
        del trainers[trainer.out]

    take_turns(
        trainers.values(),
        budget=settings.budget,
        turn=settings.turn,
        stops=lambda trainer: [second for _, second in paper_looks.stops(trainer)],
        on_stop=paper_looks.reached,
        after_turn=lambda trainer: trainer.save(),
        on_failure=failed,
    )
    for folder in list(trainers):
        trainer = trainers.pop(folder)
        for name in paper_looks.missed(trainer):
            say(f"{names[folder]} no look {name!r}: its time had passed before an interruption")
        summary = trainer.run()
        for router in trainer.routers.values():
            router.blend = 0.0  # of the final scores alone: looks and curves are of one kind throughout
        paper_looks.look(trainer, settings.budget)
        cameras = scene.test.cameras
        row: Row = {
            **summary,
            "lr": trainer.config.lr,
            "size": [cameras.height, cameras.width],
            "curve": curve(trainer),
            "looks": paper_looks.numbers(folder),
            "config": changed_settings(json.loads(trainer.config.to_json())),
            "made_on": made_on(),
        }
        write_text(folder / "result.json", json.dumps(row, indent=1) + "\n")


def curve(trainer: Trainer) -> list[Row]:
    """The evaluations of a finished training, all as those on the way: other views, or blended, are another curve."""
    found = read_metrics(trainer.out)
    config, count = trainer.config, len(trainer.scene.test)
    if min(config.final_views or count, count) != min(config.eval_views, count) or config.blend:
        found[-1] |= mean_scores(evaluate(trainer.renderer, trainer.scene, views=config.eval_views))
        found[-1]["views"] = config.eval_views
    return found


def results(runs: Sequence[Run]) -> list[Row]:
    """The results of runs that were trained, each with its variant's name, its scene, its seed and its folder.

    Of several learning rates that with the best mean PSNR of the final test views counts, for every scene and variant
    alike; "rates" has the means of all. A rate at which a seed failed does not count, nor does one at which a training
    is still missing that a variant of the scene has at another: no side is searched further than the others.
    """
    tried: dict[tuple[str, str], dict[float, list[Row]]] = {}
    searched = rates_of_all(runs)
    for run in runs:
        if not run.result.is_file() or run.rate not in searched[run.scene]:
            continue
        row = {
            "variant": run.variant.name,
            "scene": Path(run.scene).name,
            "seed": run.seed,
            "rate": run.rate,
            "changes": {key: list(v) if isinstance(v, tuple) else v for key, v in run.variant.changes.items()},
            "run": run.folder.name,
            **read_result(run.folder),
        }
        tried.setdefault((row["scene"], row["variant"]), {}).setdefault(run.rate, []).append(row)
    found = []
    for group in tried.values():
        means = {
            rate: statistics.fmean(row["psnr"] for row in rows)
            for rate, rows in group.items()
            if not any("failed" in row for row in rows)
        }
        if not means:
            continue
        best = max(means, key=lambda rate: means[rate])
        found += [{**row, "rates": {f"{rate:g}": mean for rate, mean in means.items()}} for row in group[best]]
    return found


def rates_of_all(runs: Sequence[Run]) -> dict[str, list[float]]:
    """By scene the learning rates at which every variant and seed was trained that was trained at any."""
    found: dict[str, dict[float, set[tuple[str, int]]]] = {}
    for run in runs:
        made = found.setdefault(run.scene, {}).setdefault(run.rate, set())
        if run.result.is_file():
            made.add((run.variant.name, run.seed))
    return {
        scene: [rate for rate, made in rates.items() if made == set().union(*rates.values())]
        for scene, rates in found.items()
    }


def still_missing(runs: Sequence[Run]) -> list[str]:
    """Of trainings that were not made yet, a line a scene, variant and rate with its seeds."""
    found: dict[str, list[str]] = {}
    for run in runs:
        if not run.result.is_file():
            rate = f", rate x {run.rate:g}" if run.rate != 1 else ""
            found.setdefault(f"{run.variant.name} on {Path(run.scene).name}{rate}", []).append(str(run.seed))
    return [f"{name}, seed{'s' * (len(seeds) > 1)} {', '.join(seeds)}" for name, seeds in found.items()]


def failures(runs: Sequence[Run]) -> list[str]:
    """Of runs that failed, each training and why."""
    found = []
    for run in {run.folder: run for run in runs}.values():
        row = json.loads(run.result.read_text()) if run.result.is_file() else {}
        if "failed" in row:
            rate = f", rate x {run.rate:g}" if run.rate != 1 else ""
            found.append(f"{run.variant.name} on {Path(run.scene).name}, seed {run.seed}{rate}: {row['failed']}")
    return found
