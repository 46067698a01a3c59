"""Checks of the settings of a training run."""

from __future__ import annotations

import ast
import itertools
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch

from voronerf.nerf.fields import FIELDS
from voronerf.nerf.samplers import SAMPLERS
from voronerf.ops._core.backends import BACKENDS

if TYPE_CHECKING:
    from voronerf.app.train.config import TrainConfig

#: Settings that are options of a field where its class has an option of that name.
NETWORK_SETTINGS = ("width", "depth")


class ConfigError(Exception):
    """A setting that cannot be used. The message names the setting, the rule and the value.

    It is not a ValueError, because the parser of the command line would catch that and print a long explanation.
    """


def check_sampling(config: TrainConfig) -> None:
    """Raises ConfigError for a sampler that is not in the table."""
    if config.sampling not in SAMPLERS:
        raise ConfigError(f"--sampling must be {either(list(SAMPLERS))}, got {config.sampling!r}")


def check_field(config: TrainConfig) -> None:
    """Raises ConfigError for a field that is not in the table, or a setting that it has no option for."""
    if config.field not in FIELDS:
        known = either(list(FIELDS))
        raise ConfigError(
            f"--field must be {known}, got {config.field!r}; voronerf.nerf.fields.register_field adds others"
        )
    options = config.field_type.options
    for name in NETWORK_SETTINGS:
        given = getattr(config, name)
        if name not in options and given is not None:
            raise ConfigError(f"--{name.replace('_', '-')} must not come with --field {config.field}, got {given!r}")
    own = [name for name in options if name not in NETWORK_SETTINGS]
    for text in config.field_options:
        if "=" not in text:
            raise ConfigError(f"--field-options must be NAME=VALUE, got {text!r}")
        name, value = parse_option(text)
        if name in NETWORK_SETTINGS:
            raise ConfigError(f"--field-options must not hold {name}, use --{name.replace('_', '-')}; got {text!r}")
        if name not in own:
            raise ConfigError(f"--field-options of {config.field} are {', '.join(own) or 'none'}; got {text!r}")
        is_number = isinstance(value, (int, float)) and abs(value) <= sys.float_info.max
        if isinstance(options[name], (int, float)) and not (is_number or value is None):
            raise ConfigError(f"--field-options must give {name} a finite number, got {text!r:.60}")


def parse_option(text: str) -> tuple[str, Any]:
    """Splits ``name=value`` into a name and a Python value; a value that is no Python literal is a string."""
    name, _, value = text.partition("=")
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value


def either(names: Sequence[str]) -> str:
    """``a, b or c``."""
    return " or ".join((", ".join(names[:-1]), names[-1])) if len(names) > 1 else names[0]


def check_config(config: TrainConfig, choices: Mapping[str, Sequence[str]]) -> None:
    """Raises ConfigError for the first setting that is out of range, or is none of its ``choices``."""

    def need(ok: bool, name: str, rule: str) -> None:
        if not ok:
            raise ConfigError(f"--{name.replace('_', '-')} must {rule}, got {getattr(config, name)!r}")

    if config.budget is not None and config.steps is not None:
        raise ConfigError("give --budget SECONDS or --steps N, not both")
    for name, words in choices.items():
        need(getattr(config, name) in words, name, f"be {either(words)}")
    need(config.backend in ("auto", *BACKENDS), "backend", f"be auto, {', '.join(BACKENDS)}")
    need(config.budget is None or 0 < config.budget < float("inf"), "budget", "be a positive number of seconds")
    for name in ("rays", "fine_samples", "reservoir", "reservoir_batches", "evaluations", "keep_checkpoints"):
        need(getattr(config, name) >= 1, name, "be at least 1")
    need(config.downscale is None or config.downscale >= 1, "downscale", "be at least 1")
    cells = config.occupancy_resolution
    need(cells is None or 1 <= cells <= 512, "occupancy_resolution", "be at least 1 and at most 512")
    need(config.ray_growth is not None and 1 <= config.ray_growth <= 16, "ray_growth", "lie in 1..16")
    need(config.samples is None or config.samples >= 1, "samples", "be at least 1")
    need(config.steps is None or config.steps >= 1, "steps", "be at least 1")
    need(config.width is None or config.width >= 2, "width", "be at least 2")
    need(config.depth is None or 1 <= config.depth <= 1000, "depth", "be at least 1 and at most 1000")
    need(config.parameters is None or config.parameters >= 1, "parameters", "be at least 1")
    for name in ("panels", "min_cell_samples"):
        need((getattr(config, name) or 0) >= 0, name, "not be negative")
    need(config.eval_views >= 1, "eval_views", "be at least 1")
    need(0 <= config.evaluation_share <= 0.5, "evaluation_share", "lie in 0..0.5")
    need(config.final_views is None or config.final_views >= 1, "final_views", "be at least 1")
    need(config.lr is None or 0 < config.lr < float("inf"), "lr", "be positive")
    need(config.lr_hold is not None and 0 <= config.lr_hold < 1, "lr_hold", "lie in [0, 1)")
    need(0 < config.lr_final <= 1, "lr_final", "lie in (0, 1]")
    need(0 <= config.average < 1, "average", "lie in [0, 1)")
    need(0 < config.temperature < float("inf"), "temperature", "be positive and finite")
    need(0 <= config.seed < 2**63, "seed", "lie in 0..2^63 - 1")
    largest = max(config.cells, default=0)
    need(largest <= config.reservoir, "cells", f"not exceed --reservoir, the {config.reservoir} samples of a split")
    need(config.checkpoint_every > 0, "checkpoint_every", "be positive")
    need(config.device.startswith("cuda") or not config.cuda_graph, "cuda_graph", "come with --device cuda")
    for name in ("appearance", "refine_cameras"):
        need(
            not (getattr(config, name) and config.cuda_graph),
            name,
            "be off with --cuda-graph: it counts steps on the host",
        )
    half = config.precision != "fp32"
    need(not (config.refine_cameras and half), "refine_cameras", "be off with --precision bf16 and fp16")
    need(all(k >= 2 for k in config.cells), "cells", "be at least 2 on every level (none for one network)")
    _check_splits(config, need)
    shares = "share" in config.field_type.router_options
    need(shares or not config.cell_tables, "cell_tables", "come with a field whose cells share parameters, as hashgrid")
    need(config.sightings is None or 0 <= config.sightings < float("inf"), "sightings", "be a factor of 0 or more")


def why_no_occupancy(config: TrainConfig) -> str | None:
    """What keeps a run from skipping samples in empty space, whatever its scene; None if nothing does."""
    obstacles = {
        f"--field {config.field}, which takes cones": config.field_type.cones,
        f"--sampling {config.sampling}": not SAMPLERS[config.sampling].skips,
    }
    return next((name for name, there in obstacles.items() if there), None)


def _check_splits(config: TrainConfig, need: Callable[[bool, str, str], None]) -> None:
    if config.max_cells is not None:
        need(config.split == "worst", "max_cells", "come with --split worst")
        need(len(config.cells) in (1, 2), "max_cells", "come with one or two numbers of --cells")
        need(config.max_cells > config.cells[0], "max_cells", f"exceed the {config.cells[0]} cells of the first split")
    given = [name for name in ("split_at", "split_at_steps") if getattr(config, name) is not None]
    if len(given) > 1:
        raise ConfigError("give --split-at or --split-at-steps, not both")
    for name in given:
        times, unit = getattr(config, name), {"split_at": "fraction"}.get(name, "number")
        if config.max_cells is None:
            rule = f"have one {unit} for each of the {len(config.cells)} levels of --cells"
            need(len(times) == len(config.cells), name, rule)
        else:
            need(len(times) == 2, name, f"have two {unit}s, of the first and the last split, with --max-cells")
        rising = all(a < b for a, b in itertools.pairwise(times))
        end = 1.0 if name == "split_at" else config.steps
        inside = all(0 < at < (float("inf") if end is None else end) for at in times)
        kind = "fractions" if name == "split_at" else "numbers"
        bound = "above 0" if end is None else f"between 0 and {end:g}"
        need(rising and inside, name, f"be rising {kind} {bound}")


def check_device(name: str) -> None:
    """Raises ConfigError unless ``name`` is a torch device that is present."""
    try:
        if torch.device(name).type not in ("cpu", "cuda"):
            raise ConfigError(f"--device must be cpu or cuda, got {name!r}")
        float(torch.zeros((), device=name))
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"--device must name a device that is present, got {name!r}: {reason}") from None
