"""First hits of rays on solids. r rays, s solids; each solid in its own frame, where it stands upright at the origin.

Sources: the quadratic and slab tests of any textbook; the torus by sphere tracing its exact distance (Hart 1996).
"""

from __future__ import annotations

import torch
from torch import Tensor

SPHERE, BOX, CYLINDER, TORUS = range(4)
TRACE_STEPS = 40
SURFACE = 5e-4  # a traced ray closer than this to a torus has hit it
TINY = 1e-9  # components of directions below this are rounded up to it, against divisions by zero


@torch.no_grad()
def cast_solids(
    kinds: Tensor, frames: Tensor, sizes: Tensor, origins: Tensor, directions: Tensor
) -> tuple[Tensor, Tensor]:
    """Distance to and number of the first solid on each ray; see ``voronerf.ops.cast_solids``."""
    depths = torch.full_like(origins[:, 0], float("inf"))
    solids = torch.full_like(depths, -1, dtype=torch.int32)
    given = kinds.tolist()
    for kind in given:
        if kind not in _DISTANCES:
            raise ValueError(f"cast_solids: kinds must be 0 (sphere) to 3 (torus), got {kind}")
    for number, (kind, frame, size) in enumerate(zip(given, frames, sizes)):
        local = (origins - frame[3]) @ frame[:3], directions @ frame[:3]
        found = _DISTANCES[kind](*local, size)
        closer = found < depths
        depths = torch.where(closer, found, depths)
        solids = torch.where(closer, number, solids)
    return depths, solids.to(torch.int32)


def extents(kinds: Tensor, sizes: Tensor) -> Tensor:
    """Half sides [s, 3] of the solids' boxes in their own frames."""
    first, second, third = sizes.unbind(1)
    around = torch.stack((first, first, second), dim=1)
    ring = torch.stack((first + second, first + second, second), dim=1)
    ball, box = first[:, None].expand(-1, 3), torch.stack((first, second, third), dim=1)
    kind = kinds[:, None]
    return torch.where(kind == SPHERE, ball, torch.where(kind == BOX, box, torch.where(kind == CYLINDER, around, ring)))


def bounds(kinds: Tensor, frames: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor]:
    """Lowest and highest corners [s, 3] of boxes in the world that hold the solids."""
    half = (frames[:, :3].abs() * extents(kinds, sizes)[:, None, :]).sum(-1)
    return frames[:, 3] - half, frames[:, 3] + half


def _sphere(origins: Tensor, directions: Tensor, size: Tensor) -> Tensor:
    b = (origins * directions).sum(1)
    root = b * b - (origins * origins).sum(1) + size[0] * size[0]
    t = -b - root.clamp(min=0).sqrt()
    return torch.where((root >= 0) & (t > 0), t, float("inf"))


def _box(origins: Tensor, directions: Tensor, size: Tensor) -> Tensor:
    enter, leave = _slab(origins, directions, size)
    return torch.where((leave > enter) & (enter > 0), enter, float("inf"))


def _cylinder(origins: Tensor, directions: Tensor, size: Tensor) -> Tensor:
    # The ray is inside between the later of the two entries (tube, slab) and the earlier of the two exits.
    o, d = origins[:, :2], directions[:, :2]
    a = (d * d).sum(1).clamp(min=1e-12)
    b, c = (o * d).sum(1), (o * o).sum(1) - size[0] * size[0]
    root = b * b - a * c
    spread = root.clamp(min=0).sqrt()
    low, high = _slab(origins[:, 2:], directions[:, 2:], size[1:2])
    enter, leave = torch.maximum((-b - spread) / a, low), torch.minimum((-b + spread) / a, high)
    return torch.where((root >= 0) & (enter <= leave) & (enter > 0), enter, float("inf"))


def _torus(origins: Tensor, directions: Tensor, size: Tensor) -> Tensor:
    ring, tube = size[0], size[1]
    t, leave = _slab(origins, directions, torch.stack((ring + tube, ring + tube, tube)))
    on = (leave > t) & (t > 0)
    found = torch.full_like(t, float("inf"))
    for _ in range(TRACE_STEPS):
        x, y, z = (origins + t[:, None] * directions).unbind(1)
        gap = torch.hypot(torch.hypot(x, y) - ring, z) - tube
        found = torch.where(on & (gap < SURFACE), t, found)
        on = on & (gap >= SURFACE)
        t = torch.where(on, t + gap, t)
        on = on & (t < leave)
    return found


def _slab(origins: Tensor, directions: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave a box around the origin."""
    safe = torch.where(directions.abs() < TINY, TINY, directions)
    low, high = (-half - origins) / safe, (half - origins) / safe
    return torch.minimum(low, high).amax(1), torch.maximum(low, high).amin(1)


_DISTANCES = {SPHERE: _sphere, BOX: _box, CYLINDER: _cylinder, TORUS: _torus}
