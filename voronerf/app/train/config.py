"""The settings of a training: checked once, and stored beside the results as JSON.

:mod:`voronerf.app.train.defaults` fills in the defaults that depend on the scene.
"""

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

#: Settings that are passed to the field if its class has an option of the same name.
NETWORK_SETTINGS = ("width", "depth")


class ConfigError(Exception):
    """An unusable setting; the message names the setting, the rule and the value.

    It is not a ValueError, which the command-line parser would catch to print a long explanation.
    """


@dataclass(frozen=True)
class SceneSettings:
    """The scene."""

    data: str = "builtin"
    """Scene folder in a format of --format, the folder of a COLMAP model in it, or a built-in scene: "builtin",
    "builtin:400" with 400 pixels a side, or "builtin-city:4x4", a city of 16 blocks."""
    format: Literal["auto", "blender", "colmap", "transforms", "llff"] = "auto"
    """Format of the scene folder; auto takes the first of these formats that the folder has. However, transforms
    precedes a COLMAP model in colmap/sparse (written by nerfstudio), distorted/sparse or dense/sparse."""
    kind: Literal["auto", "object", "forward", "inside-out", "unbounded"] = "auto"
    """Kind of scene: an object on white; cameras that look the same way; cameras that look outwards; or cameras that
    look at one place with surroundings. auto decides by transparent pixels and by the cameras."""
    normalise: bool = True
    """Move, turn and scale photographs so that the origin is in the middle, z is up and the farthest camera at distance
    1; otherwise the coordinates of the files are kept."""
    downscale: int | None = None
    """Factor by which the images are reduced; default 1 or, for photographs, the smallest factor that leaves at most
    512 pixels a side."""
    images: Literal["auto", "memory", "disk"] = "auto"
    """Keep the images of a scene folder or city in memory, or on disk: decoded once into a file of the cache
    (VORONERF_CACHE, or voronerf in the user's caches), from which the pixels of each step are read. auto is disk if the
    images do not fit into memory."""
    allow_outside: bool = False
    """Also read images outside of the scene folder, to which a scene may refer by .., an absolute path or a link."""
    keep_far: bool = False
    """Keep photographs whose cameras lie far from the others. By default they are left out, since one lost camera would
    determine the scale of the scene."""
    region: tuple[float, float, float, float, float, float] | None = None
    """Train only a box of the scene, x y z of its lowest and of its highest corner, on the pixels that see it; voronerf
    regions divides a scene into such boxes, and voronerf join joins them."""


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
    """Number of training steps, instead of a budget."""


@dataclass(frozen=True)
class FieldSettings:
    """The network of a cell."""

    field: str = "hashgrid"
    """Kind of network: hashgrid (small networks on a hash grid shared by the cells), nerf (as published), mipnerf
    (cones instead of rays), kilonerf (nerf in the size of KiloNeRF's networks), or another name in
    `voronerf.nerf.fields.FIELDS`."""
    field_options: tuple[str, ...] = ()
    """Further options of the field, each as NAME=VALUE, such as density_scale=20, skips=(4,) or view_directions=False.
    By default, position_octaves, the number of octaves of the positional encoding, is the smallest for which the
    shortest wave spans at most two pixels of the training views. mipnerf has two more octaves, but not the published
    16, since its cones filter out even shorter waves."""
    width: int | None = None
    """Channels of the networks' hidden layers; default 32, nerf and mipnerf 64."""
    depth: int | None = None
    """Hidden layers before the heads; default 1, nerf and mipnerf 4, kilonerf 2."""
    parameters: int | None = None
    """Limit of the number of parameters of all final cells together; --width becomes the largest that fits."""


@dataclass(frozen=True)
class CellSettings:
    """The Voronoi diagram."""

    cells: tuple[int, ...] = (16,)
    """Cells per level: `16` is 16 cells, `16 16` splits each of the 16 cells into 16. `--cells` without a
    number is one network."""
    split_at: tuple[float, ...] | None = None
    """Time of the split of each level: below 1 a fraction of the run, otherwise a number of steps; default: 0.2 for one
    split, evenly spaced from 0.15 to 0.5 for several. With --max-cells, the times of the first and of the last split.
    """
    max_cells: int | None = None
    """Final number of cells. Each split after the first one then divides only the cell with the largest accumulated
    error. The first number of --cells is for the first split, the last number for each later split."""
    centres: Literal["balanced", "random", "uniform", "centroidal"] = "centroidal"
    """Centres of the new cells: balanced by importance (as published), random samples, a uniform grid, or centroids of
    the cells (centroidal), which makes cells compact."""
    init: Literal["inherit", "random"] = "inherit"
    """Initial parameters of new cells: copies of their parent's parameters, or random parameters."""
    assignment: Literal["nearest", "stochastic"] = "nearest"
    """Cell of a sample: the nearest cell, or in training a random cell, more often one with a near centre."""


@dataclass(frozen=True)
class SamplingSettings:
    """Rays and their samples."""

    rays: int | None = None
    """Rays per training step; default 512, and more on a hash grid in a box for a long --budget. With --occupancy, this
    number is for the first steps: hashgrid takes up to eight times as many when most samples of a ray are skipped. On a
    hash grid in contracted space, the number also grows with the length of a --budget, see --lr."""
    sampling: str = "stratified"
    """Samples along a ray: stratified in one pass, or hierarchical, with a second pass concentrated where the first
    pass has large weights (nerf: a coarse and a fine network)."""
    samples: tuple[int, ...] | None = None
    """Samples per ray of each pass; default 32 and 32 for two passes, 64 for one pass. With --occupancy, the default
    depends on the scene and on the length of the training. In contracted space, it is 128, or 256 for a training of at
    least 25 seconds, or 384 for at least 90 seconds. In a box, it grows with the box's size in pixels: for Lego, it is
    64 for images of 100 x 100 pixels, and 128 for 400 x 400. On a hash grid in a box, it is doubled, up to 256, for a
    training of at least 40 seconds (100 x 100) or 160 seconds (400 x 400). These times are for two cores of an AMD EPYC
    (Zen 5), and shorter for a CPU that is measured to be faster; with --steps, the machine has no effect."""
    sparse_depth: float | None = None
    """Factor of a loss that makes rays end at the points of a sparse model (Deng et al. 2022, "Depth-supervised
    NeRF"); 0 is off. Default 0.0015 for COLMAP's models, 0 for scenes without points."""
    contraction: Literal["auto", "none", "sphere", "ndc"] = "auto"
    """Input space of the networks: unchanged (none); all points outside a sphere mapped into a shell up to twice its
    radius (sphere); or normalised device coordinates, for forward-facing scenes (ndc). auto is none for a scene with a
    box (sphere with --region) and for fields without a hash grid, otherwise ndc for forward-facing cameras and sphere
    for other cameras."""
    occupancy: bool = True
    """Skip samples in empty space, in training and in pictures. This needs a field that takes points (not cones),
    sampling in a single pass, and a scene with a box or a contraction; it is off otherwise."""


@dataclass(frozen=True)
class OptimiserSettings:
    """The optimiser and its precision."""

    precision: Literal["fp32", "bf16", "fp16"] = "fp32"
    """Precision of the networks' matrix products in training: float32, bfloat16, or float16 with a scaled loss. Sums,
    parameters and moments are float32. A CPU multiplies in float32 and rounds only the outputs of the networks."""
    lr: float | None = None
    """Initial learning rate of Adam; default: 0.02; for nerf, mipnerf and kilonerf inversely proportional to widths
    above 64; 0.001 for a registered field without a rule. Except on a hash grid in a box, a training of more than 3,500
    steps divides the rate by (number of steps) / 3,500, at most by 8. On a hash grid with --budget, it multiplies the
    number of rays by the square of this factor."""
    average: float = 0.98
    """Decay per step of the averaged weights, which evaluations and pictures use; 0 is off. The decay is smaller in the
    first steps. Training itself uses the weights without averaging."""


@dataclass(frozen=True)
class OutputSettings:
    """Evaluations during the run."""

    evaluations: int = 8
    """Evaluations during the run, evenly spaced; the last one is at the end."""
    eval_views: int | None = None
    """Test views of every evaluation, evenly spaced; evaluations then do not count for --budget. Default: at most 20
    during the run, and all at the end; with a budget fewer, if evaluations would take more than a twentieth of the
    elapsed time, or a tenth of the budget in all."""
    lpips: Path | None = None
    """LPIPS weights for the final evaluation, a file or folder, or "off". Default: VORONERF_LPIPS if it is set,
    otherwise the first that exists of these: the folder lpips in VORONERF_DATA, the folder lpips beside the scene's
    folder, and the installed lpips package."""


@dataclass(frozen=True)
class TrainConfig(
    OutputSettings, OptimiserSettings, SamplingSettings, CellSettings, FieldSettings, RunSettings, SceneSettings
):
    """All settings of a training.

    Raises:
        ConfigError: For a setting that is out of range; the message names the setting, the rule and the value.

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
        """The field's entry in `FIELDS`."""
        return FIELDS[self.field]

    @property
    def reading(self) -> dict[str, Any]:
        """The settings that are arguments of ``load_scene``."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(SceneSettings)[1:]}

    @property
    def network_options(self) -> dict[str, Any]:
        """The options of the field: the settings that the field accepts, and ``field_options``."""
        settings = {name: getattr(self, name) for name in NETWORK_SETTINGS if name in self.field_type.options}
        chosen = {name: value for name, value in settings.items() if value is not None}
        return chosen | dict(parse_option(text) for text in self.field_options)

    @property
    def plan(self) -> tuple[PlannedSplit, ...]:
        """All splits of the run, in order."""
        return plan_splits(self.cells, self.split_at, self.max_cells)

    @property
    def final_cells(self) -> int:
        """The number of cells at the end, if every cell has enough samples for its split."""
        return final_cells(self.plan)

    def to_values(self) -> dict[str, Any]:
        """Returns the settings as JSON values."""
        values = dataclasses.asdict(self)
        values |= {name: None if values[name] is None else str(values[name]) for name in PATHS}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}

    def to_json(self) -> str:
        """Returns the settings as the text of a JSON file."""
        return json.dumps(self.to_values(), indent=2) + "\n"

    @staticmethod
    def from_values(values: Any, source: str = "config.json") -> TrainConfig:
        """Builds the settings from the values of :meth:`to_values`.

        Raises:
            ConfigError: For values that are no configuration, or another version's; the message names ``source``.
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


#: The choices of the settings that take one of several words.
CHOICES: dict[str, tuple[str, ...]] = {
    name: get_args(kind) for name, kind in get_type_hints(TrainConfig).items() if get_origin(kind) is Literal
}
#: Path settings, which are strings in JSON.
PATHS = ("out", "lpips")
#: Settings that may differ between a run and its continuation.
RESUMABLE = frozenset(
    {
        *("data", "allow_outside", "images", "out", "device", "backend"),
        *("sparse_depth", "budget", "steps", "evaluations", "eval_views", "lpips"),
    }
)


def differences(a: TrainConfig, b: TrainConfig) -> list[str]:
    """Returns the differences that prevent ``b`` from continuing ``a``, such as "--width 64 -> 128"."""
    return [
        f"--{f.name.replace('_', '-')} {getattr(a, f.name)} -> {getattr(b, f.name)}"
        for f in dataclasses.fields(TrainConfig)
        if f.name not in RESUMABLE and getattr(a, f.name) != getattr(b, f.name)
    ]


def parse_option(text: str) -> tuple[str, Any]:
    """Splits ``name=value`` into a name and a Python literal, or a string if the value is no literal."""
    name, _, value = text.partition("=")
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value


def check_backend_name(name: str) -> None:
    """Raises ConfigError for a name that is not a backend, such as the name of a device."""
    names = ("auto", *BACKENDS)
    if name not in names:
        device = device_of(name)
        hint = f"; did you mean --device {device}?" if device else did_you_mean(name, names)
        raise ConfigError(f"--backend must be {either(names)}, got {name!r}{hint}")


def check_config(config: TrainConfig) -> None:
    """Raises ConfigError for the first setting that is out of range, or that the field or the sampler lacks."""

    def need(ok: bool, name: str, rule: str, words: Iterable[str] = ()) -> None:
        if not ok:
            value = getattr(config, name)
            hint = did_you_mean(value, words)
            raise ConfigError(f"--{name.replace('_', '-')} must {rule}, got {as_typed(value)}{hint}")

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
        hint = "" if config.steps is None else f" below --steps {config.steps}"
        need(rising and (fractions or steps), "split_at", f"be rising fractions of the run, or numbers of steps{hint}")


def check_samples(config: TrainConfig) -> None:
    """Raises ConfigError unless there is one number of samples for each pass of the sampler."""
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
    allowed = [name for name in options if name not in NETWORK_SETTINGS]
    for text in config.field_options:
        if "=" not in text:
            raise ConfigError(f"--field-options must be NAME=VALUE, got {text!r}")
        name, value = parse_option(text)
        if name in NETWORK_SETTINGS:
            raise ConfigError(f"--field-options must not hold {name}, use --{name.replace('_', '-')}; got {text!r}")
        if name not in allowed:
            raise ConfigError(f"--field-options of {config.field} are {', '.join(allowed) or 'none'}; got {text!r}")
        is_number = isinstance(value, (int, float)) and abs(value) <= sys.float_info.max
        if isinstance(options[name], (int, float)) and not (is_number or value is None):
            raise ConfigError(f"--field-options must give {name} a finite number, got {text!r:.60}")
