"""How the networks of a configuration become pictures of a scene: the renderer, its contraction, its occupancy grid."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import nn

from voronerf.data import Scene
from voronerf.rendering.contraction import Contraction
from voronerf.rendering.field import DirectionPerSample, Field
from voronerf.rendering.occupancy import OccupancyGrid
from voronerf.rendering.renderer import Renderer
from voronerf.router import VoronoiRouter
from voronerf.training.config import ConfigError, TrainConfig

#: A sample that takes less of the light than this, were its cell that dense throughout, is not worth asking for: in
#: pictures of a field that was trained without a grid, and in training with one. Most of what a young field has spread
#: through empty space lies between the two, and would keep a third of the samples.
LEAST_OPACITY, TRAINING_OPACITY = 0.02, 0.05
#: What a cell remembers each time a sample of a training batch lies in it, and how many samples in a row have to find
#: nothing in a new cell: some thirty steps, until which the field has said nothing about most of them.
OCCUPANCY_DECAY, OCCUPANCY_PATIENCE = 0.8, 8
#: Of a grid made for pictures alone: cells along each axis, and points asked for in each.
PICTURE_RESOLUTION, PICTURE_POINTS = 128, 2


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
        {name: as_field(router) for name, router in routers.items()},
        samples=int(config.samples or 0) if samples is None else samples,
        fine_samples=0 if config.sampling == "stratified" else fine_samples or config.fine_samples,
        cones=config.field_type.cones,
        contraction=None if config.contraction == "none" else make_contraction(scene, device),
        spacing=scene.spacing,
        occupancy=occupancy,
        rounds=config.proposal_rounds,
        distortion=config.distortion,
        backend=config.backend if backend is None else backend,
    )


def as_field(router: VoronoiRouter) -> Field:
    """A router as the renderer asks it: with one direction for each ray, or for each sample where it takes no other."""
    takes_rays = "ray_index" in inspect.signature(router.module.forward).parameters
    return router if takes_rays else DirectionPerSample(router)


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


def make_picture_grid(config: TrainConfig, scene: Scene, field: Field, *, backend: str = "auto") -> OccupancyGrid:
    """The occupancy grid of a field that was trained without one, made by asking the field in every cell.

    Raises:
        ConfigError: When the scene has no box, or the run's sampling has no use for a grid.
    """
    replace(config, occupancy=True, cuda_graph=False)  # checks that the run can use one
    device = next(field.parameters()).device if isinstance(field, nn.Module) else "cpu"
    grid = make_grid(config, scene, device, PICTURE_RESOLUTION, LEAST_OPACITY)
    generator = torch.Generator().manual_seed(0)
    for points in range(PICTURE_POINTS):
        grid.update(field, decay=float(points > 0), generator=generator, backend=backend)
    return grid
