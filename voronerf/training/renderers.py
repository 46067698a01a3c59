"""The renderer of a configuration: how its networks become pictures of a scene."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import replace

import torch

from voronerf.data import Scene
from voronerf.rendering.contraction import Contraction, Perspective
from voronerf.rendering.field import DirectionPerSample, Field
from voronerf.rendering.occupancy import OccupancyGrid
from voronerf.rendering.renderer import Renderer
from voronerf.router import VoronoiRouter
from voronerf.training.config import ConfigError, TrainConfig

#: Samples of a ray of a picture, for each of training: those are at random places, and meet all of a stratum in time.
PICTURE_SAMPLES = 2


def make_renderer(
    config: TrainConfig,
    scene: Scene,
    routers: Mapping[str, VoronoiRouter],
    *,
    samples: int | None = None,
    fine_samples: int | None = None,
    occupancy: OccupancyGrid | None = None,
    backend: str | None = None,
    kind: type[Renderer] = Renderer,
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
        kind: The class to make.

    Raises:
        ConfigError: For a contraction that the scene does not allow.
    """
    device = next(routers["field"].parameters()).device
    contraction = None if config.contraction == "none" else make_contraction(scene, config.contraction, device)
    full_gradient = None
    if config.gradient_scaling and scene.kind == "unbounded" and isinstance(contraction, Contraction):
        full_gradient = contraction.radius
    return kind(
        {name: as_field(router) for name, router in routers.items()},
        samples=int(config.samples or 0) if samples is None else samples,
        fine_samples=0 if config.sampling == "stratified" else fine_samples or config.fine_samples,
        cones=config.field_type.cones,
        contraction=contraction,
        spacing=scene.spacing,
        occupancy=occupancy,
        rounds=config.proposal_rounds,
        distortion=config.distortion,
        picture_samples=PICTURE_SAMPLES * int(config.samples or 0) if samples is None else samples,
        sightings=config.sightings or 0.0,
        full_gradient=full_gradient,
        backend=config.backend if backend is None else backend,
    )


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
