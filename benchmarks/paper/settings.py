"""How large an experiment of the paper is, and what of it is made now: the options of benchmarks/paper.py."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from voronerf.training.config import ConfigError, TrainConfig

#: Settings that follow from those of an experiment.
TAKEN = frozenset(
    {"data", "downscale", "seed", "budget", "steps", "evaluations", "eval_views", "final_views", "rays", "samples"}
    | {"backend", "checkpoint_every", "keep_checkpoints", "out", "resume", "panels", "lr"}
)


@dataclass(frozen=True)
class Settings:
    """How large an experiment is."""

    scene: tuple[str, ...] = ()
    """Scenes: folders, names in the data folder (VORONERF_DATA, else ../shared/data), or built-in ones; default: lego
    where it is there, else builtin, and for the tables by sampling and architecture also ship, for the latter drums.
    Results are kept by a
    scene's name: another scene of that name, or other images in its folder, need another --out, or --again."""
    downscale: int = 4
    """Factor on a scene's own images, 400 x 400 as published; the built-in scenes have 100 x 100 at 4. Results are kept
    by the factor, not by the size that comes out."""
    budget: float = 480.0
    """Training seconds of every variant."""
    seeds: int = 2
    """Runs of every variant, seeds 0, 1, ..."""
    out: Path = Path("runs/paper")
    """Folder for runs, JSON, tables and pictures."""
    again: bool = False
    """Make trainings again that are in --out already: their results are deleted before the first one starts. What is
    interrupted goes on without --again; with it, all begins anew."""
    turn: float = 5.0
    """Seconds that a variant trains before the next one has its turn."""
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
    rates: tuple[float, ...] = (1.0,)
    """Factors on the learning rate: every variant is trained with each of them, and the one with the best mean PSNR
    of the final test views counts; by default there is no search."""
    large: bool = False
    """Also what takes a larger machine: 16 x 16 cells among the numbers of cells."""
    backend: str = "auto"
    """Backend of the operations."""
    options: tuple[str, ...] = ()
    """Further settings of all variants alike, NAME=VALUE as config.json has them, such as lr_split=0.5; none that the
    experiment compares."""
    variants: str = ""
    """Train now only variants in whose name this regular expression is found. Tables show what is there of all
    variants, and say what is missing."""
    only_seeds: tuple[int, ...] = ()
    """Train now only these of the seeds."""
    train: bool = True
    """With --no-train nothing is trained: tables are made of what is there."""
    record: Path | None = None
    """A file of results, to be kept where --out is not: trainings that it knows are not made again, and those made are
    added to it."""

    def __post_init__(self) -> None:
        try:
            re.compile(self.variants)
        except re.error as error:
            raise ConfigError(f"--variants must be a regular expression, got {self.variants!r}: {error}") from None
        for name in self.further:
            if name in TAKEN or name not in {field.name for field in fields(TrainConfig)}:
                raise ConfigError(
                    f"--options must name settings of `voronerf train` that have no option here, got {name}"
                )
        if not set(self.only_seeds) <= set(range(self.seeds)):
            raise ConfigError(f"--only-seeds must be below --seeds {self.seeds}, got {self.only_seeds}")
        for name in ("downscale", "seeds", "rays", "evaluations", "eval_views"):
            if getattr(self, name) < 1:
                raise ConfigError(f"--{name.replace('_', '-')} must be at least 1, got {getattr(self, name)}")
        if self.samples < 2:
            raise ConfigError(f"--samples must be at least 2, one in each of two passes, got {self.samples}")
        if self.cells < 2:
            raise ConfigError(f"--cells must be at least 2, got {self.cells}")
        if not self.rates or not all(0 < rate < float("inf") for rate in self.rates):
            raise ConfigError(f"--rates must be positive factors, got {self.rates}")
        for name in ("budget", "turn"):
            if not 0 < getattr(self, name) < float("inf"):
                raise ConfigError(f"--{name} must be a positive number of seconds, got {getattr(self, name)}")

    @property
    def further(self) -> dict[str, Any]:
        """The options by name.

        Raises:
            ConfigError: When one is not NAME=VALUE.
        """
        found: dict[str, Any] = {}
        for option in self.options:
            name, equals, text = option.partition("=")
            if not equals:
                raise ConfigError(f"--options must be NAME=VALUE, got {option!r}")
            try:
                value = json.loads(text)
            except json.JSONDecodeError:
                value = text
            found[name] = tuple(value) if isinstance(value, list) else value
        return found
