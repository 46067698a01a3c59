"""A field of KiloNeRF's size, for hundreds of cells. Units as in `voronerf.fields.nerf`."""

from __future__ import annotations

from typing import Any, ClassVar

from voronerf.fields.nerf import NeRF

#: Channels and trunk layers of KiloNeRF's networks.
WIDTH, DEPTH = 32, 2


class KiloNeRF(NeRF):
    """The network of one cell in KiloNeRF (Reiser et al. 2021, figure 3): two trunk layers of 32 channels, a feature
    layer, and a layer of the same 32 channels that also sees the view direction.

    Args:
        width: Channels of every hidden layer.
        depth: Trunk layers.
        **options: The further arguments of :class:`NeRF`.

    Examples:
        >>> import torch
        >>> from voronerf import VoronoiRouter
        >>> from voronerf.fields import KiloNeRF
        >>> router = VoronoiRouter(KiloNeRF(), torch.rand(512, 3))  # 512 networks of width 32
        >>> colour, density = router(torch.rand(1000, 3), torch.tensor([[0.0, 0, 1]]).expand(1000, 3))
        >>> colour.shape, density.shape
        (torch.Size([1000, 3]), torch.Size([1000]))
    """

    training_defaults: ClassVar[dict[str, Any]] = {}

    def __init__(self, width: int = WIDTH, depth: int = DEPTH, **options: object) -> None:
        super().__init__(width, depth, **{"view_width": width, **options})  # type: ignore[arg-type]
