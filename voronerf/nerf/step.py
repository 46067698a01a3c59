"""A training step: from a batch of rays to a loss with gradients, and what it is made of, in words."""

from __future__ import annotations

import torch

from voronerf.nerf.ray_loss import Batch, Composed, Fused, RayLoss, RenderOutput, why_not_fused
from voronerf.nerf.renderer import Renderer
from voronerf.nerf.samplers import Occupancy
from voronerf.ops._core import backends
from voronerf.router import VoronoiRouter


class Step:
    """What a training does with a batch: samples its rays, asks the networks, compares colours.

    Whoever calls it moves the parameters, and tells `Cells` what was found.

    Args:
        renderer: Networks and sampler.
        sightings: Factor of the `sighting_loss`; 0 is off.

    Examples:
        >>> import torch
        >>> from voronerf import NeRF, VoronoiRouter
        >>> from voronerf.nerf import Renderer, Stratified
        >>> from voronerf.nerf import Step
        >>> router = VoronoiRouter(NeRF(width=16, depth=2), torch.zeros(1, 3))
        >>> print(Step(Renderer({"field": router}, Stratified(8))).explain())
        samples: Stratified, 8 a ray
        loss: networks, colours and loss are separate operations
        not faster: empty space is not skipped
    """

    def __init__(self, renderer: Renderer, *, sightings: float = 0.0) -> None:
        self.renderer, self.sightings = renderer, sightings

    @property
    def way(self) -> RayLoss:
        """The fastest way to the loss; here alone it is chosen."""
        if why_not_fused(self.renderer) is None:
            return Fused(self.renderer, self.sightings)
        return Composed(self.renderer, self.sightings)

    def run(self, batch: Batch, generator: torch.Generator | None = None, *, backward: bool = False) -> RenderOutput:
        """The loss of a batch, with gradients, and what its samples have found.

        Args:
            batch: The rays.
            generator: Of random samples.
            backward: Whether gradients are added to those of the parameters at once, as ``loss.backward()`` does it,
                in less time; the loss has none then.
        """
        return self.way(batch, generator, backward=backward)

    def explain(self) -> str:
        """How a step is computed, and what keeps it from a faster way: some lines."""
        renderer, sampler = self.renderer, self.renderer.sampler
        counts = f"{sampler.samples} and {sampler.fine_samples}" if sampler.passes > 1 else f"{sampler.samples}"  # type: ignore[attr-defined]
        lines = [f"samples: {type(sampler).__name__}, {counts} a ray"]
        if isinstance(sampler, Occupancy):
            lines[0] += f", of which {sampler.grid.share:.0%} of the grid are left"
        lines.append(f"loss: {self.way.explain()}")
        obstacle = why_not_fused(renderer)
        if obstacle is None:
            device, dtype = renderer.device, torch.float32
            chosen = backends.chosen("forward_with_tape", device, dtype, backend=renderer.backend)
            lines[-1] += f", on the {chosen} backend"
            if chosen != "native":
                obstacle = (
                    backends.why_not("forward_with_tape", "native", device, dtype) or f"--backend {renderer.backend}"
                )
        if obstacle is not None:
            lines.append(f"not faster: {obstacle}")
        for name, field in renderer.fields.items():
            if isinstance(field, VoronoiRouter) and not field.by_table:
                lines.append(f"{name}: {field.explain()}")
        return "\n".join(lines)
