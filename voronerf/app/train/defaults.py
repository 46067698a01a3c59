"""The defaults that depend on the scene, the field or the machine: here, and nowhere else, they are filled in."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch

from voronerf.app.scenes import Scene
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.nerf.contraction import Contraction, Perspective
from voronerf.nerf.fields.hashgrid import LONG
from voronerf.nerf.samplers import SAMPLERS
from voronerf.nerf.volume import Space

#: Factor of the loss on sparse depths: 0.3 dB more on bonsai, 0.7 to 1.4 on beer, at equal steps and time.
SPARSE_DEPTH = 0.003
#: Samples of a ray through contracted space whose empty part is skipped, and those of a training of at least `LONG`
#: seconds: shorter strata make steps dearer at first, and sharper pictures in the end.
CONTRACTED_SAMPLES, LONG_SAMPLES = 128, 256
#: Samples of a ray in one pass and in each of two, where empty space is not skipped.
SAMPLES, EACH_SAMPLES = 64, 32
#: About what a step takes on two cores, for a training that is given in steps.
STEP_SECONDS = 0.01


def resolve(config: TrainConfig, scene: Scene) -> TrainConfig:
    """The settings with every default filled in, but for ``width`` and ``lr`` where ``parameters`` decides them.

    They are contraction, occupancy, sparse depth, samples of a ray, and the options of the field.

    Raises:
        ConfigError: When there are no sparse depths to learn from, or no space that the field can cover.
    """
    kind, boxed = config.field_type, scene.box is not None
    if config.contraction == "auto":
        if kind.scene_options is None or boxed:
            config = replace(config, contraction="none")
        else:
            forward = isinstance(scene.contraction, Perspective)
            config = replace(config, contraction="ndc" if forward else "sphere")
    contracted = config.contraction != "none"
    if config.occupancy and (why_no_occupancy(config) is not None or not (boxed or contracted)):
        config = replace(config, occupancy=False)
    points = scene.train.sightings is not None
    if config.sparse_depth and not points:
        raise ConfigError(f"--sparse-depth needs a COLMAP model with points, got {config.sparse_depth:g} without")
    if config.sparse_depth is None:
        config = replace(config, sparse_depth=SPARSE_DEPTH if points else 0.0)
    seconds = STEP_SECONDS * (config.steps or 0) if config.budget is None else config.budget
    if config.samples is None:
        passes = SAMPLERS[config.sampling].passes
        samples = EACH_SAMPLES if passes > 1 else SAMPLES
        if config.occupancy:
            samples = samples_for(scene)
            if contracted:
                samples = LONG_SAMPLES if seconds >= LONG else CONTRACTED_SAMPLES
        config = replace(config, samples=(samples,) * passes)
    options: dict[str, Any] = {}
    if "position_octaves" in kind.options:
        options["position_octaves"] = kind.octaves(octaves_for(scene, config.contraction))
    if kind.scene_options is not None:
        pixel, cube = pixel_at_the_middle(scene, config.contraction), cube_of(config, scene)
        options |= kind.scene_options(pixel, cube, contracted, seconds)
    more = [f"{name}={value}" for name, value in options.items() if name not in config.network_options]
    config = replace(config, field_options=(*config.field_options, *more))
    if config.depth is None:
        config = replace(config, depth=kind.options.get("depth"))
    if config.width is None and config.parameters is None:
        config = replace(config, width=kind.options.get("width"))
    if config.lr is None and config.parameters is None:
        config = replace(config, lr=kind.learning_rate(config.network_options))
    return config


def why_no_occupancy(config: TrainConfig) -> str | None:
    """What keeps a run from skipping samples in empty space, whatever its scene; None if nothing does."""
    if config.field_type.cones:
        return f"--field {config.field}, which takes cones"
    return None if SAMPLERS[config.sampling].passes == 1 else f"--sampling {config.sampling}"


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
    """Samples of a ray through a scene with a box whose empty space is skipped; `SAMPLES` without a box.

    They grow with the square root of the box's pixels: 64 for the 100 x 100 images of Lego, 128 for those of 400 x 400.
    Every sample costs time, every pixel that a stratum is longer than costs sharpness.
    """
    if scene.box is None:
        return SAMPLES
    pixels = float((scene.box[1] - scene.box[0]).amax()) / pixel_at_the_middle(scene)
    return min(max(8 * round(0.85 * math.sqrt(pixels)), 48), 192)


def cube_of(config: TrainConfig, scene: Scene) -> tuple[tuple[float, ...], ...]:
    """The corners of the space that the networks see: a cube around the scene's box, or that of a contraction.

    In a box with unequal sides, the cells of a hash grid would be as much finer along the short ones, where the images
    show nothing finer: in a city five times, at the cost of entries.

    Raises:
        ConfigError: For a scene without a box that is not contracted.
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


def space_of(config: TrainConfig, scene: Scene, device: torch.device | str = "cpu") -> Space:
    """How a field sees a scene.

    Raises:
        ConfigError: As `make_contraction`.
    """
    contraction = None if config.contraction == "none" else make_contraction(scene, config.contraction, device)
    full_gradient = None
    if scene.kind == "unbounded" and isinstance(contraction, Contraction):
        full_gradient = contraction.radius
    return Space(contraction, scene.spacing, config.field_type.cones, full_gradient)


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
