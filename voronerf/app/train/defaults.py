"""The defaults that depend on the scene, the field or the machine: here, and nowhere else, they are filled in."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch

from voronerf.app.scenes import Scene
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.nerf.contraction import Perspective
from voronerf.nerf.samplers import SAMPLERS, usual_samples
from voronerf.nerf.volume import Space
from voronerf.ops._core import native

#: Factor of the loss on sparse depths, beside the robust loss, whose gradients are as large as those of the squared one
#: at most. Beside that, twice as much gave 0.3 dB more on bonsai and 0.7 to 1.4 on beer, at equal steps and time.
SPARSE_DEPTH = 0.0015
#: Depths from where no camera was are to lie on planes in the more steps, the fewer tiles of photographs have points of
#: the sparse model: in all if none has, in none from this share on. `TILES` go along the longer side. Of the mouse's
#: 0.13 have points, of beer's 0.31, of the bust's 0.35, and of bonsai's, which loses by such depths, 0.68.
COVERED, TILES = 2 / 3, 12
#: How far from a camera that is, as a share of the distance of the farthest one from what they look at.
BESIDE = 0.2
#: Samples of a ray in one pass and in each of two, where empty space is not skipped.
SAMPLES, EACH_SAMPLES = 64, 32
#: Rays of a step. On a hash grid in a box, a training of four times `SHORT` seconds has twice as many, one of sixteen
#: times as long four times as many, up to `MOST_RAYS`: beyond some 4,000 steps, more rays a step teach more. Steps of
#: pictures with more than `SHORT_PIXELS` along the box take longer, so that `SHORT` grows with the root of these.
RAYS, MOST_RAYS, SHORT, SHORT_PIXELS = 512, 4096, 10.0, 128
#: About what a step takes on two cores, for a training that is given in steps.
STEP_SECONDS = 0.01
#: Operations a second of the two cores on which the rules were measured: multiply-adds of two threads of Zen 5.
PEAK = 5.1e11


def resolve(config: TrainConfig, scene: Scene, speed: float = 1.0) -> TrainConfig:
    """The settings with every default filled in, but for ``width`` and ``lr`` where ``parameters`` decides them.

    They are contraction, occupancy, sparse depth, rays, samples of a ray, and the options of the field. A machine of
    twice the ``speed`` does in a second what that of the rules does in two. Settings that are given in steps do not
    depend on it, since the same seed should give the same networks everywhere.
    """
    kind, boxed = config.field_type, scene.box is not None
    contraction, sparse_depth, rays, samples = config.contraction, config.sparse_depth, config.rays, config.samples
    if contraction == "auto":
        forward = isinstance(scene.contraction, Perspective)
        contraction = "none" if kind.scene_options is None or boxed else "ndc" if forward else "sphere"
    contracted = contraction != "none"
    space = scene.space(contraction, cones=kind.cones)
    pixel = scene.pixel(space)
    occupancy = config.occupancy and why_no_occupancy(config) is None and (boxed or contracted)
    points = scene.train.sparse_depth is not None
    if config.sparse_depth and not points:
        raise ConfigError(f"--sparse-depth needs a COLMAP model with points, got {config.sparse_depth:g} without")
    if sparse_depth is None:
        sparse_depth = SPARSE_DEPTH if points else 0.0
    seconds = STEP_SECONDS * (config.steps or 0) if config.budget is None else config.budget * speed
    side = 0.0 if scene.box is None else float((scene.box[1] - scene.box[0]).amax())
    if rays is None:
        short = SHORT * math.sqrt(max(1.0, side / pixel / SHORT_PIXELS))
        grows = config.budget is not None and kind.scene_options is not None and not contracted and seconds > short
        rays = min(RAYS * 2 ** math.floor(math.log(seconds / short, 4) + 1e-9), MOST_RAYS) if grows else RAYS
    if samples is None:
        passes = SAMPLERS[config.sampling].passes
        each = EACH_SAMPLES if passes > 1 else SAMPLES
        if occupancy:
            # The rule was measured with hash grids: a step of a larger network takes several times as long.
            long = seconds if contracted or kind.scene_options is not None else 0.0
            each = usual_samples(side / pixel, contracted=contracted, seconds=long)
        samples = (each,) * passes
    options: dict[str, Any] = {}
    if "position_octaves" in kind.options:
        options["position_octaves"] = kind.octaves(octaves_for(pixel))
    if kind.scene_options is not None:
        options |= kind.scene_options(pixel, scene.cube(space), contracted, seconds)
    more = [f"{name}={value}" for name, value in options.items() if name not in config.network_options]
    width = kind.options.get("width") if config.parameters is None else None
    config = replace(
        config,
        contraction=contraction,
        occupancy=occupancy,
        sparse_depth=sparse_depth,
        rays=rays,
        samples=samples,
        field_options=(*config.field_options, *more),
        depth=kind.options.get("depth") if config.depth is None else config.depth,
        width=width if config.width is None else config.width,
    )
    if config.lr is None and config.parameters is None:
        config = replace(config, lr=kind.learning_rate(config.network_options))
    return config


def unseen_share(scene: Scene, space: Space) -> float:
    """The part of a training in which batches have rays that no picture shows; 0 for none.

    They are of photographs of something that cameras stand around. The fewer of the tiles have a point of the sparse
    model, the more surfaces are plain.
    """
    points, cameras = scene.train.sparse_depth, scene.train.cameras
    if scene.background is not None or space.full_gradient is None or points is None:
        return 0.0
    side = max(1, round(max(cameras.width, cameras.height) / TILES))
    row, column = points.pixels // cameras.width, points.pixels % cameras.width
    image, row = row // cameras.height, row % cameras.height
    tiles = ((image * cameras.height + row // side) * cameras.width + column // side).unique()
    every = sum(width * height for width, height in map(cameras.size, range(len(cameras)))) / side**2
    return max(0.0, 1 - len(tiles) / every / COVERED)


def unseen_move(scene: Scene, space: Space) -> float:
    """How far from cameras these rays begin; 0 for none."""
    return BESIDE * (space.full_gradient or 0.0) if unseen_share(scene, space) else 0.0


def machine_speed() -> float:
    """How many times as fast this CPU is as the two cores on which the rules were measured: 1, 2, 4 and so on.

    Measured in 0.1 s by the multiply-adds of all threads. Powers of two, since the same machine should have the same
    settings tomorrow; at least 1, so that a moment in which others use it cannot make them worse than before.
    """
    if native.missing(torch.device("cpu")) is not None:
        return 1.0
    return 2.0 ** max(0, round(math.log2(native.measure_peak("float32") / PEAK)))


def why_no_occupancy(config: TrainConfig) -> str | None:
    """The reason why a run cannot skip empty space in any scene; None if it can."""
    if config.field_type.cones:
        return f"--field {config.field}, which takes cones"
    return None if SAMPLERS[config.sampling].skips else f"--sampling {config.sampling}"


def octaves_for(pixel: float) -> int:
    """Frequencies that positions need so that the finest wave spans two pixels of the training views.

    The wave of octave l has length 2 pi / 2^l. The 100 x 100 images of a Blender scene give 8, its 400 x 400 images the
    10 of the NeRF paper; finer waves would be noise to the images, and cost time.

    Args:
        pixel: Width of a pixel at the middle of the scene, in scene units.
    """
    return min(max(1 + math.ceil(math.log2(math.pi / pixel)), 4), 14)
