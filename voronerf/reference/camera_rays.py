"""Rays through pixels. c cameras, b pixels. Frames and the lens model are those of ``voronerf.rendering.cameras``."""

from __future__ import annotations

import torch
from torch import Tensor

NEWTON_STEPS = 12


@torch.no_grad()
def camera_rays(
    poses: Tensor,
    intrinsics: Tensor,
    x: Tensor,
    y: Tensor,
    *,
    camera: Tensor | None,
    distortion: Tensor | None,
    fisheye: bool,
) -> tuple[Tensor, Tensor]:
    """Origins and unit directions; see ``voronerf.ops.camera_rays``."""
    index = 0 if camera is None else camera
    lens = intrinsics[index]
    if distortion is None:
        fx, fy, cx, cy = lens.unbind(-1)
        u, v = (x - cx) / fx, (y - cy) / fy
        ahead = torch.ones_like(u)
    else:
        # float64: a millionth of a pixel is below the resolution of float32
        fx, fy, cx, cy = lens.double().unbind(-1)
        u, v = undistort((x - cx) / fx, (y - cy) / fy, distortion[index].double(), fisheye)
        ahead = torch.ones_like(u)
        if fisheye:
            angle = torch.sqrt(u * u + v * v)
            share = torch.sinc(angle / torch.pi)  # sin(angle) / angle
            u, v, ahead = u * share, v * share, angle.cos()
        u, v, ahead = u.to(poses.dtype), v.to(poses.dtype), ahead.to(poses.dtype)
    pose = poses[index]
    local = torch.stack((u, -v, -ahead), dim=-1)
    if camera is None:
        directions = local @ pose[:3, :3].T
    else:
        directions = (pose[:, :3, :3] * local[:, None, :]).sum(-1)
    directions = torch.nn.functional.normalize(directions, dim=-1)
    return pose[..., :3, 3].expand_as(directions), directions


def distort(u: Tensor, v: Tensor, coefficients: Tensor, fisheye: bool = False) -> tuple[Tensor, Tensor]:
    """The lens model: where the lens puts the ideal point (u, v).

    Without ``fisheye``, (u, v) lies on the plane at distance 1, and the model is OpenCV's rational one: the factor
    (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6), and the tangential terms of p1 and p2. With it,
    (u, v) has the length of the angle to the optical axis, and the model is COLMAP's THIN_PRISM_FISHEYE: the factor
    1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8, the tangential terms, s1 r^2 and s2 r^2. OpenCV's fisheye has k1 to k4 alone.

    Source: OpenCV, "Camera Calibration and 3D Reconstruction" and "Fisheye camera model"; COLMAP, "Camera Models".

    Args:
        u: [n].
        v: [n].
        coefficients: [8] or [n, 8], (k1, k2, p1, p2, k3, k4, k5, k6); with ``fisheye`` s1, s2 in the place of k5, k6.
        fisheye: which of the two models.
    """
    _, _, p1, p2, *_, s1, s2 = coefficients.unbind(-1)
    r2 = u * u + v * v
    radial, _ = _radial(r2, coefficients, fisheye)
    a = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    b = v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v
    return (a + s1 * r2, b + s2 * r2) if fisheye else (a, b)


def undistort(u: Tensor, v: Tensor, coefficients: Tensor, fisheye: bool = False) -> tuple[Tensor, Tensor]:
    """Inverse of `distort` by Newton's method, from the distorted point itself.

    Converges quadratically wherever the lens model is invertible between the start and the solution, which holds inside
    the image of any lens this model describes; a fixed number of steps keeps the device out of the host's hands. Give
    float64 for an error below a millionth of a pixel.
    """
    _, _, p1, p2, *_, s1, s2 = coefficients.unbind(-1)
    a, b = u, v
    for _ in range(NEWTON_STEPS):
        radial, slope = _radial(a * a + b * b, coefficients, fisheye)
        du, dv = distort(a, b, coefficients, fisheye)
        du, dv = du - u, dv - v
        aa = radial + a * a * slope + 2 * p1 * b + 6 * p2 * a
        ab = ba = a * b * slope + 2 * p1 * a + 2 * p2 * b
        bb = radial + b * b * slope + 6 * p1 * b + 2 * p2 * a
        if fisheye:
            aa, ab, ba, bb = aa + 2 * s1 * a, ab + 2 * s1 * b, ba + 2 * s2 * a, bb + 2 * s2 * b
        determinant = aa * bb - ab * ba
        a, b = a - (bb * du - ab * dv) / determinant, b - (aa * dv - ba * du) / determinant
    return a, b


def _radial(r2: Tensor, coefficients: Tensor, fisheye: bool) -> tuple[Tensor, Tensor]:
    """The radial factor, and twice its derivative to r2."""
    k1, k2, _, _, k3, k4, k5, k6 = coefficients.unbind(-1)
    if fisheye:
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        return radial, 2 * (k1 + r2 * (2 * k2 + r2 * (3 * k3 + r2 * 4 * k4)))
    below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / below
    rise = k1 + r2 * (2 * k2 + r2 * 3 * k3) - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))
    return radial, 2 * rise / below
