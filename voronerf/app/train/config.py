"""The configuration of a training run: one dataclass, checked once, stored beside the results as JSON."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from voronerf.app.files import parse_json
from voronerf.app.train.config_checks import (
    NETWORK_SETTINGS,
    ConfigError,
    check_config,
    check_field,
    check_sampling,
    parse_option,
)
from voronerf.app.train.schema import check_types
from voronerf.nerf.cells import SplitRule
from voronerf.nerf.fields import FIELDS, FieldType
from voronerf.nerf.samplers import SAMPLERS
from voronerf.nerf.schedule import PlannedSplit, TimeUnit, default_times, final_cells, plan_splits


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training run.

    Examples:
        >>> from voronerf.app.train.config import TrainConfig
        >>> config = TrainConfig(data="builtin", steps=1000, cells=(4, 4), width=32)
        >>> config.final_cells
        16
        >>> TrainConfig.from_json(config.to_json()) == config
        True
    """

    data: str = "builtin"
    """Scene folder (--format says which there are), or a built-in scene: "builtin", "builtin-rich"
    with hundreds of solids, or "builtin-city:4x4", a city of so many
    blocks."""
    format: Literal["auto", "blender", "colmap", "transforms", "llff"] = "auto"
    """What is read of a scene folder; auto is the first of them that it holds, in this order."""
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
    what does not fit into memory, and with several processes."""
    allow_outside: bool = False
    """Also read images that lie outside of the scene folder, which it may name by .., an absolute path or a link."""
    out: Path | None = None
    """Run directory, which must not hold a run unless --resume is given; default: runs/SCENE, or the first free
    runs/SCENE-N."""
    resume: bool = False
    """Continue the run in --out from its last checkpoint."""
    seed: int = 0
    """Seed of every random choice."""
    device: str = "cpu"
    """Torch device, such as cpu or cuda:0."""
    backend: str = "auto"
    """Backend of the operations: auto, native, warp or reference (see `voronerf info`)."""

    budget: float | None = None
    """Time in seconds for training and evaluation; default 480, unless --steps is given."""
    steps: int | None = None
    """Number of training steps, instead of a time."""

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
    cell_tables: bool = False
    """Each cell has all parameters of its network for itself: with hashgrid a table of features too, which the cells
    share otherwise."""

    cells: tuple[int, ...] = (16,)
    """Cells per level: `16` is 16 cells, `16 16` splits each of them into 16 again, no number is one network."""
    split_at: tuple[float, ...] | None = None
    """When to split, as fractions of the run, one per level; default: 0.2, or evenly spaced from 0.15 to 0.5."""
    split_at_steps: tuple[int, ...] | None = None
    """When to split, in training steps."""
    split: Literal["all", "worst"] = "all"
    """On the levels below the first: split every cell, or only the one with the largest accumulated error."""
    max_cells: int | None = None
    """With --split worst: split the worst cell again and again until there are this many cells. The first split makes
    the first number of --cells, each later one divides the worst cell into the last number; the splits are evenly
    spaced between the two times of --split-at."""
    centres: Literal["balanced", "random", "uniform", "centroidal"] = "centroidal"
    """Centres of the new cells: balanced by importance (as published), drawn from the samples, a regular grid, or
    centroids of their cells, which makes cells compact."""
    init: Literal["inherit", "random"] = "inherit"
    """New cells start as copies of their parent, or from random parameters."""
    assignment: Literal["nearest", "stochastic"] = "nearest"
    """A sample goes to the nearest cell, or, while training, to one drawn by its distances to the centres."""
    temperature: float = 0.05
    """Temperature of the stochastic assignment, in scene units."""
    reservoir: int = 10_000
    """Samples kept for the next split."""
    reservoir_batches: int = 500
    """Number of latest batches that the kept samples come from; each gives the same number, its heaviest."""
    min_cell_samples: int = 64
    """A cell with fewer kept samples is not split further."""

    rays: int = 512
    """Rays per training step; where empty space is skipped, of the first steps."""
    ray_growth: float | None = None
    """Where empty space is skipped, few samples of a ray are left. A step then takes more rays, up to this multiple of
    --rays, so that it has a quarter of the samples of the first steps, or in a box half with 128 samples a ray, and so
    on, elsewhere with 256; 1 is off. Default 8 for hashgrid, else 1."""
    sampling: str = "stratified"
    """Samples along a ray: stratified in one pass; hierarchical, with a second pass where the first found something
    (nerf: a coarse and a fine network); or proposal, where a small density network places the samples."""
    samples: int | None = None
    """Samples per ray of the first pass, one in each stratum; default 32 for two passes, for one 64. Where empty space
    is skipped 128, or 256 in a training of at least 150 seconds; for an object more for larger images: 64 at 100 pixels
    across it, 128 at 400."""
    fine_samples: int = 32
    """Samples per ray of the second pass; the fine network of nerf evaluates those of the first pass too."""
    sightings: float | None = None
    """Factor of a loss on light that does not come from where the points of a sparse model were seen (Deng et al. 2022,
    "Depth-supervised NeRF"); default 0.003 for COLMAP's models, and 0, which is off, without points."""
    appearance: bool = False
    """Give each training picture a gain for each channel, for exposure and white balance that differ. The field has the
    average look of all pictures, and held-out pictures are scored as it shows them. For opaque pictures."""
    refine_cameras: bool = False
    """Let the poses and focal lengths of the training cameras learn with the field, where a step is one operation.
    Held-out cameras stay as they were read."""
    contraction: Literal["auto", "none", "sphere", "ndc"] = "auto"
    """Space as the networks see it: unchanged; with all points outside a sphere mapped into a shell of twice its
    radius; or in normalised device coordinates, for forward-facing scenes. auto is none for a scene with a box and for
    fields without a grid, else ndc where the cameras face forward and the sphere elsewhere."""
    occupancy: bool = True
    """Skip samples in empty space, in training and in pictures, wherever that works: for points in a single pass, in a
    scene with a box or with a contraction."""
    occupancy_resolution: int | None = None
    """Cells of the occupancy grid along each axis; default 64 in a box, and 128 with a contraction."""
    precision: Literal["fp32", "bf16", "fp16"] = "fp32"
    """Products of the networks while training: float32, bfloat16, or float16 with a scaled loss. Sums, parameters and
    moments are float32. A CPU multiplies in float32 and rounds only the outputs of the networks."""
    cuda_graph: bool = False
    """On CUDA: capture a whole step in a graph and replay it; captured again after each split. Empty
    space is not skipped then."""
    lr: float | None = None
    """Learning rate of Adam at the start; default: 0.02 up to width 64, in inverse proportion to the width beyond."""
    lr_hold: float | None = None
    """Fraction of the run for which the learning rate stays at --lr before it falls; default 0.25 for hashgrid, else
    0."""
    lr_final: float = 0.05
    """Learning rate at the end, as a fraction of --lr; the decay is exponential."""
    average: float = 0.98
    """Decay per step of the averaged weights, which evaluations and pictures use; 0 is off. It is smaller in the first
    steps. Training goes on with the weights themselves."""
    background: Literal["random", "white"] = "random"
    """Colour behind images with an alpha channel while training: random for every ray, or white as in evaluation."""

    evaluations: int = 8
    """Evaluations during the run, evenly spaced; the last one is at the end."""
    eval_views: int = 20
    """Test views of an evaluation during training, evenly spread; the final evaluation uses --final-views."""
    final_views: int | None = None
    """Test views of the final evaluation; default all, or as many as --evaluation-share allows."""
    evaluation_share: float = 0.1
    """Share of --budget for evaluations, half of it for the final one. Where that is too short for all their views,
    evenly spread ones are scored. 0: evaluations take the time that they need, beside the budget."""
    checkpoint_every: float = 30.0
    """Seconds of training between checkpoints, which are written while it goes on."""
    keep_checkpoints: int = 3
    """How many checkpoints are kept. If the last one is damaged, the one before takes its place."""
    panels: int = 4
    """Test views drawn as panels at the end: truth, render, error, depth, cells."""
    tensorboard: bool = False
    """Also write loss, speed, cells and scores for TensorBoard, into the folder tensorboard of the run."""
    lpips: Path | None = None
    """LPIPS weights for the final evaluation, a file or folder, or "off"; default: VORONERF_LPIPS, the folder lpips of
    VORONERF_DATA or beside the scene, the installed lpips package."""

    def __post_init__(self) -> None:
        if self.budget is None and self.steps is None:
            object.__setattr__(self, "budget", 480.0)
        check_sampling(self)
        if self.samples is None and SAMPLERS[self.sampling].passes > 1:
            object.__setattr__(self, "samples", 32)
        check_field(self)
        for name in ("width", "depth"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, self.field_type.options.get(name))
        for name in ("ray_growth", "lr_hold"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, getattr(self.field_type, name))
        if self.lr is None and self.parameters is None:
            object.__setattr__(self, "lr", self.field_type.learning_rate(self.network_options))
        check_config(self, CHOICES)

    @property
    def field_type(self) -> FieldType:
        """The field's row in the table of fields."""
        return FIELDS[self.field]

    @property
    def reading(self) -> dict[str, Any]:
        """The settings that are arguments of ``load_scene``, but for ``allow_outside``."""
        return {name: getattr(self, name) for name in ("downscale", "format", "kind", "normalise", "images")}

    @property
    def network_options(self) -> dict[str, Any]:
        """What the field is made with: the settings that it has options for, and ``field_options``."""
        settings = {name: getattr(self, name) for name in NETWORK_SETTINGS if name in self.field_type.options}
        given = {name: value for name, value in settings.items() if value is not None}
        return given | dict(parse_option(text) for text in self.field_options)

    @property
    def router_options(self) -> dict[str, Any]:
        """Further arguments of the router around the field."""
        options = dict(self.field_type.router_options)
        if self.cell_tables:
            options.pop("share")
        return options

    @property
    def split_unit(self) -> TimeUnit:
        """What the times of the splits count."""
        return "fraction" if self.split_at_steps is None else "steps"

    @property
    def splits(self) -> tuple[float, ...]:
        """When each level is split, in ``split_unit``; with ``max_cells`` the times of the first and the last split."""
        for times in (self.split_at, self.split_at_steps):
            if times is not None:
                return times
        return default_times(len(self.cells) if self.max_cells is None else 2)

    @property
    def planned_splits(self) -> tuple[PlannedSplit, ...]:
        """All splits of the run, in order."""
        return plan_splits(self.cells, self.splits, self.split, self.max_cells)

    @property
    def final_cells(self) -> int:
        """Cells at the end, where every cell holds enough samples to be split."""
        return final_cells(self.planned_splits)

    @property
    def split_rule(self) -> SplitRule:
        """How the splits are made."""
        return SplitRule(
            centres=self.centres,
            min_samples=self.min_cell_samples,
            inherit=self.init == "inherit",
            reservoir=self.reservoir,
            batches=self.reservoir_batches,
        )

    def to_values(self) -> dict[str, Any]:
        """The settings as values of JSON."""
        values = dataclasses.asdict(self)
        values |= {name: None if values[name] is None else str(values[name]) for name in PATHS}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}

    def to_json(self) -> str:
        """The settings as JSON text, which :meth:`from_json` reads."""
        return json.dumps(self.to_values(), indent=2) + "\n"

    @staticmethod
    def from_json(text: str, source: str = "config.json") -> TrainConfig:
        """Reads what :meth:`to_json` wrote.

        Raises:
            ConfigError: For text that is not a configuration, or one of another version; names ``source``.
        """
        try:
            values = parse_json(text)
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
        "data",
        "allow_outside",
        "images",
        "out",
        "resume",
        "device",
        "cuda_graph",
        "backend",
        "sightings",
        "budget",
        "steps",
        "evaluations",
        "eval_views",
        "final_views",
    }
    | {"checkpoint_every", "keep_checkpoints", "panels", "tensorboard", "lpips"}
)


def differences(a: TrainConfig, b: TrainConfig) -> list[str]:
    """What keeps a checkpoint of ``a`` from being continued under ``b``: "--width 64 -> 128" and so on."""
    return [
        f"--{f.name.replace('_', '-')} {getattr(a, f.name)} -> {getattr(b, f.name)}"
        for f in dataclasses.fields(TrainConfig)
        if f.name not in RESUMABLE and getattr(a, f.name) != getattr(b, f.name)
    ]
