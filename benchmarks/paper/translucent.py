"""The translucent scene of the experiment on limits: fog, coloured glass and stained shells, integrated exactly.

A ball of thin fog holds small opaque seeds, two striped shells that overlap, a block of layered glass and a lens.
Hardly any ray ends at its first surface, so what a pixel shows is spread along its ray. All media have constant density
and colour: along a ray both are piecewise constant, and the volume rendering integral is a finite sum. Units, cameras
and views are those of the built-in scene.

r rays, m media. Distances are along unit directions, densities per scene unit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from voronerf.data.builtin.opaque import TEST_VIEWS, TRAIN_VIEWS, builtin_cameras, render_scene
from voronerf.data.builtin.solids import Array
from voronerf.data.scene import Scene

Vector = tuple[float, float, float]
Doubles = NDArray[np.float64]

NAME = "translucent"
NOWHERE: Vector = (-math.inf,) * 3
SUPERSAMPLES = 2  # on each side of a pixel; translucent media have few hard edges
EMPTY = 1e-9  # sums of densities and their negatives below this are rounding


@dataclass(frozen=True)
class Medium:
    """An ellipsoid of constant density and colour, or the part of it that lies in an axis-aligned box.

    Where media overlap their densities add up and colours mix in proportion. A negative density takes out what another
    medium of the same colour has put there: a shell is a ball less a smaller one.

    Attributes:
        centre: of the ellipsoid.
        radii: its half axes, along x, y, z.
        density: per scene unit.
        colour: 0..1.
        low: lowest corner of the box.
        high: its highest corner.
    """

    centre: Vector
    radii: Vector
    density: float
    colour: Vector
    low: Vector = NOWHERE
    high: Vector = (math.inf,) * 3

    def bounds(self) -> Doubles:
        """A box that holds the medium, [2, 3]."""
        centre, radii = np.array(self.centre), np.array(self.radii)
        return np.stack((np.maximum(centre - radii, self.low), np.minimum(centre + radii, self.high)))

    def span(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """Where rays are inside: (enter [r], leave [r]), both 0 where they never are or the medium lies behind them."""
        start = (origins - np.array(self.centre, np.float32)) / np.array(self.radii, np.float32)
        (ox, oy, oz), (dx, dy, dz) = start.T, (directions / np.array(self.radii, np.float32)).T
        a, b = dx * dx + dy * dy + dz * dz, ox * dx + oy * dy + oz * dz
        # the discriminant by the closest point to the centre, which loses no digits far away
        cx, cy, cz = ox - b / a * dx, oy - b / a * dy, oz - b / a * dz
        root = np.sqrt(np.maximum((1 - (cx * cx + cy * cy + cz * cz)) / a, 0))
        enter, leave = -b / a - root, -b / a + root
        for o, d, low, high in zip(origins.T, directions.T, self.low, self.high):
            if math.isinf(low) and math.isinf(high):
                continue
            d = np.where(np.abs(d) < 1e-9, np.float32(1e-9), d)
            first, last = (np.float32(low) - o) / d, (np.float32(high) - o) / d
            enter, leave = np.maximum(enter, np.minimum(first, last)), np.minimum(leave, np.maximum(first, last))
        enter = np.maximum(enter, 0)
        met = leave > enter
        return np.where(met, enter, 0), np.where(met, leave, 0)


def striped_shell(
    centre: Vector, radius: float, thickness: float, density: float, axis: int, colours: tuple[Vector, ...]
) -> list[Medium]:
    """A spherical shell cut across an axis into stripes of equal height."""
    media = []
    for index, colour in enumerate(colours):
        low, high = [-math.inf] * 3, [math.inf] * 3
        height = 2 * radius / len(colours)
        low[axis] = centre[axis] - radius + index * height
        high[axis] = low[axis] + height
        for size, sign in ((radius, 1.0), (radius - thickness, -1.0)):
            box = (low[0], low[1], low[2]), (high[0], high[1], high[2])
            media.append(Medium(centre, (size,) * 3, sign * density, colour, *box))
    return media


def layered_block(low: Vector, high: Vector, density: float, colours: tuple[Vector, ...]) -> list[Medium]:
    """A block of glass in layers of equal width along x."""
    middle = tuple((a + b) / 2 for a, b in zip(low, high))
    around = tuple(2 * (b - a) for a, b in zip(low, high))  # an ellipsoid well outside of the block
    width = (high[0] - low[0]) / len(colours)
    edges = [low[0] + index * width for index in range(len(colours) + 1)]
    return [
        Medium(
            (middle[0], middle[1], middle[2]),
            (around[0], around[1], around[2]),
            density,
            colour,
            (left, low[1], low[2]),
            (right, high[1], high[2]),
        )
        for left, right, colour in zip(edges, edges[1:], colours)
    ]


RED, AMBER, TEAL, BLUE, PLUM = (
    (0.85, 0.15, 0.15),
    (0.95, 0.7, 0.2),
    (0.1, 0.6, 0.55),
    (0.15, 0.3, 0.85),
    (0.5, 0.1, 0.5),
)
MEDIA: tuple[Medium, ...] = (
    Medium((0.0, 0.0, 0.0), (1.05, 1.05, 0.8), 0.35, (0.75, 0.8, 0.88)),
    *striped_shell((-0.38, -0.1, 0.05), 0.52, 0.05, 7.0, 2, (RED, AMBER, RED, TEAL, AMBER, RED)),
    *striped_shell((0.22, 0.3, 0.0), 0.46, 0.05, 7.0, 0, (BLUE, TEAL, AMBER, BLUE, PLUM)),
    *layered_block((0.25, -0.75, -0.45), (0.75, -0.3, 0.35), 2.5, (TEAL, PLUM, AMBER, BLUE)),
    Medium((-0.1, 0.62, -0.35), (0.3, 0.12, 0.3), 5.0, TEAL),
    Medium((-0.38, -0.1, 0.05), (0.13, 0.13, 0.2), 120.0, (0.95, 0.9, 0.8)),
    Medium((0.22, 0.3, 0.0), (0.18, 0.1, 0.1), 120.0, (0.2, 0.12, 0.1)),
    Medium((0.5, -0.5, -0.05), (0.1, 0.1, 0.22), 120.0, RED),
    Medium((0.0, -0.62, -0.3), (0.09, 0.09, 0.09), 120.0, BLUE),
    Medium((-0.65, 0.45, -0.2), (0.1, 0.14, 0.1), 120.0, PLUM),
)


def translucent_scene(size: int = 100, *, train_views: int = TRAIN_VIEWS, test_views: int = TEST_VIEWS) -> Scene:
    """Computes the scene.

    Args:
        size: pixels on each side of an image.
        train_views: number of training views, placed as those of the built-in scene.
        test_views: number of test views, placed as those of the built-in scene.

    Raises:
        ValueError: a size or number of views below 1.
    """
    cameras = builtin_cameras("translucent_scene", size, train_views, test_views)
    return render_scene(NAME, cameras, integrate, bounds(), SUPERSAMPLES)


def bounds(media: tuple[Medium, ...] = MEDIA) -> Array:
    """The box that holds all media, [2, 3]."""
    boxes = np.stack([medium.bounds() for medium in media])
    return np.stack((boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0))).astype(np.float32)


def integrate(origin: Array, directions: Array, media: tuple[Medium, ...] = MEDIA) -> Array:
    """Light along rays from one point: emission and absorption (Max 1995), in closed form.

    Between two neighbouring borders of media density s and colour c are constant, so a stretch of length d adds
    `T * (1 - exp(-s d)) * c` and leaves `T * exp(-s d)` of the transmittance T.

    Args:
        origin: [1, 3].
        directions: [r, 3], unit.
        media: what is there; the rays start outside of all of it.

    Returns:
        Premultiplied colour and opacity, [r, 4].
    """
    spans = [medium.span(origin, directions) for medium in media]
    depths = np.stack([enter for enter, _ in spans] + [leave for _, leave in spans], axis=-1)
    density = np.array([medium.density for medium in media])
    glow = density[:, None] * np.array([medium.colour for medium in media])
    # Media that a ray misses have depth 0, before all others, and add nothing.
    met = int((depths[:, len(media) :] > 0).sum(axis=-1).max(initial=0))
    order = np.argsort(depths, axis=-1)[:, 2 * (len(media) - met) :]
    depths = np.take_along_axis(depths, order, -1)
    lengths = np.diff(depths, axis=-1).astype(np.float64)
    order, there = order[:, :-1], depths[:, :-1] > 0
    # entering adds a medium's density and glow, leaving takes them away again
    sigma = np.where(there, np.concatenate((density, -density))[order], 0).cumsum(axis=-1)
    passed = np.maximum(sigma, 0) * lengths
    through = np.exp(-(passed.cumsum(axis=-1) - passed))
    share = np.where(sigma > EMPTY, through * -np.expm1(-passed) / np.maximum(sigma, EMPTY), 0)
    result = np.empty((len(directions), 4), dtype=np.float32)
    for channel in range(3):
        steps = np.concatenate((glow[:, channel], -glow[:, channel]))
        result[:, channel] = (share * np.where(there, steps[order], 0).cumsum(axis=-1)).sum(axis=-1)
    result[:, 3] = -np.expm1(-passed.sum(axis=-1))
    return result.clip(0, 1)
