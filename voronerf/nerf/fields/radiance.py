"""The base class and shared functions of radiance fields that are described by a layer table."""

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

#: The density of the untrained field, per scene unit. A scene of diameter 2 then starts with an opacity of about 0.2.
#: The field is then translucent enough for a gradient at every sample of a ray, and opaque enough for gradients of the
#: colours.
INITIAL_DENSITY = 0.1


def activate_radiance(self: Any, raw: Tensor) -> tuple[Tensor, Tensor]:
    """Applies the activations, which turn raw network outputs into colours and densities.

    A training with an occupancy grid recognises these activations in the traced program, and fuses them with the loss
    (``voronerf.ops.render_loss``).

    Args:
        self: The field, which has a ``density_scale``.
        raw: [n, 4]: colour before its sigmoid, density before its softplus.

    Returns:
        (colour [n, 3] in 0..1, density [n] >= 0 per scene unit), float32 or wider.
    """
    raw = raw.float() if raw.dtype in (torch.float16, torch.bfloat16) else raw
    # The gradient of `split` is one concatenation; two slices would need two padded arrays and their sum. Torch
    # vectorises activations only for contiguous values. Both measures together cut the time to a third.
    colour, density = (part.contiguous() for part in raw.split([3, 1], dim=-1))
    return torch.sigmoid(colour), F.softplus(density.squeeze(-1)) * self.density_scale


def reset_layers(
    layers: Sequence[nn.Linear],
    heads: Sequence[nn.Linear],
    density_scale: float,
    initial_density: float = INITIAL_DENSITY,
) -> None:
    """Initialises ReLU layers (He et al. 2015), small heads, and the density of the untrained field.

    Args:
        layers: All layers, including the heads.
        heads: The layers without an activation; the first head gives the density.
        density_scale: The factor on the softplus of the density.
        initial_density: The density of the untrained field, per scene unit.
    """
    for layer in layers:
        nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
        nn.init.zeros_(layer.bias)
    for head in heads:
        nn.init.xavier_uniform_(head.weight, gain=0.1)
    # The inverse of softplus: where the head's weights contribute 0, the bias alone gives `initial_density`.
    nn.init.constant_(heads[0].bias, math.log(math.expm1(initial_density / density_scale)))


def run_network(
    layers: MLP,
    linears: Sequence[nn.Linear],
    positions: Tensor,
    directions: Tensor | None = None,
    ray_index: Tensor | None = None,
    features: Tensor | None = None,
) -> Tensor:
    """Returns the raw outputs [n, layers.out_features] of one network that a layer table describes."""
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
    """The base class of ``NeRF`` and ``HashGridField``: a field with a layer table for colour and density.

    A subclass sets ``layers``, ``view_directions`` and ``density_scale``, and ``features`` if the table has a hash
    grid. It also defines :meth:`linears`.
    """

    layers: MLP
    view_directions: bool
    density_scale: float

    activate = activate_radiance

    def linears(self) -> list[nn.Linear]:
        """Returns the linear layers in the order of ``layers``."""
        raise NotImplementedError

    def program(self) -> CellProgram:
        """Returns the program of ``forward``, which a router runs for all cells at once."""
        return layered_program(self.layers, self.linears(), self.activate, getattr(self, "features", None))

    def forward(
        self, positions: Tensor, directions: Tensor | None = None, ray_index: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Evaluates the field.

        Args:
            positions: [n, 3] in scene units, or Gaussians [n, 6] with the integrated encoding. Outside the box of a
                hash grid, the features of the nearest point inside are used.
            directions: [n, 3], unit vectors, or [r, 3] with ``ray_index``; not needed without view directions.
            ray_index: int32 [n], the row of ``directions`` for each sample.

        Returns:
            (colour [n, 3] in 0..1, density [n] per scene unit).
        """
        if self.view_directions and directions is None:
            name = type(self).__name__
            raise ValueError(f"{name}: directions must be given, since the colour depends on the view direction")
        seen = (directions, ray_index) if self.view_directions else (None, None)
        features = getattr(self, "features", None)
        return self.activate(run_network(self.layers, self.linears(), positions, *seen, features=features))
