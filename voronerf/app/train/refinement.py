"""Training cameras that learn with the field: their poses, and the focal lengths of those that share a lens.

c cameras, r rays of a batch, g lenses. Poses and axes are those of `voronerf.nerf.cameras`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from voronerf.nerf import Batch
from voronerf.nerf.cameras import Cameras

#: Steps before cameras move, and steps between two moves.
START, EVERY = 256, 4
#: Adam's rates at first: of turns in radians and moves in scene units, and of the logarithms of focal lengths.
RATE, FOCAL_RATE = 1e-3, 1e-4
BETAS, EPSILON = (0.9, 0.99), 1e-15


class Refinement:
    """Moves cameras by Adam, against the gradients of a loss to the origins and directions of their rays.

    What turns, moves or scales all cameras alike is left out: the field could follow it, held-out views could not.

    Attributes:
        cameras: c, as they are now.
        moments: [2, 7 c], Adam's, of a camera's turn about its centre and its move, and last of the focal length; that
            of a lens stands at each of its cameras.
        moves: [], how many were made.

    Args:
        cameras: c, to begin with; they stay as they are.

    Examples:
        >>> import torch
        >>> from voronerf.nerf import orbit_cameras
        >>> from voronerf.nerf import Batch
        >>> from voronerf.app.train.refinement import Refinement
        >>> cameras = orbit_cameras(4, radius=2.0, elevation=0.0, width=8, height=8, focal=9.0)
        >>> refinement, ends = Refinement(cameras), torch.ones(2, 64)
        >>> batch = Batch(cameras.image_rays(0), *ends, torch.zeros(64, 3), view=torch.zeros(64, dtype=torch.int64))
        >>> batch = refinement.asked(batch)
        >>> batch.rays.origins[:, 2].sum().backward()  # lower is better
        >>> batch.rays.directions.sum().mul(0).backward()
        >>> refinement.learn(batch, share=1.0)
        >>> moved = refinement.cameras.origins - cameras.origins
        >>> bool(moved[0, 2] < 0), bool(moved.sum(0).abs().max() < 1e-6)
        (True, True)
    """

    def __init__(self, cameras: Cameras) -> None:
        self.cameras = replace(cameras, poses=cameras.poses.clone(), intrinsics=cameras.intrinsics.clone())
        c, poses = len(cameras), cameras.poses.double()
        numbers = [part for part in (cameras.intrinsics, cameras.distortion) if part is not None]
        self.lens = torch.cat(numbers, 1).unique(dim=0, return_inverse=True)[1]
        self.moments = torch.zeros(2, 7 * c, device=poses.device)
        self.moves = torch.zeros((), device=poses.device)
        # Turns about an axis, moves along it and a change of scale, of all cameras.
        eye = torch.eye(3).to(poses).expand(c, 3, 3)
        places = (poses[:, :3, 3] - poses[:, :3, 3].mean(0))[:, None]
        turns = torch.cat((eye, torch.linalg.cross(eye, places, dim=-1)), -1)
        shifts, scale = torch.cat((0 * eye, eye), -1), torch.cat((0 * places, places), -1)
        alike = torch.cat((turns, shifts, scale), 1).transpose(1, 2).reshape(6 * c, 7)
        self.alike = torch.linalg.qr(alike)[0].to(cameras.poses)

    @staticmethod
    def asked(batch: Batch) -> Batch:
        """A batch whose rays ask for gradients."""
        rays = batch.rays
        origins, directions = (tensor.detach().requires_grad_() for tensor in (rays.origins, rays.directions))
        return replace(batch, rays=replace(rays, origins=origins, directions=directions))

    @torch.no_grad()
    def learn(self, batch: Batch, share: float) -> None:
        """Moves the cameras.

        Args:
            batch: Of :meth:`asked`, with gradients.
            share: Factor on the rates.
        """
        rays, view, poses = batch.rays, batch.view, self.cameras.poses
        assert view is not None and rays.origins.grad is not None and rays.directions.grad is not None
        directions, slopes = rays.directions.detach(), rays.directions.grad
        # A longer focal length turns rays towards the axis.
        axes = -poses[:, :3, 2].index_select(0, view)
        ahead = (directions * axes).sum(-1, keepdim=True)
        longer = (slopes * ahead * (axes - ahead * directions)).sum(-1, keepdim=True)
        every = torch.cat((torch.linalg.cross(directions, slopes), rays.origins.grad, longer), 1)
        sums = _summed(every.nan_to_num(0.0, 0.0, 0.0), view, len(poses))  # a step that is left out may have none
        sums[:, 6:] = _summed(sums[:, 6:], self.lens, len(poses)).index_select(0, self.lens)
        steps = share * self._adam(sums.view(-1)).view(-1, 7)
        moves = RATE * steps[:, :6].reshape(-1)
        moves = (moves - self.alike @ (self.alike.T @ moves)).view(-1, 6)
        poses[:, :3, :3] = rotation(moves[:, :3]) @ poses[:, :3, :3]
        poses[:, :3, 3] += moves[:, 3:]
        self.cameras.intrinsics[:, :2] *= (FOCAL_RATE * steps[:, 6:]).exp()

    def _adam(self, gradient: Tensor) -> Tensor:
        """The step of Adam at a rate of 1."""
        (first, second), (mean, square) = BETAS, self.moments
        self.moves += 1
        mean.lerp_(gradient, 1 - first)
        square.lerp_(gradient.square(), 1 - second)
        return -mean / (1 - first**self.moves) / ((square / (1 - second**self.moves)).sqrt() + EPSILON)

    def state_dict(self) -> dict[str, Tensor]:
        """All that changes."""
        cameras = {"poses": self.cameras.poses, "intrinsics": self.cameras.intrinsics}
        return {**cameras, "moments": self.moments, "moves": self.moves}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Takes what :meth:`state_dict` gave."""
        for name, own in self.state_dict().items():
            own.copy_(state[name])


def _summed(values: Tensor, where: Tensor, count: int) -> Tensor:
    """The sums [count, d] of values [n, d] by their places int64 [n]; in a fixed order on the CPU."""
    width = values.shape[1]
    place = (where * width)[:, None] + torch.arange(width, device=where.device)
    return values.new_zeros(count * width).index_add_(0, place.view(-1), values.reshape(-1)).view(count, width)


def rotation(turn: Tensor) -> Tensor:
    """Rotations [..., 3, 3] by turns [..., 3], their axis times the angle in radians."""
    x, y, z = turn.double().unbind(-1)
    none = torch.zeros_like(x)
    across = torch.stack((none, -z, y, z, none, -x, -y, x, none), -1).unflatten(-1, (3, 3))
    return torch.linalg.matrix_exp(across).to(turn)
