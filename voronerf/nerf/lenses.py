"""Lens models: positions in an image to directions and back, and tables of the directions of all pixels.

The only place that knows the models. n points, l lenses of images of h x w pixels. u and v are image-plane coordinates,
u = (x - cx) / fx to the right and v = (y - cy) / fy downwards.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["EQUIRECTANGULAR", "FISHEYE", "FOV", "PERSPECTIVE", "LensTables", "distort", "undistort", "unproject"]

#: The camera models, by their numbers in `Cameras.models`.
PERSPECTIVE, FISHEYE, FOV, EQUIRECTANGULAR = range(4)
NEWTON_STEPS = 12
#: Newton's method stops at steps of this length: it doubles the digits, so what is left is below float64's.
SETTLED = 1e-9
#: In the place of zero, where a length divides.
TINY = 1e-12
#: Radians beyond the border of a picture all around that are a matter of rounding.
ROUNDED = 1e-6
#: Imaginary part of a root, over its size, that is a matter of rounding.
FLAT = 1e-9
#: How far from its position, in pixels, a point may be imaged that counts as its inverse.
MISSED = 1e-3
#: Bytes that the tables of one capture may take. A pixel takes 8, an RGB picture 3.
MOST_BYTES = 4 << 30


def distort(u: Tensor, v: Tensor, coefficients: Tensor, model: int = PERSPECTIVE) -> tuple[Tensor, Tensor]:
    """The lens model: where the lens puts the ideal point (u, v); NaN from where on the model folds over.

    The point of a perspective or an FOV lens lies on the plane at distance 1; that of a fisheye has the length of the
    angle to the optical axis. With r = |(u, v)| the models are

    - perspective, OpenCV's rational one: the factor (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6),
      and the tangential terms of p1 and p2;
    - fisheye, COLMAP's THIN_PRISM_FISHEYE: the factor 1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8, the tangential terms,
      s1 r^2 and s2 r^2. OpenCV's fisheye has k1 to k4 alone;
    - FOV, COLMAP's: the factor atan(2 r tan(omega / 2)) / (r omega);
    - equirectangular, of pictures all around: none. (u, v) are the angles to the right and downwards, so that fx and fy
      are pixels a radian.

    Source: OpenCV, "Camera Calibration and 3D Reconstruction" and "Fisheye camera model"; COLMAP, "Camera Models";
    Devernay and Faugeras, "Straight lines have to be straight", 2001, for FOV.

    Args:
        u: [n].
        v: [n].
        coefficients: [8]: (k1, k2, p1, p2, k3, k4, k5, k6), of a fisheye (k1, k2, p1, p2, k3, k4, s1, s2), of an FOV
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
    """The length of (u, v) from which on the radial factor brings points back towards the middle, or infinity.

    Fits are good inside the image that they were made of. Beyond it a polynomial may turn, and would show again what
    lies far outside.

    Args:
        terms: The coefficients of `distort`, but for those of an FOV lens, which never folds.
        model: PERSPECTIVE, FISHEYE or EQUIRECTANGULAR.
    """
    k1, k2, _, _, k3, k4, k5, k6 = terms
    above = [1, k1, k2, k3, k4] if model == FISHEYE else [1, k1, k2, k3]  # of r^2
    below = [1] if model == FISHEYE else [1, k4, k5, k6]
    slope = [0.0] * (len(above) + len(below) - 1)  # of r above / below, times below^2
    for i, a in enumerate(above):
        for j, b in enumerate(below):
            slope[i + j] += (1 + 2 * i - 2 * j) * a * b
    inverses = torch.cat((_inverse_roots(slope), _inverse_roots(below)))
    real = inverses.real[(inverses.real > 0) & (inverses.imag.abs() < FLAT * inverses.abs())]
    return 1 / math.sqrt(float(real.max())) if len(real) else math.inf


def _inverse_roots(factors: Sequence[float]) -> Tensor:
    """1 / root of a polynomial, complex128, by the factors of its powers; that of 0 is 1.

    The inverses are the eigenvalues of a matrix without a division, which tiny factors do not disturb.
    """
    matrix = torch.diag(torch.ones(len(factors) - 1, dtype=torch.float64), -1)[:-1, :-1]
    matrix[:1] -= torch.tensor(factors[1:], dtype=torch.float64)
    return torch.linalg.eigvals(matrix)


def undistort(u: Tensor, v: Tensor, coefficients: Tensor, model: int = PERSPECTIVE) -> tuple[Tensor, Tensor]:
    """Inverse of `distort`: that of FOV in closed form, and of the others by Newton's method from the distorted point.

    Converges quadratically wherever the lens model is invertible between the start and the solution, which holds inside
    the image of any lens this model describes. Give float64 for an error below a millionth of a pixel.
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
    """The image (a, b) of (u, v) under the polynomials, and the derivatives da/du, da/dv, db/du, db/dv."""
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
    """Directions through positions in the image of one lens.

    Args:
        x: [n], to the right, in pixels; the centre of the first column is at 0.5.
        y: [n], downwards.
        intrinsics: [4], (fx, fy, cx, cy) in pixels.
        coefficients: [8], see `distort`.
        model: PERSPECTIVE, FISHEYE, FOV or EQUIRECTANGULAR.

    Returns:
        (float64 [n, 3] of unit length in the camera's OpenGL axes, bool [n] whether the lens images that direction
        there: a model that folds over inside the image, or a fisheye in its corners, has no ray for some positions).
    """
    fx, fy, cx, cy = intrinsics.double().tolist()
    u, v = (x.double() - cx) / fx, (y.double() - cy) / fy
    a, b = undistort(u, v, coefficients, model)
    again, and_again = distort(a, b, coefficients, model)
    there = torch.maximum((again - u).abs() * fx, (and_again - v).abs() * fy) < MISSED
    ahead = torch.ones_like(a)
    if model == FISHEYE:
        angle = torch.hypot(a, b)
        there &= angle < math.pi
        share = torch.sinc(angle / math.pi)  # sin(angle) / angle
        a, b, ahead = a * share, b * share, angle.cos()
    elif model == EQUIRECTANGULAR:
        there &= (a.abs() < math.pi + ROUNDED) & (b.abs() < math.pi / 2 + ROUNDED)
        a, b, ahead = a.sin() * b.cos(), b.sin(), a.cos() * b.cos()
    return torch.nn.functional.normalize(torch.stack((a, -b, -ahead), dim=-1), dim=-1), there


class LensTables:
    """The directions of all pixels of l lenses, and which have one, computed on first use and kept on each device that
    asks.

    A direction (x, y, z) in the camera's axes is kept as its stereographic projection (x, -y) / (1 - z), which two
    numbers of float32 hold for every direction but straight back.

    Args:
        lenses: [l, 13], intrinsics, coefficients and model of each.
        width: Of the images, in pixels.
        height: Of the images, in pixels.
    """

    def __init__(self, lenses: Tensor, width: int, height: int) -> None:
        size = 8 * len(lenses) * width * height
        if size > MOST_BYTES:
            raise ValueError(
                f"the ray tables of {len(lenses)} lenses of {width} x {height} pixels take {size / 2**30:.1f} GiB, at "
                f"most {MOST_BYTES >> 30} GiB; reduce the images (--downscale), or give all pictures one lens"
            )
        self._lenses, self._width, self._height = lenses.double().cpu(), width, height
        self._on: dict[torch.device, Tensor] = {}
        self._there = torch.empty(0, dtype=torch.bool)

    def on(self, device: torch.device) -> Tensor:
        """float32 [l, h, w, 2] on a device."""
        if not self._on:
            self._on[torch.device("cpu")] = self._computed()
        if device not in self._on:
            self._on[device] = self._on[torch.device("cpu")].to(device)
        return self._on[device]

    def there(self, lens: int) -> Tensor:
        """The pixels of a lens that have a direction, bool [h, w] on the CPU."""
        self.on(torch.device("cpu"))
        return self._there[lens]

    def _computed(self) -> Tensor:
        tables = torch.empty(len(self._lenses), self._height, self._width, 2)
        self._there = torch.empty(tables.shape[:3], dtype=torch.bool)
        y, x = torch.meshgrid(torch.arange(self._height) + 0.5, torch.arange(self._width) + 0.5, indexing="ij")
        for table, there, lens in zip(tables, self._there, self._lenses):
            directions, seen = unproject(x, y, lens[:4], lens[4:12], int(lens[12]))
            there.copy_(seen)
            right, up, back = directions.unbind(-1)
            # a position without a ray may have no direction either
            table.copy_((torch.stack((right, -up), dim=-1) / (1 - back)[..., None]).nan_to_num(0.0, 0.0, 0.0))
        return tables
