"""Default settings that depend on the scene, the field or the machine; only this module fills them in."""

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

#: Factor of the loss on sparse depths, for a robust loss on colours. It is half of the factor for the squared loss on
#: colours, since the gradients of the robust loss are smaller for large errors. With the squared loss, the loss on
#: sparse depths gained 0.3 dB on the capture bonsai and 0.7 to 1.4 dB on beer, at equal steps and time.
SPARSE_DEPTH = 0.0015
#: Unseen rays begin at positions without a camera, and have no target colour; a loss draws their depths towards planes.
#: An image has `TILES` tiles along its longer side. If no tile has points of the sparse model, the loss acts during the
#: whole training. The more tiles have points, the shorter it acts, linearly; if the fraction `COVERED` of the tiles has
#: points, it never acts. The fraction of tiles with points is 0.13 for the capture mouse, 0.31 for beer, 0.35 for bust,
#: and 0.68 for bonsai, whose scores this loss lowers.
COVERED, TILES = 2 / 3, 12
#: The maximum offset of an unseen ray's origin from a camera along each axis, as a fraction of the distance between the
#: farthest camera and the point at which all cameras look.
BESIDE = 0.2
#: Samples per ray for one pass, and for each of two passes, without skipping of empty space.
SAMPLES, EACH_SAMPLES = 64, 32
#: Rays per step. On a hash grid in a box, the number is doubled for a budget of 4 T, doubled again for 16 T, and so on
#: up to `MOST_RAYS`: beyond some 4,000 steps, more rays per step are better. The time T is `SHORT` seconds. If the box
#: spans p > `SHORT_PIXELS` pixels of an image, steps are slower, and T is `SHORT` * sqrt(p / `SHORT_PIXELS`) seconds.
RAYS, MOST_RAYS, SHORT, SHORT_PIXELS = 512, 4096, 10.0, 128
#: Approximate seconds per step on two cores, for a training whose length is given in steps.
STEP_SECONDS = 0.01
#: Multiply-adds per second of the two cores (Zen 5, two threads) on which the defaults were measured.
PEAK = 5.1e11


def resolve(config: TrainConfig, scene: Scene, speed: float = 1.0) -> TrainConfig:
    """Returns the settings with every default filled in, except ``width`` and ``lr`` if ``parameters`` determines them.

    Contraction, occupancy, sparse depth, rays, samples per ray, and the options of the field have such defaults.
    ``speed`` is this machine's speed, see `machine_speed`. It has no effect if the length of the training is a number
    of steps, since the same seed should give the same networks on every machine.
    """
    kind, boxed = config.field_type, scene.box is not None
    contraction, sparse_depth, rays, samples = config.contraction, config.sparse_depth, config.rays, config.samples
    if contraction == "auto":
        forward = isinstance(scene.contraction, Perspective)
        is_plain = kind.scene_options is None or (boxed and scene.contraction is None)
        contraction = "none" if is_plain else "ndc" if forward else "sphere"
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
        is_long = config.budget is not None and kind.scene_options is not None and not contracted and seconds > short
        rays = min(RAYS * 2 ** math.floor(math.log(seconds / short, 4) + 1e-9), MOST_RAYS) if is_long else RAYS
    if samples is None:
        passes = SAMPLERS[config.sampling].passes
        per_pass = EACH_SAMPLES if passes > 1 else SAMPLES
        if occupancy:
            # In a box, only a hash grid gets the additional samples of a long training. `usual_samples` was measured
            # with hash grids; the steps of larger networks take several times as long.
            long = seconds if contracted or kind.scene_options is not None else 0.0
            per_pass = usual_samples(side / pixel, contracted=contracted, seconds=long)
        samples = (per_pass,) * passes
    options: dict[str, Any] = {}
    if "position_octaves" in kind.options:
        options["position_octaves"] = kind.octaves(octaves_for(pixel))
    if kind.scene_options is not None:
        options |= kind.scene_options(pixel, scene.cube(space), contracted, seconds)
    added = [f"{name}={value}" for name, value in options.items() if name not in config.network_options]
    width = kind.options.get("width") if config.parameters is None else None
    config = replace(
        config,
        contraction=contraction,
        occupancy=occupancy,
        sparse_depth=sparse_depth,
        rays=rays,
        samples=samples,
        field_options=(*config.field_options, *added),
        depth=kind.options.get("depth") if config.depth is None else config.depth,
        width=width if config.width is None else config.width,
    )
    if config.lr is None and config.parameters is None:
        config = replace(config, lr=kind.learning_rate(config.network_options))
    return config


def unseen_share(scene: Scene, space: Space) -> float:
    """Returns the fraction of a training in which batches have unseen rays; 0 for no unseen rays.

    Unseen rays begin at positions without a camera. They need photographs around a place and a sparse model; regions
    get none. The fraction is larger if fewer image tiles have points of the sparse model, since
    surfaces without texture have few points.
    """
    points, cameras = scene.train.sparse_depth, scene.train.cameras
    if scene.background is not None or space.full_gradient is None or points is None or scene.region is not None:
        return 0.0
    side = max(1, round(max(cameras.width, cameras.height) / TILES))
    row, column = points.pixels // cameras.width, points.pixels % cameras.width
    image, row = row // cameras.height, row % cameras.height
    tiles = ((image * cameras.height + row // side) * cameras.width + column // side).unique()
    all_tiles = sum(width * height for width, height in map(cameras.size, range(len(cameras)))) / side**2
    return max(0.0, 1 - len(tiles) / all_tiles / COVERED)


def unseen_move(scene: Scene, space: Space) -> float:
    """Returns the maximum offset along each axis of an unseen ray's origin from a camera; 0 for no unseen rays."""
    return BESIDE * (space.full_gradient or 0.0) if unseen_share(scene, space) else 0.0


def machine_speed() -> float:
    """Returns the CPU's speed relative to the two cores on which the defaults were measured: 1, 2, 4, ...

    The speed is measured in 0.1 s by the multiply-adds of all threads, and rounded to a power of two for reproducible
    settings. It is at least 1, so that load by other processes cannot make the settings worse.
    """
    if native.missing(torch.device("cpu")) is not None:
        return 1.0
    return 2.0 ** max(0, round(math.log2(native.measure_peak("float32") / PEAK)))


def why_no_occupancy(config: TrainConfig) -> str | None:
    """Returns the reason why settings exclude skipping of empty space; None if the settings allow it."""
    if config.field_type.cones:
        return f"--field {config.field}, which takes cones"
    return None if SAMPLERS[config.sampling].skips else f"--sampling {config.sampling}"


def octaves_for(pixel: float) -> int:
    """Returns the number of octaves of the positional encoding that fits the pixels of the training views.

    It is the smallest number for which the shortest wave spans at most two pixels, clamped to 4..14. The wave of octave
    l has length 2 pi / 2^l. A Blender scene has 8 octaves for images of 100 x 100, and 10, as in the NeRF paper, for
    400 x 400. Shorter waves would fit noise, and cost time.

    Args:
        pixel: Width of a pixel at the middle of the scene, in scene units.
    """
    return min(max(1 + math.ceil(math.log2(math.pi / pixel)), 4), 14)
