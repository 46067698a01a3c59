"""What radiance fields on a layer table have in common."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from voronerf.ops._core.layers import MLP
from voronerf.ops.grouped_mlp import grouped_mlp
from voronerf.router import CellProgram, layered_program

#: Density of the untrained field, per scene unit. A scene of diameter 2 then starts with an opacity of about 0.2:
#: translucent enough that every sample of a ray receives a gradient, opaque enough that the colours do as well.
INITIAL_DENSITY = 0.1


def activate_radiance(self: Any, raw: Tensor) -> tuple[Tensor, Tensor]:
    """Turns the network's outputs into what a renderer needs.

    A training through an occupancy grid reads them off its steps, and goes from outputs to the loss in one operation
    (``voronerf.ops.render_loss``).

    Args:
        self: The field, which has a ``density_scale``.
        raw: [n, 4]: colour before its sigmoid, density before its softplus.

    Returns:
        (colour [n, 3] in 0..1, density [n] >= 0 per scene unit), float32 or wider.
    """
    raw = raw.float() if raw.dtype in (torch.float16, torch.bfloat16) else raw
    # `split`, because its gradient is one concatenation, and that of two slices two padded arrays and their sum.
    # `contiguous`, because torch vectorises activations for contiguous values only. Together a third of the time.
    colour, density = (part.contiguous() for part in raw.split([3, 1], dim=-1))
    return torch.sigmoid(colour), F.softplus(density.squeeze(-1)) * self.density_scale


def reset_layers(
    layers: Sequence[nn.Linear],
    heads: Sequence[nn.Linear],
    density_scale: float,
    initial_density: float = INITIAL_DENSITY,
) -> None:
    """He initialisation of ReLU layers (He et al. 2015), small heads, and a density that can grow.

    Args:
        layers: all layers, the heads too.
        heads: those without an activation; the first gives the density.
        density_scale: factor on the softplus of the density.
        initial_density: of the untrained field, per scene unit.
    """
    for layer in layers:
        nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
        nn.init.zeros_(layer.bias)
    for head in heads:
        nn.init.xavier_uniform_(head.weight, gain=0.1)
    # The inverse of softplus, so that the untrained density is that wherever the head's weights say 0.
    nn.init.constant_(heads[0].bias, math.log(math.expm1(initial_density / density_scale)))


def run_network(
    layers: MLP,
    linears: Sequence[nn.Linear],
    positions: Tensor,
    directions: Tensor | None = None,
    ray_index: Tensor | None = None,
    features: Tensor | None = None,
) -> Tensor:
    """The raw outputs [n, layers.out_features] of one network that a layer table describes."""
    offsets = torch.tensor([0, positions.shape[0]], dtype=torch.int32, device=positions.device)
    return grouped_mlp(
        positions,
        offsets,
        [layer.weight[None] for layer in linears],
        [layer.bias[None] for layer in linears],
        layers=layers,
        directions=directions,
        direction_index=ray_index,
        features=features,
    )


class RadianceField(nn.Module):
    """A layer table with colour and density as its outputs; the base of ``NeRF`` and ``HashGridField``.

    A subclass sets ``layers``, ``view_directions`` and ``density_scale``, and ``features`` where the table has a hash
    grid, and defines :meth:`linears`.
    """

    layers: MLP
    view_directions: bool
    density_scale: float

    activate = activate_radiance

    def linears(self) -> list[nn.Linear]:
        """The linear layers in the order of ``layers``."""
        raise NotImplementedError

    def program(self) -> CellProgram:
        """All that ``forward`` computes, as a router runs it for all cells at once."""
        return layered_program(self.layers, self.linears(), self.activate, getattr(self, "features", None))

    def forward(
        self, positions: Tensor, directions: Tensor | None = None, ray_index: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Evaluates the field.

        Args:
            positions: [n, 3] in scene units; with the integrated encoding Gaussians [n, 6]. Outside of the box of a
                hash grid, the features are those of the nearest point inside.
            directions: Unit vectors [n, 3], or [r, 3] together with ``ray_index``; not needed without view directions.
            ray_index: int32 [n], the row of ``directions`` that belongs to each sample.

        Returns:
            (colour [n, 3] in 0..1, density [n] per scene unit).
        """
        if self.view_directions and directions is None:
            name = type(self).__name__
            raise ValueError(f"{name}: directions must be given, since the colour depends on the view direction")
        seen = (directions, ray_index) if self.view_directions else (None, None)
        features = getattr(self, "features", None)
        return self.activate(run_network(self.layers, self.linears(), positions, *seen, features=features))
