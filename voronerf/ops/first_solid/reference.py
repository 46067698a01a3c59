"""The first of some solids on rays, in plain PyTorch: each solid in turn, in a frame of its own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

KINDS = ("box", "sphere", "cylinder", "torus")
TRACE_STEPS = 40
SURFACE = 5e-4  # a traced ray closer than this to a torus has hit it

Axes = Sequence[Tensor]
"""x, y and z, [r] each."""


class Solids(NamedTuple):
    """Solids that rays are cast against, each in a frame of its own.

    Attributes:
        kinds: int32 [m], of each: 0 box, 1 sphere, 2 cylinder and 3 torus around the z axis.
        centres: [m, 3].
        turns: [m, 3, 3], rotations of the solids' frames to the world.
        measures: [m, 3]: half sides; squared radius; squared radius and half height; radius of the ring, of the tube,
            and both together. What a kind does not have is not read.

    Examples:
        >>> import torch
        >>> from voronerf.ops import Solids
        >>> cube = Solids(torch.zeros(1).int(), torch.zeros(1, 3), torch.eye(3)[None], torch.ones(1, 3))
        >>> len(cube.kinds)
        1
    """

    kinds: Tensor
    centres: Tensor
    turns: Tensor
    measures: Tensor


def first_solid(origins: Tensor, directions: Tensor, solids: Solids) -> tuple[Tensor, Tensor]:
    """Distances [r] and numbers [r]; see ``voronerf.ops.first_solid``."""
    count = len(directions) if len(origins) == 1 else len(origins)
    nearest = origins.new_full((count,), math.inf)
    number = torch.zeros(count, dtype=torch.int32, device=origins.device)
    for solid, kind in enumerate(solids.kinds.tolist()):
        turn = solids.turns[solid]
        away = _turned((origins - solids.centres[solid]).unbind(1), turn)
        along = _turned(directions.unbind(1), turn)
        found = _DISTANCES[kind](away, along, solids.measures[solid])
        closer = found < nearest
        nearest = torch.where(closer, found, nearest)
        number = number.masked_fill(closer, solid)
    return nearest, number


def _turned(vectors: Axes, turn: Tensor) -> Axes:
    """Vectors @ turn [3, 3]."""
    x, y, z = vectors
    return [x * turn[0, i] + y * turn[1, i] + z * turn[2, i] for i in range(3)]


def _slab(away: Axes, along: Axes, half: Axes) -> tuple[Tensor, Tensor, Tensor]:
    """Where rays are inside of a box around the origin: (enter, leave, hit). One behind them is missed."""
    lows, highs = [], []
    for o, d, side in zip(away, along, half, strict=True):
        d = d.masked_fill(d.abs() < 1e-9, 1e-9)
        low, high = (-side - o) / d, (side - o) / d
        lows.append(torch.minimum(low, high))
        highs.append(torch.maximum(low, high))
    enter = torch.maximum(torch.maximum(lows[0], lows[1]), lows[2])
    leave = torch.minimum(torch.minimum(highs[0], highs[1]), highs[2])
    return enter, leave, (leave > enter) & (enter > 0)


def _box(away: Axes, along: Axes, measures: Tensor) -> Tensor:
    enter, _, hit = _slab(away, along, measures.unbind())
    return enter.masked_fill(~hit, math.inf)


def _sphere(away: Axes, along: Axes, measures: Tensor) -> Tensor:
    (ox, oy, oz), (dx, dy, dz) = away, along
    b = ox * dx + oy * dy + oz * dz
    root = b * b - (ox * ox + oy * oy + oz * oz) + measures[0]
    t = -b - root.clamp(min=0).sqrt()
    return t.masked_fill(~((root >= 0) & (t > 0)), math.inf)


def _cylinder(away: Axes, along: Axes, measures: Tensor) -> Tensor:
    # A ray is inside between the later of its two entries (tube, slab) and the earlier of its two exits.
    (ox, oy, oz), (dx, dy, dz) = away, along
    square, half = measures[0], measures[1]
    a = (dx * dx + dy * dy).clamp(min=1e-12)
    b, c = ox * dx + oy * dy, ox * ox + oy * oy - square
    root = b * b - a * c
    spread = root.clamp(min=0).sqrt()
    dz = dz.masked_fill(dz.abs() < 1e-9, 1e-9)
    low, high = (-half - oz) / dz, (half - oz) / dz
    enter = torch.maximum((-b - spread) / a, torch.minimum(low, high))
    leave = torch.minimum((-b + spread) / a, torch.maximum(low, high))
    return enter.masked_fill(~((root >= 0) & (enter <= leave) & (enter > 0)), math.inf)


def _torus(away: Axes, along: Axes, measures: Tensor) -> Tensor:
    """By sphere tracing its exact distance (Hart 1996)."""
    (ox, oy, oz), (dx, dy, dz), (ring, tube, outer) = away, along, measures.unbind()
    t, leave, on = _slab(away, along, (outer, outer, tube))
    found = torch.full_like(t, math.inf)
    for _ in range(TRACE_STEPS):
        gap = _length(_length(ox + t * dx, oy + t * dy) - ring, oz + t * dz) - tube
        arrived = on & (gap < SURFACE)
        found = torch.where(arrived, t, found)
        t = t + gap
        on = on & ~arrived & (t < leave)
    return found


def _length(x: Tensor, y: Tensor) -> Tensor:
    """Rounded once, as hypot is."""
    return (x.double().square() + y.double().square()).sqrt().to(x.dtype)


_DISTANCES = (_box, _sphere, _cylinder, _torus)
