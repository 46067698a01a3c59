"""The interface of a field that can be rendered."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor, nn


class Field(Protocol):
    """A callable that returns the colours and densities of points seen along directions; the input of all renderers.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import Field
        >>> def fog(positions, directions, ray_index):
        ...     return torch.ones_like(positions), torch.full_like(positions[:, 0], 0.5)
        >>> field: Field = fog  # any callable of this form
    """

    def __call__(self, positions: Tensor, directions: Tensor, ray_index: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the colours [n, 3] in 0..1 and the densities [n] >= 0 at n samples of r rays.

        Args:
            positions: [n, 3], the positions of the samples; [n, 6] Gaussians for cones.
            directions: [r, 3], the unit directions of the rays.
            ray_index: int32 [n], the row of ``directions`` for each sample.
        """
        ...


class DirectionPerSample(nn.Module):
    """A field around a network that takes one direction for each sample.

    Args:
        network: Module that maps positions [n, 3], or Gaussians [n, 6], and unit directions [n, 3] to a colour [n, 3]
            in 0..1 and a density [n] or [n, 1] >= 0 per scene unit.

    Examples:
        >>> import torch
        >>> from voronerf import VoronoiRouter
        >>> from voronerf.nerf import DirectionPerSample
        >>> class Fog(torch.nn.Module):
        ...     def __init__(self):
        ...         super().__init__()
        ...         self.layer = torch.nn.Linear(6, 4)
        ...     def forward(self, positions, directions):
        ...         found = self.layer(torch.cat([positions, directions], dim=-1))
        ...         return found[:, :3].sigmoid(), found[:, 3].exp()
        >>> router = VoronoiRouter(Fog(), torch.rand(8, 3), coords="first3", fuse=True)
        >>> field = DirectionPerSample(router)  # a field for a Renderer
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, positions: Tensor, directions: Tensor, ray_index: Tensor) -> tuple[Tensor, Tensor]:
        """Evaluates the field; see :class:`Field`."""
        n = len(positions)
        outputs = self.network(positions, directions.index_select(0, ray_index))
        if not (isinstance(outputs, (tuple, list)) and len(outputs) == 2):
            raise ValueError(f"field: forward must return (colour, density), got {type(outputs).__name__}")
        colour, density = outputs
        if colour.shape != (n, 3) or density.shape not in ((n,), (n, 1)):
            raise ValueError(
                f"field: forward must return a colour [{n}, 3] and a density [{n}], "
                f"got {list(colour.shape)} and {list(density.shape)}"
            )
        return colour, density.reshape(n)
