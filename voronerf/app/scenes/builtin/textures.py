"""Textures: functions from points [n, 3] and normals [n, 3] in a solid's frame to colours [n, 3]."""

from __future__ import annotations

import math

import numpy as np

from voronerf.app.scenes.builtin.solids import Array, Texture

Colour = tuple[float, float, float]

MOSAIC: tuple[Colour, ...] = (
    (0.86, 0.79, 0.66),
    (0.72, 0.68, 0.62),
    (0.84, 0.68, 0.52),
    (0.68, 0.74, 0.70),
    (0.90, 0.74, 0.50),
)


def _paint(colour: Colour) -> Array:
    return np.array(colour, dtype=np.float32)


def _pick(colours: tuple[Colour, ...], index: Array) -> Array:
    """Picks colours by index, rounded down and taken modulo their number: [n] -> [n, 3]."""
    return np.array(colours, dtype=np.float32)[np.floor(index).astype(np.int64) % len(colours)]


def _azimuth(points: Array) -> Array:
    """Returns the azimuths [n] of points [n, 3] as fractions of a full turn, 0..1."""
    x, y, _ = points.T
    turn: Array = np.arctan2(y, x) / np.float32(2 * math.pi)
    return turn + np.float32(0.5)


def plain(colour: Colour) -> Texture:
    """Returns the texture of a single colour."""
    return lambda points, normals: np.broadcast_to(_paint(colour), points.shape)


def mosaic(points: Array, normals: Array) -> Array:
    """Draws rings of tiles in five colours on top and a striped band on the rim."""
    x, y, _ = points.T
    ring = np.floor(np.hypot(x, y) / 0.1686)
    sector = np.floor(_azimuth(points) * (6 * ring + 5))
    top = _pick(MOSAIC, ring * 3 + sector * 2 + ring * sector % 3)
    rim = _pick(((0.62, 0.56, 0.52), (0.80, 0.74, 0.68)), _azimuth(points) * 36)
    return np.where(normals[:, 2:] > 0.5, top, rim)


def checker(points: Array, normals: Array) -> Array:
    """Draws a fine checkerboard along longitude and latitude."""
    climb = np.arccos(np.clip(normals[:, 2], -1, 1)) / math.pi
    return _pick(((0.86, 0.22, 0.20), (0.97, 0.62, 0.48)), np.floor(_azimuth(points) * 14) + np.floor(climb * 7))


def diagonals(points: Array, normals: Array) -> Array:
    """Draws diagonal stripes with two colours for each pair of opposite faces."""
    stripe = np.floor((points.sum(axis=-1) + 9) / 0.15) % 2
    pair = np.argmax(np.abs(normals), axis=-1)
    dark_and_light = (
        (0.16, 0.34, 0.74),
        (0.40, 0.62, 0.92),
        (0.12, 0.40, 0.58),
        (0.40, 0.74, 0.80),
        (0.34, 0.32, 0.68),
        (0.58, 0.56, 0.88),
    )
    return _pick(dark_and_light, 2 * pair + stripe)


def bricks(points: Array, normals: Array) -> Array:
    """Draws courses of bricks in three reds with pale mortar, and rings on both ends."""
    x, y, z = points.T
    height = (z + 1) / 0.105
    course = np.floor(height)
    along = _azimuth(points) * 11 + 0.5 * (course % 2)
    mortar = (height % 1 < 0.2) | (along % 1 < 0.12)
    brick = _pick(((0.66, 0.26, 0.18), (0.76, 0.36, 0.24), (0.56, 0.20, 0.17)), np.floor(along) * 2 + course)
    side = np.where(mortar[:, None], _paint((0.80, 0.62, 0.50)), brick)
    rings = _pick(((0.90, 0.70, 0.52), (0.55, 0.30, 0.28)), np.hypot(x, y) / 0.1034)
    return np.where(np.abs(normals[:, 2:]) > 0.5, rings, side)


def barber_pole(points: Array, normals: Array) -> Array:
    """Draws a helix in two colours."""
    return _pick(((0.95, 0.94, 0.92), (0.46, 0.50, 0.60)), 2 * _azimuth(points) + points[:, 2] / 0.16)


def globe(points: Array, normals: Array) -> Array:
    """Draws continents in a sea."""
    x, y, z = normals.T
    land = np.sin(4 * x + 1.3) * np.sin(5 * y + 0.4) + 0.7 * np.sin(6 * z + 2 * x) > 0.15
    shade = (0.5 + 0.5 * np.sin(9 * x) * np.sin(9 * y + 4 * z))[:, None]
    ground = _paint((0.24, 0.52, 0.20)) * (1 - shade) + _paint((0.86, 0.74, 0.42)) * shade
    sea = _paint((0.08, 0.26, 0.58)) * (1 - shade) + _paint((0.16, 0.52, 0.76)) * shade
    return np.where(land[:, None], ground, sea).astype(np.float32)


def spiral(points: Array, normals: Array) -> Array:
    """Draws bands wound around the tube of a torus, without a seam in either direction."""
    outward = (normals[:, :2] * points[:, :2]).sum(axis=-1) / np.hypot(points[:, 0], points[:, 1])
    tube = np.arctan2(normals[:, 2], outward) / (2 * math.pi)
    return _pick(((0.20, 0.66, 0.34), (0.56, 0.84, 0.40), (0.86, 0.92, 0.52)), _azimuth(points) * 12 + 3 * tube)
