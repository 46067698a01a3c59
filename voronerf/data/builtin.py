"""The built-in scene: ray-cast from formulas, so that everything runs with no download.

A mosaic plinth carries a sphere, a box, a drum and a column with a ring and a globe, among a circle of marbles: fine texture
spread over space, sharp edges, hard shadows (which views share) and highlights (which move with the view). Images have exact
alpha, by supersampling. Units, axes and camera distance are those of Blender synthetic scenes.
"""

from __future__ import annotations

import colorsys
import math
from functools import cache

import torch
from torch import Tensor

from voronerf.data.scene import Scene, Split
from voronerf.data.solids import Box, Cylinder, Solid, Sphere, Texture, Torus, candidates, rotation
from voronerf.rendering.cameras import Cameras, look_at
from voronerf.rendering.rays import intersect_box

TRAIN_VIEWS, TEST_VIEWS = 100, 25
DISTANCE = 4.0
ANGLE_X = 0.6911112  # horizontal field of view of the Blender scenes, radians
NEAR, FAR = 2.0, 6.0
SUPERSAMPLES = 3  # on each side of a pixel
CHUNK = 1 << 16
FLOOR = -0.46  # height of the plinth's top
LIGHT = (0.45, -0.55, 0.70)
AMBIENT_DOWN, AMBIENT_UP, DIFFUSE = 0.36, 0.56, 0.58

MOSAIC = ((0.93, 0.87, 0.74), (0.16, 0.42, 0.52), (0.80, 0.45, 0.30), (0.30, 0.62, 0.60), (0.95, 0.76, 0.42))


def builtin_scene(size: int = 100, *, train_views: int = TRAIN_VIEWS, test_views: int = TEST_VIEWS) -> Scene:
    """Computes the scene.

    Args:
        size: of the square images, pixels.
        train_views: spread over the upper hemisphere on a spherical Fibonacci lattice.
        test_views: on an orbit that rises and falls twice, apart from the training views.
    """
    if size < 1:
        raise ValueError(f"builtin_scene: size must be >= 1, got {size}")
    if train_views < 1 or test_views < 1:
        raise ValueError(f"builtin_scene: there must be at least one view, got {train_views} and {test_views}")
    height = (torch.arange(train_views) + 0.5) / train_views
    golden = math.pi * (3 - math.sqrt(5))
    train = _cameras(torch.asin(0.02 + 0.96 * height), golden * torch.arange(train_views), size)
    turn = 2 * math.pi * torch.arange(test_views) / test_views
    test = _cameras(torch.deg2rad(28 + 16 * torch.sin(2 * turn)), turn + 0.05, size)
    return Scene("builtin", _render(train, "train"), _render(test, "test"), NEAR, FAR, bounds(), "linear", "white")


@cache
def solids() -> tuple[Solid, ...]:
    """Everything in the scene."""
    parts: list[Solid] = [
        Cylinder((0, 0, FLOOR - 0.08), _mosaic, 0.08, 10, radius=1.18, half_height=0.08),
        Sphere((0.62, 0.30, FLOOR + 0.36), _checker, 0.55, 40, rotation("x", 24), radius=0.36),
        Box((-0.60, 0.38, FLOOR + 0.30), _diagonals, 0.15, 12, rotation("z", 28), half=(0.27, 0.27, 0.30)),
        Cylinder((-0.02, -0.70, FLOOR + 0.21), _bricks, 0.10, 10, radius=0.31, half_height=0.21),
        Cylinder((0, 0, FLOOR + 0.50), _barber_pole, 0.25, 20, radius=0.10, half_height=0.50),
        Sphere((0, 0, FLOOR + 1.22), _globe, 0.45, 30, radius=0.24),
        Torus((0, 0, FLOOR + 0.66), _spiral, 0.40, 30, rotation("x", -20), ring=0.37, tube=0.085),
    ]
    count = 14
    for index in range(count):
        azimuth = 2 * math.pi * (index + 0.5) / count
        colour = colorsys.hsv_to_rgb(index / count, 0.75, 0.92)
        place = (1.06 * math.cos(azimuth), 1.06 * math.sin(azimuth), FLOOR + 0.075)
        parts.append(Sphere(place, _plain(colour), 0.6, 40, radius=0.075))
    return tuple(parts)


def bounds() -> Tensor:
    """The box that holds all solids, [2, 3]."""
    boxes = torch.stack([solid.bounds() for solid in solids()])
    return torch.stack((boxes[:, 0].amin(0), boxes[:, 1].amax(0)))


def cast(origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """First hits of rays, and their light.

    Args:
        origins: [r, 3], or [1, 3] where all rays start from the same point.
        directions: [r, 3], unit.

    Returns:
        (colour [r, 3] in 0..1, zero where nothing is hit; depth [r], infinite there).
    """
    depth = torch.full((len(directions),), float("inf"))
    which = torch.zeros(len(directions), dtype=torch.int8)
    for index, (solid, rows) in enumerate(zip(solids(), candidates(solids(), origins, directions))):
        found = solid.hit(origins[rows] if len(origins) > 1 else origins, directions[rows])
        closer = found < depth[rows]
        depth[rows[closer]], which[rows[closer]] = found[closer], index
    colour = torch.zeros_like(directions)
    rows = depth.isfinite().nonzero()[:, 0]
    points = (origins[rows] if len(origins) > 1 else origins) + depth[rows, None] * directions[rows]
    which = which[rows]
    normals, albedo = torch.zeros_like(points), torch.zeros_like(points)
    gloss, sharpness = torch.zeros(len(rows)), torch.ones(len(rows))
    for index, solid in enumerate(solids()):
        mine = (which == index).nonzero()[:, 0]
        if len(mine):
            normals[mine], albedo[mine] = solid.surface(points[mine])
            gloss[mine], sharpness[mine] = solid.gloss, solid.sharpness
    colour[rows] = _shade(points, normals, albedo, gloss, sharpness, directions[rows])
    return colour, depth


def _shade(
    points: Tensor, normals: Tensor, albedo: Tensor, gloss: Tensor, sharpness: Tensor, directions: Tensor
) -> Tensor:
    """Sky light from above, one lamp far away with hard shadows, Phong highlights."""
    light = torch.nn.functional.normalize(torch.tensor(LIGHT), dim=0)
    facing = (normals @ light).clamp_min(0)
    lit = (facing > 0).nonzero()[:, 0]
    start = points[lit] + 2e-3 * normals[lit]
    lamp = torch.zeros_like(facing)
    lamp[lit] = 1.0
    for solid, rows in zip(solids(), candidates(solids(), start, light[None])):
        shaded = solid.hit(start[rows], light[None]).isfinite()
        lamp[lit[rows[shaded]]] = 0.0
    ambient = AMBIENT_DOWN + (AMBIENT_UP - AMBIENT_DOWN) * (0.5 + 0.5 * normals[:, 2])
    mirrored = 2 * (normals @ light)[:, None] * normals - light
    highlight = gloss * (-(mirrored * directions).sum(-1)).clamp_min(0) ** sharpness
    return (albedo * (ambient + DIFFUSE * facing * lamp)[:, None] + (highlight * lamp)[:, None]).clamp(0, 1)


def _cameras(elevation: Tensor, azimuth: Tensor, size: int) -> Cameras:
    around = torch.stack(
        (elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()), dim=-1
    )
    poses = look_at(DISTANCE * around, torch.zeros(3), torch.tensor((0.0, 0.0, 1.0)))
    focal = 0.5 * size / math.tan(0.5 * ANGLE_X)
    return Cameras(poses, torch.tensor((focal, focal, size / 2, size / 2)).repeat(len(poses), 1), size, size)


def _render(cameras: Cameras, name: str) -> Split:
    """Casts SUPERSAMPLES^2 rays a pixel and averages premultiplied colour and coverage."""
    size, fine = cameras.width, SUPERSAMPLES
    dense = Cameras(cameras.poses, cameras.intrinsics * fine, size * fine, size * fine)
    box = bounds()
    images = torch.empty(len(cameras), size, size, 4, dtype=torch.uint8)
    for index in range(len(cameras)):
        rays = dense.image_rays(index)
        rgba = torch.zeros(len(rays), 4)
        _, _, near_solids = intersect_box(rays.origins, rays.directions, box, 0.0, 2 * DISTANCE)
        for rows in near_solids.nonzero()[:, 0].split(CHUNK):
            colour, depth = cast(rays.origins[:1], rays.directions[rows])
            rgba[rows] = torch.cat((colour, depth.isfinite().float()[:, None]), dim=-1)
        pixels = rgba.reshape(size, fine, size, fine, 4).mean(dim=(1, 3))
        pixels[..., :3] /= pixels[..., 3:].clamp_min(1e-6)
        images[index] = (pixels * 255).round().to(torch.uint8)
    return Split(cameras, images, tuple(f"{name}_{index:03d}" for index in range(len(cameras))))


def _pick(colours: tuple[tuple[float, float, float], ...], index: Tensor) -> Tensor:
    """Colours by index, [n] -> [n, 3]."""
    return torch.tensor(colours)[index.long() % len(colours)]


def _plain(colour: tuple[float, float, float]) -> Texture:
    return lambda points, normals: torch.tensor(colour).expand_as(points)


def _mosaic(points: Tensor, normals: Tensor) -> Tensor:
    """Rings of tiles in five colours; a band of stripes on the rim."""
    x, y, z = points.unbind(-1)
    turn = torch.atan2(y, x) / (2 * math.pi) + 0.5
    ring = (torch.hypot(x, y) / 0.1312).floor()
    tiles = 6 * ring + 5
    sector = (turn * tiles).floor()
    top = _pick(MOSAIC, ring * 3 + sector * 2 + (ring * sector % 3))
    rim = _pick(((0.24, 0.30, 0.40), (0.90, 0.86, 0.78)), (turn * 48).floor() + (z > 0.0))
    return torch.where((normals[:, 2:] > 0.5), top, rim)


def _checker(points: Tensor, normals: Tensor) -> Tensor:
    """A fine checker of longitudes and latitudes."""
    turn = torch.atan2(normals[:, 1], normals[:, 0]) / (2 * math.pi) + 0.5
    climb = torch.acos(normals[:, 2].clamp(-1, 1)) / math.pi
    return _pick(((0.88, 0.16, 0.20), (0.97, 0.93, 0.86)), (turn * 20).floor() + (climb * 10).floor())


def _diagonals(points: Tensor, normals: Tensor) -> Tensor:
    """Diagonal stripes, in other colours on each pair of faces."""
    stripe = ((points.sum(-1) + 9) / 0.085).floor() % 2
    pair = normals.abs().argmax(-1)
    colours = (
        (0.12, 0.28, 0.70),
        (0.98, 0.80, 0.22),
        (0.10, 0.46, 0.66),
        (0.98, 0.62, 0.24),
        (0.20, 0.20, 0.52),
        (0.96, 0.90, 0.60),
    )
    return _pick(colours, 2 * pair + stripe)


def _bricks(points: Tensor, normals: Tensor) -> Tensor:
    """Courses of bricks of three reds in pale mortar; rings on top."""
    x, y, z = points.unbind(-1)
    turn = torch.atan2(y, x) / (2 * math.pi) + 0.5
    course = ((z + 1) / 0.084).floor()
    along = turn * 14 + 0.5 * (course % 2)
    mortar = ((z + 1) / 0.084 % 1 < 0.17) | (along % 1 < 0.12)
    brick = _pick(((0.66, 0.26, 0.18), (0.76, 0.36, 0.24), (0.56, 0.20, 0.17)), along.floor() * 2 + course)
    side = torch.where(mortar[:, None], torch.tensor((0.86, 0.82, 0.76)), brick)
    rings = _pick(((0.93, 0.88, 0.78), (0.30, 0.24, 0.34)), (torch.hypot(x, y) / 0.0775).floor())
    return torch.where(normals[:, 2:].abs() > 0.5, rings, side)


def _barber_pole(points: Tensor, normals: Tensor) -> Tensor:
    """Two-coloured helix."""
    turn = torch.atan2(points[:, 1], points[:, 0]) / (2 * math.pi)
    return _pick(((0.95, 0.94, 0.92), (0.13, 0.16, 0.22)), (2 * turn + points[:, 2] / 0.11 + 40).floor())


def _globe(points: Tensor, normals: Tensor) -> Tensor:
    """Smooth continents in a sea with meridians."""
    x, y, z = (normals * 1.0).unbind(-1)
    land = torch.sin(4 * x + 1.3) * torch.sin(5 * y + 0.4) + 0.7 * torch.sin(6 * z + 2 * x) > 0.15
    shade = (0.5 + 0.5 * torch.sin(9 * x) * torch.sin(9 * y + 4 * z))[:, None]
    green = torch.lerp(torch.tensor((0.24, 0.52, 0.20)), torch.tensor((0.86, 0.74, 0.42)), shade)
    sea = torch.lerp(torch.tensor((0.08, 0.26, 0.58)), torch.tensor((0.16, 0.52, 0.76)), shade)
    return torch.where(land[:, None], green, sea)


def _spiral(points: Tensor, normals: Tensor) -> Tensor:
    """Bands wound around the tube."""
    around = torch.atan2(points[:, 1], points[:, 0]) / (2 * math.pi)
    tube = torch.atan2(normals[:, 2], torch.hypot(points[:, 0], points[:, 1]) - 0.37) / (2 * math.pi)
    return _pick(((0.16, 0.62, 0.36), (0.98, 0.95, 0.70), (0.52, 0.22, 0.56)), (around * 18 + tube + 40).floor())
