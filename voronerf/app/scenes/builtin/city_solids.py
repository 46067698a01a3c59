"""The solids of the built-in city: blocks of buildings, trees, lamps and cars along streets, and their textures.

A block is a square of one scene unit, with half a street along each side. Its solids depend only on its column and row,
so a larger city contains the smaller cities.
"""

from __future__ import annotations

import colorsys
from dataclasses import replace

import numpy as np

from voronerf.app.scenes.builtin.solids import Array, Box, Cylinder, Solid, Sphere, Texture, rotation
from voronerf.app.scenes.builtin.textures import Colour, plain

STREET = 0.12  # half the width of a street
KERB = 0.008  # height of the pavement
DEPTH = 0.03  # thickness of the ground
FLOOR, BAY = 0.034, 0.04  # height of a storey and width of a bay, which holds one window
TALLEST = 0.7
WALLS: tuple[Colour, ...] = (
    (0.68, 0.36, 0.27),
    (0.83, 0.76, 0.62),
    (0.62, 0.66, 0.70),
    (0.78, 0.55, 0.38),
    (0.55, 0.46, 0.42),
    (0.88, 0.86, 0.80),
)
GLASS: tuple[Colour, ...] = ((0.12, 0.18, 0.26), (0.30, 0.44, 0.56), (0.95, 0.84, 0.52), (0.52, 0.60, 0.64))
SHOPS: tuple[Colour, ...] = ((0.80, 0.18, 0.16), (0.12, 0.46, 0.34), (0.16, 0.30, 0.66), (0.93, 0.70, 0.18))
CARS: tuple[Colour, ...] = (
    (0.82, 0.12, 0.12),
    (0.14, 0.24, 0.62),
    (0.92, 0.92, 0.90),
    (0.12, 0.12, 0.14),
    (0.95, 0.75, 0.12),
    (0.20, 0.52, 0.40),
)


def _noise(x: Array, y: Array, salt: float) -> Array:
    """Hashes pairs of integers to pseudo-random numbers in 0..1 by the sine hash of many shaders: [n], [n] -> [n]."""
    wave = np.sin(x.astype(np.float64) * 12.9898 + y * 78.233 + salt * 37.719) * 43758.5453
    return (wave - np.floor(wave)).astype(np.float32)


def _choose(colours: tuple[Colour, ...], share: Array) -> Array:
    """Picks a colour for each number in 0..1: [n] -> [n, 3]."""
    table = np.array(colours, dtype=np.float32)
    return table[np.minimum((share * len(colours)).astype(np.int64), len(colours) - 1)]


def facade(half: tuple[float, float, float], wall: Colour, shop: Colour, salt: float) -> Texture:
    """Returns a texture of brick walls with a ledge and windows in each storey, shops below and a tiled roof."""
    storeys, base = max(1, round(2 * half[2] / FLOOR)), np.array(wall, dtype=np.float32)

    def texture(points: Array, normals: Array) -> Array:
        x, y, z = points.T
        across = np.abs(normals[:, 1]) > 0.5
        along, length = np.where(across, x, y), np.where(across, half[0], half[1])
        face = normals[:, 0] + 2 * normals[:, 1]
        bays = np.maximum(np.round(2 * length / BAY), 1)
        bay = np.clip((along / length + 1) / 2, 0, 0.9999) * bays
        storey = np.clip((z / half[2] + 1) / 2, 0, 0.9999) * storeys
        column, row = np.floor(bay), np.floor(storey)
        u, v = bay - column, storey - row
        key = _noise(column + 17 * face, row, salt)

        # four courses of bricks per storey, with mortar between them
        course = np.floor(4 * storey)
        brick = 3 * bay + 0.5 * (course % 2)
        tint = 0.86 + 0.28 * _noise(np.floor(brick) + 31 * face, course, salt)
        mortar = ((4 * storey) % 1 < 0.16) | (brick % 1 < 0.1)
        colour = base * np.where(mortar, np.float32(1.1), tint)[:, None]
        colour[v < 0.1] = base * np.float32(1.25)  # the ledge
        frame = (np.abs(u - 0.5) < 0.33) & (v > 0.22) & (v < 0.84)
        glass = (
            (np.abs(u - 0.5) < 0.28) & (v > 0.27) & (v < 0.79) & (np.abs(u - 0.5) > 0.03) & (np.abs(v - 0.56) > 0.03)
        )
        colour[frame] = (0.93, 0.92, 0.88)
        colour[glass] = _choose(GLASS, key[glass])
        blind = glass & (v > 0.27 + 0.6 * key)
        colour[blind] = (0.86, 0.83, 0.74)

        shops = row == 0
        awning = shops & (v > 0.62)
        colour[awning] = np.where((bay[awning] * 4 % 1 < 0.5)[:, None], np.array(shop, np.float32), np.float32(0.95))
        window = shops & (v < 0.62)
        colour[window] = np.where((np.abs(u - 0.5) < 0.42)[window, None], _choose(GLASS, key[window]), base * 0.6)

        roof = np.abs(normals[:, 2]) > 0.5
        tile = _noise(np.floor(x / 0.02), np.floor(y / 0.02), salt)
        edge = np.maximum(np.abs(x) - half[0], np.abs(y) - half[1]) > -0.012
        grey = np.where(edge, np.float32(0.8), 0.38 + 0.2 * tile)
        colour[roof] = np.stack((grey, grey * 0.97, grey * 0.93), axis=-1)[roof]
        return np.clip(colour, 0, 1).astype(np.float32)

    return texture


def leaves(points: Array, normals: Array) -> Array:
    """Colours leaves: patches in three greens."""
    x, y, z = points.T
    patch = _noise(np.floor(x / 0.009) + 50 * np.floor(z / 0.009), np.floor(y / 0.009), 0.7)
    return _choose(((0.16, 0.36, 0.14), (0.28, 0.50, 0.18), (0.42, 0.60, 0.24)), patch)


def ground(points: Array, normals: Array) -> Array:
    """Colours the streets: asphalt, dashed centre lines at integer x and y, and crossings."""
    x, y, _ = points.T
    across, beside = np.abs(x - np.round(x)), np.abs(y - np.round(y))
    grain = _noise(np.floor(x / 0.012), np.floor(y / 0.012), 0.1)
    colour = np.repeat((0.24 + 0.08 * grain)[:, None], 3, axis=1)
    for off, far, along in ((across, beside, y), (beside, across, x)):
        line = (off < 0.005) & (far > STREET + 0.05) & (along / 0.07 % 1 < 0.55)
        crossing = (far > STREET + 0.005) & (far < STREET + 0.045) & (off < STREET) & (off / 0.02 % 1 < 0.5)
        colour[line] = (0.92, 0.84, 0.45)
        colour[crossing] = (0.92, 0.92, 0.92)
    return colour.astype(np.float32)


def _paving(points: Array, normals: Array) -> Array:
    """Colours the top of a block: paving slabs around a lawn."""
    x, y, _ = points.T
    slab = 0.58 + 0.14 * _noise(np.floor(x / 0.025), np.floor(y / 0.025), 0.3)
    colour = np.stack((slab, 0.97 * slab, 0.92 * slab), axis=-1)
    lawn = np.maximum(np.abs(x), np.abs(y)) < 0.27
    colour[lawn] = _choose(
        ((0.30, 0.48, 0.20), (0.36, 0.54, 0.24)), _noise(np.floor(x / 0.018), np.floor(y / 0.018), 0.9)
    )[lawn]
    return colour.astype(np.float32)


def _body(colour: Colour) -> Texture:
    """Returns the texture of a car's body, with dark lower parts and lamps at both ends."""
    paint = np.array(colour, dtype=np.float32)

    def texture(points: Array, normals: Array) -> Array:
        x, y, z = points.T
        colours = np.repeat(paint[None], len(points), axis=0)
        colours[z < -0.003] = paint * 0.35
        lamp = (np.abs(normals[:, 0]) > 0.5) & (np.abs(y) > 0.012) & (z > -0.003)
        colours[lamp] = np.where(x[lamp, None] > 0, np.array((0.98, 0.96, 0.8)), np.array((0.8, 0.05, 0.05)))
        return colours

    return texture


def _car(place: tuple[float, float], degrees: float, colour: Colour) -> list[Solid]:
    """Returns the solids of a car: a body, a cabin of glass, a roof and two axles with wheels."""
    x, y = place
    turn = rotation("z", degrees)
    ahead = turn[:, 0] * 0.023  # from the car's middle to its front axle
    wheels = turn @ rotation("x", 90)
    parts: list[Solid] = [
        Box((x, y, 0.014), _body(colour), 0.5, 40, turn, half=(0.038, 0.017, 0.008)),
        Box((x, y, 0.027), plain((0.13, 0.17, 0.22)), 0.6, 50, turn, half=(0.021, 0.0145, 0.0055)),
        Box((x, y, 0.0335), plain(colour), 0.5, 40, turn, half=(0.018, 0.0145, 0.001)),
    ]
    for sign in (-1.0, 1.0):
        centre = (x + sign * float(ahead[0]), y + sign * float(ahead[1]), 0.0075)
        parts.append(Cylinder(centre, plain((0.07, 0.07, 0.08)), 0.1, 10, wheels, radius=0.0075, half_height=0.018))
    return parts


def _tree(x: float, y: float, size: float) -> list[Solid]:
    bark = plain((0.36, 0.26, 0.18))
    return [
        Cylinder((x, y, KERB + 0.025 * size), bark, 0.05, 10, radius=0.005 * size, half_height=0.025 * size),
        Sphere((x, y, KERB + 0.068 * size), leaves, 0.05, 10, radius=0.032 * size),
        Sphere((x + 0.009 * size, y - 0.007 * size, KERB + 0.095 * size), leaves, 0.05, 10, radius=0.022 * size),
    ]


def _building(x: float, y: float, half: tuple[float, float], height: float, random: np.random.Generator) -> list[Solid]:
    """Returns the solids of a building: one box, or two with a setback if it is tall, and its roof equipment."""
    wall = WALLS[int(random.integers(len(WALLS)))]
    shop, salt = SHOPS[int(random.integers(len(SHOPS)))], float(random.uniform(0, 10))
    parts: list[Solid] = []
    top, sides = KERB, half
    for share in (0.62, 0.38) if height > 0.4 else (1.0,):
        size = (sides[0], sides[1], share * height / 2)
        parts.append(Box((x, y, top + size[2]), facade(size, wall, shop, salt), 0.12, 15, half=size))
        top, sides = top + 2 * size[2], (0.72 * sides[0], 0.72 * sides[1])
    sides = (sides[0] / 0.72, sides[1] / 0.72)
    for _ in range(int(random.integers(1, 4))):
        dx, dy = (float(random.uniform(-0.6, 0.6)) * side for side in sides)
        if random.random() < 0.3:
            tank = plain((0.50, 0.36, 0.26))
            parts.append(Cylinder((x + dx, y + dy, top + 0.018), tank, 0.1, 10, radius=0.014, half_height=0.018))
        else:
            unit = plain(colorsys.hsv_to_rgb(0.55, 0.08, float(random.uniform(0.5, 0.85))))
            parts.append(Box((x + dx, y + dy, top + 0.009), unit, 0.2, 20, half=(0.016, 0.012, 0.009)))
    return parts


def block(column: int, row: int) -> list[Solid]:
    """Returns the solids of one block, centred at the origin.

    The centre lines of the four streets around it are at x = -0.5, x = 0.5, y = -0.5 and y = 0.5.
    """
    random = np.random.default_rng((column, row))
    inner = 0.5 - STREET
    parts: list[Solid] = [Box((0, 0, KERB / 2), _paving, 0.05, 10, half=(inner, inner, KERB / 2))]
    park = int(random.integers(12))  # a value above 3 means no park
    for lot in range(4):
        x, y = 0.17 * (1 if lot % 2 else -1), 0.17 * (1 if lot // 2 else -1)
        if lot == park:
            for _ in range(7):
                dx, dy = random.uniform(-0.1, 0.1, size=2).tolist()
                parts += _tree(x + dx, y + dy, float(random.uniform(0.9, 1.5)))
            continue
        half = float(random.uniform(0.1, 0.145)), float(random.uniform(0.1, 0.145))
        height = FLOOR * round(float(random.uniform(0.15, 1) ** 2 * TALLEST) / FLOOR + 3)
        parts += _building(x, y, half, min(height, TALLEST - 2 * FLOOR), random)
    for side in range(4):
        turn = rotation("z", 90.0 * side)
        for index in range(4):
            along = -0.27 + 0.18 * index
            x, y, _ = (turn @ np.array((along, -inner + 0.025, 0.0), dtype=np.float32)).tolist()
            if index % 2 == 0:
                parts += _tree(x, y, float(random.uniform(0.7, 1.0)))
            else:
                post = plain((0.22, 0.24, 0.26))
                parts.append(Cylinder((x, y, KERB + 0.045), post, 0.3, 20, radius=0.002, half_height=0.045))
                parts.append(Sphere((x, y, KERB + 0.094), plain((0.98, 0.95, 0.82)), 0.5, 30, radius=0.007))
        for index in range(3):
            if random.random() < 0.7:
                along = -0.22 + 0.2 * index + float(random.uniform(-0.03, 0.03))
                x, y, _ = (turn @ np.array((along, -inner - 0.024, 0.0), dtype=np.float32)).tolist()
                parts += _car((x, y), 90.0 * side, CARS[int(random.integers(len(CARS)))])
    return parts


def city(blocks: tuple[int, int]) -> list[Solid]:
    """Returns the solids of a city with `blocks` (along x, along y): first the ground, then block by block."""
    across, along = blocks[0] / 2, blocks[1] / 2
    corner = np.array((across, along, 0), dtype=np.float32)
    half = (across, along, DEPTH / 2)
    solids: list[Solid] = [
        Box((0, 0, -DEPTH / 2), lambda points, normals: ground(points + corner, normals), 0.03, 8, half=half)
    ]
    for row in range(blocks[1]):
        for column in range(blocks[0]):
            x, y = column + 0.5 - across, row + 0.5 - along
            for solid in block(column, row):
                place = (solid.centre[0] + x, solid.centre[1] + y, solid.centre[2])
                solids.append(replace(solid, centre=place))
    return solids
