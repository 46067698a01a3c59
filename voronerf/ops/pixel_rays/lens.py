"""Rays through positions in images, and the lenses that bend them. c cameras, b positions. Frames are those of
``voronerf.nerf.cameras``."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core.checks import check_range

NEWTON_STEPS = 12
#: The camera models, by their numbers in ``models``.
PERSPECTIVE, FISHEYE, FOV = range(3)
#: In the place of zero, where a length divides.
TINY = 1e-12


@torch.no_grad()
def camera_rays(
    poses: Tensor,
    intrinsics: Tensor,
    x: Tensor,
    y: Tensor,
    camera: Tensor | None,
    distortion: Tensor | None,
    models: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Rays through positions in images. Lens distortion is undone by Newton's method in float64. Not differentiable.

    Args:
        poses: float32 [c, 4, 4], camera to world, OpenGL axes.
        intrinsics: float32 [c, 4], (fx, fy, cx, cy) in pixels.
        x: float32 [b], to the right, in pixels; the centre of the first column is at 0.5.
        y: float32 [b], downwards.
        camera: int32 [b], the camera of each position, 0 to c - 1; None for the first camera.
        distortion: [c, 8], see `distort`, or None.
        models: int32 [c], the model of each lens, PERSPECTIVE, FISHEYE or FOV; None for PERSPECTIVE.

    Returns:
        (origins float32 [b, 3], directions float32 [b, 3] of unit length).

    Raises:
        ValueError: on the CPU cameras out of range.
    """
    if camera is not None:
        check_range("camera_rays", "camera", camera, len(poses))
    index = 0 if camera is None else camera
    lens = intrinsics[index]
    if distortion is None:
        fx, fy, cx, cy = lens.unbind(-1)
        u, v = (x - cx) / fx, (y - cy) / fy
        ahead = torch.ones_like(u)
    else:
        # float64: a millionth of a pixel is below the resolution of float32
        fx, fy, cx, cy = lens.double().unbind(-1)
        model = PERSPECTIVE if models is None else models[index]
        u, v = undistort((x - cx) / fx, (y - cy) / fy, distortion[index].double(), model)
        ahead = torch.ones_like(u)
        if models is not None:
            angle = torch.sqrt(u * u + v * v)
            turned = models[index] == FISHEYE
            share = torch.where(turned, torch.sinc(angle / torch.pi), ahead)  # sin(angle) / angle
            u, v, ahead = u * share, v * share, torch.where(turned, angle.cos(), ahead)
        u, v, ahead = u.to(poses.dtype), v.to(poses.dtype), ahead.to(poses.dtype)
    pose = poses[index]
    local = torch.stack((u, -v, -ahead), dim=-1)
    if camera is None:
        directions = local @ pose[:3, :3].T
    else:
        directions = (pose[:, :3, :3] * local[:, None, :]).sum(-1)
    directions = torch.nn.functional.normalize(directions, dim=-1)
    return pose[..., :3, 3].expand_as(directions), directions


def distort(u: Tensor, v: Tensor, coefficients: Tensor, model: Tensor | int = PERSPECTIVE) -> tuple[Tensor, Tensor]:
    """The lens model: where the lens puts the ideal point (u, v).

    The point of a perspective or an FOV lens lies on the plane at distance 1; that of a fisheye has the length of the
    angle to the optical axis. With r = |(u, v)| the models are

    - perspective, OpenCV's rational one: the factor (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6),
      and the tangential terms of p1 and p2;
    - fisheye, COLMAP's THIN_PRISM_FISHEYE: the factor 1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8, the tangential terms,
      s1 r^2 and s2 r^2. OpenCV's fisheye has k1 to k4 alone;
    - FOV, COLMAP's: the factor atan(2 r tan(omega / 2)) / (r omega).

    Source: OpenCV, "Camera Calibration and 3D Reconstruction" and "Fisheye camera model"; COLMAP, "Camera Models";
    Devernay and Faugeras, "Straight lines have to be straight", 2001, for FOV.

    Args:
        u: [n].
        v: [n].
        coefficients: [8] or [n, 8]: (k1, k2, p1, p2, k3, k4, k5, k6), of a fisheye (k1, k2, p1, p2, k3, k4, s1, s2), of
            an FOV lens (omega, 0, ...).
        model: PERSPECTIVE, FISHEYE or FOV, of all or [n].
    """
    terms = _terms(coefficients, model)
    a, b = _bend(u, v, terms, _radial(u * u + v * v, terms)[0])
    radius, omega = torch.sqrt((u * u + v * v).clamp_min(TINY**2)), terms.omega
    width = torch.where(omega == 0, 1, omega)
    share = torch.where(omega == 0, 1, torch.atan(radius * 2 * torch.tan(width / 2)) / (radius * width))
    return a * share, b * share


def undistort(u: Tensor, v: Tensor, coefficients: Tensor, model: Tensor | int = PERSPECTIVE) -> tuple[Tensor, Tensor]:
    """Inverse of `distort`: that of FOV in closed form, and of the others by Newton's method from the distorted point.

    Converges quadratically wherever the lens model is invertible between the start and the solution, which holds inside
    the image of any lens this model describes; a fixed number of steps keeps the device out of the host's hands. Give
    float64 for an error below a millionth of a pixel.
    """
    terms = _terms(coefficients, model)
    radius, omega = torch.hypot(u, v).clamp_min(TINY), terms.omega
    width = torch.where(omega == 0, 1, omega)
    share = torch.where(omega == 0, 1, torch.tan(radius * width) / (radius * 2 * torch.tan(width / 2)))
    a, b = u, v = u * share, v * share
    p1, p2, s1, s2 = terms.p1, terms.p2, terms.s1, terms.s2
    for _ in range(NEWTON_STEPS):
        radial, slope = _radial(a * a + b * b, terms)
        du, dv = _bend(a, b, terms, radial)
        du, dv = du - u, dv - v
        shared = a * b * slope + 2 * p1 * a + 2 * p2 * b
        aa = radial + a * a * slope + 2 * p1 * b + 6 * p2 * a + 2 * s1 * a
        ab, ba = shared + 2 * s1 * b, shared + 2 * s2 * a
        bb = radial + b * b * slope + 6 * p1 * b + 2 * p2 * a + 2 * s2 * b
        determinant = aa * bb - ab * ba
        a, b = a - (bb * du - ab * dv) / determinant, b - (aa * dv - ba * du) / determinant
    return a, b


class _Terms(NamedTuple):
    """The coefficients of all models in one formula, where those that a model has not are zero.

    Attributes:
        above: of r^2, r^4, r^6, r^8 in the radial factor.
        below: of r^2, r^4, r^6 in its divisor.
        p1, p2: tangential.
        s1, s2: of a thin prism.
        omega: of FOV, whose other terms are zero.
    """

    above: tuple[Tensor, ...]
    below: tuple[Tensor, ...]
    p1: Tensor
    p2: Tensor
    s1: Tensor
    s2: Tensor
    omega: Tensor


def _terms(coefficients: Tensor, model: Tensor | int) -> _Terms:
    model = torch.as_tensor(model, device=coefficients.device)
    fov, fisheye = model == FOV, model == FISHEYE
    k1, k2, p1, p2, k3, k4, k5, k6 = torch.where(fov[..., None], 0, coefficients).unbind(-1)
    below = tuple(torch.where(fisheye, 0, k) for k in (k4, k5, k6))
    k4, s1, s2 = (torch.where(fisheye, k, 0) for k in (k4, k5, k6))
    return _Terms((k1, k2, k3, k4), below, p1, p2, s1, s2, torch.where(fov, coefficients[..., 0], 0))


def _radial(r2: Tensor, terms: _Terms) -> tuple[Tensor, Tensor]:
    """The radial factor, and twice its derivative to r2."""
    (k1, k2, k3, k4), (d1, d2, d3) = terms.above, terms.below
    below = 1 + r2 * (d1 + r2 * (d2 + r2 * d3))
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))) / below
    rise = k1 + r2 * (2 * k2 + r2 * (3 * k3 + r2 * 4 * k4)) - radial * (d1 + r2 * (2 * d2 + r2 * 3 * d3))
    return radial, 2 * rise / below


def _bend(u: Tensor, v: Tensor, terms: _Terms, radial: Tensor) -> tuple[Tensor, Tensor]:
    """Where the polynomials put (u, v)."""
    p1, p2, r2 = terms.p1, terms.p2, u * u + v * v
    a = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u) + terms.s1 * r2
    b = v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v + terms.s2 * r2
    return a, b
