"""Ray casting: finds the first solid on each ray, among a few candidates per ray.

Sizes: r rays, m solids, e candidates. A candidate is a solid and a range of consecutive rays that might hit it. Camera
rays lie in pixel order: each row of a projected solid's bounding rectangle gives a candidate. Shadow rays are parallel,
and sorted by the squares of a grid perpendicular to the light: each row of squares that a solid shades gives a
candidate. The candidates of a ray include every solid that it hits.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from voronerf.app.scenes.builtin.solids import Array, Solid, turned

PAIRS = 1 << 15  # ray-solid pairs per chunk; its arrays fit in the cache
SHARE = 8  # average number of rays in a square of the grid
CLIP = 1e-4  # distance of the near clipping plane from the camera
SLACK = 5e-4  # tolerance for float32 rounding, relative to the distance

Indices = NDArray[np.int64]
Numbers = NDArray[np.float64]
MISS = np.uint64(np.float32(np.inf).view(np.uint32)) << np.uint64(32)

_CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
_EDGES = np.array([(i, i + step) for step in (1, 2, 4) for i in range(8) if not i & step])


class Caster:
    """A ray caster: finds the first solid on each ray.

    Args:
        solids: the solids; the number of a solid is its index in this sequence.
        light: unit vector [3] towards the lamp.
    """

    def __init__(self, solids: Sequence[Solid], light: Array) -> None:
        self.solids, self.light = solids, light
        kinds = [(type(solid), solid.turn is not None) for solid in solids]
        self._kinds = list(dict.fromkeys(kinds))
        self._kind = np.array([self._kinds.index(kind) for kind in kinds])
        self._centres = np.array([solid.centre for solid in solids], dtype=np.float32).T
        self._measures = np.array([(*solid.measures(), 0, 0)[:3] for solid in solids], dtype=np.float32).T
        turns = [np.eye(3, dtype=np.float32) if solid.turn is None else solid.turn for solid in solids]
        self._turns = np.stack(turns, axis=-1)
        local = _CORNERS * np.array([solid.extent() for solid in solids])[:, None]
        self._corners = local @ np.stack(turns).swapaxes(1, 2) + np.array([solid.centre for solid in solids])[:, None]
        self._across = np.linalg.svd(light[None].astype(np.float64))[2][1:].T  # [3, 2]
        shadows = self._corners @ self._across
        self._shadows = shadows.min(1).T - 2 * SLACK, shadows.max(1).T + 2 * SLACK  # [2, m] each

    def first(
        self, origins: Array, directions: Array, solid: Indices, near: Array, start: Indices, end: Indices
    ) -> tuple[Array, Indices]:
        """Returns the first solid on each ray; at equal distances, the solid with the lowest number.

        Args:
            origins: ray origins [3, r], or [3, 1] for all rays.
            directions: unit ray directions [3, r], or [3, 1] for all rays.
            solid: solid number of each candidate [e].
            near: lower bound on the distance to each candidate [e]. Rays with a nearer hit skip the candidate.
            start: first ray of each candidate [e].
            end: end of each candidate's range of rays [e], exclusive.

        Returns:
            (distance [r], infinite for a miss; number of the solid [r], 0 for a miss).
        """
        count = np.broadcast_shapes(origins.shape, directions.shape)[1]
        # A key has the bits of the distance above the number of the solid. Keys sort by distance, since positive floats
        # sort in the order of their bits.
        keys = np.full(count, MISS)
        depth = keys.view(np.float32)[1::2]
        order = np.argsort(near, kind="stable")
        solid, near, start, end = solid[order], near[order], start[order], end[order]
        lengths = end - start
        ends = np.cumsum(lengths)
        cuts = np.searchsorted(ends, np.arange(PAIRS, ends[-1] if len(ends) else 0, PAIRS))
        for part in np.split(np.arange(len(solid)), np.unique(cuts)):
            counts = lengths[part]
            candidate = np.repeat(part, counts)
            ray = np.arange(counts.sum()) + np.repeat(start[part] - (np.cumsum(counts) - counts), counts)
            kept = (depth[ray] > near[candidate]).nonzero()[0]
            ray, number = ray[kept], solid[candidate[kept]]
            self._test(origins, directions, ray, number, keys)
        return depth, (keys & np.uint64(2**32 - 1)).astype(np.int64)

    def _test(
        self, origins: Array, directions: Array, rays: Indices, numbers: Indices, keys: NDArray[np.uint64]
    ) -> None:
        """Intersects pairs of a ray and a solid, and lowers `keys` [r] in place for nearer hits.

        Args:
            origins: ray origins, as in :meth:`first`.
            directions: unit ray directions, as in :meth:`first`.
            rays: index of each pair's ray.
            numbers: number of each pair's solid.
            keys: distance and solid number of each ray's nearest hit so far, in the bits of one integer, or `MISS`.
        """
        kinds = self._kind[numbers]
        for kind, (solid, is_turned) in enumerate(self._kinds):
            selected = (kinds == kind).nonzero()[0]
            if not len(selected):
                continue
            ray, number = rays[selected], numbers[selected]
            (ox, oy, oz), (dx, dy, dz) = (v.take(ray, 1) if v.shape[1] > 1 else v for v in (origins, directions))
            cx, cy, cz = self._centres.take(number, 1)
            away, along = (ox - cx, oy - cy, oz - cz), (dx, dy, dz)
            if is_turned:
                turns = self._turns.take(number, 2)
                away, along = turned(away, turns), turned(along, turns)
            distance = solid.distance(away, along, self._measures.take(number, 1))
            hit = np.isfinite(distance).nonzero()[0]
            hits = distance[hit].view(np.uint32).astype(np.uint64) << np.uint64(32) | number[hit].astype(np.uint64)
            np.minimum.at(keys, ray[hit], hits)

    def seen(
        self, poses: Numbers, scale: Numbers, size: tuple[int, int], origins: Array, directions: Array
    ) -> tuple[Array, Indices]:
        """Returns the first solid on each camera ray of v pictures, in row-major order.

        Args:
            poses: camera-to-world matrices [v, 4, 4].
            scale: focal length, and column and row of the principal point, of each picture [v, 3], in rays (a pixel
                may have several).
            size: width w and height h of each picture, in rays.
            origins: ray origins [3, v * h * w].
            directions: unit ray directions [3, v * h * w].

        Returns:
            (distance [v * h * w], infinite for a miss; number of the solid [v * h * w], 0 for a miss).
        """
        width, height = size
        local = (self._corners - poses[:, None, None, :3, 3]) @ poses[:, None, :3, :3]  # [v, m, 8, 3]
        tails, heads = local[:, :, _EDGES[:, 0]], local[:, :, _EDGES[:, 1]]
        # clips the edges of the bounding boxes at the near plane
        share = (-CLIP - tails[..., 2:]) / np.where(
            heads[..., 2:] == tails[..., 2:], 1, heads[..., 2:] - tails[..., 2:]
        )
        cut = tails + share * (heads - tails)
        ends = np.concatenate([np.where(e[..., 2:] > -CLIP, cut, e) for e in (tails, heads)], axis=2)
        shown = np.tile((tails[..., 2] <= -CLIP) | (heads[..., 2] <= -CLIP), 2)
        depth = np.maximum(-ends[..., 2], CLIP)
        focal, *middle = scale.T[..., None, None]
        reach = 0.01 + SLACK * focal
        bounds = []
        for axis, sign, most in ((0, 1, width), (1, -1, height)):
            place = sign * ends[..., axis] / depth * focal + middle[axis]
            low, high = np.where(shown, place - reach, np.inf).min(2), np.where(shown, place + reach, -np.inf).max(2)
            bounds += [np.ceil(low).clip(0, most), np.floor(high).clip(-1, most - 1) + 1]
        view, solid = ((bounds[1] > bounds[0]) & (bounds[3] > bounds[2])).nonzero()
        x0, x1, y0, y1 = (bound[view, solid].astype(np.int64) for bound in bounds)
        near = ((1 - SLACK) * np.where(shown, depth, np.inf).min(2))[view, solid].astype(np.float32)
        rectangle, row = _rows(y1 - y0)
        start = ((view * height + y0)[rectangle] + row) * width
        return self.first(
            origins, directions, solid[rectangle], near[rectangle], start + x0[rectangle], start + x1[rectangle]
        )

    def is_lit(self, origins: Array) -> NDArray[np.bool_]:
        """Returns whether no solid blocks the ray from each origin [3, r] to the lamp, [r]."""
        place = self._across.T @ origins
        if not place.size:
            return np.ones(0, dtype=np.bool_)
        low, side = place.min(1), max(1, int((place.shape[1] / SHARE) ** 0.5))
        width = np.maximum((place.max(1) - low) / side, 1e-9)[:, None]
        column, row = np.minimum((place - low[:, None]) // width, side - 1).astype(np.int64)
        square = row * side + column
        order = np.argsort(square, kind="stable")
        ends = np.append(0, np.bincount(square, minlength=side * side).cumsum())
        x0, y0 = ((self._shadows[0] - low[:, None]) // width).clip(0, side - 1).astype(np.int64)
        x1, y1 = ((self._shadows[1] - low[:, None]) // width).clip(-1, side - 1).astype(np.int64)
        rectangle, step = _rows(np.maximum(y1 - y0 + 1, 0))
        first = (y0[rectangle] + step) * side
        start, end = ends[first + x0[rectangle]], ends[np.maximum(first + x1[rectangle] + 1, first + x0[rectangle])]
        solid = rectangle[end > start]
        near = np.full(len(solid), np.finfo(np.float32).max)  # rays with a hit skip all further candidates
        depth, _ = self.first(origins[:, order], self.light[:, None], solid, near, start[end > start], end[end > start])
        lit = np.empty(len(order), dtype=np.bool_)
        lit[order] = np.isinf(depth)
        return lit


def _rows(heights: Indices) -> tuple[Indices, Indices]:
    """Enumerates the rows of rectangles: returns (number of the rectangle, row within it), one entry per row."""
    rectangle = np.repeat(np.arange(len(heights)), heights)
    return rectangle, np.arange(len(rectangle)) - np.repeat(np.cumsum(heights) - heights, heights)
