"""What native and Warp share of ``composite``: its arguments as custom ops take them, and its derivatives."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from voronerf.ops._core.custom_op import Op
from voronerf.ops._core.derivatives import register_derivatives
from voronerf.ops.composite.reference import composite


class RaySamples(NamedTuple):
    """Samples of rays, in float32; ``voronerf.ops.composite`` says what each is."""

    sigma: Tensor
    rgb: Tensor
    depths: Tensor
    deltas: Tensor
    ray_offsets: Tensor | None
    background: Tensor | None

    @property
    def rays(self) -> int:
        """r."""
        return self.sigma.shape[0] if self.ray_offsets is None else self.ray_offsets.shape[0] - 1

    def results(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Memory for colour, opacity, depth and weights."""
        sigma, r = self.sigma, self.rays
        return (
            sigma.new_empty(r, self.rgb.shape[-1]),
            sigma.new_empty(r),
            sigma.new_empty(r),
            sigma.new_empty(sigma.shape),
        )

    def gradients(self, wanted: list[bool]) -> list[Tensor]:
        """Memory for the gradients of the smooth parts, empty where not wanted; that to sigma is always there."""
        smooth = self.sigma, self.rgb, self.depths, self.deltas, self.background
        return [
            self.sigma.new_empty(tensor.shape if tensor is not None and want else 0)
            for tensor, want in zip(smooth, [True, *wanted[1:]])
        ]


class Arriving(NamedTuple):
    """Gradients of the results, None for zero."""

    colour: Tensor | None
    opacity: Tensor | None
    depth: Tensor | None
    weights: Tensor | None


def register(forward: Op, backward: Op) -> None:
    """Registers the derivatives of two ops."""
    register_derivatives(forward, backward, composite, ("sigma", "rgb", "depths", "deltas", "background"))
