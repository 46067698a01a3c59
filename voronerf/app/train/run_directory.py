"""Run directories: their choice, lock and files."""

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
from voronerf.app.scenes import is_builtin
from voronerf.app.train.checkpoint import checkpoint_paths
from voronerf.app.train.config import ConfigError, TrainConfig

#: The subfolders of a run directory to which files are written.
FOLDERS = ("camera_paths", "checkpoints", "images", "plots", "samples", "tensorboard")


def check_folders(run: Path) -> None:
    """Raises ConfigError if a subfolder of a run is a link out of it, since a write could then replace other files."""
    for name in FOLDERS:
        if leads_outside(run / name, run):
            raise ConfigError(f"{run}: {name} must be in the run directory, got a link to {(run / name).resolve()}")


def is_outside(run: Path, path: str | Path) -> bool:
    """Returns whether a path lies outside the run directory, the working directory and ``VORONERF_DATA``.

    Paths that the user has named before, see :func:`remember_choice`, do not count as outside.
    """
    data = os.environ.get("VORONERF_DATA")
    folders = (run, Path.cwd(), *([Path(data)] if data else []))
    with contextlib.suppress(OSError):
        if _marker_of(path).exists():
            return False
    return all(leads_outside(Path(path), folder) for folder in folders)


def remember_choice(path: str | Path) -> None:
    """Remembers that the user of this machine has named a path; settings of runs may then name the path, too."""
    with contextlib.suppress(OSError):  # on failure, the user must name it again
        _marker_of(path).touch()


def _marker_of(path: str | Path) -> Path:
    name = hashlib.sha256(os.path.realpath(path).encode(errors="surrogateescape")).hexdigest()
    return private_folder(cache_folder() / "chosen") / name


def check_stored_paths(run: Path, *, data: str | None = None, lpips: Path | None = None) -> None:
    """Raises ConfigError if `is_outside` is true for a path in a run's settings: the run may be another person's."""
    paths = {"data": None if is_builtin(data) else data, "lpips": None if str(lpips) == OFF else lpips}
    for option, path in paths.items():
        if path is not None and is_outside(run, path):
            raise ConfigError(
                f"{run}: --{option} must be given once: the run names a path outside of its directory, of the working "
                f"directory and of VORONERF_DATA, and may be another person's; add --{option} {shlex.quote(str(path))}"
            )


def choose_directory(config: TrainConfig, name: str, *, resume: bool = False) -> TrainConfig:
    """Returns the configuration with ``out`` filled in and checked; makes a new folder if ``out`` is None.

    The new folder is `runs/NAME`, or the first free `runs/NAME-N`.
    """
    out = config.out
    if out is None:
        if resume:
            raise ConfigError("--resume needs --out, the run directory to continue")
        names = (name, *(f"{name}-{i}" for i in range(2, 10_000)))
        out = next(folder for each in names if _make_folder(folder := Path("runs") / each))
    elif out.is_file():
        raise ConfigError(f"--out must be a folder, got the file {out}")
    elif not resume and checkpoint_paths(out):
        raise ConfigError(f"--out must not hold a run already, got {out}: continue it with --resume or choose another")
    elif resume and not checkpoint_paths(out):
        raise ConfigError(f"--resume needs a run in --out, and there is no checkpoint in {out}")
    return replace(config, out=out)


def _make_folder(folder: Path) -> bool:
    """Makes a folder, and returns whether it is new; another run may have made it meanwhile."""
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        return False
    return True


@contextlib.contextmanager
def held(folder: Path) -> Iterator[None]:
    """Locks a run directory against other processes; has no effect on file systems without locks."""
    check_folders(folder)
    is_new = _make_folder(folder)

    def refuse() -> None:
        raise ConfigError(f"--out must not be in use by another run, got {folder}")

    with locked(folder, refuse):
        remove_partial(folder)
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                if is_new:
                    folder.rmdir()  # removes an empty folder; fails, as intended, if it has files


def stored_config(run: Path) -> TrainConfig | None:
    """Returns the settings for continuing the run in a directory; None if there is no run.

    ``allow_outside`` is reset, since the run may be another person's.
    """
    path = run / "config.json"
    return replace(read_config(path), out=run) if path.is_file() else None


def read_config(path: Path) -> TrainConfig:
    """Reads settings from a file, perhaps another person's; resets ``out`` and ``allow_outside``."""
    config = TrainConfig.from_values(read_json(path), str(path))
    for name, value in vars(config).items():  # the help prints them as defaults of options
        if not "".join(map(str, value if isinstance(value, tuple) else (value,))).isprintable():
            raise ConfigError(f"{path}: {name} must be printable text, got {value!r:.60}")
    return replace(config, out=None, allow_outside=False)


def read_metrics(run: Path) -> list[dict[str, Any]]:
    """Returns the evaluations of a run, in order."""
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
    """Returns (training seconds, PSNR in dB) of a run's evaluations on whole views with a finite PSNR."""
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
