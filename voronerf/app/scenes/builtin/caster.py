"""The first solid on each of many rays, of which few solids are candidates.

r rays, m solids, e candidates: a solid and a range of rays that might meet it. Rays of a picture are in the order of
its pixels, and the candidates are the rows of the rectangle around a solid's picture. Rays to the lamp are parallel:
they are sorted into the squares of a grid across it. Candidates only leave out what could not be hit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from voronerf.app.scenes.builtin.solids import Array, Solid, turned

PAIRS = 1 << 15  # of a ray and a solid tested at a time, so that their arrays stay in the cache
SHARE = 8  # rays in a square of the grid
CLIP = 1e-4  # distance of the plane in front of a camera behind which nothing is projected
SLACK = 5e-4  # what float32 may miss a solid by, as a share of how far it is

Rows = NDArray[np.int64]
Numbers = NDArray[np.float64]
MISS = np.uint64(np.float32(np.inf).view(np.uint32)) << np.uint64(32)

_CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
_EDGES = np.array([(i, i + step) for step in (1, 2, 4) for i in range(8) if not i & step])


class Caster:
    """Finds the first of some solids on rays.

    Args:
        solids: each known by its number in this sequence.
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
        self, origins: Array, directions: Array, solid: Rows, near: Array, start: Rows, end: Rows
    ) -> tuple[Array, Rows]:
        """The first solid on each ray; of several at one distance, the one with the lowest number.

        Args:
            origins: [3, r], or [3, 1] for all rays.
            directions: [3, r] unit, or [3, 1] for all rays.
            solid: candidates [e], the number of the solid.
            near: [e], at most its distance. A candidate counts only for rays that have found nothing nearer.
            start: [e], its first ray.
            end: [e], the ray after its last one.

        Returns:
            (distance [r], infinite for a miss; number of the solid [r], 0 for a miss).
        """
        count = np.broadcast_shapes(origins.shape, directions.shape)[1]
        # distance and number as one key: the bits of positive floats are in the order of their values
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

    def _test(self, origins: Array, directions: Array, rays: Rows, numbers: Rows, keys: NDArray[np.uint64]) -> None:
        """Tests pairs of a ray and a solid, and notes what is nearer than what was found before."""
        kinds = self._kind[numbers]
        for kind, (solid, is_turned) in enumerate(self._kinds):
            mine = (kinds == kind).nonzero()[0]
            if not len(mine):
                continue
            ray, number = rays[mine], numbers[mine]
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
    ) -> tuple[Array, Rows]:
        """The first solid on the rays of pictures, one after another, row by row.

        Args:
            poses: [v, 4, 4], camera to world.
            scale: [v, 3], of each picture the focal length and the column and the row of its middle, in rays.
            size: width and height of each picture.
            origins: [3, v * h * w].
            directions: [3, v * h * w].
        """
        width, height = size
        local = (self._corners - poses[:, None, None, :3, 3]) @ poses[:, None, :3, :3]  # [v, m, 8, 3]
        tails, heads = local[:, :, _EDGES[:, 0]], local[:, :, _EDGES[:, 1]]
        # an edge that goes behind the camera ends at the plane in front of it
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
        which, row = _rows(y1 - y0)
        start = ((view * height + y0)[which] + row) * width
        return self.first(origins, directions, solid[which], near[which], start + x0[which], start + x1[which])

    def is_lit(self, origins: Array) -> NDArray[np.bool_]:
        """Whether rays from [3, r] to the lamp meet no solid, [r]."""
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
        which, step = _rows(np.maximum(y1 - y0 + 1, 0))
        first = (y0[which] + step) * side
        start, end = ends[first + x0[which]], ends[np.maximum(first + x1[which] + 1, first + x0[which])]
        solid = which[end > start]
        near = np.full(len(solid), np.finfo(np.float32).max)  # a ray that has met any solid is done
        depth, _ = self.first(origins[:, order], self.light[:, None], solid, near, start[end > start], end[end > start])
        lit = np.empty(len(order), dtype=np.bool_)
        lit[order] = np.isinf(depth)
        return lit


def _rows(heights: Rows) -> tuple[Rows, Rows]:
    """For each row of rectangles of such heights the number of the rectangle, and of the row in it."""
    which = np.repeat(np.arange(len(heights)), heights)
    return which, np.arange(len(which)) - np.repeat(np.cumsum(heights) - heights, heights)
