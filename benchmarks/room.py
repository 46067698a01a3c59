"""Writes the capture of a random room along a hand-held path, or measures the depth errors of a run trained on it.

Walls, table and floor have no texture; floor and table are mirrors. Many depths therefore explain the images. The seed
determines furniture, colours, textures and the path, so that no setting can be tuned to one picture. The capture has
PNG files and a COLMAP model. The model's points lie on edges of the images, and its cameras are off by a third of a
pixel. `depths.npy` has the distances in the held-out views.

    python benchmarks/room.py FOLDER --seed 1
    voronerf train --data FOLDER --budget 60 --out RUN
    python benchmarks/room.py FOLDER --run RUN
"""

from __future__ import annotations

import argparse
import colorsys
import math
import random
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from voronerf.app.render.camera import render_camera
from voronerf.app.run import open_run
from voronerf.app.scenes import Scene
from voronerf.app.scenes.builtin.caster import Caster
from voronerf.app.scenes.builtin.pictures import LIGHT, shaded
from voronerf.app.scenes.builtin.solids import Array, Box, Cylinder, Solid, Sphere, Texture, rotation
from voronerf.app.scenes.builtin.textures import bricks, checker, diagonals, globe, plain, spiral
from voronerf.app.scenes.photographs import HOLD_OUT
from voronerf.nerf.cameras import Cameras, look_at
from voronerf.nerf.renderer import Renderer
from voronerf.nerf.volume import per_ray

FINE = 2  # rays along each side of a pixel
#: Reflectance of mirrors at normal and at grazing incidence (Schlick 1994).
MIRROR = 0.05, 0.6
#: Standard deviations of the errors: pixel values, camera directions in pixels, and points as a fraction of
#: their distance.
NOISE, TURN, OFF = 0.008, 0.3, 0.003
#: Points that each view adds to the model.
POINTS = 20
#: Samples at less than this fraction of a surface's distance count as in front of the surface.
BEFORE = 0.95


def wall(draw: random.Random) -> Texture:
    """Draws a pale colour that becomes a little darker towards one side."""
    colour = np.array(colorsys.hsv_to_rgb(draw.random(), 0.15 * draw.random(), 0.7 + 0.25 * draw.random()))
    slope = np.array([draw.uniform(-0.05, 0.05) for _ in range(3)])
    return lambda points, normals: (colour * (1 + points @ slope)[:, None]).astype(np.float32)


def room(draw: random.Random) -> tuple[list[Solid], int]:
    """Draws a room; returns its solids and the number of mirrors, which come first: floor and table."""
    a, b, up = draw.uniform(1.9, 2.5), draw.uniform(1.9, 2.5), 1.6
    top = draw.uniform(0.6, 0.8)
    sides = draw.uniform(0.4, 0.6), draw.uniform(0.35, 0.5)
    turn = rotation("z", draw.uniform(0, 90))
    solids: list[Solid] = [
        Box((0, 0, -0.1), wall(draw), 0.15, 30, half=(a, b, 0.1)),
        Box((0, 0, top - 0.02), wall(draw), 0.15, 30, turn, half=(*sides, 0.02)),
        *(Box((s * (a + 0.1), 0, up), wall(draw), 0, half=(0.1, b + 0.2, up)) for s in (-1, 1)),
        *(Box((0, s * (b + 0.1), up), wall(draw), 0, half=(a, 0.1, up)) for s in (-1, 1)),
        Cylinder((0, 0, top / 2 - 0.02), wall(draw), radius=0.06, half_height=top / 2 - 0.021),
    ]

    def surface() -> Texture:
        colour = colorsys.hsv_to_rgb(draw.random(), 0.3 + 0.6 * draw.random(), 0.3 + 0.6 * draw.random())
        return draw.choice([plain(colour), checker, diagonals, bricks, globe])

    for i in range(4):  # objects on the table
        angle, size = math.pi / 2 * (i + draw.random()), draw.uniform(0.06, 0.13)
        x, y = 0.28 * math.cos(angle), 0.28 * math.sin(angle)
        spin = rotation("z", draw.uniform(0, 90))
        solids.append(
            draw.choice(
                [
                    Sphere((x, y, top + size), surface(), 0.4, 30, radius=size),
                    Box((x, y, top + size), surface(), 0.1, 10, spin, half=(0.7 * size, size, size)),
                    Cylinder((x, y, top + size), surface(), 0.4, 30, radius=0.7 * size, half_height=size),
                ]
            )
        )
    for i in range(6):  # furniture along the walls, with a picture above each piece
        deep, wide, high = 0.2, draw.uniform(0.25, 0.5), draw.uniform(0.2, 0.8)
        s, along = (-1) ** i, draw.uniform(-0.6, 0.6)
        place = (s * (a - deep), along * b) if i < 3 else (along * a, s * (b - deep))
        half = (deep, wide) if i < 3 else (wide, deep)
        solids.append(Box((*place, high), surface(), 0.1, 10, half=(*half, high)))
        across = draw.uniform(-0.5, 0.5)
        place = (s * (a - 0.01), across * b) if i < 3 else (across * a, s * (b - 0.01))
        half = (0.01, 0.3) if i < 3 else (0.3, 0.01)
        texture = draw.choice([diagonals, checker, spiral, bricks])
        solids.append(Box((*place, 2.1), texture, 0.1, 10, half=(*half, 0.22)))
    return solids, 2


def path(draw: random.Random, views: int, width: int, height: int) -> Cameras:
    """Returns cameras that circle the table at head height and look roughly at it."""
    t = torch.linspace(0, 1, views)
    waves = [torch.sin(2 * math.pi * (draw.choice([2, 3, 5]) * t + draw.random())) for _ in range(6)]
    angle = 2 * math.pi * draw.random() + draw.uniform(4.0, 5.5) * t + 0.05 * waves[0]
    radius, up = draw.uniform(1.15, 1.3) + 0.2 * waves[1], draw.uniform(1.3, 1.5) + 0.15 * waves[2]
    origins = torch.stack((radius * angle.cos(), radius * angle.sin(), up), dim=-1)
    targets = torch.stack((0.2 * waves[3], 0.2 * waves[4], 0.75 + 0.15 * waves[5]), dim=-1)
    vertical = torch.tensor((0.0, 0.0, 1.0))
    poses = torch.cat([look_at(origins[i : i + 1], targets[i], vertical) for i in range(views)])
    lens = torch.tensor((0.75 * width, 0.75 * width, width / 2, height / 2))
    return Cameras(poses, lens.repeat(views, 1), width, height)


def meet(caster: Caster, cameras: Cameras, view: int) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Returns a view's rays: origins and directions [r, 3], distances [r], and indices of the hit solids [r]."""
    rays, size = cameras.image_rays(view), (cameras.width, cameras.height)
    origins, directions = rays.origins.numpy(), rays.directions.numpy()
    scale = np.array([[float(cameras.intrinsics[view, 0]), size[0] / 2 - 0.5, size[1] / 2 - 0.5]])
    pose = cameras.poses[view : view + 1].double().numpy()
    return origins, directions, *caster.seen(pose, scale, size, origins.T, directions.T)


def look(
    caster: Caster, mirrors: int, origins: Array, directions: Array, depth: Array, number: NDArray[np.int64]
) -> Array:
    """Returns the colours [r, 3] of rays that hit solids ``number`` at ``depth`` (inf: no hit), with one reflection."""
    colour = shaded(origins, directions, depth, number, caster)
    rows = (np.isfinite(depth) & (number < mirrors)).nonzero()[0]
    along = directions[rows]
    rows, along = rows[along[:, 2] < 0], along[along[:, 2] < 0]  # rays from above
    starts = origins[rows] + depth[rows, None] * along + np.array((0, 0, 1e-3), np.float32)
    bounced = (along * np.array((1, 1, -1))).astype(np.float32)
    solids = np.arange(len(caster.solids))
    met = caster.first(starts.T, bounced.T, solids, 0.0 * solids, 0 * solids, 0 * solids + len(rows))
    straight, flat = MIRROR
    share = straight + (flat - straight) * (1 + along[:, 2:]) ** 5
    colour[rows] = (1 - share) * colour[rows] + share * shaded(starts, bounced, *met, caster)
    return colour


def write_room(folder: Path, seed: int, *, views: int = 72, width: int = 200, height: int = 150) -> None:
    """Writes the capture of a room: images, a COLMAP model, and the distances in held-out views."""
    draw, noise = random.Random(seed), np.random.default_rng(seed)
    solids, mirrors = room(draw)
    caster, cameras = Caster(solids, LIGHT), path(draw, views, width, height)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    (folder / "sparse/0").mkdir(parents=True, exist_ok=True)
    fine = Cameras(cameras.poses, cameras.intrinsics * FINE, width * FINE, height * FINE)
    depths, points = [], []
    for view in range(views):
        origins, directions, depth, number = meet(caster, fine, view)
        colour = look(caster, mirrors, origins, directions, depth, number)
        colour[np.isinf(depth)] = 0
        pixels = colour.reshape(height, FINE, width, FINE, 3).mean((1, 3)) + noise.normal(0, NOISE, (height, width, 3))
        Image.fromarray(np.rint(255 * pixels.clip(0, 1)).astype(np.uint8)).save(folder / f"images/{view:03d}.png")
        origins, directions, depth, _ = meet(caster, cameras, view)
        depths.append(depth.reshape(height, width))
        edges = np.hypot(*(np.abs(slope).sum(-1) for slope in np.gradient(pixels, axis=(0, 1)))).reshape(-1)
        edges = np.where(np.isfinite(depth) & (edges > 0.1), edges, 0)
        rows = noise.choice(len(edges), min(POINTS, int((edges > 0).sum())), replace=False, p=edges / edges.sum())
        points.append(origins[rows] + depth[rows, None] * directions[rows])
    every = torch.from_numpy(np.concatenate(points))
    tracks: list[list[int]] = [[] for _ in range(len(every))]
    lines = []
    for view in range(views):
        places, ahead = cameras.project(every, view)
        inside = (ahead > 0) & (places > 0).all(-1) & (places < torch.tensor((width, height))).all(-1)
        column, row = torch.where(inside[:, None], places, 0).long().unbind(-1)
        away = (every - cameras.poses[view, :3, 3]).norm(dim=-1)
        there = inside & ((torch.from_numpy(depths[view])[row, column] - away).abs() < 0.01 * away)
        seen = there.nonzero()[:, 0].tolist()
        for number in seen:
            tracks[number].append(view)
        shaken = rotation("x", d := math.degrees(noise.normal(0, TURN) / (0.75 * width))) @ rotation("y", d)
        turn = cameras.poses[view, :3, :3].numpy() @ shaken * np.array((1, -1, -1))
        place = -turn.T @ cameras.poses[view, :3, 3].numpy()
        lines.append(f"{view + 1} {' '.join(map(str, (*quaternion(turn.T), *place)))} 1 {view:03d}.png")
        lines.append(" ".join(f"{places[n, 0]:.2f} {places[n, 1]:.2f} {n}" for n in seen))
    moved = every.numpy() * (1 + noise.normal(0, OFF, (len(every), 1)))
    (folder / "sparse/0/images.txt").write_text("\n".join(lines) + "\n")
    text = "\n".join(
        f"{n} {x} {y} {z} 0 0 0 1 {' '.join(f'{view + 1} 0' for view in tracks[n])}"
        for n, (x, y, z) in enumerate(moved)
    )
    (folder / "sparse/0/points3D.txt").write_text(text + "\n")
    lens = f"1 PINHOLE {width} {height} {0.75 * width} {0.75 * width} {width / 2} {height / 2}\n"
    (folder / "sparse/0/cameras.txt").write_text(lens)
    np.save(folder / "depths.npy", np.stack(depths)[::HOLD_OUT])


def quaternion(turn: Array) -> Array:
    """Returns the quaternion (w, x, y, z) of a rotation matrix, by Bar-Itzhack's eigenvector method (2000)."""
    (a, b, c), (d, e, f), (g, h, i) = turn.astype(np.float64)
    rows = [
        [a + e + i, h - f, c - g, d - b],
        [0, a - e - i, b + d, c + g],
        [0, 0, e - a - i, f + h],
        [0, 0, 0, i - a - e],
    ]
    return np.asarray(np.linalg.eigh(np.array(rows) / 3, UPLO="U")[1][:, 3])


@torch.no_grad()
def depth_errors(renderer: Renderer, scene: Scene, folder: Path) -> dict[str, float]:
    """Returns the median relative depth error of held-out views, and the mean rendering weight in front of surfaces."""
    scale = float(torch.linalg.det(scene.transform[:3, :3])) ** (1 / 3)
    errors, early = [], []
    for view, true in enumerate(torch.from_numpy(scale * np.load(folder / "depths.npy")).float()):
        met = true.isfinite().reshape(-1)
        depth = render_camera(renderer, scene, scene.test.cameras, view, heaviest=False).depth
        errors.append(((depth - true).abs() / true).reshape(-1)[met])
        rays, true = scene.test.cameras.image_rays(view)[met], true.reshape(-1)[met]
        last = renderer.render(rays, per_ray(scene.near, rays), per_ray(scene.far, rays))[-1]
        before = last.samples.depths < BEFORE * true[last.samples.ray_index.long()]
        early.append(torch.zeros(len(true)).index_add(0, last.samples.ray_index.long(), last.weights * before))
    return {"depth_error": float(torch.cat(errors).median()), "light_before": float(torch.cat(early).mean())}


def main() -> None:
    """Writes a room, or prints the depth errors of a run that was trained on it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--run", type=Path, help="a run trained on the room: print its depth errors, write nothing")
    options = parser.parse_args()
    if options.run is None:
        write_room(options.folder, options.seed)
    else:
        run = open_run(options.run)
        print(depth_errors(run.renderer, run.scene, options.folder))


if __name__ == "__main__":
    main()
