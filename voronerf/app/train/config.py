"""The settings of a training: checked once, stored beside the results as JSON. Defaults that depend on the scene are
filled in by :mod:`voronerf.app.train.defaults`."""

from __future__ import annotations

import ast
import dataclasses
import itertools
import json
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from voronerf.app.train.schema import check_types
from voronerf.app.wording import as_typed, device_of, did_you_mean, either
from voronerf.nerf.fields import FIELDS, FieldType
from voronerf.nerf.samplers import SAMPLERS
from voronerf.nerf.split import RESERVOIR, PlannedSplit, final_cells, plan_splits
from voronerf.ops._core.backends import BACKENDS

#: Settings that are options of a field where its class has an option of that name.
NETWORK_SETTINGS = ("width", "depth")


class ConfigError(Exception):
    """A setting that cannot be used. The message names the setting, the rule and the value.

    It is not a ValueError, because the parser of the command line would catch that and print a long explanation.
    """


@dataclass(frozen=True)
class SceneSettings:
    """The scene that is learnt."""

    data: str = "builtin"
    """Scene folder (--format says which there are), that of one of its COLMAP models, or a built-in scene: "builtin",
    "builtin:400" of so many pixels, or "builtin-city:4x4", a city of so many blocks."""
    format: Literal["auto", "blender", "colmap", "transforms", "llff"] = "auto"
    """What is read of a scene folder; auto is the first of them that it holds, in this order, but
    transforms before a model in colmap/sparse (nerfstudio's), distorted/sparse or dense/sparse."""
    kind: Literal["auto", "object", "forward", "inside-out", "unbounded"] = "auto"
    """Kind of scene: an object on white; cameras that look the same way; that look outwards; or that look at one place
    with surroundings. auto tells it by transparent pixels and by the cameras."""
    normalise: bool = True
    """Move, turn and scale photographs so that the origin is in the middle, z is up and the farthest camera at distance
    1; the coordinates of the files are kept otherwise."""
    downscale: int | None = None
    """Factor by which the images are made smaller when they are loaded; default 1, and for photographs the least that
    leaves at most 512 pixels a side."""
    images: Literal["auto", "memory", "disk"] = "auto"
    """Keep the images of a scene folder or city in memory, or on disk: decoded once into a file of the cache
    (VORONERF_CACHE, or voronerf in the user's caches), from which the pixels of each step are read. auto is on disk for
    what does not fit into memory."""
    allow_outside: bool = False
    """Also read images that lie outside of the scene folder, which it may name by .., an absolute path or a link."""
    keep_far: bool = False
    """Keep photographs whose cameras lie far from the others. They are left out otherwise: one lost camera would give
    the scene its scale."""


@dataclass(frozen=True)
class RunSettings:
    """The run directory, the length of the run, and the device."""

    out: Path | None = None
    """Run directory, which must not hold a run unless --resume is given; default: runs/SCENE, or the first free
    runs/SCENE-N."""
    seed: int = 0
    """Seed of every random choice."""
    device: str = "cpu"
    """cpu, cuda, cuda:1, ...; auto is a GPU that this package has kernels for, else the CPU."""
    backend: str = "auto"
    """Backend of the operations: auto, native, warp or reference (see `voronerf info`)."""
    budget: float | None = None
    """Time in seconds for training and evaluation; default 480, unless --steps is given."""
    steps: int | None = None
    """Number of training steps, instead of a time."""


@dataclass(frozen=True)
class FieldSettings:
    """The network of a cell."""

    field: str = "hashgrid"
    """Kind of network: hashgrid (small networks on a hash grid that the cells share), nerf (as published), mipnerf
    (cones instead of rays), kilonerf (nerf in the size of KiloNeRF's networks), or another name in
    `voronerf.nerf.fields.FIELDS`."""
    field_options: tuple[str, ...] = ()
    """Further options of the field, each as NAME=VALUE, such as density_scale=20, skips=(4,) or view_directions=False.
    position_octaves is by default such that the finest wave spans two pixels of the training views, and two more for
    mipnerf, whose cones leave nothing of finer ones (published: 16)."""
    width: int | None = None
    """Channels of the networks' hidden layers; default 32, nerf and mipnerf 64."""
    depth: int | None = None
    """Hidden layers before the heads; default 1, nerf and mipnerf 4, kilonerf 2."""
    parameters: int | None = None
    """Upper limit for the number of parameters of all final cells together; --width becomes the largest that fits."""


@dataclass(frozen=True)
class CellSettings:
    """The Voronoi diagram."""

    cells: tuple[int, ...] = (16,)
    """Cells per level: `16` is 16 cells, `16 16` splits each of them into 16 again, no number is one network."""
    split_at: tuple[float, ...] | None = None
    """When to split, one time for each level: below 1 a fraction of the run, from 1 on a number of steps; default: 0.2,
    or evenly spaced from 0.15 to 0.5. With --max-cells those of the first and of the last split."""
    max_cells: int | None = None
    """Below the first level, split the cell with the largest accumulated error alone, again and again until there are
    this many cells. The first split makes the first number of --cells, each later one divides a cell into the last."""
    centres: Literal["balanced", "random", "uniform", "centroidal"] = "centroidal"
    """Centres of the new cells: balanced by importance (as published), drawn from the samples, a regular grid, or
    centroids of their cells, which makes cells compact."""
    init: Literal["inherit", "random"] = "inherit"
    """New cells start as copies of their parent, or from random parameters."""
    assignment: Literal["nearest", "stochastic"] = "nearest"
    """A sample goes to the nearest cell, or, while training, to one drawn by its distances to the centres."""


@dataclass(frozen=True)
class SamplingSettings:
    """Rays and where they are sampled."""

    rays: int | None = None
    """Rays per training step; default 512, on a hash grid in a box more for a long --budget. Where empty space is
    skipped, of the first steps: hashgrid takes up to eight times as many when few samples of a ray are left."""
    sampling: str = "stratified"
    """Samples along a ray: stratified in one pass, or hierarchical, with a second pass where the first found something
    (nerf: a coarse and a fine network)."""
    samples: tuple[int, ...] | None = None
    """Samples per ray of each pass; default 32 and 32 for two passes, for one 64. Where empty space is skipped 128, or
    256 in a training of at least 25 seconds, or 384 in one of 90; for an object more for larger images: 64 at 100
    pixels across it, 128 at 400, and on a hash grid twice as many, at most 256, in a training of at least 40 or 160
    seconds. A CPU that is measured to be faster than two cores of an AMD EPYC (Zen 5) needs less of --budget for it;
    --steps count the same everywhere."""
    sparse_depth: float | None = None
    """Factor of a loss on light that does not come from where the points of a sparse model are (Deng et al. 2022,
    "Depth-supervised NeRF"); default 0.0015 for COLMAP's models, and 0, which is off, without points."""
    contraction: Literal["auto", "none", "sphere", "ndc"] = "auto"
    """Space as the networks see it: unchanged; with all points outside a sphere mapped into a shell of twice its
    radius; or in normalised device coordinates, for forward-facing scenes. auto is none for a scene with a box and for
    fields without a grid, else ndc where the cameras face forward and the sphere elsewhere."""
    occupancy: bool = True
    """Skip samples in empty space, in training and in pictures, wherever that works: for points in a single pass, in a
    scene with a box or with a contraction."""


@dataclass(frozen=True)
class OptimiserSettings:
    """How the networks learn."""

    precision: Literal["fp32", "bf16", "fp16"] = "fp32"
    """Products of the networks while training: float32, bfloat16, or float16 with a scaled loss. Sums, parameters and
    moments are float32. A CPU multiplies in float32 and rounds only the outputs of the networks."""
    lr: float | None = None
    """Learning rate of Adam at the start; default: 0.02 up to width 64, in inverse proportion to the width beyond."""
    average: float = 0.98
    """Decay per step of the averaged weights, which evaluations and pictures use; 0 is off. It is smaller in the first
    steps. Training goes on with the weights themselves."""


@dataclass(frozen=True)
class OutputSettings:
    """Evaluations on the way."""

    evaluations: int = 8
    """Evaluations during the run, evenly spaced; the last one is at the end."""
    eval_views: int | None = None
    """Test views of every evaluation, evenly spread, in time of their own beside --budget; default: at most 20 on the
    way and all at the end, as many as a twentieth of the time so far and a tenth of the budget allow."""
    lpips: Path | None = None
    """LPIPS weights for the final evaluation, a file or folder, or "off"; default: VORONERF_LPIPS, the folder lpips of
    VORONERF_DATA or beside the scene, the installed lpips package."""


@dataclass(frozen=True)
class TrainConfig(
    OutputSettings, OptimiserSettings, SamplingSettings, CellSettings, FieldSettings, RunSettings, SceneSettings
):
    """All settings of a training.

    Raises:
        ConfigError: For a setting that is out of range; names it, the rule and the value.

    Examples:
        >>> from voronerf.app.train import TrainConfig
        >>> config = TrainConfig(data="builtin", steps=1000, cells=(4, 4), width=32)
        >>> config.final_cells
        16
        >>> TrainConfig.from_values(config.to_values()) == config
        True
    """

    def __post_init__(self) -> None:
        if self.budget is None and self.steps is None:
            object.__setattr__(self, "budget", 480.0)
        check_config(self)

    @property
    def field_type(self) -> FieldType:
        """The field's row in the table of fields."""
        return FIELDS[self.field]

    @property
    def reading(self) -> dict[str, Any]:
        """The settings that are arguments of ``load_scene``."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(SceneSettings)[1:]}

    @property
    def network_options(self) -> dict[str, Any]:
        """The arguments of the field: settings that it has options for, and ``field_options``."""
        settings = {name: getattr(self, name) for name in NETWORK_SETTINGS if name in self.field_type.options}
        chosen = {name: value for name, value in settings.items() if value is not None}
        return chosen | dict(parse_option(text) for text in self.field_options)

    @property
    def plan(self) -> tuple[PlannedSplit, ...]:
        """All splits of the run, in order."""
        return plan_splits(self.cells, self.split_at, self.max_cells)

    @property
    def final_cells(self) -> int:
        """Cells at the end, where every cell holds enough samples to be split."""
        return final_cells(self.plan)

    def to_values(self) -> dict[str, Any]:
        """The settings as values of JSON."""
        values = dataclasses.asdict(self)
        values |= {name: None if values[name] is None else str(values[name]) for name in PATHS}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}

    def to_json(self) -> str:
        """The settings as the text of a JSON file."""
        return json.dumps(self.to_values(), indent=2) + "\n"

    @staticmethod
    def from_values(values: Any, source: str = "config.json") -> TrainConfig:
        """Reads what :meth:`to_values` gave, from JSON.

        Raises:
            ConfigError: For values that are not a configuration, or one of another version; names ``source``.
        """
        try:
            if isinstance(values, dict):
                values = {key: tuple(v) if isinstance(v, list) else v for key, v in values.items()}
                paths = {name: values.get(name) for name in PATHS}
                values |= {name: Path(text) for name, text in paths.items() if isinstance(text, str)}
            check_types("settings", TrainConfig, values, optional=True)
            if not values:
                raise ValueError("no settings")
            return TrainConfig(**values)
        except (ValueError, ConfigError) as error:
            raise ConfigError(f"{source}: not a configuration of this version: {error}") from None


#: Settings that take one of a few words, with these words.
CHOICES: dict[str, tuple[str, ...]] = {
    name: get_args(kind) for name, kind in get_type_hints(TrainConfig).items() if get_origin(kind) is Literal
}
#: Settings that are text in JSON.
PATHS = ("out", "lpips")
#: Settings that may differ between a run and its continuation.
RESUMABLE = frozenset(
    {
        *("data", "allow_outside", "images", "out", "device", "backend"),
        *("sparse_depth", "budget", "steps", "evaluations", "eval_views", "lpips"),
    }
)


def differences(a: TrainConfig, b: TrainConfig) -> list[str]:
    """The settings in which ``b`` must not differ to continue ``a``: "--width 64 -> 128" and so on."""
    return [
        f"--{f.name.replace('_', '-')} {getattr(a, f.name)} -> {getattr(b, f.name)}"
        for f in dataclasses.fields(TrainConfig)
        if f.name not in RESUMABLE and getattr(a, f.name) != getattr(b, f.name)
    ]


def parse_option(text: str) -> tuple[str, Any]:
    """Splits ``name=value`` into a name and a Python value; a value that is no Python literal is a string."""
    name, _, value = text.partition("=")
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value


def check_backend_name(name: str) -> None:
    """Raises ConfigError for a name that is no backend's, such as that of a device."""
    names = ("auto", *BACKENDS)
    if name not in names:
        device = device_of(name)
        end = f"; did you mean --device {device}?" if device else did_you_mean(name, names)
        raise ConfigError(f"--backend must be {either(names)}, got {name!r}{end}")


def check_config(config: TrainConfig) -> None:
    """Raises ConfigError for the first setting that is out of range, or that the field or the sampler does not have."""

    def need(ok: bool, name: str, rule: str, words: Iterable[str] = ()) -> None:
        if not ok:
            value = getattr(config, name)
            end = did_you_mean(value, words)
            raise ConfigError(f"--{name.replace('_', '-')} must {rule}, got {as_typed(value)}{end}")

    need(config.sampling in SAMPLERS, "sampling", f"be {either(list(SAMPLERS))}", SAMPLERS)
    more = "voronerf.nerf.fields.register_field adds others"
    need(config.field in FIELDS, "field", f"be {either(list(FIELDS))}; {more}", FIELDS)
    if config.budget is not None and config.steps is not None:
        raise ConfigError("give --budget SECONDS or --steps N, not both")
    for name, words in CHOICES.items():
        need(getattr(config, name) in words, name, f"be {either(words)}", words)
    check_backend_name(config.backend)
    need(config.budget is None or 0 < config.budget < float("inf"), "budget", "be a positive number of seconds")
    need(config.steps is None or 1 <= config.steps < 2**53, "steps", "lie in 1..2^53 - 1")
    for name in ("rays", "evaluations", "eval_views", "downscale", "parameters"):
        value = getattr(config, name)
        need(value is None or value >= 1, name, "be at least 1")
    need(config.width is None or 2 <= config.width <= 65536, "width", "be at least 2 and at most 65536")
    need(config.depth is None or 1 <= config.depth <= 1000, "depth", "be at least 1 and at most 1000")
    need(config.lr is None or 0 < config.lr < float("inf"), "lr", "be a positive number")
    need(0 <= config.average < 1, "average", "lie in [0, 1)")
    need(0 <= config.seed < 2**63, "seed", "lie in 0..2^63 - 1")
    factor = config.sparse_depth
    need(factor is None or 0 <= factor < float("inf"), "sparse_depth", "be a factor of 0 or more")
    check_samples(config)
    _check_field_options(config)
    fits = all(2 <= k <= RESERVOIR for k in config.cells)
    need(fits, "cells", f"lie in 2..{RESERVOIR} on every level (none for one network)")
    if config.max_cells is not None:
        need(len(config.cells) in (1, 2), "max_cells", "come with one or two numbers of --cells")
        need(config.max_cells > config.cells[0], "max_cells", f"exceed the {config.cells[0]} cells of the first split")
    if config.split_at is not None:
        levels = len(config.cells) if config.max_cells is None else 2
        what = "level of --cells" if config.max_cells is None else "of the first and the last split"
        need(len(config.split_at) == levels, "split_at", f"have {levels} times, one for each {what}")
        rising = all(a < b for a, b in itertools.pairwise(config.split_at))
        fractions = all(0 < at < 1 for at in config.split_at)
        steps = all(1 <= at < (config.steps or float("inf")) for at in config.split_at)
        end = "" if config.steps is None else f" below --steps {config.steps}"
        need(rising and (fractions or steps), "split_at", f"be rising fractions of the run, or numbers of steps{end}")


def check_samples(config: TrainConfig) -> None:
    """Raises ConfigError for samples that are not one number for each pass of the sampler."""
    passes = SAMPLERS[config.sampling].passes
    if config.samples is not None and (len(config.samples) != passes or min(config.samples) < 1):
        count = "one number" if passes == 1 else f"{passes} numbers, one for each pass,"
        raise ConfigError(f"--samples must be {count} of at least 1, got {as_typed(config.samples)}")


def _check_field_options(config: TrainConfig) -> None:
    options = config.field_type.options
    for name in NETWORK_SETTINGS:
        setting = getattr(config, name)
        if name not in options and setting is not None:
            raise ConfigError(f"--{name.replace('_', '-')} must not come with --field {config.field}, got {setting!r}")
    known = [name for name in options if name not in NETWORK_SETTINGS]
    for text in config.field_options:
        if "=" not in text:
            raise ConfigError(f"--field-options must be NAME=VALUE, got {text!r}")
        name, value = parse_option(text)
        if name in NETWORK_SETTINGS:
            raise ConfigError(f"--field-options must not hold {name}, use --{name.replace('_', '-')}; got {text!r}")
        if name not in known:
            raise ConfigError(f"--field-options of {config.field} are {', '.join(known) or 'none'}; got {text!r}")
        is_number = isinstance(value, (int, float)) and abs(value) <= sys.float_info.max
        if isinstance(options[name], (int, float)) and not (is_number or value is None):
            raise ConfigError(f"--field-options must give {name} a finite number, got {text!r:.60}")
