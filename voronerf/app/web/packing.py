"""Packs the contents of a page: bytes in the layout that the shader reads, and a description in JSON.

The bytes have these parts in this order, each aligned to 16 bytes:

    parameters  float16, cell after cell in the order of `ParameterOffsets`: blocks of matrices, and biases
    table       float16, of a hash grid: [e, f], or [k, e, f] if each cell has its own table
    occupied    a bit per voxel, 32 to a word, least significant bit first
    centres     float32 [m, 4]: x, y, z, and the bits of an int32: the index of the child diagram, or
                -1 - (cell number) if the centre is a leaf
    diagrams    uint32 [g + 1]: the first centre of each diagram, and m
    colours     uint8 [k, 4]: the colours of the cells in pictures

k cells, m centres of g diagrams, e entries of f features.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from voronerf.app.evaluate.panels import palette
from voronerf.app.run import Run
from voronerf.app.web.shader import BLOCK, CannotDraw, ParameterOffsets, fours, networks_text, shader_text
from voronerf.nerf.cameras import Cameras, shared_focus
from voronerf.nerf.contraction import Contraction, Perspective
from voronerf.nerf.radiance import Radiance, radiance_of
from voronerf.nerf.samplers import FINE_WAVE, OPAQUE, Occupancy
from voronerf.ops.formulas import SPACINGS

#: Greatest number of bytes of a part, WebGPU's guaranteed size of a storage binding.
LARGEST = 2**27
#: Greatest number of training cameras in a page.
MOST_CAMERAS = 240
#: Number of sample points with which a module is traced.
TRACED = 16
#: Largest float16.
GREATEST = 65504.0


@dataclass(frozen=True)
class Packed:
    """The contents of a web page that draws a trained scene.

    Attributes:
        scene: The description, as JSON values.
        data: The bytes for the shader: parameters, tables, occupied voxels, centres and colours.
        shader: The source of the shader in WGSL.
    """

    scene: dict[str, Any]
    data: bytes
    shader: str

    @property
    def summary(self) -> str:
        """A line about the contents of the page."""
        sizes = {name: size for name, (_, size) in self.scene["parts"].items()}
        table = f"a table of {sizes['table'] / 1e6:.2f} MB, " if sizes["table"] > 16 else ""
        networks = f"networks of {sizes['parameters'] / 1e6:.2f} MB, "
        return f"{self.scene['cells']} cells: {networks}{table}{len(self.scene['cameras'])} cameras"


def pack(run: Run) -> Packed:
    """Packs the parts of a run, its description and its shader.

    Raises:
        CannotDraw: A page cannot draw the run; the message is one line.
    """
    radiance, sampler = _networks(run), run.renderer.sampler
    assert isinstance(sampler, Occupancy)
    grid, k, diagram = sampler.grid, run.diagram.num_cells, run.diagram
    layout = ParameterOffsets()
    networks = networks_text(radiance.networks, layout)
    parameters, tables = radiance.cells.parameters, radiance.networks.program.tables
    if len(tables) > 1:
        raise CannotDraw(f"its networks read {len(tables)} tables of hash grids")
    table = parameters[tables[0]] if tables else None
    sizes = {
        "parameters": 2 * layout.size * k,
        "table": 0 if table is None else 2 * table.numel(),
        "occupied": grid.occupied.numel() // 8,
        "centres": 16 * len(diagram.centres),
    }
    for name, size in sizes.items():
        if size > LARGEST:
            raise CannotDraw(f"its part {name} takes {size / 2**20:,.1f} MiB, of {LARGEST / 2**20:g} at most")
    parts: dict[str, NDArray[Any]] = {
        "parameters": _parameters(parameters, radiance.networks.program.parameters, layout, k),
        "table": _half(np.zeros(8, np.float32) if table is None else table.detach().float().cpu().numpy()),
        "occupied": np.packbits(grid.occupied.cpu().numpy().reshape(-1), bitorder="little"),
        "centres": _centres(diagram),
        "diagrams": diagram.child_offsets.cpu().numpy().astype("<u4"),
        "colours": np.pad(palette(k).numpy(), ((0, 0), (0, 1))),
    }
    data, places = bytearray(), {}
    for name, part in parts.items():
        padded = part.tobytes()
        padded += bytes(-len(padded) % 16)
        places[name] = [len(data), len(padded)]
        data += padded
    per_cell = table is not None and table.dim() == 3 and table.shape[0] == k and k > 1
    constants = _constants(run, sampler, diagram.depth, table.shape[-2] if per_cell and table is not None else 0)
    scene = {
        "name": run.scene.name,
        "cells": k,
        "bytes": len(data),
        "parts": places,
        "background": None if run.scene.background is None else [1, 1, 1],
        **_views(run),
    }
    _check_finite(scene)
    return Packed(scene, bytes(data), shader_text(networks, constants))


def _networks(run: Run) -> Radiance:
    """Returns the networks of a run; raises CannotDraw if a page cannot draw them."""
    renderer = run.renderer
    if hasattr(run.router, "parts"):
        made = "it has several parts, as runs made by join, cut or place"
        raise CannotDraw(f"{made}; export the runs of which it was made, or show this run by voronerf render or view")
    if renderer.cones:
        raise CannotDraw("its field takes cones, a page can only evaluate points")
    if not isinstance(renderer.sampler, Occupancy):
        raise CannotDraw("it has no occupancy grid; train it with --occupancy")
    points = torch.linspace(-1, 1, 3 * TRACED, dtype=torch.float32, device="cpu").view(-1, 3).to(renderer.device)
    radiance = radiance_of(renderer.field, (points, torch.nn.functional.normalize(points, dim=-1)))
    if isinstance(radiance, str):
        raise CannotDraw(f"its field does not have one network per cell ({radiance})")
    if radiance.router.places(points).cells is not None:
        raise CannotDraw("its cells are not assigned by the nearest centre")
    return radiance


def _half(values: NDArray[np.float32]) -> NDArray[np.float16]:
    if not np.isfinite(values).all() or (values.size and np.abs(values).max() > GREATEST):
        raise CannotDraw("its parameters are not all finite numbers of at most 65,504")
    return values.astype("<f2")


def _parameters(
    parameters: list[Tensor], shapes: tuple[tuple[int, ...], ...], layout: ParameterOffsets, k: int
) -> NDArray[np.float16]:
    """Returns [k, size], the matrix blocks and biases of every cell."""
    rows = np.zeros((k, layout.size), "<f2")

    def of_cells(number: int) -> NDArray[np.float16]:
        values, shape = parameters[number].detach().float().cpu().numpy(), shapes[number]
        return _half(np.broadcast_to(values.reshape(-1, *shape), (k, *shape)))

    for number, start, o, i, place in layout.matrices:
        padded = np.zeros((k, 4 * fours(o), 4 * fours(i)), "<f2")
        padded[:, :o, :i] = of_cells(number)[:, :, start : start + i]
        # [k, o / 4, i / 4, 4 inputs, 4 outputs]: a block is a mat4x4f, column by column.
        blocks = padded.reshape(k, fours(o), 4, fours(i), 4).transpose(0, 1, 3, 4, 2)
        rows[:, place : place + fours(o) * fours(i) * BLOCK] = blocks.reshape(k, -1)
    for number, start, width, place in layout.vectors:
        rows[:, place : place + width] = of_cells(number).reshape(k, -1)[:, start : start + width]
    return rows


def _centres(diagram: Any) -> NDArray[np.float32]:
    """Returns the part `centres`, [m, 4]; see the module."""
    centres = diagram.centres.detach().float().cpu().numpy()
    if not np.isfinite(centres).all():
        raise CannotDraw("its centres are not finite")
    rows = np.zeros((len(centres), 4), "<f4")
    rows[:, : centres.shape[1]] = centres
    rows[:, 3] = diagram.child.cpu().numpy().astype("<i4").view("<f4")
    return rows


def _constants(run: Run, sampler: Occupancy, levels: int, table: int) -> dict[str, Any]:
    """Returns the constants of march.wgsl by name."""
    scene, grid, contraction = run.scene, sampler.grid, sampler.space.contraction
    low, high = grid.box.double().tolist()
    size = grid.occupied.shape
    box = [[0.0] * 3, [1.0] * 3] if scene.box is None else scene.box.tolist()
    diagonal = math.dist(low, high)
    constants: dict[str, Any] = {
        "STRATA": sampler.picture_samples,
        "WAVE": FINE_WAVE,
        "OPAQUE": OPAQUE,
        "SPACING": SPACINGS.index(sampler.space.spacing),
        "NEAR": float(scene.near),
        "FAR": float(scene.far),
        "BOXED": scene.box is not None,
        "BOX_LOW": box[0],
        "BOX_HIGH": box[1],
        "GRID_BOX_LOW": low,
        "GRID_SIZE": [float(count) for count in size],
        "GRID_SCALE": [count / (b - a) for count, a, b in zip(size, low, high)],
        "LEVELS": levels,
        "TABLE_OF_CELL": table,
        "CUT_DEPTH": diagonal / 200,
        "CONTRACTION": 0,
        "SPHERE_CENTRE": [0.0] * 3,
        "SPHERE_RADIUS": 1.0,
        "RIGHT": [0.0] * 3,
        "UP": [0.0] * 3,
        "AHEAD": [0.0] * 3,
        "PLANE": [1.0] * 3,
    }
    if isinstance(contraction, Contraction):
        sphere = {"SPHERE_CENTRE": contraction.centre.tolist(), "SPHERE_RADIUS": float(contraction.radius)}
        constants |= {"CONTRACTION": 1, **sphere}
    elif isinstance(contraction, Perspective):
        right, up, ahead = contraction.axes.tolist()
        axes = {"SPHERE_CENTRE": contraction.centre.tolist(), "RIGHT": right, "UP": up, "AHEAD": ahead}
        constants |= {"CONTRACTION": 2, **axes, "PLANE": [float(contraction.near), *map(float, contraction.slopes)]}
    _check_finite(constants)
    return constants


def _check_finite(value: Any) -> None:
    if isinstance(value, dict | list | tuple):
        for part in value.values() if isinstance(value, dict) else value:
            _check_finite(part)
    elif isinstance(value, float) and not abs(value) < 1e30:
        raise CannotDraw(f"its scene has a number that a page cannot use, {value}")


def _views(run: Run) -> dict[str, Any]:
    """Returns the training cameras, the first view, the target to turn around, and the bounds for cuts."""
    scene, cameras = run.scene, run.scene.train.cameras.perspective()
    chosen = np.linspace(0, len(cameras) - 1, min(len(cameras), MOST_CAMERAS)).round().astype(int)
    chosen = chosen[_tour(cameras.origins[chosen].numpy())]
    first = scene.test.cameras.perspective() if len(scene.test.cameras) else cameras
    target = shared_focus(cameras)
    contraction = scene.contraction
    if scene.box is not None:
        low, high = scene.box.tolist()
    elif isinstance(contraction, Contraction):
        low, high = (contraction.centre + side * contraction.radius for side in (-1, 1))
        low, high = low.tolist(), high.tolist()
    else:
        origins = cameras.origins
        low, high = (origins.amin(0) - scene.near).tolist(), (origins.amax(0) + scene.near).tolist()
    if target is None:
        depth = math.sqrt(scene.near * scene.far) if scene.near > 0 else scene.far / 2
        ahead = torch.nn.functional.normalize(cameras.forward.mean(0), dim=0)
        target = cameras.origins.mean(0) + min(depth, math.dist(low, high)) * ahead
    return {
        "cameras": [_camera(cameras, int(number)) for number in chosen],
        "first": _camera(first, 0),
        "target": target.tolist(),
        "bounds": [low, high],
        "near": float(scene.near),
    }


def _tour(places: NDArray[np.float32]) -> list[int]:
    """Orders places [c, 3] into a tour from the first place; the next place is always the nearest remaining one."""
    remaining, order = np.arange(1, len(places)), [0]
    while len(remaining):
        nearest = int(np.square(places[remaining] - places[order[-1]]).sum(1).argmin())
        order.append(int(remaining[nearest]))
        remaining = np.delete(remaining, nearest)
    return order


def _camera(cameras: Cameras, number: int) -> list[float]:
    """Returns a camera as 15 numbers: three rows of the pose, then focal length, width and height in pixels."""
    width, height = cameras.size(number)
    focal = float(cameras.intrinsics[number, :2].mean())
    if not focal > 0:
        raise CannotDraw(f"its camera {number} has a focal length of {focal:g}")
    return [round(x, 6) for x in cameras.poses[number, :3].flatten().tolist()] + [round(focal, 3), width, height]
