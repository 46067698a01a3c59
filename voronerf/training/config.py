"""The configuration of a training run: one dataclass, checked once, stored beside the results as JSON."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from voronerf.backends import BACKENDS

FieldName = Literal["nerf"]


class ConfigError(Exception):
    """A setting that cannot be used; the message names it, the rule and the value.

    No ValueError, because the command line's parser takes those for its own and explains them at length.
    """


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training run."""

    data: str = "builtin"
    """Scene folder (Blender synthetic or transforms.json), or "builtin" for the scene computed from formulas."""
    downscale: int = 1
    """Factor by which the images are made smaller on load."""
    out: Path | None = None
    """Run directory, without a run in it unless --resume; default: runs/SCENE, or the first free runs/SCENE-N."""
    resume: bool = False
    """Continue the run in --out from its last checkpoint."""
    seed: int = 0
    """Seed of every random choice."""
    device: str = "cpu"
    """Torch device, such as cpu or cuda:0."""
    backend: str = "auto"
    """Backend of the operations: auto, native, warp or reference (see `voronerf info`)."""

    budget: float | None = None
    """Training time in seconds, evaluation not counted; default 480, unless --steps is given."""
    steps: int | None = None
    """Training steps, instead of a time."""

    field: FieldName = "nerf"
    """Architecture of the networks."""
    width: int = 64
    """Channels of the networks' hidden layers."""
    depth: int = 4
    """Hidden layers before the heads."""
    skips: tuple[int, ...] | None = None
    """Trunk layers whose output is joined with the encoded position again; default: 4, as published, where there are
    more than five layers, else none."""
    position_octaves: int | None = None
    """Frequencies of the position's encoding; default: until the finest wave spans two pixels of the training views."""
    direction_octaves: int = 4
    """Frequencies of the view direction's encoding."""
    view_directions: bool = True
    """Whether colour depends on the view direction."""

    cells: tuple[int, ...] = (16,)
    """Cells per level: `16` is 16 cells, `16 16` splits each of them into 16 again, nothing is one network."""
    split_at: tuple[float, ...] | None = None
    """When to split, as fractions of the run, one per level; default: 0.2, or evenly spaced from 0.15 to 0.5."""
    split: Literal["all", "worst"] = "all"
    """On the levels below the first: split every cell, or only the one with the largest accumulated error."""
    centres: Literal["balanced", "random", "uniform"] = "balanced"
    """Centres of the new cells: balanced by importance, drawn from the samples, or a regular grid."""
    balance: Literal["published", "transport"] = "published"
    """How centres are balanced: the paper's update, or power weights from optimal transport."""
    init: Literal["inherit", "random"] = "inherit"
    """New cells start as copies of their parent, or from random parameters."""
    assignment: Literal["nearest", "stochastic"] = "nearest"
    """Samples go to the nearest cell, or while training to one drawn from the distances."""
    temperature: float = 0.05
    """Temperature of the stochastic assignment, in scene units."""
    reservoir: int = 10_000
    """Importance samples kept for the next split."""
    reservoir_batches: int = 500
    """Batches over which the kept samples are spread, each giving the same number of its heaviest."""
    min_cell_samples: int = 64
    """A cell holding fewer kept samples than this is not split further."""

    rays: int = 1024
    """Rays per training step."""
    samples: int = 64
    """Samples per ray, one in each of as many strata."""
    occupancy: bool = False
    """Skip the samples in cells of space found empty, in training and in its pictures; needs a scene with a box."""
    occupancy_resolution: int = 64
    """Cells of that grid along each axis."""
    lr: float | None = None
    """Learning rate of Adam at the start; default: 0.02 up to width 64, beyond in inverse proportion to the width."""
    lr_final: float = 0.05
    """Learning rate at the end, as a fraction of --lr; the decay is exponential."""
    warmup: float = 0.02
    """Fraction of the run over which the learning rate rises from a hundredth of --lr."""
    background: Literal["random", "white"] = "random"
    """Colour behind images with an alpha channel while training: a new one for every ray, or white as in evaluation."""

    evaluations: int = 8
    """Evaluations during the run, evenly spaced; the last one comes at its end."""
    eval_views: int = 20
    """Test views of an evaluation during training, evenly spread; the final one uses --final-views."""
    final_views: int | None = None
    """Test views of the final evaluation; default all."""
    checkpoint_every: float = 60.0
    """Seconds between checkpoints."""
    panels: int = 4
    """Test views drawn as picture panels at the end."""

    def __post_init__(self) -> None:
        if self.budget is None and self.steps is None:
            object.__setattr__(self, "budget", 480.0)
        if self.lr is None:
            # Hidden layers under Adam want steps in inverse proportion to their width (Yang et al. 2021, table 3).
            object.__setattr__(self, "lr", 0.02 * 64 / max(self.width, 64))
        check_config(self)

    @property
    def splits(self) -> tuple[float, ...]:
        """When each level is split, as fractions of the run."""
        if self.split_at is not None:
            return self.split_at
        levels = len(self.cells)
        if levels < 2:
            return (0.2,) * levels
        return tuple(0.15 + 0.35 * i / (levels - 1) for i in range(levels))

    def to_json(self) -> str:
        """The settings as JSON text, which :meth:`from_json` reads."""
        values = dataclasses.asdict(self)
        values["out"] = None if self.out is None else str(self.out)
        return json.dumps(values, indent=2) + "\n"

    @staticmethod
    def from_json(text: str, source: str = "config.json") -> TrainConfig:
        """Reads what :meth:`to_json` wrote.

        Raises:
            ConfigError: For text that is no configuration, or one of another version; names ``source``.
        """
        try:
            values: dict[str, Any] = json.loads(text)
            known = {f.name for f in dataclasses.fields(TrainConfig)}
            unknown = sorted(set(values) - known)
            if unknown:
                raise ConfigError(f"unknown settings {', '.join(unknown)}")
            lists = ("cells", "split_at", "skips")
            values = {key: tuple(v) if key in lists and v is not None else v for key, v in values.items()}
            values["out"] = None if values["out"] is None else Path(values["out"])
            return TrainConfig(**values)
        except (json.JSONDecodeError, TypeError, AttributeError, KeyError, ConfigError) as error:
            raise ConfigError(f"{source}: not a configuration of this version: {error}") from None


#: Settings that may differ between a run and its continuation.
RESUMABLE = frozenset(
    {"data", "out", "resume", "device", "backend", "budget", "steps", "evaluations", "eval_views", "final_views"}
    | {"checkpoint_every", "panels"}
)


def check_config(config: TrainConfig) -> None:
    """Raises ConfigError for the first setting that is out of range."""

    def need(ok: bool, name: str, rule: str) -> None:
        if not ok:
            raise ConfigError(f"--{name.replace('_', '-')} must {rule}, got {getattr(config, name)!r}")

    if config.budget is not None and config.steps is not None:
        raise ConfigError("give --budget SECONDS or --steps N, not both")
    need(config.backend in ("auto", *BACKENDS), "backend", f"be auto, {', '.join(BACKENDS)}")
    need(config.budget is None or 0 < config.budget < float("inf"), "budget", "be a positive number of seconds")
    for name in (
        "downscale",
        "rays",
        "samples",
        "depth",
        "reservoir",
        "reservoir_batches",
        "evaluations",
        "occupancy_resolution",
    ):
        need(getattr(config, name) >= 1, name, "be at least 1")
    need(config.occupancy_resolution <= 512, "occupancy_resolution", "be at most 512")
    need(config.steps is None or config.steps >= 1, "steps", "be at least 1")
    need(config.width >= 2, "width", "be at least 2")
    for name in ("position_octaves", "direction_octaves", "panels", "min_cell_samples"):
        need((getattr(config, name) or 0) >= 0, name, "not be negative")
    need(config.eval_views >= 1, "eval_views", "be at least 1")
    need(config.final_views is None or config.final_views >= 1, "final_views", "be at least 1")
    need(0 < (config.lr or 0.0) < float("inf"), "lr", "be positive")
    need(0 < config.lr_final <= 1, "lr_final", "lie in (0, 1]")
    need(0 <= config.warmup < 1, "warmup", "lie in [0, 1)")
    need(0 < config.temperature < float("inf"), "temperature", "be positive and finite")
    need(0 <= config.seed < 2**63, "seed", "lie in 0..2^63 - 1")
    largest = max(config.cells, default=0)
    need(largest <= config.reservoir, "cells", f"not exceed --reservoir, the {config.reservoir} samples of a split")
    need(config.checkpoint_every > 0, "checkpoint_every", "be positive")
    need(all(k >= 2 for k in config.cells), "cells", "be at least 2 on every level (none for one network)")
    if config.split_at is not None:
        fits = len(config.split_at) == len(config.cells)
        need(fits, "split_at", f"have one fraction for each of the {len(config.cells)} levels of --cells")
        rising = all(a < b for a, b in zip(config.split_at, config.split_at[1:], strict=False))
        inside = all(0 < at < 1 for at in config.split_at)
        need(rising and inside, "split_at", "be rising fractions between 0 and 1")


def check_device(name: str) -> None:
    """Raises ConfigError unless ``name`` is a torch device that is present."""
    try:
        float(torch.zeros((), device=name))
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"--device must name a device that is present, got {name!r}: {reason}") from None


def differences(a: TrainConfig, b: TrainConfig) -> list[str]:
    """What keeps a checkpoint of ``a`` from being continued under ``b``: "--width 64 -> 128" and so on."""
    return [
        f"--{f.name.replace('_', '-')} {getattr(a, f.name)} -> {getattr(b, f.name)}"
        for f in dataclasses.fields(TrainConfig)
        if f.name not in RESUMABLE and getattr(a, f.name) != getattr(b, f.name)
    ]
