"""What rays of a picture see: they are walked in waves, and end when they are opaque. r rays, s strata of a ray."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core.declare import declared
from voronerf.ops.composite import Composite, composite
from voronerf.ops.march_rays import march_rays
from voronerf.ops.render_loss.reference import activate
from voronerf.ops.routed_mlp import routed_mlp
from voronerf.ops.routed_program.reference import routed_program


class RaysSeen(NamedTuple):
    """What rays see.

    Attributes:
        colour: [r, 3], the background included.
        opacity: [r], 1 for a ray that has ended.
        depth: [r], the mean by weight; the far end for a ray without any.
        light: [r], the share of the light that is left. A ray that has ended has the colour of what it has met by then.
        heaviest: [r], the depth of the heaviest sample; the far end for a ray without any.

    Examples:
        >>> from voronerf.ops import RaysSeen
        >>> RaysSeen._fields
        ('colour', 'opacity', 'depth', 'light', 'heaviest')
    """

    colour: Annotated[Tensor, "same [r, 3]"]
    opacity: Annotated[Tensor, "same [r]"]
    depth: Annotated[Tensor, "same [r]"]
    light: Annotated[Tensor, "same [r]"]
    heaviest: Annotated[Tensor, "same [r]"]


class Wave(NamedTuple):
    """Samples of rays, as they were seen.

    Attributes:
        seen: Of the rays, by these samples alone.
        ray_index: int32 [m].
        ray_offsets: int32 [rays + 1].
        depths: [m].
        stop: int32 [rays], the strata at which the rays go on.
    """

    seen: Composite
    ray_index: Tensor
    ray_offsets: Tensor
    depths: Tensor
    stop: Tensor


@torch.no_grad()
def render_opaque(*flat: Any, backend: str = "reference") -> RaysSeen:
    """Every ray up to the first surface; see ``voronerf.ops.render_opaque``.

    ``backend`` is that of the operations it is made of.
    """
    given = declared("render_opaque").Inputs._make(flat)
    network, wave = given.network, given.wave
    centres, seen_by, by_program = network.get("centres"), network.get("directions"), "program" in network
    dtype = (network["inputs"][0] if by_program else network["positions"]).dtype
    of_samples = ("positions", "inputs", "coords", "directions", "direction_index", "ray_index")
    fixed = {name: value for name, value in network.items() if name not in of_samples}
    space: dict[str, Any] = {"spacing": given.spacing, "most": wave, "contraction": given.contraction}

    def look(live: Tensor, start: Tensor | None) -> Wave:
        of_rays = given.origins[live], given.directions[live], given.near[live], given.far[live]
        march = march_rays(*of_rays, given.occupied, given.box, given.samples, start=start, **space, backend=backend)
        positions = march.positions.to(dtype)
        coords = None if centres is None else positions.to(centres.dtype)
        taken: dict[str, Any] = {**fixed, "coords": coords, "backend": backend}
        if by_program:
            rays = [x[live] for x in network["inputs"][1:]]
            index = march.ray_index if rays else None
            (raw,), _ = routed_program(inputs=[positions, *rays], ray_index=index, **taken)
        else:
            seen_from: dict[str, Any] = {"directions": None, "direction_index": None}
            if seen_by is not None:
                seen_from = {"directions": seen_by[live], "direction_index": march.ray_index}
            raw, _ = routed_mlp(positions=positions, **seen_from, **taken)
        colours, density = activate(raw.to(given.near.dtype), given.density_scale, given.activated)
        packed: dict[str, Any] = {"ray_offsets": march.ray_offsets, "backend": backend}
        seen = composite(density, colours, march.depths, march.deltas, **packed)
        return Wave(seen, march.ray_index, march.ray_offsets, march.depths, march.stop)

    return walk(look, given.far, given.samples, wave, given.opaque, given.background, given.heaviest)


@torch.no_grad()
def walk(
    look: Callable[[Tensor, Tensor | None], Wave],
    far: Tensor,
    samples: int,
    wave: int,
    opaque: float,
    background: Tensor | None,
    heaviest: bool,
) -> RaysSeen:
    """Rays in waves, and what they see.

    Args:
        look: The next wave of some rays, int64, from strata int32 on, or with None from the first.
        far: [r].
        samples: s.
        wave: Samples of a ray in a wave, at the most.
        opaque: Rays end with a wave after which no more light than this is left.
        background: [3] or [r, 3]; None is black.
        heaviest: Whether to find the heaviest samples.
    """
    colour, opacity, depth = far.new_zeros(len(far), 3), torch.zeros_like(far), torch.zeros_like(far)
    through, top, at = torch.ones_like(far), torch.zeros_like(far), far.clone()
    live, start = torch.arange(len(far), device=far.device), None
    while live.numel() > 0:
        found = look(live, start)
        part, light = found.seen, through[live]
        colour[live] += light[:, None] * part.colour
        opacity[live] += light * part.opacity
        depth[live] += light * part.depth
        if heaviest:
            weight, place = _heaviest(found, wave)
            weight = weight * light
            better = weight > top[live]
            top[live[better]], at[live[better]] = weight[better], place[better]
        light = light * (1 - part.opacity)
        through[live] = light
        more = ((found.stop < samples) & (light > opaque)).nonzero()[:, 0]
        live, start = live[more], found.stop[more]
    depth = torch.where(opacity > 0, depth / opacity, far)
    ended = through <= opaque
    colour, opacity = torch.where(ended[:, None], colour / opacity[:, None], colour), opacity.masked_fill(ended, 1)
    if background is not None:
        colour = colour + (1 - opacity)[:, None] * background.to(colour)
    return RaysSeen(colour, opacity, depth, through, at)


def _heaviest(wave: Wave, most: int) -> tuple[Tensor, Tensor]:
    """Weight and depth [r] of the heaviest sample of each ray, of which there are at most `most`; -1 without any."""
    weights, rays = wave.seen.weights, len(wave.stop)
    row = torch.arange(len(weights), device=weights.device) - wave.ray_offsets[wave.ray_index]
    table = weights.new_full((2, rays * most), -1.0)
    table[:, wave.ray_index.long() * most + row] = torch.stack((weights, wave.depths))
    weight, column = table[0].reshape(-1, most).max(dim=1)
    return weight, table[1].reshape(-1, most).gather(1, column[:, None])[:, 0]
