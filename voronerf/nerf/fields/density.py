"""A small network for the density only, which proposes where to sample a ray. Units as in `fields.nerf`."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from voronerf.nerf.fields.radiance import RadianceField, reset_layers
from voronerf.ops._core.layers import MLP, Layer


class DensityField(RadianceField):
    """ReLU layers and a density, without colour: a proposal network (Barron et al. 2022, "Mip-NeRF 360", section 3).

    Its colour is black, and it takes no view directions. Density is a scaled softplus, as that of
    :class:`voronerf.nerf.fields.NeRF`.

    Args:
        width: Channels of the hidden layers, at least 1.
        depth: Hidden layers, at least 1.
        position_octaves: Frequencies of the position's encoding.
        position_encoding: "frequency", or "integrated" for Gaussians [n, 6].
        density_scale: Factor on the density, per scene unit.

    Raises:
        ValueError: A width or depth below 1.

    Examples:
        >>> import torch
        >>> from voronerf.nerf.fields import DensityField
        >>> black, density = DensityField()(torch.rand(10, 3))
        >>> density.shape
        torch.Size([10])
    """

    view_directions = False

    def __init__(
        self,
        width: int = 32,
        depth: int = 2,
        position_octaves: int = 6,
        position_encoding: str = "frequency",
        density_scale: float = 10.0,
    ) -> None:
        super().__init__()
        if min(width, depth) < 1:
            raise ValueError(f"DensityField: width and depth must be at least 1, got {width} and {depth}")
        trunk = [Layer(("positions",) if i == 0 else (i - 1,), width, "relu") for i in range(depth)]
        self.layers = MLP(
            (*trunk, Layer((depth - 1,), 1)),
            (depth,),
            position_octaves=position_octaves,
            position_encoding=position_encoding,
        )
        self.density_scale = density_scale
        shapes = self.layers.weight_shapes(6 if self.layers.integrated else 3)
        self.trunk = nn.ModuleList(nn.Linear(i, o) for o, i in shapes)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """See :func:`voronerf.nerf.fields.radiance.reset_layers`."""
        reset_layers(self.linears(), self.linears()[-1:], self.density_scale)

    def linears(self) -> list[nn.Linear]:
        """The linear layers in the order of ``layers``."""
        return [layer for layer in self.trunk if isinstance(layer, nn.Linear)]

    def activate(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        """Raw [n, 1] to (black [n, 3], density [n] >= 0 per scene unit), float32 or wider."""
        raw = raw.float() if raw.dtype in (torch.float16, torch.bfloat16) else raw
        return raw.new_zeros(raw.shape[0], 3), F.softplus(raw.squeeze(-1)) * self.density_scale
