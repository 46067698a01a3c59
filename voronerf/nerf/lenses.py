"""Lens models: the maps between image positions and directions, and tables of the directions of all pixels.

Other modules do not depend on the formulas of the models. n points, l lenses of images of h x w pixels. u and v are
image-plane coordinates, u = (x - cx) / fx to the right and v = (y - cy) / fy downwards.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["EQUIRECTANGULAR", "FISHEYE", "FOV", "PERSPECTIVE", "LensTables", "distort", "undistort", "unproject"]

#: The camera models; their values are used in `Cameras.models`.
PERSPECTIVE, FISHEYE, FOV, EQUIRECTANGULAR = range(4)
NEWTON_STEPS = 12
#: The step length at which Newton's method stops. It converges quadratically, so the remaining error is below the
#: precision of float64.
SETTLED = 1e-9
#: The lower limit of lengths in denominators, to avoid a division by zero.
TINY = 1e-12
#: Tolerance in radians at the border of an equirectangular picture.
ROUNDED = 1e-6
#: The relative imaginary part below which a root counts as real.
FLAT = 1e-9
#: The largest reprojection error, in pixels, of a valid inverse.
MISSED = 1e-3
#: The maximum size of the tables of one scene in bytes. A table has 8 bytes per pixel, an RGB picture 3.
MOST_BYTES = 4 << 30


def distort(u: Tensor, v: Tensor, coefficients: Tensor, model: int = PERSPECTIVE) -> tuple[Tensor, Tensor]:
    """Distorts the ideal points (u, v) by a lens model; NaN for points beyond the fold of the model.

    For perspective and FOV lenses, (u, v) lies on the plane at distance 1. For a fisheye, the length of (u, v) is the
    angle to the optical axis. With r = |(u, v)| the models are

    - perspective, OpenCV's rational model: the factor (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6),
      and the tangential terms of p1 and p2;
    - fisheye, COLMAP's THIN_PRISM_FISHEYE: the factor 1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8, the tangential terms,
      s1 r^2 and s2 r^2. OpenCV's fisheye has only k1 to k4;
    - FOV, as in COLMAP: the factor atan(2 r tan(omega / 2)) / (r omega);
    - equirectangular: no distortion. (u, v) are the angles to the right and downwards, so fx and fy are in pixels per
      radian.

    Source: OpenCV, "Camera Calibration and 3D Reconstruction" and "Fisheye camera model"; COLMAP, "Camera Models";
    Devernay and Faugeras, "Straight lines have to be straight", 2001, for FOV.

    Args:
        u: [n], image-plane coordinates to the right.
        v: [n], image-plane coordinates downwards.
        coefficients: [8], (k1, k2, p1, p2, k3, k4, k5, k6); for a fisheye (k1, k2, p1, p2, k3, k4, s1, s2), for an FOV
            lens (omega, 0, ...).
        model: PERSPECTIVE, FISHEYE, FOV or EQUIRECTANGULAR.
    """
    if model == FOV:
        omega, radius = float(coefficients[0]), torch.hypot(u, v).clamp_min(TINY)
        share = torch.atan(radius * 2 * math.tan(omega / 2)) / (radius * omega) if omega else torch.ones_like(u)
        return u * share, v * share
    terms = coefficients.tolist()
    a, b, *_ = _bend(u, v, terms, model)
    seen = torch.hypot(u, v) < fold(terms, model)
    return a.where(seen, torch.nan), b.where(seen, torch.nan)


def fold(terms: Sequence[float], model: int) -> float:
    """Returns the length of (u, v) at which the model folds over, or infinity if it never does.

    Beyond the fold, the radial factor moves points back towards the middle. Coefficients are fitted inside an image.
    Beyond the image, the distorted radius may decrease again, and directions far outside would appear in the image.

    Args:
        terms: The eight coefficients of `distort`. Not for an FOV lens, which never folds.
        model: PERSPECTIVE, FISHEYE or EQUIRECTANGULAR.
    """
    k1, k2, _, _, k3, k4, k5, k6 = terms
    numerator = [1, k1, k2, k3, k4] if model == FISHEYE else [1, k1, k2, k3]  # powers of r^2
    denominator = [1] if model == FISHEYE else [1, k4, k5, k6]
    slope = [0.0] * (
        len(numerator) + len(denominator) - 1
    )  # derivative of r * numerator / denominator, times denominator^2
    for i, a in enumerate(numerator):
        for j, b in enumerate(denominator):
            slope[i + j] += (1 + 2 * i - 2 * j) * a * b
    inverses = torch.cat((_inverse_roots(slope), _inverse_roots(denominator)))
    real = inverses.real[(inverses.real > 0) & (inverses.imag.abs() < FLAT * inverses.abs())]
    return 1 / math.sqrt(float(real.max())) if len(real) else math.inf


def _inverse_roots(factors: Sequence[float]) -> Tensor:
    """Returns 1 / root, complex128, for all roots of a polynomial.

    `factors` are the coefficients in ascending order; the first one, the constant term, must be 1. The results
    are eigenvalues of a matrix whose entries need no division, so tiny coefficients do no harm.
    """
    matrix = torch.diag(torch.ones(len(factors) - 1, dtype=torch.float64, device="cpu"), -1)[:-1, :-1]
    matrix[:1] -= torch.tensor(factors[1:], dtype=torch.float64, device="cpu")
    return torch.linalg.eigvals(matrix)


def undistort(u: Tensor, v: Tensor, coefficients: Tensor, model: int = PERSPECTIVE) -> tuple[Tensor, Tensor]:
    """Inverts `distort`: FOV in closed form, other models by Newton's method from the distorted point.

    Newton's method converges quadratically if the lens model is invertible between the start and the solution. Inside
    the image of a lens, the model is invertible unless it folds over there (`fold`). With float64 the error is below a
    millionth of a pixel.
    """
    if model == FOV:
        omega, radius = float(coefficients[0]), torch.hypot(u, v).clamp_min(TINY)
        share = torch.tan(radius * omega) / (radius * 2 * math.tan(omega / 2)) if omega else torch.ones_like(u)
        return u * share, v * share
    terms = coefficients.tolist()
    a, b = u, v
    for _ in range(NEWTON_STEPS):
        du, dv, aa, ab, ba, bb = _bend(a, b, terms, model)
        du, dv = du - u, dv - v
        over = 1 / (aa * bb - ab * ba)
        left, down = (bb * du - ab * dv) * over, (aa * dv - ba * du) * over
        a, b = a - left, b - down
        if not bool((left.abs() + down.abs() > SETTLED).any()):
            break
    return a, b


def _bend(u: Tensor, v: Tensor, terms: Sequence[float], model: int) -> tuple[Tensor, ...]:
    """Returns the distorted point (a, b) of (u, v), and the derivatives da/du, da/dv, db/du, db/dv."""
    k1, k2, p1, p2, k3, k4, k5, k6 = terms
    s1, s2 = (k5, k6) if model == FISHEYE else (0.0, 0.0)
    r2 = u * u + v * v
    if model == FISHEYE:
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        slope = 2 * (k1 + r2 * (2 * k2 + r2 * (3 * k3 + r2 * (4 * k4))))
    else:
        below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / below
        slope = 2 * (k1 + r2 * (2 * k2 + r2 * (3 * k3)) - radial * (k4 + r2 * (2 * k5 + r2 * (3 * k6)))) / below
    a = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u) + s1 * r2
    b = v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v + s2 * r2
    shared = u * v * slope + 2 * p1 * u + 2 * p2 * v
    across = radial + u * u * slope + 2 * p1 * v + 6 * p2 * u + 2 * s1 * u
    along = radial + v * v * slope + 6 * p1 * v + 2 * p2 * u + 2 * s2 * v
    return a, b, across, shared + 2 * s1 * v, shared + 2 * s2 * u, along


def unproject(
    x: Tensor, y: Tensor, intrinsics: Tensor, coefficients: Tensor, model: int = PERSPECTIVE
) -> tuple[Tensor, Tensor]:
    """Returns the directions through positions in the image of one lens.

    Args:
        x: [n], positions to the right, in pixels; the centre of the first column is at 0.5.
        y: [n], positions downwards, in pixels.
        intrinsics: [4], (fx, fy, cx, cy) in pixels.
        coefficients: [8], see `distort`.
        model: PERSPECTIVE, FISHEYE, FOV or EQUIRECTANGULAR.

    Returns:
        (float64 [n, 3], unit directions in the camera's OpenGL axes; bool [n], whether a position has a direction).
        Some positions have no direction if the model folds over inside the image, or in the corners of a fisheye.
    """
    fx, fy, cx, cy = intrinsics.double().tolist()
    u, v = (x.double() - cx) / fx, (y.double() - cy) / fy
    a, b = undistort(u, v, coefficients, model)
    again, and_again = distort(a, b, coefficients, model)
    valid = torch.maximum((again - u).abs() * fx, (and_again - v).abs() * fy) < MISSED
    ahead = torch.ones_like(a)
    if model == FISHEYE:
        angle = torch.hypot(a, b)
        valid &= angle < math.pi
        share = torch.sinc(angle / math.pi)  # sin(angle) / angle
        a, b, ahead = a * share, b * share, angle.cos()
    elif model == EQUIRECTANGULAR:
        valid &= (a.abs() < math.pi + ROUNDED) & (b.abs() < math.pi / 2 + ROUNDED)
        a, b, ahead = a.sin() * b.cos(), b.sin(), a.cos() * b.cos()
    return torch.nn.functional.normalize(torch.stack((a, -b, -ahead), dim=-1), dim=-1), valid


class LensTables:
    """Tables of the directions of all pixels of l lenses, computed on first use and cached on each device.

    A direction (x, y, z) in the camera's axes is stored as its stereographic projection (x, -y) / (1 - z), two float32
    numbers, which can represent every direction except straight back. A mask marks the pixels that have a direction.

    Args:
        lenses: [l, 13], intrinsics, coefficients and model of each lens.
        width: The width of the images in pixels.
        height: The height of the images in pixels.
    """

    def __init__(self, lenses: Tensor, width: int, height: int) -> None:
        size = 8 * len(lenses) * width * height
        if size > MOST_BYTES:
            raise ValueError(
                f"the ray tables of {len(lenses)} lenses of {width} x {height} pixels take {size / 2**30:.1f} GiB, the "
                f"limit is {MOST_BYTES >> 30} GiB; reduce the images (--downscale), or use one lens for all pictures"
            )
        self._lenses, self._width, self._height = lenses.double().cpu(), width, height
        self._by_device: dict[torch.device, Tensor] = {}
        self._has_direction = torch.empty(0, dtype=torch.bool, device="cpu")

    def on(self, device: torch.device) -> Tensor:
        """Returns the tables float32 [l, h, w, 2] on a device."""
        if not self._by_device:
            self._by_device[torch.device("cpu")] = self._compute()
        if device not in self._by_device:
            self._by_device[device] = self._by_device[torch.device("cpu")].to(device)
        return self._by_device[device]

    def has_direction(self, lens: int) -> Tensor:
        """Returns the mask bool [h, w], on the CPU, of the pixels of a lens that have a direction."""
        self.on(torch.device("cpu"))
        return self._has_direction[lens]

    def _compute(self) -> Tensor:
        shape = len(self._lenses), self._height, self._width
        tables = torch.empty(*shape, 2, dtype=torch.float32, device="cpu")
        self._has_direction = torch.empty(shape, dtype=torch.bool, device="cpu")
        middles = (torch.arange(size, dtype=torch.float32, device="cpu") + 0.5 for size in shape[1:])
        y, x = torch.meshgrid(*middles, indexing="ij")
        for table, mask, lens in zip(tables, self._has_direction, self._lenses):
            directions, valid = unproject(x, y, lens[:4], lens[4:12], int(lens[12]))
            mask.copy_(valid)
            right, up, back = directions.unbind(-1)
            # The projection of a position without a valid direction may be NaN or infinite.
            table.copy_((torch.stack((right, -up), dim=-1) / (1 - back)[..., None]).nan_to_num(0.0, 0.0, 0.0))
        return tables
