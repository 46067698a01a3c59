"""From a configuration to the networks that it describes: their sizes, their routers, their optimiser."""

from __future__ import annotations

import fnmatch
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import nn

from voronerf.app.scenes import Scene
from voronerf.app.train.checkpoint import Checkpoint, CheckpointError
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.train.config_checks import why_no_occupancy
from voronerf.app.train.renderers import make_contraction
from voronerf.diagram import VoronoiDiagram
from voronerf.nerf.adam import Adam
from voronerf.nerf.contraction import Perspective
from voronerf.nerf.fields import DensityField
from voronerf.nerf.fields.hashgrid import LONG
from voronerf.nerf.samplers import SAMPLERS
from voronerf.ops._core import backends
from voronerf.ops._core.checks import physical_memory
from voronerf.router import VoronoiRouter

#: Size of the density network of a proposal. It is small, since it only sees coarse intervals.
PROPOSAL: dict[str, Any] = {"width": 32, "depth": 2, "position_octaves": 6}
#: Weight decay of tables: of what nothing asks for again, such as noise that early steps have left in empty space. With
#: more views than these it is less by as much: a place is asked for again only after many more steps.
TABLE_DECAY, DECAY_VIEWS = 0.1, 300
#: Steps from one decay to the next, since a large table takes time to read.
SHRINK_EVERY = 16
#: Factor of the loss on the sightings of points.
SIGHTINGS = 0.003
#: Cells of the occupancy grid along each axis, of a box and of contracted space, which is all the world.
OCCUPANCY_RESOLUTION, CONTRACTED_RESOLUTION = 64, 128
#: Samples of a ray through contracted space whose empty part is skipped, and those of a training of at least `LONG`
#: seconds: shorter strata make steps dearer at first, and sharper pictures in the end.
CONTRACTED_SAMPLES, LONG_SAMPLES = 128, 256
#: About what a step takes on two cores, for a training that is given in steps.
STEP_SECONDS = 0.01
#: The least that a sample takes in a step: 100 bytes (kilonerf) to 230 (hashgrid) were measured.
SAMPLE_BYTES = 64


def octaves_for(scene: Scene, contraction: str = "none") -> int:
    """Frequencies that positions need so that the finest wave spans two pixels of the training views.

    The wave of octave l has length 2 pi / 2^l. The 100 x 100 images of a Blender scene give 8, its 400 x 400 images the
    10 of the NeRF paper; finer waves would be noise to the images, and cost time.
    """
    return min(max(1 + math.ceil(math.log2(math.pi / pixel_at_the_middle(scene, contraction))), 4), 14)


def pixel_at_the_middle(scene: Scene, contraction: str = "none") -> float:
    """Width of a pixel of the training views at the middle of the scene: distance / focal length, in scene units.

    In normalised device coordinates it is the same at all distances.
    """
    cameras = scene.train.cameras
    focal = float(cameras.intrinsics[:, :2].mean())
    if contraction == "ndc" and isinstance(scene.contraction, Perspective):
        return 1 / (focal * max(scene.contraction.slopes))
    if scene.kind in ("forward", "inside-out"):
        return 2 / (1 / scene.near + 1 / scene.far) / focal
    centre = torch.zeros(3) if scene.contraction is None else scene.contraction.centre
    centre = centre if scene.box is None else scene.box.mean(0)
    distance = float((cameras.origins - centre).norm(dim=-1).mean()) or scene.near  # of a panorama from one place
    return distance / focal


def samples_for(scene: Scene) -> int:
    """Samples of a ray through a scene with a box whose empty space is skipped.

    They grow with the square root of the box's pixels: 64 for the 100 x 100 images of Lego, 128 for those of 400 x 400.
    Every sample costs time, every pixel that a stratum is longer than costs sharpness.
    """
    assert scene.box is not None
    pixels = float((scene.box[1] - scene.box[0]).amax()) / pixel_at_the_middle(scene)
    return min(max(8 * round(0.85 * math.sqrt(pixels)), 48), 192)


def space_of(config: TrainConfig, scene: Scene) -> tuple[tuple[float, ...], ...]:
    """The corners of the space that the networks see: a cube around the scene's box, or that of a contraction.

    In a box with unequal sides, the cells of a hash grid would be as much finer along the short ones, where the images
    show nothing finer: in a city five times, at the cost of entries.

    Raises:
        ConfigError: for a scene without a box that is not contracted.
    """
    if config.contraction != "none":
        box = make_contraction(scene, config.contraction).cube
    elif scene.box is not None:
        middle, half = scene.box.mean(0), (scene.box[1] - scene.box[0]).amax() / 2
        box = torch.stack((middle - half, middle + half))
    else:
        raise ConfigError(
            f"--field {config.field} needs --contraction sphere or auto for {scene.name}, a scene without a box"
        )
    low, high = (tuple(round(x, 6) for x in corner) for corner in box.tolist())
    return low, high


def resolve_config(config: TrainConfig, scene: Scene) -> TrainConfig:
    """Fills in the settings that depend on the scene.

    They are the contraction, whether empty space is skipped, the loss on sightings, samples of a ray, octaves, options
    of the field, and with ``parameters`` the width and learning rate.

    Raises:
        ConfigError: When the smallest networks have more parameters than asked for, a CUDA graph would have to read
            images on disk, or there are no sightings to learn from.
    """
    if config.cuda_graph and scene.train.on_disk:
        raise ConfigError("--cuda-graph must be off with images on disk: --no-cuda-graph, or --images memory")
    if config.appearance and scene.train.images.shape[-1] == 4:
        raise ConfigError("--appearance must be off for pictures with transparent pixels: what is behind has no gain")
    kind = config.field_type
    if config.contraction == "auto":
        if kind.scene_options is None or scene.box is not None:
            config = replace(config, contraction="none")
        else:
            forward = isinstance(scene.contraction, Perspective)
            config = replace(config, contraction="ndc" if forward else "sphere")
    boxed = scene.box is not None and config.contraction == "none"
    contracted = config.contraction != "none"
    if config.occupancy and (not (boxed or contracted) or why_no_occupancy(config) is not None):
        config = replace(config, occupancy=False)
    if config.occupancy and config.occupancy_resolution is None:
        config = replace(config, occupancy_resolution=CONTRACTED_RESOLUTION if contracted else OCCUPANCY_RESOLUTION)
    seen = scene.train.sightings is not None
    if config.sightings and not seen:
        raise ConfigError(f"--sightings needs a COLMAP model with points, got {config.sightings:g} without")
    if config.sightings is None:
        config = replace(config, sightings=SIGHTINGS if seen else 0.0)
    seconds = STEP_SECONDS * (config.steps or 0) if config.budget is None else config.budget
    if config.samples is None and config.occupancy:
        through_all = LONG_SAMPLES if seconds >= LONG else CONTRACTED_SAMPLES
        config = replace(config, samples=through_all if contracted else samples_for(scene))
    elif config.samples is None:
        config = replace(config, samples=64)
    if "position_octaves" in kind.options and "position_octaves" not in config.network_options:
        octaves = kind.octaves(octaves_for(scene, config.contraction))
        config = replace(config, field_options=(*config.field_options, f"position_octaves={octaves}"))
    if kind.scene_options is not None:
        pixel, space = pixel_at_the_middle(scene, config.contraction), space_of(config, scene)
        found = kind.scene_options(pixel, space, contracted, seconds)
        more = [f"{name}={value}" for name, value in found.items() if name not in config.network_options]
        config = replace(config, field_options=(*config.field_options, *more))
    if config.parameters is None:
        return config
    config = replace(config, width=solve_width(config, config.parameters))
    return replace(config, lr=kind.learning_rate(config.network_options)) if config.lr is None else config


def network_names(config: TrainConfig) -> tuple[str, ...]:
    """The names of a cell's networks for :class:`voronerf.nerf.Renderer`; "field" gives the colours."""
    return SAMPLERS[config.sampling].networks(config.field_type.cones)


def _whole(config: TrainConfig, name: str) -> bool:
    """Whether a network gives densities alone, and has a single cell."""
    return name in SAMPLERS[config.sampling].whole


def make_network(config: TrainConfig, name: str = "field") -> nn.Module:
    """One of the networks of a cell, freshly initialised from torch's global generator."""
    if _whole(config, name):
        return DensityField(position_encoding="integrated" if config.field_type.cones else "frequency", **PROPOSAL)
    return config.field_type.build(config.network_options)


def parameter_shapes(config: TrainConfig, name: str) -> dict[str, tuple[torch.Size, bool]]:
    """The shape of each parameter of one network, and whether all cells share it; without memory for any of them."""
    share = () if _whole(config, name) else config.router_options.get("share", ())
    return _shapes(functools.partial(make_network, config, name), share)


def _shapes(make: Callable[[], nn.Module], share: Sequence[str]) -> dict[str, tuple[torch.Size, bool]]:
    try:
        with torch.device("meta"):
            network = make()
    except RuntimeError:  # a field that computes numbers where it is made
        with torch.random.fork_rng(devices=[]):  # draws nothing from the caller's random numbers
            network = make()
    return {
        key: (parameter.shape, any(fnmatch.fnmatchcase(key, pattern) for pattern in share))
        for key, parameter in network.named_parameters()
    }


def count_parameters(config: TrainConfig, width: int | None = None) -> int:
    """Parameters of all networks of all final cells, with another width than the configured one where given."""
    if width is not None:
        config = replace(config, width=width)
    total = 0
    for name in network_names(config):
        cells = 1 if _whole(config, name) else config.final_cells
        for shape, shared in parameter_shapes(config, name).values():
            total += (1 if shared else cells) * shape.numel()
    return total


def check_backend(config: TrainConfig, device: torch.device) -> None:
    """Looks up every op of a step: a backend that cannot train should say so before anything is written.

    Raises:
        BackendUnavailable: names the op.
    """
    marching = (
        ("march_rays", "observe_occupancy", "forward_with_tape", "render_loss_gradient") if config.occupancy else ()
    )
    drawing = () if SAMPLERS[config.sampling].passes == 1 else ("resample",)
    ops = ("pixel_rays", "nearest_centre", "locate_cell", "grouped_mlp", "routed_mlp", "composite", "adam")
    seeing = ("sighting_gradient",) if config.sightings and config.occupancy else ()
    for op in (*ops, *marching, *drawing, *seeing):
        backends.resolve(op, backend=config.backend, device=device, dtype=torch.float32)
    backends.resolve("cell_sort", backend=config.backend, device=device, dtype=torch.int32)


def check_memory(config: TrainConfig) -> None:
    """Refuses what does not fit into the machine.

    Raises:
        ConfigError: with the sizes.
    """
    there = _memory(config)
    parts = {
        f"--rays {config.rays} with {config.samples} samples": SAMPLE_BYTES * config.rays * int(config.samples or 0),
        f"--reservoir {config.reservoir}": 16 * config.reservoir,
        f"--reservoir-batches {config.reservoir_batches}": 16 * config.reservoir_batches,
    }
    for name, needed in parts.items():
        _check_fits(name, needed, there)
    width = "" if config.width is None else f" of --width {config.width}"
    name = f"--field {config.field}{width} with {config.final_cells} cells"
    _check_fits(name, _parameter_bytes(config) * count_parameters(config), there)


def _parameter_bytes(config: TrainConfig) -> int:
    """Of a parameter, its gradient, Adam's two moments and its average."""
    return 20 if config.average else 16


def _memory(config: TrainConfig) -> int:
    """Bytes of memory where a run trains."""
    device = torch.device(config.device)
    return torch.cuda.get_device_properties(device).total_memory if device.type == "cuda" else physical_memory()


def _check_fits(name: str, needed: int, there: int) -> None:
    if needed > there:
        needed = min(needed, 2**100)  # which a float holds
        raise ConfigError(f"{name} needs {needed / 2**30:.1f} GiB of memory or more, there are {there / 2**30:.1f}")


def solve_width(config: TrainConfig, total: int) -> int:
    """The largest width with which all networks of all final cells have at most ``total`` parameters together.

    Raises:
        ConfigError: When a width of 2 has more, or the field has no width.
    """
    if config.width is None:
        raise ConfigError(f"--parameters needs a field with an option width, {config.field} has none")
    _check_fits(f"--parameters {total}", _parameter_bytes(config) * total, _memory(config))
    low, high = 2, 4
    if count_parameters(config, low) > total:
        least = count_parameters(config, low)
        raise ConfigError(f"--parameters must be at least {least} for {config.final_cells} cells, got {total}")
    while count_parameters(config, high) <= total:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if count_parameters(config, middle) <= total else (low, middle)
    return low


def make_routers(config: TrainConfig, device: torch.device | str) -> dict[str, VoronoiRouter]:
    """A router of one cell around each network, for the coarse stage; the seed alone decides its parameters."""
    with torch.random.fork_rng():  # of GPUs as well: manual_seed reaches them
        torch.manual_seed(config.seed)
        networks = {name: make_network(config, name) for name in network_names(config)}
    return {
        name: VoronoiRouter(
            network,
            VoronoiDiagram(torch.zeros(1, 3)),
            coords="first3",
            assignment=config.assignment,
            temperature=config.temperature,
            backend=config.backend,
            way="fused",  # a run is resumed bit for bit, so nothing depends on timings
            **({} if _whole(config, name) else config.router_options),
        ).to(device)
        for name, network in networks.items()
    }


def computes_natively(routers: Mapping[str, VoronoiRouter], config: TrainConfig) -> bool:
    """Whether native CPU ops evaluate all networks, so that torch is left with little to do in a step."""
    device = torch.device(config.device)
    chosen = backends.chosen("routed_mlp", device, torch.float32, backend=config.backend)
    return (
        device.type == "cpu"
        and chosen == "native"
        and all(getattr(router, "by_table", False) for router in routers.values())
    )


def parameter_groups(
    routers: Mapping[str, VoronoiRouter], config: TrainConfig
) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
    """The parameters in the order that the optimiser numbers them: those of the networks, then the tables."""
    dense: list[nn.Parameter] = []
    tables: list[nn.Parameter] = []
    for network, router in routers.items():
        patterns = () if _whole(config, network) else config.field_type.sparse_parameters
        for name, parameter in router.module.named_parameters():
            sparse = any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)
            (tables if sparse else dense).append(parameter)
    return dense, tables


def make_optimizer(routers: Mapping[str, VoronoiRouter], config: TrainConfig, *, views: int) -> Adam:
    """Adam with a decay of 0.99 for the squared gradients, where the default is 0.999.

    After a split each cell sees fewer samples and other gradients than its parent. With the default, the moments of the
    parent would set its step sizes for a thousand steps. The change is worth 0.7 dB after 800 steps of Lego at
    100 x 100.

    Tables have weight decay; otherwise their entries that have no gradient stay as they are.

    Args:
        routers: The networks, by name.
        config: The settings.
        views: Of the training; the more of them, the less a table decays.
    """
    assert config.lr is not None
    dense, tables = parameter_groups(routers, config)
    groups = [{"params": dense, "sparse": False}]
    if tables:
        groups.append({"params": tables, "sparse": True, "shrink": TABLE_DECAY / max(1.0, views / DECAY_VIEWS)})
    options: dict[str, Any] = {"lr": config.lr}
    if config.cuda_graph:  # a graph reads the learning rate and the step count from tensors
        options = {"lr": torch.tensor(config.lr, device=dense[0].device), "capturable": True}
    return Adam(groups, betas=(0.9, 0.99), eps=1e-15, backend=config.backend, **options)


def check_shapes(config: TrainConfig, checkpoint: Checkpoint) -> None:
    """Compares the networks of a configuration with those in a checkpoint, before memory is taken for either.

    Raises:
        CheckpointError: for a parameter that is missing, of another shape, or not for as many cells as there are.
    """
    for name in network_names(config):
        state = checkpoint.group(_group(name))
        try:
            diagram = VoronoiDiagram.from_state(state, "diagram.")
        except (ValueError, TypeError) as error:
            raise CheckpointError(f"{checkpoint.source}: {error}") from None
        for key, (shape, shared) in parameter_shapes(config, name).items():
            wanted = [*([] if shared else [diagram.num_cells]), *shape]
            found = state.get(f"module.{key}")
            if found is None or list(found.shape) != wanted:
                came = "nothing" if found is None else list(found.shape)
                raise CheckpointError(
                    f"{checkpoint.source}: the checkpoint is of another architecture: {_group(name)}.module.{key} "
                    f"must have shape {wanted}, got {came}"
                )


def router_states(routers: Mapping[str, VoronoiRouter]) -> dict[str, dict[str, Any]]:
    """The states of the routers, by their names in a checkpoint."""
    return {_group(name): router.state_dict() for name, router in routers.items()}


def restore_routers(routers: Mapping[str, VoronoiRouter], checkpoint: Checkpoint, *, assign: bool = False) -> None:
    """Loads the cells of a checkpoint into routers; their number may differ.

    Args:
        routers: By name.
        checkpoint: Of networks of the same architecture.
        assign: Takes the checkpoint's tensors in place of copies of them, for routers on the CPU.

    Raises:
        CheckpointError: When the checkpoint's parameters are of another architecture.
    """
    for name, router in routers.items():
        try:
            router.load_state_dict(checkpoint.group(_group(name)), assign=assign)
        except RuntimeError as error:
            line = str(error).splitlines()[-1]
            raise CheckpointError(f"{checkpoint.source}: the checkpoint is of another architecture: {line}") from None


def _group(name: str) -> str:
    return "router" if name == "field" else f"router-{name}"
