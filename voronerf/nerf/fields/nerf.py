"""NeRF, an MLP from a point and a view direction to a colour and a density; mip-NeRF; and KiloNeRF.

Letters: n samples, r rays. Positions are in scene units, directions are unit vectors, densities are per scene unit.
"""

from __future__ import annotations

from typing import Any, ClassVar

from torch import nn

from voronerf.nerf.fields.radiance import RadianceField, reset_layers
from voronerf.ops._core.layers import MLP, Layer

#: The octaves of mip-NeRF's encoding, as published; the encoding fades out waves that a Gaussian cannot resolve.
MIP_OCTAVES = 16


class NeRF(RadianceField):
    """The architecture of NeRF (Mildenhall et al. 2020, figure 7) with any width and depth.

    The trunk is ``depth`` ReLU layers on the encoded position, which is concatenated again after each layer listed in
    ``skips``. A linear head gives the density. A linear feature layer, followed by one ReLU layer of half the width
    that also sees the encoded view direction, gives the colour. Without view directions, the colour is a linear head on
    the trunk.

    The density is ``density_scale * softplus(raw)``; the paper uses a ReLU. A ReLU has no gradient if its input becomes
    negative everywhere: a NeRF on a white background can collapse to a white image within its first hundred steps.
    Softplus always has a gradient, as in mip-NeRF, section 3.1. The bias of the head sets the untrained density to
    ``INITIAL_DENSITY``. Surfaces need densities near 100 per scene unit; with ``density_scale``, network outputs of
    order one suffice.

    The layer table ``layers`` (see :class:`voronerf.ops._core.layers.MLP`) and :meth:`linears` describe the network.
    :class:`voronerf.VoronoiRouter` uses them to evaluate the copies of all cells in one pass.

    Args:
        width: Channels of the hidden layers, at least 2.
        depth: Hidden layers before the heads, at least 1.
        skips: The indices of trunk layers whose output is concatenated with the encoded position. None is layer 4, as
            published, if the trunk has more than five layers, else no layer.
        position_octaves: Octaves of the positional encoding; 0 uses the position itself.
        direction_octaves: Octaves of the encoding of the view direction.
        view_directions: Whether colour depends on the view direction.
        density_scale: Factor on the density, per scene unit, > 0.
        view_width: Channels of the layer that sees the view direction; None is half the width.
        position_encoding: "frequency", or "integrated" for Gaussians [n, 6] instead of positions (mip-NeRF).

    Raises:
        ValueError: A width, depth, skip or scale is out of range.

    Examples:
        >>> import torch
        >>> from voronerf import NeRF
        >>> field = NeRF(width=64, depth=4)
        >>> positions, directions = torch.rand(10, 3), torch.nn.functional.normalize(torch.rand(10, 3), dim=-1)
        >>> colour, density = field(positions, directions)
        >>> colour.shape, density.shape
        (torch.Size([10, 3]), torch.Size([10]))
        >>> per_ray = directions[:2]  # two rays of five samples each
        >>> ray_index = torch.arange(2, dtype=torch.int32).repeat_interleave(5)
        >>> colour, density = field(positions, per_ray, ray_index)
    """

    #: Half the published layers: a cell is small, and its contents are simpler than the scene.
    training_defaults: ClassVar[dict[str, Any]] = {"depth": 4}

    def __init__(
        self,
        width: int = 64,
        depth: int = 8,
        skips: tuple[int, ...] | None = None,
        position_octaves: int = 10,
        direction_octaves: int = 4,
        view_directions: bool = True,
        density_scale: float = 10.0,
        view_width: int | None = None,
        position_encoding: str = "frequency",
    ) -> None:
        super().__init__()
        if width < 2:
            raise ValueError(f"NeRF: width must be at least 2, got {width}")
        if depth < 1:
            raise ValueError(f"NeRF: depth must be at least 1, got {depth}")
        if min(position_octaves, direction_octaves) < 0:
            raise ValueError(f"NeRF: octaves must not be negative, got {position_octaves} and {direction_octaves}")
        if skips is None:
            skips = (4,) if depth > 5 else ()
        if any(not 0 <= s < depth - 1 for s in skips):
            raise ValueError(
                f"NeRF: skips must be indices of trunk layers before the last, 0..{depth - 2}, got {skips}"
            )
        if not density_scale > 0:
            raise ValueError(f"NeRF: density_scale must be positive, got {density_scale}")
        self.width, self.view_directions, self.density_scale = width, view_directions, density_scale
        table = [Layer(("positions",), width, "relu")]
        for i in range(1, depth):
            table.append(Layer(("positions", i - 1) if i - 1 in skips else (i - 1,), width, "relu"))
        table.append(Layer((depth - 1,), 1))
        if view_directions:
            view = Layer((depth + 1, "directions"), view_width or max(width // 2, 1), "relu")
            table += [Layer((depth - 1,), width), view, Layer((depth + 2,), 3)]
        else:
            table.append(Layer((depth - 1,), 3))
        self.layers = MLP(
            layers=tuple(table),
            outputs=(len(table) - 1, depth),
            position_octaves=position_octaves,
            direction_octaves=direction_octaves if view_directions else None,
            position_encoding=position_encoding,
        )
        shapes = self.layers.weight_shapes(6 if self.layers.integrated else 3, 3)
        linears = [nn.Linear(i, o) for o, i in shapes]
        self.trunk, self.density = nn.ModuleList(linears[:depth]), linears[depth]
        self.feature = linears[depth + 1] if view_directions else None
        self.view = linears[depth + 2] if view_directions else None
        self.colour = linears[-1]
        self.reset_parameters()

    @staticmethod
    def learning_rate(width: int, **_: object) -> float:
        """Returns Adam's initial learning rate, inverse to the width above 64 (Yang et al. 2021, table 3)."""
        return 0.02 * 64 / max(width, 64)

    def reset_parameters(self) -> None:
        """Initialises the parameters; see :func:`voronerf.nerf.fields.radiance.reset_layers`."""
        reset_layers(self.linears(), [self.density, self.colour], self.density_scale)

    def linears(self) -> list[nn.Linear]:
        """Returns the linear layers in the order of ``layers``."""
        linears = [*self.trunk, self.density, self.feature, self.view, self.colour]
        return [layer for layer in linears if isinstance(layer, nn.Linear)]


class MipNeRF(NeRF):
    """The architecture of NeRF with the integrated encoding (Barron et al. 2021, "Mip-NeRF", section 3.1).

    Its inputs are Gaussians [n, 6], mean and diagonal variance, instead of positions;
    `voronerf.nerf.cones.frustum_gaussians` computes them from cones.

    Args:
        width: Channels of the hidden layers.
        depth: Hidden layers before the heads.
        position_octaves: Frequencies of the integrated encoding, at least 1.
        **options: The further arguments of :class:`NeRF`.

    Examples:
        >>> import torch
        >>> from voronerf.nerf.fields import MipNeRF
        >>> field = MipNeRF(width=32, depth=2)
        >>> gaussians = torch.cat([torch.rand(10, 3), torch.full((10, 3), 1e-4)], dim=1)  # mean and diagonal variance
        >>> colour, density = field(gaussians, torch.tensor([[0.0, 0, 1]]).expand(10, 3))
        >>> colour.shape, density.shape
        (torch.Size([10, 3]), torch.Size([10]))
    """

    inputs = "gaussians"

    def __init__(
        self, width: int = 64, depth: int = 8, *, position_octaves: int = MIP_OCTAVES, **options: object
    ) -> None:
        options = {"position_octaves": position_octaves, "position_encoding": "integrated", **options}
        super().__init__(width, depth, **options)  # type: ignore[arg-type]

    @staticmethod
    def octaves(finest: int) -> int:
        """Returns the number of octaves of the encoding: ``finest`` + 2, at most 16.

        The images show ``finest`` octaves of detail. The cone of a pixel damps the wave of the second additional octave
        to a thousandth, and the next wave to 1e-11: the published 16 octaves would feed zeros to the network.
        """
        return min(finest + 2, MIP_OCTAVES)


class KiloNeRF(NeRF):
    """The network of one cell in KiloNeRF (Reiser et al. 2021, figure 3).

    It has two trunk layers of 32 channels, a feature layer, and a layer of 32 channels that sees the view direction.

    Args:
        width: Channels of each hidden layer.
        depth: Trunk layers.
        **options: The further arguments of :class:`NeRF`.

    Examples:
        >>> import torch
        >>> from voronerf import VoronoiRouter
        >>> from voronerf.nerf.fields import KiloNeRF
        >>> router = VoronoiRouter(KiloNeRF(), torch.rand(512, 3))  # 512 networks of width 32
        >>> colour, density = router(torch.rand(1000, 3), torch.tensor([[0.0, 0, 1]]).expand(1000, 3))
        >>> colour.shape, density.shape
        (torch.Size([1000, 3]), torch.Size([1000]))
    """

    training_defaults: ClassVar[dict[str, Any]] = {}

    def __init__(self, width: int = 32, depth: int = 2, **options: object) -> None:
        super().__init__(width, depth, **{"view_width": width, **options})  # type: ignore[arg-type]
