"""From a configuration to a router, and from a run directory back to one."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from voronerf.data import Scene
from voronerf.diagram import VoronoiDiagram
from voronerf.fields import DensityField, KiloNeRF, MipNeRF, NeRF, density_table, nerf_table
from voronerf.fields.mipnerf import OCTAVES
from voronerf.layers import MLP
from voronerf.rendering.contraction import Contraction
from voronerf.rendering.occupancy import OccupancyGrid
from voronerf.rendering.renderer import Renderer
from voronerf.router import VoronoiRouter
from voronerf.training.checkpoint import Checkpoint, CheckpointError, load_checkpoint
from voronerf.training.config import ConfigError, TrainConfig, default_learning_rate

#: What the networks' products are rounded to, by the configuration's precision; float32 is left alone.
HALVES = {"bf16": torch.bfloat16, "fp16": torch.float16}
#: Channels, layers and frequencies of the proposal's density network: small, and asked about coarse intervals alone.
PROPOSAL: dict[str, Any] = {"width": 32, "depth": 2, "position_octaves": 6}
#: A sample that takes less of the light than this, were its cell that dense throughout, is not worth asking for: in
#: pictures of a field that was trained without a grid, and in training with one. Most of what a young field has spread
#: through empty space lies between the two, and would keep a third of the samples.
LEAST_OPACITY, TRAINING_OPACITY = 0.02, 0.05
#: What a cell remembers each time a sample of a training batch lies in it, and how many samples in a row have to find
#: nothing in a new cell: some thirty steps, until which the field has said nothing about most of them.
OCCUPANCY_DECAY, OCCUPANCY_PATIENCE = 0.8, 8
#: Of a grid made for pictures alone: cells along each axis, and points asked for in each.
PICTURE_RESOLUTION, PICTURE_POINTS = 128, 2


def octaves_for(scene: Scene) -> int:
    """Frequencies that positions need so that the finest wave spans two pixels of the training views.

    The wave of octave l has length 2 pi / 2^l. A pixel at the middle of the scene is distance / focal length wide. The
    100 x 100 images of a Blender scene give 8, its 400 x 400 images the 10 of the NeRF paper; finer waves would be
    noise to the images, and cost time. Of mip-NeRF's waves two octaves more, a pixel's cone leaves a thousandth, and of
    the next 10^-11: the published 16 would feed zeros to the network.
    """
    cameras = scene.train.cameras
    centre = torch.zeros(3) if scene.box is None else scene.box.mean(0)
    distance = float((cameras.origins - centre).norm(dim=-1).mean()) or scene.near  # of a panorama from one place
    pixel = distance / float(cameras.intrinsics[:, :2].mean())
    return min(max(1 + math.ceil(math.log2(math.pi / pixel)), 4), 14)


def resolve_config(config: TrainConfig, scene: Scene) -> TrainConfig:
    """The configuration with what depends on the scene filled in: octaves, and with ``parameters`` width and rate.

    Raises:
        ConfigError: When the smallest networks have more parameters than asked for.
    """
    if config.position_octaves is None:
        octaves = octaves_for(scene)
        config = replace(config, position_octaves=min(octaves + 2, OCTAVES) if config.field == "mipnerf" else octaves)
    if config.parameters is None:
        return config
    width = solve_width(config, config.parameters)
    return replace(config, width=width, lr=default_learning_rate(width) if config.lr is None else config.lr)


def _table_options(config: TrainConfig) -> dict[str, Any]:
    if config.position_octaves is None:
        raise ValueError("make_field: config.position_octaves must be a number, got None (octaves_for gives one)")
    return {
        "depth": config.depth,
        "skips": config.skips,
        "position_octaves": config.position_octaves,
        "direction_octaves": config.direction_octaves,
        "view_directions": config.view_directions,
    }


def make_field(config: TrainConfig) -> NeRF:
    """The field that a configuration describes, freshly initialised from torch's global generator."""
    kind = {"nerf": NeRF, "mipnerf": MipNeRF, "kilonerf": KiloNeRF}[config.field]
    return kind(int(config.width or 0), **_table_options(config))


def network_names(config: TrainConfig) -> tuple[str, ...]:
    """The networks of a cell, as :class:`voronerf.rendering.Renderer` names them; "field" is the one whose colours
    count."""
    if config.sampling == "proposal":
        return ("field", "proposal")
    # mip-NeRF asks one network twice.
    return ("field", "coarse") if config.sampling == "hierarchical" and config.field != "mipnerf" else ("field",)


def count_parameters(config: TrainConfig, width: int | None = None) -> int:
    """Parameters of all networks of all final cells, with another width than the configured one where given."""
    width = int(config.width or 0) if width is None else width
    names, cells, encoding = network_names(config), config.final_cells, _encoding(config)
    view = width if config.field == "kilonerf" else None
    table = nerf_table(width, view_width=view, position_encoding=encoding, **_table_options(config))
    total = cells * _parameters_of(table) * (2 if "coarse" in names else 1)
    if "proposal" in names:
        proposal = density_table(position_encoding=encoding, **PROPOSAL)
        total += _parameters_of(proposal) * (cells if config.split_proposal else 1)
    return total


def _encoding(config: TrainConfig) -> str:
    return "integrated" if config.field == "mipnerf" else "frequency"


def _parameters_of(table: MLP) -> int:
    return sum(o * i + o for o, i in table.weight_shapes(6 if table.integrated else 3, 3))


def solve_width(config: TrainConfig, total: int) -> int:
    """The largest width with which all networks of all final cells have at most ``total`` parameters together.

    Raises:
        ConfigError: When a width of 2 has more.
    """
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
    """A router of one cell around each of the configured networks: the coarse stage. Depends on the seed alone."""
    with torch.random.fork_rng():  # of GPUs as well: manual_seed reaches them
        torch.manual_seed(config.seed)
        fields: dict[str, torch.nn.Module] = {}
        for name in network_names(config):
            proposal = name == "proposal"
            fields[name] = (
                DensityField(position_encoding=_encoding(config), **PROPOSAL) if proposal else make_field(config)
            )
    return {
        name: VoronoiRouter(
            field,
            VoronoiDiagram(torch.zeros(1, 3)),
            assignment=config.assignment,
            temperature=config.temperature,
            backend=config.backend,
        ).to(device)
        for name, field in fields.items()
    }


def make_renderer(
    config: TrainConfig,
    scene: Scene,
    routers: Mapping[str, VoronoiRouter],
    *,
    samples: int | None = None,
    fine_samples: int | None = None,
    occupancy: OccupancyGrid | None = None,
    backend: str | None = None,
) -> Renderer:
    """How the configured networks become pictures of a scene; samples and backend differ from the configuration's where
    they are given."""
    device = next(routers["field"].parameters()).device
    return Renderer(
        routers,
        samples=int(config.samples or 0) if samples is None else samples,
        fine_samples=0 if config.sampling == "stratified" else fine_samples or config.fine_samples,
        cones=config.field == "mipnerf",
        contraction=None if config.contraction == "none" else make_contraction(scene, device),
        spacing=scene.spacing,
        occupancy=occupancy,
        rounds=config.proposal_rounds,
        distortion=config.distortion,
        backend=config.backend if backend is None else backend,
    )


def make_contraction(scene: Scene, device: torch.device | str = "cpu") -> Contraction:
    """The sphere around a scene's box, or without one around the origin and all cameras.

    Raises:
        ConfigError: When all cameras are at the origin, so that there is no such sphere.
    """
    if scene.box is not None:
        return Contraction(scene.box.mean(0).to(device), float((scene.box[1] - scene.box[0]).norm()) / 2)
    radius = float(scene.train.cameras.origins.norm(dim=-1).max())
    if radius == 0:
        raise ConfigError(f"--contraction sphere needs cameras in several places, those of {scene.name} are in one")
    return Contraction(torch.zeros(3, device=device), radius)


def make_grid(
    config: TrainConfig,
    scene: Scene,
    device: torch.device | str,
    resolution: int | None = None,
    least_opacity: float = TRAINING_OPACITY,
) -> OccupancyGrid:
    """A grid over the scene's box that is occupied everywhere.

    A cell is empty below the density with which an average stratum, the box's diagonal divided by the samples of a ray,
    takes `least_opacity` of the light.

    Raises:
        ConfigError: When the scene has no box.
    """
    if scene.box is None:
        raise ConfigError(f"--occupancy needs a scene with a box around everything, {scene.name} has none")
    diagonal = float((scene.box[1] - scene.box[0]).norm())
    threshold = -math.log1p(-least_opacity) * int(config.samples or 0) / diagonal
    size = resolution or config.occupancy_resolution
    remembered = OCCUPANCY_DECAY**-OCCUPANCY_PATIENCE
    return OccupancyGrid(scene.box, size, threshold=threshold, remembered=remembered, device=device)


def make_optimizer(routers: Mapping[str, VoronoiRouter], config: TrainConfig) -> torch.optim.Adam:
    """Adam with a shorter memory of squared gradients than its default (0.99 for 0.999).

    After a split each cell meets fewer samples and other gradients than its parent; moments inherited from the parent
    would otherwise set its step sizes for a thousand steps. Worth 0.7 dB after 800 steps of Lego at 100 x 100.
    """
    assert config.lr is not None
    parameters = [parameter for router in routers.values() for parameter in router.parameters()]
    options: dict[str, Any] = {"lr": config.lr}
    if config.cuda_graph:  # which reads the learning rate from a tensor, and counts steps in one
        options = {"lr": torch.tensor(config.lr, device=parameters[0].device), "capturable": True}
    return torch.optim.Adam(parameters, betas=(0.9, 0.99), eps=1e-15, fused=True, **options)


def checkpoint_path(run: Path) -> Path:
    """Where a run directory keeps its last checkpoint."""
    return run / "checkpoints" / "last.safetensors"


def router_states(routers: Mapping[str, VoronoiRouter]) -> dict[str, dict[str, Any]]:
    """The routers' states, under the names that a checkpoint has for them."""
    return {_group(name): router.state_dict() for name, router in routers.items()}


def restore_routers(routers: Mapping[str, VoronoiRouter], checkpoint: Checkpoint) -> None:
    """Fills routers with a checkpoint's cells, whatever the number of them.

    Raises:
        CheckpointError: When the checkpoint's parameters are of another architecture.
    """
    for name, router in routers.items():
        try:
            router.load_state_dict(checkpoint.group(_group(name)))
        except RuntimeError as error:
            line = str(error).splitlines()[-1]
            raise CheckpointError(f"the checkpoint is of another architecture: {line}") from None


def _group(name: str) -> str:
    return "router" if name == "field" else f"router-{name}"


def load_run(run: Path, *, device: str = "cpu", backend: str = "auto") -> tuple[TrainConfig, dict[str, VoronoiRouter]]:
    """The configuration and the trained routers of a run directory, for :func:`make_renderer`.

    Raises:
        CheckpointError: When ``run`` holds no usable checkpoint.
    """
    path = checkpoint_path(run)
    checkpoint = load_checkpoint(path)
    config = TrainConfig.from_json(json.dumps(checkpoint.values["config"]), str(path))
    routers = make_routers(config, device)
    restore_routers(routers, checkpoint)
    for router in routers.values():
        router.backend = backend
        router.eval()
    return config, routers


def load_grid(
    run: Path, config: TrainConfig, router: VoronoiRouter, scene: Scene, *, wanted: bool, backend: str = "auto"
) -> OccupancyGrid | None:
    """The occupancy grid to make pictures with: the run's own, else one made from its field where ``wanted``.

    A field that was trained with a grid has learnt nothing about the cells that were empty, so it always gets its own.

    Raises:
        CheckpointError: When ``run`` holds no usable checkpoint.
        ConfigError: When a grid is to be made and the scene has no box, or the run's sampling has no use for one.
    """
    device = next(router.parameters()).device
    state = load_checkpoint(checkpoint_path(run)).group("occupancy")
    if state:
        return OccupancyGrid.from_state(state, device=device)
    if not wanted:
        return None
    replace(config, occupancy=True, cuda_graph=False)  # checks that the run can use one
    grid = make_grid(config, scene, device, PICTURE_RESOLUTION, LEAST_OPACITY)
    generator = torch.Generator().manual_seed(0)
    for points in range(PICTURE_POINTS):
        grid.update(router, decay=float(points > 0), generator=generator, backend=backend)
    return grid
