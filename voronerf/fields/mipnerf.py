"""The mip-NeRF field: a NeRF whose inputs are Gaussians. Units as in `voronerf.fields.nerf`."""

from __future__ import annotations

from voronerf.fields.nerf import NeRF

#: Octaves of the positional encoding, as published; the encoding fades out waves that a Gaussian cannot resolve.
OCTAVES = 16


class MipNeRF(NeRF):
    """The architecture of NeRF with the integrated encoding (Barron et al. 2021, "Mip-NeRF", section 3.1).

    Its input is Gaussians [n, 6], mean and diagonal variance, instead of positions;
    `voronerf.rendering.cones.frustum_gaussians` makes them from cones.

    Args:
        width: Channels of the hidden layers.
        depth: Hidden layers before the heads.
        position_octaves: Frequencies of the integrated encoding, at least 1.
        **options: The further arguments of :class:`NeRF`.

    Examples:
        >>> import torch
        >>> from voronerf.fields import MipNeRF
        >>> field = MipNeRF(width=32, depth=2)
        >>> gaussians = torch.cat([torch.rand(10, 3), torch.full((10, 3), 1e-4)], dim=1)  # mean and diagonal variance
        >>> colour, density = field(gaussians, torch.tensor([[0.0, 0, 1]]).expand(10, 3))
        >>> colour.shape, density.shape
        (torch.Size([10, 3]), torch.Size([10]))
    """

    inputs = "gaussians"

    def __init__(self, width: int = 64, depth: int = 8, *, position_octaves: int = OCTAVES, **options: object) -> None:
        options = {"position_octaves": position_octaves, "position_encoding": "integrated", **options}
        super().__init__(width, depth, **options)  # type: ignore[arg-type]

    @staticmethod
    def octaves(finest: int) -> int:
        """Two beyond the finest that the images show, where a pixel's cone leaves a thousandth of the wave.

        Of the next it leaves 1e-11: the published 16 would feed zeros to the network.
        """
        return min(finest + 2, OCTAVES)
