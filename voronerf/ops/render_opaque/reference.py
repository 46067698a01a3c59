"""The rendering of rays in waves of samples, until they are opaque. r rays, s strata of a ray."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core.declare import declared
from voronerf.ops.composite import composite
from voronerf.ops.formulas import RenderedRays, Wave, walk
from voronerf.ops.march_rays import march_rays


@torch.no_grad()
def render_opaque(*flat: Any, backend: str = "reference") -> RenderedRays:
    """Renders every ray until it is opaque; see ``voronerf.ops.render_opaque``.

    ``backend`` is the backend of the operations that this function calls.
    """
    arguments = declared("render_opaque").Inputs._make(flat)
    network, cells, wave = arguments.network, arguments.cells, arguments.wave
    space: dict[str, Any] = {"spacing": arguments.spacing, "max_samples": wave, "contraction": arguments.contraction}

    def look(live: Tensor, start: Tensor | None) -> Wave:
        of_rays = arguments.origins[live], arguments.directions[live], arguments.near[live], arguments.far[live]
        march = march_rays(
            *of_rays, arguments.occupied, arguments.box, arguments.samples, start=start, **space, backend=backend
        )
        inputs = [march.positions, arguments.directions[live]][: len(network.program.inputs)]
        index = march.ray_index if network.program.rays else None
        (raw,), _ = network.run(inputs, cells, index, backend)
        raw = raw.to(arguments.near.dtype)
        packed: dict[str, Any] = {"ray_offsets": march.ray_offsets, "backend": backend}
        along = composite(raw[:, 3], raw[:, :3], march.depths, march.deltas, **packed)
        return Wave(along, march.ray_index, march.ray_offsets, march.depths, march.stop)

    return walk(
        look, arguments.far, arguments.samples, wave, arguments.opaque, arguments.background, arguments.heaviest
    )
