"""Rays through pixels. c cameras, b pixels. Frames and the lens model are those of ``voronerf.rendering.cameras``."""

from __future__ import annotations

import torch
from torch import Tensor

NEWTON_STEPS = 12


@torch.no_grad()
def camera_rays(
    poses: Tensor, intrinsics: Tensor, x: Tensor, y: Tensor, *, camera: Tensor | None, distortion: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Origins and unit directions; see ``voronerf.ops.camera_rays``."""
    index = 0 if camera is None else camera
    lens = intrinsics[index]
    if distortion is None:
        fx, fy, cx, cy = lens.unbind(-1)
        u, v = (x - cx) / fx, (y - cy) / fy
    else:
        # float64: a millionth of a pixel is below the resolution of float32
        fx, fy, cx, cy = lens.double().unbind(-1)
        u, v = undistort((x - cx) / fx, (y - cy) / fy, distortion[index].double())
        u, v = u.to(poses.dtype), v.to(poses.dtype)
    pose = poses[index]
    local = torch.stack((u, -v, -torch.ones_like(u)), dim=-1)
    if camera is None:
        directions = local @ pose[:3, :3].T
    else:
        directions = (pose[:, :3, :3] * local[:, None, :]).sum(-1)
    directions = torch.nn.functional.normalize(directions, dim=-1)
    return pose[..., :3, 3].expand_as(directions), directions


def distort(u: Tensor, v: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """OpenCV's lens model: where the lens puts the ideal image-plane point (u, v).

    Source: OpenCV, "Camera Calibration and 3D Reconstruction", radial-tangential model with k1, k2, p1, p2.

    Args:
        u: [n].
        v: [n].
        coefficients: (k1, k2, p1, p2), [4] or [n, 4].
    """
    k1, k2, p1, p2 = coefficients.unbind(-1)
    r2 = u * u + v * v
    radial = 1 + r2 * (k1 + r2 * k2)
    return (
        u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u),
        v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v,
    )


def undistort(u: Tensor, v: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse of `distort` by Newton's method, from the distorted point itself.

    Converges quadratically wherever the lens model is invertible between the start and the solution, which holds inside
    the image of any lens this model describes; a fixed number of steps keeps the device out of the host's hands. Give
    float64 for an error below a millionth of a pixel.
    """
    k1, k2, p1, p2 = coefficients.unbind(-1)
    a, b = u, v
    for _ in range(NEWTON_STEPS):
        r2 = a * a + b * b
        radial = 1 + r2 * (k1 + r2 * k2)
        slope = 2 * k1 + 4 * k2 * r2  # d radial / d r2, times 2
        du, dv = distort(a, b, coefficients)
        du, dv = du - u, dv - v
        aa = radial + a * a * slope + 2 * p1 * b + 6 * p2 * a
        ab = a * b * slope + 2 * p1 * a + 2 * p2 * b
        bb = radial + b * b * slope + 6 * p1 * b + 2 * p2 * a
        determinant = aa * bb - ab * ab
        a, b = a - (bb * du - ab * dv) / determinant, b - (aa * dv - ab * du) / determinant
    return a, b
