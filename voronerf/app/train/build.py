"""Builds the training state from settings and a scene."""

from __future__ import annotations

import contextlib
import fnmatch
import functools
import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.app.scenes import Scene
from voronerf.app.scenes.store import Pages
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.train.defaults import resolve, unseen_move, unseen_share, why_no_occupancy
from voronerf.app.train.state import State
from voronerf.app.wording import device_of
from voronerf.diagram import VoronoiDiagram
from voronerf.nerf.adam import Adam
from voronerf.nerf.batches import RayBatches
from voronerf.nerf.cameras import Rays
from voronerf.nerf.contraction import Contraction
from voronerf.nerf.distributed import ALONE, Ranks
from voronerf.nerf.field import DirectionPerSample, Field
from voronerf.nerf.loss import RayLoss
from voronerf.nerf.occupancy import OccupancyGrid
from voronerf.nerf.renderer import Renderer
from voronerf.nerf.samplers import SAMPLERS, Occupancy, Sampler
from voronerf.nerf.split import SplitStrategy
from voronerf.nerf.terms import SmoothDepth, SparseDepth, Surface, Term
from voronerf.ops import Guard
from voronerf.ops._core import backends
from voronerf.ops._core.checks import physical_memory
from voronerf.router import VoronoiRouter

#: Temperature of the stochastic assignment, in scene units.
TEMPERATURE = 0.05
#: Voxels along each axis of a grid that is used for pictures alone, and points evaluated in each voxel.
PICTURE_RESOLUTION, PICTURE_POINTS = 128, 2
#: Scale of the robust loss for photographs, which differ in exposure and highlights; synthetic images have no robust
#: loss.
ROBUST = 0.05
#: Factor of the smoothness loss on the depths of unseen rays (rays from positions without a camera), for photographs.
SMOOTH_DEPTH = 0.1
#: Factors of the distortion and orientation losses for photographs, which favour one surface per ray. With three times
#: the distortion loss, even fewer silhouettes are half transparent, but bonsai loses 0.3 dB.
DISTORTION, ORIENTATION = 0.003, 0.01
#: To find the voxels in front of a camera, at most this number of rays is cast along the longer side of its picture.
LOOKS = 64
#: A lower bound of the bytes per sample in a step; the measured values are 100 (kilonerf) to 230 (hashgrid).
SAMPLE_BYTES = 64


def build(
    config: TrainConfig,
    scene: Scene,
    *,
    on_event: Callable[[str], None] | None = None,
    speed: float = 1.0,
    ranks: Ranks = ALONE,
) -> State:
    """Builds the state of a training before its first step.

    Args:
        config: The settings.
        scene: The scene that ``config.data`` names.
        on_event: Called with a line of text for each split, evaluation and checkpoint.
        speed: The machine's speed, for the defaults of a training with a budget: see
            :func:`voronerf.app.train.defaults.machine_speed`.
        ranks: The processes of a data-parallel training.

    Raises:
        ConfigError: For settings that do not fit the scene, or networks that do not fit into memory.
        BackendUnavailable: For a backend that cannot train.

    Examples:
        >>> from voronerf.app.scenes import load_scene
        >>> from voronerf.app.train import TrainConfig, build, train
        >>> scene = load_scene("builtin", downscale=10)
        >>> state = build(TrainConfig(steps=3, cells=(4,), split_at=(1,), rays=64), scene)
        >>> train(state)
        >>> state.step, state.router.num_cells
        (3, 4)
    """
    given = config.width
    config = resolve(replace(config, device=present_device(config.device)), scene, speed)
    if config.assignment == "stochastic" and ranks.size > 1:  # draws a number for each sample, and samples differ
        raise ConfigError("--assignment must be nearest with several processes, got stochastic")
    if config.parameters is not None:
        width = solve_width(config, config.parameters)
        if given not in (None, width):
            raise ConfigError(f"--width must be left out with --parameters, which decide {width}, got {given}")
        lr = config.field_type.learning_rate({**config.network_options, "width": width})
        config = replace(config, width=width, lr=lr if config.lr is None else config.lr)
    check_memory(config)
    device = torch.device(config.device)
    check_backend(config, device)
    generator = torch.Generator().manual_seed(config.seed)
    # Random numbers for the device are drawn on it, without a wait for the host.
    draws = generator if device.type == "cpu" else torch.Generator(device).manual_seed(config.seed)
    routers = make_routers(config)
    for router in routers.values():
        router.generator = draws
    grid = make_grid(config, scene, device) if config.occupancy else None
    contraction = None if grid is None else grid.contraction
    empty = (
        space_before(scene, grid, contraction) if grid is not None and isinstance(contraction, Contraction) else None
    )
    renderer = make_renderer(config, scene, routers, grid=grid, empty=empty)
    unseen = unseen_move(scene, renderer.sampler.space) if config.occupancy else 0.0
    optimizer = Adam.of(
        routers,
        lr=float(config.lr or 0),
        views=len(scene.train),
        sparse=config.field_type.sparse_parameters,
        average=config.average,
        backend=config.backend,
    )
    strategy = SplitStrategy(
        routers,
        config.plan,
        centres=config.centres,
        inherit=config.init == "inherit",
        generator=generator,
        backend=config.backend,
    )
    photographs = scene.background is None
    terms: list[Term] = [SparseDepth(config.sparse_depth)] if config.sparse_depth else []
    if unseen:
        terms.append(SmoothDepth(SMOOTH_DEPTH))
    if photographs and isinstance(contraction, Contraction):  # would lower the scores of forward-facing scenes
        terms.append(Surface(distortion=DISTORTION, orientation=ORIENTATION))
    return State(
        config=config,
        scene=scene,
        routers=routers,
        renderer=renderer,
        ray_loss=RayLoss(renderer, terms=terms, robust=ROBUST if photographs else 0.0),
        optimizer=optimizer,
        strategy=strategy,
        batches=make_batches(config, scene, unseen=unseen),
        generator=generator,
        draws=draws,
        scaler=torch.amp.GradScaler(device.type, enabled=config.precision == "fp16"),
        guard=Guard.on(device),
        rays=int(config.rays or 0),
        ranks=ranks,
        unseen_share=unseen_share(scene, renderer.sampler.space),
        on_event=on_event,
    )


def make_batches(config: TrainConfig, scene: Scene, *, unseen: float = 0.0) -> RayBatches:
    """Returns ray batches of a scene's training views; for ``unseen`` see `RayBatches`."""
    train, device = scene.train, torch.device(config.device)
    images = train.images if train.on_disk else train.images.to(device)
    return RayBatches(
        train.cameras,
        images,
        near=scene.near,
        far=scene.far,
        box=scene.box,
        region=scene.region,
        background=scene.background_colour(),
        masks=train.masks,
        sparse=train.sparse_depth if config.sparse_depth else None,
        unseen=unseen,
        cones=config.field_type.cones,
        fetch=Pages(images).fetch if train.on_disk else None,
        device=device,
        backend=config.backend,
    )


def make_routers(config: TrainConfig, device: torch.device | str | None = None) -> dict[str, VoronoiRouter]:
    """Returns one-cell routers for the coarse stage, one for each network; the seed alone determines the parameters."""
    kind = config.field_type
    names = SAMPLERS[config.sampling].networks(kind.cones)
    with torch.random.fork_rng(), _usual_defaults():  # includes GPUs, which manual_seed also seeds
        torch.manual_seed(config.seed)
        networks = {name: kind.build(config.network_options) for name in names}
    return {
        name: VoronoiRouter(
            network,
            VoronoiDiagram(torch.zeros(1, 3, dtype=torch.float32, device="cpu")),
            coords="first3",
            assignment=config.assignment,
            temperature=TEMPERATURE,
            backend=config.backend,
            **kind.router_options,
        ).to(config.device if device is None else device)
        for name, network in networks.items()
    }


@contextlib.contextmanager
def _usual_defaults() -> Iterator[None]:
    """Makes new parameters float32 on the CPU, whatever the defaults of the program are."""
    dtype = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        with torch.device("cpu"):
            yield
    finally:
        torch.set_default_dtype(dtype)


def make_renderer(
    config: TrainConfig,
    scene: Scene,
    routers: Mapping[str, VoronoiRouter],
    *,
    grid: OccupancyGrid | None = None,
    empty: Tensor | None = None,
    samples: tuple[int, ...] | None = None,
    backend: str | None = None,
) -> Renderer:
    """Returns the renderer of a configuration.

    Args:
        config: The resolved settings.
        scene: The scene, for its space.
        routers: The networks by name.
        grid: The occupancy grid; None to take every sample.
        empty: Voxels of the grid that stay empty in training, bool [x, y, z]; None for no such voxels.
        samples: Samples per ray of each pass, also in pictures; None for the configuration's.
        backend: The backend of the operations; None for the configuration's.
    """
    device, backend = next(routers["field"].parameters()).device, backend or config.backend
    space = scene.space(config.contraction, cones=config.field_type.cones, device=device)
    counts = samples or config.samples or ()
    sampler: Sampler
    if grid is None:
        sampler = SAMPLERS[config.sampling](*counts, space=space, backend=backend)
    else:
        picture = None if samples is None else samples[0]
        sampler = Occupancy(grid, counts[0], picture_samples=picture, space=space, empty=empty, backend=backend)
    return Renderer({name: as_field(router) for name, router in routers.items()}, sampler, backend=backend)


def space_before(scene: Scene, grid: OccupancyGrid, contraction: Contraction) -> Tensor:
    """Returns the voxels between each training camera and its near bound, in contracted space, bool [x, y, z].

    A camera stands in empty space. Fog in front of it could fit the images of other cameras, but would hide the scene
    in a view from beside this camera.
    """
    device = grid.box.device
    voxel = float((grid.box[1] - grid.box[0]).min()) / max(grid.occupied.shape)
    end = max(scene.near - voxel / 2, voxel / 4)
    depths = torch.arange(voxel / 4, end, voxel / 2, dtype=torch.float32, device=device)
    empty = torch.zeros(grid.occupied.numel(), dtype=torch.bool, device=device)
    for rays in view_rays(scene, LOOKS, device):
        points = rays.origins[:, None] + depths[:, None] * rays.directions[:, None]
        empty[grid.voxels(contraction.points(points.reshape(-1, 3))).long()] = True
    return empty.view(grid.occupied.shape)


def view_rays(scene: Scene, count: int, device: torch.device) -> Iterator[Rays]:
    """Yields the rays of each training view through a grid of pixels, with ``count`` pixels along the longer side."""
    cameras = scene.train.cameras.to(device)
    for image in range(len(cameras)):
        width, height = cameras.size(image)
        stride = max(width, height, count) / count
        columns, rows = (torch.arange(0, side, stride, dtype=torch.float32, device=device) for side in (width, height))
        y, x = (values.reshape(-1) for values in torch.meshgrid(rows, columns, indexing="ij"))
        if (mask := scene.train.mask(image)) is not None:  # masked pixels may have no ray
            y, x = y.long(), x.long()
            seen = mask[y.cpu(), x.cpu()].to(device)
            y, x = y[seen], x[seen]
        yield cameras.rays(image, x, y)


def as_field(router: VoronoiRouter) -> Field:
    """Adapts a router to the renderer, which gives one direction per ray; some networks need a direction per sample."""
    takes_rays = "ray_index" in inspect.signature(router.module.forward).parameters
    return router if takes_rays else DirectionPerSample(router)


def make_grid(
    config: TrainConfig, scene: Scene, device: torch.device | str = "cpu", resolution: int | None = None
) -> OccupancyGrid:
    """Returns a fully occupied grid over the scene's box, or over the cube of its contraction."""
    contraction = scene.space(config.contraction, device=device).contraction
    if contraction is None and scene.box is None:
        raise ConfigError(f"--occupancy needs a scene with a box or --contraction, {scene.name} has no box")
    samples = (config.samples or (0,))[0]
    return OccupancyGrid.for_training(scene.box, samples, contraction=contraction, resolution=resolution, device=device)


def make_picture_grid(config: TrainConfig, scene: Scene, renderer: Renderer) -> OccupancyGrid:
    """Builds the occupancy grid of a field that was trained without one, by evaluating the field in every voxel."""
    obstacle = why_no_occupancy(config)
    if obstacle is not None:
        raise ConfigError(f"--occupancy does not work with {obstacle}")
    grid = make_grid(config, scene, renderer.device, PICTURE_RESOLUTION)
    return ask_everywhere(grid, renderer.field, renderer.backend)


def ask_everywhere(grid: OccupancyGrid, field: Field, backend: str = "auto") -> OccupancyGrid:
    """Updates a grid in place by evaluating a field in every voxel, and returns the grid."""
    generator = torch.Generator().manual_seed(0)
    for points in range(PICTURE_POINTS):
        grid.update(field, decay=float(points > 0), generator=generator, backend=backend)
    return grid


def parameter_shapes(config: TrainConfig, **options: Any) -> dict[str, tuple[torch.Size, bool]]:
    """Returns (shape, whether all cells share it) for each parameter of a network.

    It allocates no memory for the parameters, unless the field computes values in its constructor. ``options`` override
    options of the field in ``config``.
    """
    kind = config.field_type
    make, share = functools.partial(kind.build, {**config.network_options, **options}), kind.router_options
    network: nn.Module
    try:
        with torch.device("meta"):
            network = make()
    except RuntimeError:  # some fields compute values in their constructor
        with torch.random.fork_rng(devices=[]), torch.device("cpu"):  # keeps the caller's random state
            network = make()
    return {
        key: (parameter.shape, any(fnmatch.fnmatchcase(key, pattern) for pattern in share.get("share", ())))
        for key, parameter in network.named_parameters()
    }


def count_parameters(config: TrainConfig, **options: Any) -> int:
    """Returns the number of parameters of all networks of all final cells; options as in `parameter_shapes`."""
    shapes, cells = parameter_shapes(config, **options).values(), config.final_cells
    per_network = sum((1 if shared else cells) * shape.numel() for shape, shared in shapes)
    return per_network * len(SAMPLERS[config.sampling].networks(config.field_type.cones))


def solve_width(config: TrainConfig, total: int) -> int:
    """Returns the largest width with which all networks of all final cells have at most ``total`` parameters."""
    if "width" not in config.field_type.options:
        raise ConfigError(f"--parameters needs a field with an option width, {config.field} has none")
    _check_fits(config, f"--parameters {total}", _parameter_bytes(config) * total)
    low, high = 2, 4
    if (least := count_parameters(config, width=low)) > total:
        raise ConfigError(f"--parameters must be at least {least} for {config.final_cells} cells, got {total}")
    while count_parameters(config, width=high) <= total:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if count_parameters(config, width=middle) <= total else (low, middle)
    return low


def check_backend(config: TrainConfig, device: torch.device) -> None:
    """Looks up every op of a step, so that a backend that cannot train fails before any file is written."""
    ops = ["pixel_rays", "nearest_centre", "locate_cell", "grouped_mlp", "routed_mlp", "composite", "adam"]
    if config.occupancy:
        ops += ["march_rays", "observe_occupancy", "grouped_program", "render_loss"]
        ops += ["sparse_depth_loss", "rendered_gradient"] if config.sparse_depth else []
    ops += ["resample"] if SAMPLERS[config.sampling].passes > 1 else []
    for op in ops:
        backends.resolve(op, backend=config.backend, device=device, dtype=torch.float32)
    backends.resolve("cell_sort", backend=config.backend, device=device, dtype=torch.int32)


def check_memory(config: TrainConfig) -> None:
    """Raises ConfigError, with the sizes, if rays or networks do not fit into the machine's memory."""
    rays, samples = int(config.rays or 0), sum(config.samples or ())
    _check_fits(config, f"--rays {rays} with {samples} samples", SAMPLE_BYTES * rays * samples)
    width = "" if config.width is None else f" of --width {config.width}"
    name = f"--field {config.field}{width} with {config.final_cells} cells"
    _check_fits(config, name, _parameter_bytes(config) * count_parameters(config))


def _parameter_bytes(config: TrainConfig) -> int:
    """Returns the bytes for a parameter, its gradient, Adam's two moments and, if used, its average."""
    return 20 if config.average else 16


def _check_fits(config: TrainConfig, name: str, needed: int) -> None:
    device = torch.device(config.device)
    available = torch.cuda.get_device_properties(device).total_memory if device.type == "cuda" else physical_memory()
    if needed > available:
        needed = min(needed, 2**100)  # prevents a float overflow
        raise ConfigError(f"{name} needs {needed / 2**30:.1f} GiB of memory or more, there are {available / 2**30:.1f}")


def present_device(name: str) -> str:
    """Returns the name of a device that is present; for "auto" a GPU that this package has kernels for, else the CPU.

    Raises:
        ConfigError: For a device that is not present, or is no CPU or GPU.
    """
    if name == "auto":
        has_gpu = torch.cuda.is_available()
        return (
            "cuda"
            if has_gpu and backends.chosen("routed_mlp", torch.device("cuda"), torch.float32) != "reference"
            else "cpu"
        )
    try:
        if torch.device(name).type not in ("cpu", "cuda"):
            raise ConfigError(f"--device must be auto, cpu or cuda, got {name!r}")
        float(torch.zeros((), device=name))
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        device = device_of(name)
        reason = str(error).splitlines()[0].partition(": ")[0]
        hint = f": {reason}; leave it out for the CPU" if device == name else f"; did you mean {device or 'auto'}?"
        raise ConfigError(f"--device must be auto, cpu or a GPU that is present, got {name!r}{hint}") from None
    return name
