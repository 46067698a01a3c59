"""The angle between a test view and the nearest training camera, at the surfaces that the view shows."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from voronerf.nerf.cameras import Cameras
from voronerf.nerf.lenses import EQUIRECTANGULAR, FISHEYE, PERSPECTIVE
from voronerf.nerf.renderer import RenderedImage

#: The maximum number of points along the longer side of a view at which the angle is measured.
POINTS = 16
#: Points with less opacity show no surface.
OPAQUE = 0.5
#: The angle in degrees beyond which a test view counts as far from the training cameras. The training views hardly
#: determine such a view.
FAR_ANGLE = 15.0


def nearest_angle(image: RenderedImage, cameras: Cameras, index: int, training: Cameras) -> float | None:
    """Returns the angle in degrees between a view and the nearest training cameras, the mean over the view's surfaces.

    The angle at a point of a surface is the angle between the directions to the view's camera and to the nearest
    training camera that has the point in its image; surfaces in between are ignored. It is 180 if the point lies in no
    training image.

    Args:
        image: The rendered view, whose depths give the surfaces.
        cameras: The camera of the view, and perhaps other cameras.
        index: The index of the view's camera.
        training: The training cameras.

    Returns:
        The angle, 0..180, or None if the view shows no surface.

    Examples:
        >>> import torch
        >>> from voronerf.app.evaluate import nearest_angle
        >>> from voronerf.nerf import orbit_cameras
        >>> from voronerf.nerf.renderer import RenderedImage
        >>> cameras = orbit_cameras(8, radius=2.0, elevation=0.0, width=4, height=4, focal=40.0)
        >>> middle = RenderedImage(torch.ones(4, 4, 3), torch.ones(4, 4), torch.full((4, 4), 2.0), torch.zeros(4, 4, 3))
        >>> round(nearest_angle(middle, cameras, 0, cameras[[1, 4]]), 1)
        45.0
    """
    height, width = image.depth.shape
    stride = -(-max(height, width) // POINTS)
    rows, columns = (torch.arange(stride // 2, side, stride, device=image.depth.device) for side in (height, width))
    row, column = (values.reshape(-1) for values in torch.meshgrid(rows, columns, indexing="ij"))
    opaque = image.opacity[row, column] >= OPAQUE
    row, column = row[opaque], column[opaque]
    if not len(row):
        return None
    rays = cameras.to(row.device).rays(index, column, row)
    points = rays.origins + image.depth[row, column, None] * rays.directions
    training = training.to(row.device)
    between = torch.nn.functional.normalize(points[:, None] - training.origins, dim=-1)  # [points, cameras, 3]
    cosines = (between * rays.directions[:, None]).sum(-1)
    seen = (between * training.forward).sum(-1) >= _least_cosines(training)
    nearest = cosines.where(seen, -1.0).amax(1).double().clamp(-1, 1)
    return math.degrees(float(nearest.acos().mean()))


def _least_cosines(cameras: Cameras) -> Tensor:
    """Returns [c], the cosine of the angle between each camera's axis and the corners of its image, without distortion.

    All points in an image lie within this angle of the axis.
    """
    sizes = cameras.poses.new_tensor([cameras.size(index) for index in range(len(cameras))])
    slope = (sizes / (2 * cameras.intrinsics[:, :2])).norm(dim=-1)
    models = torch.full_like(slope, PERSPECTIVE, dtype=torch.int64) if cameras.models is None else cameras.models
    angle = torch.where(models == FISHEYE, slope.clamp(max=math.pi), slope.atan())
    return torch.where(models == EQUIRECTANGULAR, -1.0, angle.cos())
