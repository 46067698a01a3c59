"""From a configuration to a router, and from a run directory back to one."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from voronerf.data import Scene
from voronerf.diagram import VoronoiDiagram
from voronerf.fields import KiloNeRF, NeRF, nerf_table
from voronerf.rendering.occupancy import OccupancyGrid
from voronerf.router import VoronoiRouter
from voronerf.training.checkpoint import Checkpoint, CheckpointError, load_checkpoint
from voronerf.training.config import ConfigError, TrainConfig, default_learning_rate

#: A sample that takes less of the light than this, were its cell that dense throughout, is not worth asking for: in
#: pictures of a field that was trained without a grid, and in training with one. Most of what a young field has spread
#: through empty space lies between the two, and would keep a third of the samples.
LEAST_OPACITY, TRAINING_OPACITY = 0.01, 0.05
#: What a cell remembers each time a sample of a training batch lies in it, and how many samples in a row have to find
#: nothing in a new cell: some thirty steps, until which the field has said nothing about most of them.
OCCUPANCY_DECAY, OCCUPANCY_PATIENCE = 0.8, 8
#: Of a grid made for pictures alone: cells along each axis, and points asked for in each.
PICTURE_RESOLUTION, PICTURE_POINTS = 128, 2


def octaves_for(scene: Scene) -> int:
    """Frequencies that positions need so that the finest wave spans two pixels of the training views.

    The wave of octave l has length 2 pi / 2^l. A pixel at the middle of the scene is distance / focal length wide. The
    100 x 100 images of a Blender scene give 8, its 400 x 400 images the 10 of the NeRF paper; finer waves would be
    noise to the images, and cost time.
    """
    cameras = scene.train.cameras
    centre = torch.zeros(3) if scene.box is None else scene.box.mean(0)
    distance = float((cameras.origins - centre).norm(dim=-1).mean())
    pixel = distance / float(cameras.intrinsics[:, :2].mean())
    return min(max(1 + math.ceil(math.log2(math.pi / pixel)), 4), 14)


def resolve_config(config: TrainConfig, scene: Scene) -> TrainConfig:
    """The configuration with what depends on the scene filled in: octaves, and with ``parameters`` width and rate.

    Raises:
        ConfigError: When the smallest networks have more parameters than asked for.
    """
    if config.position_octaves is None:
        config = replace(config, position_octaves=octaves_for(scene))
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
    kind = KiloNeRF if config.field == "kilonerf" else NeRF
    return kind(int(config.width or 0), **_table_options(config))


def count_parameters(config: TrainConfig, width: int | None = None) -> int:
    """Parameters of all networks of all final cells, with another width than the configured one where given."""
    width = int(config.width or 0) if width is None else width
    view = width if config.field == "kilonerf" else None
    table = nerf_table(width, view_width=view, **_table_options(config))
    return config.final_cells * sum(o * i + o for o, i in table.weight_shapes(3, 3))


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


def make_router(config: TrainConfig, device: torch.device | str) -> VoronoiRouter:
    """A router of one cell around the configured field: the coarse stage. Depends on the seed alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        field = make_field(config)
    router = VoronoiRouter(
        field,
        VoronoiDiagram(torch.zeros(1, 3)),
        assignment=config.assignment,
        temperature=config.temperature,
        backend=config.backend,
    )
    return router.to(device)


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


def make_optimizer(router: VoronoiRouter, config: TrainConfig) -> torch.optim.Adam:
    """Adam with a shorter memory of squared gradients than its default (0.99 for 0.999).

    After a split each cell meets fewer samples and other gradients than its parent; moments inherited from the parent
    would otherwise set its step sizes for a thousand steps. Worth 0.7 dB after 800 steps of Lego at 100 x 100.
    """
    assert config.lr is not None
    return torch.optim.Adam(router.parameters(), lr=config.lr, betas=(0.9, 0.99), eps=1e-15, fused=True)


def checkpoint_path(run: Path) -> Path:
    """Where a run directory keeps its last checkpoint."""
    return run / "checkpoints" / "last.safetensors"


def restore_router(router: VoronoiRouter, checkpoint: Checkpoint) -> None:
    """Fills a router with a checkpoint's cells, whatever the number of them.

    Raises:
        CheckpointError: When the checkpoint's parameters are of another architecture.
    """
    state = checkpoint.group("router")
    try:
        router.load_state_dict(state)
    except RuntimeError as error:
        raise CheckpointError(f"the checkpoint is of another architecture: {str(error).splitlines()[-1]}") from None


def load_run(run: Path, *, device: str = "cpu", backend: str = "auto") -> tuple[TrainConfig, VoronoiRouter]:
    """The configuration and the trained router of a run directory.

    Raises:
        CheckpointError: When ``run`` holds no usable checkpoint.
    """
    path = checkpoint_path(run)
    checkpoint = load_checkpoint(path)
    config = TrainConfig.from_json(json.dumps(checkpoint.values["config"]), str(path))
    router = make_router(config, device)
    restore_router(router, checkpoint)
    router.backend = backend
    return config, router.eval()


def load_grid(
    run: Path, config: TrainConfig, router: VoronoiRouter, scene: Scene, *, wanted: bool, backend: str = "auto"
) -> OccupancyGrid | None:
    """The occupancy grid to make pictures with: the run's own, else one made from its field where ``wanted``.

    A field that was trained with a grid has learnt nothing about the cells that were empty, so it always gets its own.

    Raises:
        CheckpointError: When ``run`` holds no usable checkpoint.
        ConfigError: When a grid is to be made and the scene has no box.
    """
    device = next(router.parameters()).device
    state = load_checkpoint(checkpoint_path(run)).group("occupancy")
    if state:
        return OccupancyGrid.from_state(state, device=device)
    if not wanted:
        return None
    grid = make_grid(config, scene, device, PICTURE_RESOLUTION, LEAST_OPACITY)
    generator = torch.Generator().manual_seed(0)
    for points in range(PICTURE_POINTS):
        grid.update(router, decay=float(points > 0), generator=generator, backend=backend)
    return grid
