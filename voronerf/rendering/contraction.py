"""Contraction of unbounded space into a ball. n points.

Source: Barron et al. 2022, "Mip-NeRF 360", equation 10. Space inside a sphere stays as it is. Space outside is mapped
into the shell between the sphere and one of twice its radius. Here the sphere has any centre and radius, in world
units.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True, eq=False)
class Contraction:
    """``c + R f((x - c) / R)`` with ``f(x) = x`` up to length 1 and ``(2 - 1 / |x|) x / |x|`` beyond.

    Attributes:
        centre: [3], c. It should be on the device of the points, or it is copied at every call.
        radius: R > 0.

    Raises:
        ValueError: a centre of another shape, or a radius that is not positive and finite.

    Examples:
        >>> import torch
        >>> from voronerf.rendering import Contraction
        >>> contraction = Contraction(torch.zeros(3), radius=1.0)
        >>> contraction.points(torch.tensor([[0.5, 0, 0], [2.0, 0, 0], [100.0, 0, 0]])).round(decimals=4)
        tensor([[0.5000, 0.0000, 0.0000],
                [1.5000, 0.0000, 0.0000],
                [1.9900, 0.0000, 0.0000]])
    """

    centre: Tensor
    radius: float

    def __post_init__(self) -> None:
        if self.centre.shape != (3,) or not 0 < self.radius < float("inf"):
            raise ValueError(
                "Contraction: centre must have shape [3] and radius be positive and finite, "
                f"got {list(self.centre.shape)} and {self.radius}"
            )

    def points(self, points: Tensor) -> Tensor:
        """Maps points [..., 3] to points [..., 3] less than 2 R from the centre."""
        centre = self.centre.to(points)
        offset, length = self._offset(points, centre)
        return centre + self.radius * offset * ((2 - 1 / length) / length)

    def gaussians(self, means: Tensor, directions: Tensor, along: Tensor, across: Tensor) -> tuple[Tensor, Tensor]:
        """Maps Gaussians with covariance ``S = along d d^T + across (1 - d d^T)`` by the linearised map (equation 9):
        the new covariance is ``J S J^T``.

        Args:
            means: [..., 3].
            directions: unit vectors d, [..., 3] or of a shape that broadcasts with it.
            along: [..., 1], variance along d.
            across: [..., 1], variance across d.

        Returns:
            (means [..., 3], variances [..., 3], the diagonal of the new covariance).
        """
        centre = self.centre.to(means)
        offset, length = self._offset(means, centre)
        # J = a 1 + (b - a) u u^T for the unit vector u from the centre; inside of the sphere a = b = 1.
        a, b = (2 - 1 / length) / length, 1 / length.square()
        u = offset / length
        bent = a * directions + (b - a) * u * (u * directions).sum(-1, keepdim=True)
        spread = a.square() + (b.square() - a.square()) * u.square()
        return centre + self.radius * offset * a, (along - across) * bent.square() + across * spread

    def _offset(self, points: Tensor, centre: Tensor) -> tuple[Tensor, Tensor]:
        offset = (points - centre) / self.radius
        return offset, offset.norm(dim=-1, keepdim=True).clamp_min(1)
