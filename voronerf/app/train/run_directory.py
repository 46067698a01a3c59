"""Run directories: the choice of one, a lock on it, and the files in it."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shlex
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from voronerf.app.evaluate.lpips import OFF
from voronerf.app.evaluate.plots import plot_curves
from voronerf.app.files import (
    cache_folder,
    leads_outside,
    locked,
    private_folder,
    read_json,
    read_json_lines,
    remove_partial,
)
from voronerf.app.scenes import Scene, is_builtin
from voronerf.app.train.checkpoint import checkpoint_paths
from voronerf.app.train.config import ConfigError, TrainConfig

#: The folders of a run, in which files are written.
FOLDERS = ("camera_paths", "checkpoints", "images", "plots", "samples", "tensorboard")


def check_folders(run: Path) -> None:
    """Refuses a run with a folder that leads out of it, where files that are none of the run would be replaced."""
    for name in FOLDERS:
        if leads_outside(run / name, run):
            raise ConfigError(f"{run}: {name} must be in the run directory, got a link to {(run / name).resolve()}")


def is_outside(run: Path, path: str | Path) -> bool:
    """Whether the user has chosen neither a path nor a folder that it is in: the run's, the working directory,
    ``VORONERF_DATA``."""
    data = os.environ.get("VORONERF_DATA")
    folders = (run, Path.cwd(), *([Path(data)] if data else []))
    with contextlib.suppress(OSError):
        if _note_of(path).exists():
            return False
    return all(leads_outside(Path(path), folder) for folder in folders)


def remember_choice(path: str | Path) -> None:
    """Notes that the user of this machine has named a path, so that a run may name it from now on."""
    with contextlib.suppress(OSError):  # it must then be named again
        _note_of(path).touch()


def _note_of(path: str | Path) -> Path:
    name = hashlib.sha256(os.path.realpath(path).encode(errors="surrogateescape")).hexdigest()
    return private_folder(cache_folder() / "chosen") / name


def check_stored_paths(run: Path, *, data: str | None = None, lpips: Path | None = None) -> None:
    """Refuses paths of a run's settings outside of what the user chose, since the run may be another person's."""
    paths = {"data": None if is_builtin(data) else data, "lpips": None if str(lpips) == OFF else lpips}
    for option, path in paths.items():
        if path is not None and is_outside(run, path):
            raise ConfigError(
                f"{run}: --{option} must be given once, since a run may be another person's and this one names what is "
                f"outside of it, of the working directory and of VORONERF_DATA: --{option} {shlex.quote(str(path))}"
            )


def choose_directory(config: TrainConfig, scene: Scene, *, resume: bool = False) -> TrainConfig:
    """The configuration with ``out`` filled in and checked."""
    out = config.out
    if out is None:
        if resume:
            raise ConfigError("--resume needs --out, the run directory to continue")
        names = (scene.name, *(f"{scene.name}-{i}" for i in range(2, 10_000)))
        out = next(folder for name in names if _made(folder := Path("runs") / name))
    elif out.is_file():
        raise ConfigError(f"--out must be a folder, got the file {out}")
    elif not resume and checkpoint_paths(out):
        raise ConfigError(f"--out must not hold a run already, got {out}: continue it with --resume or choose another")
    elif resume and not checkpoint_paths(out):
        raise ConfigError(f"--resume needs a run in --out, and there is no checkpoint in {out}")
    return replace(config, out=out)


def _made(folder: Path) -> bool:
    """Makes a folder; False if it exists, which may be since another run began."""
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        return False
    return True


@contextlib.contextmanager
def held(folder: Path) -> Iterator[None]:
    """Locks a run directory, so that two processes cannot write it; without effect on file systems without locks."""
    check_folders(folder)
    made = _made(folder)

    def refuse() -> None:
        raise ConfigError(f"--out must not be in use by another run, got {folder}")

    with locked(folder, refuse):
        remove_partial(folder)
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                if made:
                    folder.rmdir()  # fails if something was written, and is then not needed


def stored_config(run: Path) -> TrainConfig | None:
    """The settings of the run in a directory, for its continuation; None if it holds no run.

    ``allow_outside`` is not among them: whoever made the run may be another than who continues it.
    """
    path = run / "config.json"
    return replace(read_config(path), out=run) if path.is_file() else None


def read_config(path: Path) -> TrainConfig:
    """The settings in a file, for a training of another person; without directory and --allow-outside."""
    config = TrainConfig.from_values(read_json(path), str(path))
    for name, value in vars(config).items():  # they are defaults, which the help prints
        if not "".join(map(str, value if isinstance(value, tuple) else (value,))).isprintable():
            raise ConfigError(f"{path}: {name} must be printable text, got {value!r:.60}")
    return replace(config, out=None, allow_outside=False)


def read_metrics(run: Path) -> list[dict[str, Any]]:
    """The evaluations of a run, in order."""
    path = run / "metrics.jsonl"
    metrics = read_json_lines(path)
    for number, line in enumerate(metrics, 1):
        if not isinstance(line.get("step"), int):
            raise ValueError(f"{path}: line {number}: step must be an integer, got {line.get('step')!r:.60}")
        if not isinstance(line.get("psnr", ""), (int, float, type(None))):
            raise ValueError(
                f"{path}: line {number}: psnr must be a number or null, got {line.get('psnr', 'none')!r:.60}"
            )
    return metrics


def read_curve(run: Path) -> list[tuple[float, float]]:
    """Training seconds and PSNR of the evaluations of a run, of whole views and where the PSNR is finite."""
    points = [(line.get("seconds"), line.get("psnr")) for line in read_metrics(run) if line.get("part", 1) == 1]
    return [(x, y) for x, y in points if isinstance(x, (int, float)) and isinstance(y, (int, float))]


def write_curve(run: Path) -> Path | None:
    """Plots PSNR over training time into ``plots/psnr.png``; returns None if there is nothing to plot."""
    points = read_curve(run)
    if not points:
        return None
    path = run / "plots" / "psnr.png"
    plot_curves(path, {run.name: points})
    return path
