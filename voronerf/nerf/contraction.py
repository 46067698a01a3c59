"""Contraction of unbounded space, into a ball or into a cube. n points.

The ball: Barron et al. 2022, "Mip-NeRF 360", equation 10. Space inside a sphere is unchanged. Space outside is mapped
into the shell between this sphere and a sphere of twice the radius. Centre and radius are arbitrary, in world units.
The cube: Mildenhall et al. 2020, "NeRF", appendix C, for cameras that all look in the same direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Contraction:
    """The map ``c + R f((x - c) / R)`` with ``f(x) = x`` up to length 1 and ``(2 - 1 / |x|) x / |x|`` beyond.

    Attributes:
        centre: [3], c, preferably on the device of the points, since each call copies it otherwise.
        radius: R > 0, in world units.

    Raises:
        ValueError: The centre has another shape, or the radius is not positive and finite.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import Contraction
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
        """Maps world points [..., 3] to points [..., 3] less than 2 R from the centre."""
        centre = self.centre.to(points)
        offset, length = self._offset(points, centre)
        return centre + self.radius * offset * ((2 - 1 / length) / length)

    def inverse(self, points: Tensor) -> Tensor:
        """Returns the world points [..., 3] of contracted points [..., 3]; at most 1,000 R from the centre."""
        centre = self.centre.to(points)
        offset = (points - centre) / self.radius
        length = offset.norm(dim=-1, keepdim=True)
        far = 1 / ((2 - length).clamp_min(1e-3) * length.clamp_min(1))
        return centre + self.radius * offset * torch.where(length > 1, far, 1)

    def stretch(self, points: Tensor) -> Tensor:
        """Returns [...], world length per contracted length at contracted points [..., 3]; at most 1,000,000.

        Lengths are along rays from the centre.
        """
        length = (points - self.centre.to(points)).norm(dim=-1) / self.radius
        return (2 - length).clamp(1e-3, 1).square().reciprocal()

    @property
    def numbers(self) -> Tensor:
        """The centre and the radius as a tensor [4], for `voronerf.ops.march_rays`."""
        return torch.cat((self.centre, self.centre.new_tensor([self.radius])))

    @property
    def cube(self) -> Tensor:
        """The corners [2, 3] of the cube that holds all contracted points."""
        return torch.stack((self.centre - 2 * self.radius, self.centre + 2 * self.radius))

    def gaussians(self, means: Tensor, directions: Tensor, along: Tensor, across: Tensor) -> tuple[Tensor, Tensor]:
        """Maps Gaussians by the linearised map (mip-NeRF 360, equation 9): the covariance ``S`` becomes ``J S J^T``.

        The covariance is ``S = along d d^T + across (1 - d d^T)``.

        Args:
            means: [..., 3], the means of the Gaussians.
            directions: [..., 3] or a shape that broadcasts with it, the unit vectors d.
            along: [..., 1], variances along d.
            across: [..., 1], variances across d.

        Returns:
            (means [..., 3], variances [..., 3], the diagonal of the new covariance).
        """
        centre = self.centre.to(means)
        offset, length = self._offset(means, centre)
        # J = a 1 + (b - a) u u^T for the unit vector u from the centre; inside the sphere a = b = 1.
        a, b = (2 - 1 / length) / length, 1 / length.square()
        u = offset / length
        bent = a * directions + (b - a) * u * (u * directions).sum(-1, keepdim=True)
        spread = a.square() + (b.square() - a.square()) * u.square()
        return centre + self.radius * offset * a, (along - across) * bent.square() + across * spread

    def _offset(self, points: Tensor, centre: Tensor) -> tuple[Tensor, Tensor]:
        offset = (points - centre) / self.radius
        return offset, offset.norm(dim=-1, keepdim=True).clamp_min(1)


@dataclass(frozen=True, eq=False)
class Perspective:
    """A map to normalised device coordinates: the view beyond a near plane becomes the cube [-1, 1]^3.

    In camera coordinates, the point (x, y) at depth z becomes (x / (z a), y / (z b), 1 - 2 near / z). Only the inputs
    of fields are mapped; distances along rays stay in world units.

    Attributes:
        centre: [3], the position of the camera.
        axes: [3, 3]; the rows are the directions right, up and ahead.
        near: The depth of the near plane, > 0, in world units.
        slopes: (a, b), half the width and half the height of the view at depth 1.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import Perspective
        >>> ahead = Perspective(torch.zeros(3), torch.eye(3), near=1.0, slopes=(0.5, 0.5))
        >>> ahead.points(torch.tensor([[0.0, 0.5, 1.0], [0.0, 0.0, 2.0], [1e6, 0.0, 2e6]])).round(decimals=4)
        tensor([[ 0.,  1., -1.],
                [ 0.,  0.,  0.],
                [ 1.,  0.,  1.]])
    """

    centre: Tensor
    axes: Tensor
    near: float
    slopes: tuple[float, float]

    def points(self, points: Tensor) -> Tensor:
        """Maps world points [..., 3] to points [..., 3]; depths are clamped to at least half the near depth."""
        local, depth = self._local(points)
        across = local[..., :2] / (depth * depth.new_tensor(self.slopes))
        return torch.cat((across, 1 - 2 * self.near / depth), dim=-1)

    def inverse(self, points: Tensor) -> Tensor:
        """Returns the world points [..., 3] of contracted points [..., 3]; depths are at most 2,000 ``near``."""
        depth = 2 * self.near / (1 - points[..., 2:]).clamp_min(1e-3)
        across = points[..., :2] * depth * depth.new_tensor(self.slopes)
        return torch.cat((across, depth), dim=-1) @ self.axes.to(points) + self.centre.to(points)

    def stretch(self, points: Tensor) -> Tensor:
        """Returns [...], the derivative of world depth with respect to contracted depth at contracted points [..., 3].

        The derivative is at most 2,000,000 times ``near``.
        """
        return 2 * self.near / (1 - points[..., 2]).clamp_min(1e-3).square()

    @property
    def numbers(self) -> Tensor:
        """The tensor [5, 3] for `voronerf.ops.march_rays`: centre, three axes, and (near distance, slopes)."""
        last = self.centre.new_tensor([[self.near, *self.slopes]])
        return torch.cat((self.centre[None], self.axes.to(self.centre), last))

    @property
    def cube(self) -> Tensor:
        """The corners [2, 3] of the cube [-1, 1]^3."""
        return self.centre.new_tensor([[-1.0], [1.0]]).expand(2, 3)

    def gaussians(self, means: Tensor, directions: Tensor, along: Tensor, across: Tensor) -> tuple[Tensor, Tensor]:
        """Maps Gaussians by the linearised map, as in `Contraction.gaussians`."""
        local, depth = self._local(means)
        axes = self.axes.to(means)
        slopes = depth.new_tensor(self.slopes)[:, None]
        flat = (axes[:2] - (local[..., :2] / depth)[..., None] * axes[2]) / (depth[..., None] * slopes)
        rows = torch.cat((flat, (2 * self.near / depth.square())[..., None] * axes[2:]), dim=-2)
        along_rows = (rows @ directions.expand_as(means)[..., None])[..., 0].square()
        return self.points(means), across * rows.square().sum(-1) + (along - across) * along_rows

    def _local(self, points: Tensor) -> tuple[Tensor, Tensor]:
        local = (points - self.centre.to(points)) @ self.axes.to(points).T
        return local, local[..., 2:].clamp_min(self.near / 2)
