"""What rays of a picture see: they are walked in waves, and end when they are opaque. r rays, s strata of a ray."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core.declare import declared
from voronerf.ops.composite import composite
from voronerf.ops.formulas import RaysSeen, Wave, activate, walk
from voronerf.ops.march_rays import march_rays
from voronerf.ops.routed_program import run


@torch.no_grad()
def render_opaque(*flat: Any, backend: str = "reference") -> RaysSeen:
    """Every ray up to the first surface; see ``voronerf.ops.render_opaque``.

    ``backend`` is that of the operations it is made of.
    """
    given = declared("render_opaque").Inputs._make(flat)
    routed, wave = given.network, given.wave
    (origins, *seen), where = routed.inputs, routed.where
    space: dict[str, Any] = {"spacing": given.spacing, "most": wave, "contraction": given.contraction}

    def look(live: Tensor, start: Tensor | None) -> Wave:
        of_rays = given.origins[live], given.directions[live], given.near[live], given.far[live]
        march = march_rays(*of_rays, given.occupied, given.box, given.samples, start=start, **space, backend=backend)
        positions = march.positions.to(origins.dtype)
        coords = None if where.centres is None else positions.to(where.centres.dtype)
        inputs, index = [positions, *(x[live] for x in seen)], march.ray_index if seen else None
        network = routed._replace(inputs=inputs, ray_index=index).given("render_opaque")
        (raw,), _ = run(network, where._replace(coords=coords), backend=backend)
        colours, density = activate(raw.to(given.near.dtype), given.density_scale, given.activated)
        packed: dict[str, Any] = {"ray_offsets": march.ray_offsets, "backend": backend}
        along = composite(density, colours, march.depths, march.deltas, **packed)
        return Wave(along, march.ray_index, march.ray_offsets, march.depths, march.stop)

    return walk(look, given.far, given.samples, wave, given.opaque, given.background, given.heaviest)
