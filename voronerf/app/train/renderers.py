"""The renderer of a configuration: how its networks become pictures of a scene, and which space it skips."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from dataclasses import replace

import torch

from voronerf.app.scenes import Scene
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.train.config_checks import why_no_occupancy
from voronerf.nerf.cells import DECAY
from voronerf.nerf.contraction import Contraction, Perspective
from voronerf.nerf.field import DirectionPerSample, Field
from voronerf.nerf.occupancy import OccupancyGrid
from voronerf.nerf.renderer import Renderer
from voronerf.nerf.samplers import SAMPLERS, Occupancy, Stratified
from voronerf.nerf.volume import Space
from voronerf.router import VoronoiRouter

#: Samples of a ray of a picture, for each of training: those are at random places, and meet all of a stratum in time.
#: At most so many: of the 256 of a long training, twice as many would make no picture more than 0.05 dB better.
PICTURE_SAMPLES, MOST_PICTURE_SAMPLES = 2, 384
#: A cell is empty if a sample in it would take less of the light than this, were the cell that dense throughout: for
#: pictures of a field that was trained without a grid, and in training with one. Most of what a young field has spread
#: through empty space lies between the two, and would keep a third of the samples.
LEAST_OPACITY, TRAINING_OPACITY = 0.02, 0.05
#: The same of a cell of contracted space, for the light on its way through the whole cell.
CONTRACTED_OPACITY = 0.1
#: How many samples in a row empty a new cell: about thirty steps, until which the field has said nothing about most. In
#: contracted space fewer: what stays there is fog before the cameras, which explains one view and spoils the others.
OCCUPANCY_PATIENCE, CONTRACTED_PATIENCE = 8, 4
#: Of a grid made for pictures alone: cells along each axis, and points evaluated in each.
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
    """The renderer that a configuration asks for.

    Args:
        config: The settings.
        scene: Whose space is sampled.
        routers: The networks by name, see ``network_names``.
        samples: Samples per ray of the first pass, in pictures too; None for those of the configuration.
        fine_samples: Samples per ray of the second pass; None for those of the configuration.
        occupancy: The grid of what is empty.
        backend: Of the operations; None for that of the configuration.

    Raises:
        ConfigError: For a contraction that the scene does not allow.
    """
    device, backend = next(routers["field"].parameters()).device, backend or config.backend
    contraction = None if config.contraction == "none" else make_contraction(scene, config.contraction, device)
    full_gradient = None
    if scene.kind == "unbounded" and isinstance(contraction, Contraction):
        full_gradient = contraction.radius
    space = Space(contraction, scene.spacing, config.field_type.cones, full_gradient)
    counts = (samples or int(config.samples or 0), fine_samples or config.fine_samples)
    kind = SAMPLERS[config.sampling]
    sampler = kind(*counts[: kind.passes], space=space, backend=backend)
    if occupancy is not None:
        sampler = through_grid(sampler, occupancy, picture_samples=samples)
    return Renderer({name: as_field(router) for name, router in routers.items()}, sampler, backend=backend)


def through_grid(sampler: Stratified, grid: OccupancyGrid, *, picture_samples: int | None = None) -> Occupancy:
    """A sampler without the samples in empty cells; pictures have `PICTURE_SAMPLES` as many strata where not said."""
    more = picture_samples or max(min(PICTURE_SAMPLES * sampler.samples, MOST_PICTURE_SAMPLES), sampler.samples)
    return Occupancy(grid, sampler.samples, picture_samples=more, space=sampler.space, backend=sampler.backend)


def as_field(router: VoronoiRouter) -> Field:
    """A router as the renderer asks it: with one direction for each ray, or for each sample where it takes no other."""
    takes_rays = "ray_index" in inspect.signature(router.module.forward).parameters
    return router if takes_rays else DirectionPerSample(router)


def make_contraction(
    scene: Scene, name: str = "sphere", device: torch.device | str = "cpu"
) -> Contraction | Perspective:
    """The contraction "sphere" or "ndc" of a scene.

    The sphere is that around a scene's box, or without one its own, or that around the origin and all cameras.

    Raises:
        ConfigError: For ndc without forward-facing cameras, or when all cameras are at the origin, so that there is no
            sphere.
    """
    own = scene.contraction
    if name == "ndc":
        if not isinstance(own, Perspective):
            raise ConfigError(f"--contraction ndc needs a forward-facing scene, {scene.name} is {scene.kind} (--kind)")
        return replace(own, centre=own.centre.to(device), axes=own.axes.to(device))
    if scene.box is not None:
        return Contraction(scene.box.mean(0).to(device), float((scene.box[1] - scene.box[0]).norm()) / 2)
    if own is not None:
        return Contraction(own.centre.to(device), own.near if isinstance(own, Perspective) else own.radius)
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
    """A grid over the scene's box, or over the cube of its contraction, that is occupied everywhere.

    A cell is empty below the density with which an average stratum, the box's diagonal divided by the samples of a ray,
    takes `least_opacity` of the light; in contracted space, with which the cell takes `CONTRACTED_OPACITY`.

    Raises:
        ConfigError: When the scene has no box and is not contracted.
    """
    contraction = None if config.contraction == "none" else make_contraction(scene, config.contraction, device)
    size, patience = resolution or int(config.occupancy_resolution or 0), OCCUPANCY_PATIENCE
    if contraction is not None:
        box, patience = contraction.cube, CONTRACTED_PATIENCE
        threshold = -math.log1p(-CONTRACTED_OPACITY) * size / float(box[1, 0] - box[0, 0])
    elif scene.box is not None:
        box = scene.box
        threshold = -math.log1p(-least_opacity) * int(config.samples or 0) / float((box[1] - box[0]).norm())
    else:
        raise ConfigError(f"--occupancy needs a scene with a box or --contraction, {scene.name} has no box")
    remembered = DECAY**-patience
    return OccupancyGrid(box, size, threshold=threshold, remembered=remembered, contraction=contraction, device=device)


def make_picture_grid(config: TrainConfig, scene: Scene, renderer: Renderer) -> OccupancyGrid:
    """The occupancy grid of a field that was trained without one, made by asking the field in every cell.

    Raises:
        ConfigError: As `make_grid`, or when the run's sampling has no use for a grid.
    """
    obstacle = why_no_occupancy(replace(config, cuda_graph=False))
    if obstacle is not None:
        raise ConfigError(f"--occupancy does not work with {obstacle}")
    grid = make_grid(config, scene, renderer.device, PICTURE_RESOLUTION, LEAST_OPACITY)
    generator = torch.Generator().manual_seed(0)
    for points in range(PICTURE_POINTS):
        grid.update(renderer.field, decay=float(points > 0), generator=generator, backend=renderer.backend)
    return grid
