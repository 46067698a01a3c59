"""The first solid on each of many rays.

Rays that lie together are a bundle, with a cone around it. Only solids of which the bounding ball meets the cone are
tested, for all rays of the bundle, and in one array for many bundles and all solids of a kind: NumPy is called some
hundred times, whatever the number of solids. What is left out could not be hit, so results do not depend on it. r rays,
b bundles, m solids, p pairs of a bundle and a solid.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from voronerf.data.builtin.solids import Array, Rows, Solid, slab, turned_axes

BUNDLE = 64  # rays
PAIRS = 256  # tested at a time, so that their arrays stay in the cache
ROUNDING = 2e-6  # what float32 may miss a squared distance by, as a share of it
NONE = 2**31 - 1
WIDEST = 0.1  # cosine: a bundle that is wider is compared with every solid

Numbers = NDArray[np.int32]


class Caster:
    """Finds the first of some solids on rays.

    Args:
        groups: of solids that stand together. A bundle is compared with those of a group if it meets the group's ball.
    """

    def __init__(self, groups: Sequence[Sequence[Solid]]) -> None:
        self.solids = [solid for group in groups for solid in group]
        self._starts = np.cumsum([0, *(len(group) for group in groups)])
        self._balls = [np.array([(*solid.centre, solid.reach()) for solid in group]).T for group in groups]
        self._every = np.concatenate(self._balls, axis=1)
        self._halves = np.array([solid.extent() for solid in self.solids]).T
        self._groups = np.stack([_around(balls) for balls in self._balls], axis=1)
        self._centres = np.array([solid.centre for solid in self.solids], dtype=np.float32).T
        kinds = [(type(solid), solid.turn is not None) for solid in self.solids]
        self._kinds = list(dict.fromkeys(kinds))
        self._kind_of = np.array([self._kinds.index(kind) for kind in kinds])
        self._measures = np.zeros((3, len(kinds)), dtype=np.float32)
        self._turns = np.zeros((3, 3, len(kinds)), dtype=np.float32)
        for number, solid in enumerate(self.solids):
            self._measures[: len(solid.measures()), number] = solid.measures()
            self._turns[..., number] = np.eye(3) if solid.turn is None else solid.turn

    def __call__(self, origins: Array, directions: Array) -> tuple[Array, Rows]:
        """The first solid on each ray; of several at one distance, the one with the lowest number.

        Args:
            origins: [r, 3], or [1, 3] where all rays start from the same point.
            directions: [r, 3] unit, or [1, 3] where all rays are parallel. If there are r of both, rays that lie
                together should come one after another.

        Returns:
            (distance [r], infinite for a miss; number of the solid [r], 0 for a miss).
        """
        (count,) = np.broadcast_shapes(origins.shape[:1], directions.shape[:1])
        depth, which = np.full(count, np.inf, dtype=np.float32), np.zeros(count, dtype=np.int64)
        if count == 0:
            return depth, which
        order = _bundles(directions if len(directions) > 1 else origins, count, len(origins) > 1 < len(directions))
        start, along = (v.T[:, order] if len(v) > 1 else v.T[..., None] for v in (origins, directions))  # [3, b, 64]
        near, number = np.full(order.shape, np.inf, dtype=np.float32), np.zeros(order.shape, dtype=np.int32)
        bundle, solid = self._pairs(start, along, len(order))
        kinds = self._kind_of[solid]
        for kind in np.unique(kinds):
            own = (kinds == kind).nonzero()[0]
            for first in range(0, len(own), PAIRS):
                part = own[first : first + PAIRS]
                self._test(start, along, bundle[part], solid[part], near, number)
        depth[order], which[order] = near, number
        return depth, which

    def _pairs(self, start: Array, along: Array, count: int) -> tuple[Rows, Rows]:
        """Bundles and the solids that they may meet, ordered by bundle: ([p], [p])."""
        cones = _cones(start, along, count)
        met, found = _meets(cones, self._groups), []
        for group, first in enumerate(self._starts[:-1]):
            rows = met[:, group].nonzero()[0]
            bundle, solid = _meets(cones[:, rows], self._balls[group]).nonzero()
            found.append((rows[bundle], solid + first))
        bundle, solid = (np.concatenate(parts) for parts in zip(*found))
        # Of those the ones whose box, larger by the cone's width at the ball's far end, the cone's axis meets.
        own, ball = cones[:, bundle], self._every[:, solid]
        (ox, oy, oz), (ax, ay, az) = own[:3] - ball[:3], own[3:6]
        far = np.maximum(-(ox * ax + oy * ay + oz * az), 0) + ball[3]
        wide = own[8] + far * own[6] / np.maximum(own[7], WIDEST) + ROUNDING**0.5 * (1 + far)
        turns = self._turns[..., solid]
        away, axis = turned_axes((ox, oy, oz), turns), turned_axes((ax, ay, az), turns)
        enter, leave, _ = slab(away, axis, tuple(self._halves[:, solid] + wide))
        kept = (leave >= np.maximum(enter, 0)) | (own[7] == 0)
        bundle, solid = bundle[kept], solid[kept]
        order = np.argsort(bundle, kind="stable")
        return bundle[order], solid[order]

    def _test(self, start: Array, along: Array, bundle: Rows, solid: Rows, near: Array, number: Numbers) -> None:
        """Tests pairs with solids of one kind, and notes what is nearer than what was found before."""
        kind, is_turned = self._kinds[self._kind_of[solid[0]]]
        origins, directions = (v[:, bundle] if v.shape[1] > 1 or v.shape[2] > 1 else v for v in (start, along))
        (ox, oy, oz), (dx, dy, dz) = origins - self._centres[:, solid, None], directions
        away, axis = (ox, oy, oz), (dx, dy, dz)
        if is_turned:
            turns = self._turns[..., solid, None]
            away, axis = turned_axes(away, turns), turned_axes(axis, turns)
        found = kind.distance(away, axis, *self._measures[:, solid, None][: len(self.solids[solid[0]].measures())])
        new = bundle[1:] != bundle[:-1]
        first = np.append(0, new.nonzero()[0] + 1)
        rows = bundle[first]
        nearest = np.minimum.reduceat(found, first, axis=0)
        same = found == nearest[np.append(0, new.cumsum())]
        numbers = np.minimum.reduceat(np.where(same, np.int32(solid)[:, None], np.int32(NONE)), first, axis=0)
        before = near[rows]
        closer = (nearest < before) | ((nearest == before) & (numbers < number[rows]))
        near[rows], number[rows] = np.where(closer, nearest, before), np.where(closer, numbers, number[rows])


def _around(balls: NDArray[np.float64]) -> NDArray[np.float64]:
    """A ball that holds balls [4, m], [4]."""
    low, high = (balls[:3] - balls[3]).min(axis=1), (balls[:3] + balls[3]).max(axis=1)
    middle = (low + high) / 2
    return np.append(middle, (np.linalg.norm(balls[:3] - middle[:, None], axis=0) + balls[3]).max())


def _bundles(vectors: Array, count: int, ordered: bool) -> Rows:
    """Numbers of rays of which the vectors [r, 3] lie together, [b, BUNDLE]; the last ray fills up its bundle.

    They are sorted into the squares of a grid across the direction in which the vectors differ least, or ``ordered``.
    """
    order = np.arange(count)
    if len(vectors) > 1 and not ordered:
        side = max(1, min(int((count / BUNDLE) ** 0.5), 255))
        key = np.zeros(count, dtype=np.uint16)
        columns = np.ascontiguousarray(vectors.T)
        lows = columns.min(axis=1)
        spreads = columns.max(axis=1) - lows
        for axis in np.argsort(spreads)[1:]:
            place = (columns[axis] - lows[axis]) * np.float32(side / max(float(spreads[axis]), 1e-9))
            key = key * np.uint16(side) + np.minimum(place.astype(np.uint16), np.uint16(side - 1))
        order = np.argsort(key, kind="stable")
    return np.concatenate((order, np.repeat(order[-1:], -count % BUNDLE))).reshape(-1, BUNDLE)


def _cones(start: Array, along: Array, count: int) -> NDArray[np.float64]:
    """What holds the rays of each bundle, [9, b]: those of a cone, moved by a distance at most.

    The cone's apex and axis, the sine and cosine of half its angle, and the distance.
    """
    axis = along.mean(axis=2)
    axis /= np.maximum(np.linalg.norm(axis, axis=0), np.float32(1e-9))
    ahead = _dot(along, axis)
    cosine, sine = ahead.min(axis=1), _farthest(along - ahead * axis[..., None])
    wide = cosine < WIDEST
    axis[:, wide], cosine[wide], sine[wide] = 0, 0, 0  # every ball meets these
    if along.shape[1:] == (1, 1):  # of parallel rays, where they start counts across them
        climb = _dot(start, axis)
        start = start - (climb - climb.min(axis=1, keepdims=True)) * axis[..., None]
    apex = start.mean(axis=2)
    rows = (*apex, *axis, sine, cosine, _farthest(start - apex[..., None]))
    return np.stack([np.broadcast_to(row, count) for row in rows]).astype(np.float64)


def _dot(vectors: Array, axis: Array) -> Array:
    """[3, b, k], [3, b] -> [b, k]."""
    (x, y, z), (ax, ay, az) = vectors, axis[..., None]
    return x * ax + y * ay + z * az


def _farthest(vectors: Array) -> Array:
    """The greatest length among vectors [3, b, k] of a bundle, [b]."""
    x, y, z = vectors
    return np.sqrt((x * x + y * y + z * z).max(axis=1))


def _meets(cones: NDArray[np.float64], balls: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether cones [9, b] may meet balls [4, m], [b, m]: how far a centre is from a cone changes no faster than it."""
    *apex, ax, ay, az, sine, cosine, off = cones[..., None]
    x, y, z = (centre - own for centre, own in zip(balls[:3], apex))
    ahead, square = x * ax + y * ay + z * az, x * x + y * y + z * z
    reach = np.sqrt(balls[3] ** 2 + ROUNDING * (1 + square)) + off
    return (np.sqrt(np.maximum(square - ahead * ahead, 0)) * cosine - ahead * sine <= reach) & (ahead >= -reach)
