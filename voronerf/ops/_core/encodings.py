"""The table of encodings without parameters, used by programs, layer tables and the compiled module.

n rows, d encoded columns, L octaves. An encoding has one number, its size: the octaves, or the degree of spherical
harmonics.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor


class Encoding(NamedTuple):
    """An encoding of rows.

    Attributes:
        formula: (x [n, d], size) -> the encoding [n, columns] in the dtype of x, in PyTorch. The compiled module has a
            table row with the values and the gradient (csrc/encoding/encodings.h).
        columns: (d, size) -> the number of the encoding's columns.
        fits: (d, size) -> whether rows of d columns can be encoded with this size.
        octaves: the number of columns of x for one angle, if the encoding has sines and cosines of octaves: 1 for the
            angle, 2 for its mean and variance. 0 for any other encoding, which the compiled module computes by a
            formula for each row.
        positions: whether a layer table may use the encoding for positions.
        directions: whether a layer table may use the encoding for directions.
    """

    formula: Callable[[Tensor, int], Tensor]
    columns: Callable[[int, int], int]
    fits: Callable[[int, int], bool]
    octaves: int = 0
    positions: bool = True
    directions: bool = True


MOST_OCTAVES = 127
"""The largest number of octaves, since 2^128 overflows float32."""


def wide(x: Tensor) -> Tensor:
    """Promotes x to at least float32."""
    return x.to(torch.promote_types(x.dtype, torch.float32))


def frequency(x: Tensor, octaves: int) -> Tensor:
    """Computes ``frequency_encode`` with the input included: ``[x, sin x, cos x, sin 2x, cos 2x, sin 4x, ...]``."""
    parts = [wide(x)]
    for octave in range(octaves):
        angle = parts[0] * 2.0**octave
        parts += [angle.sin(), angle.cos()]
    return torch.cat(parts, dim=1).to(x.dtype)


def integrated(x: Tensor, octaves: int) -> Tensor:
    """Computes ``integrated_encode``; the columns of x are the means, then the variances."""
    mean, variance = wide(x).chunk(2, dim=1)
    parts = [mean[:, :0]]
    for octave in range(octaves):
        angle = mean * 2.0**octave
        blur = torch.exp(-0.5 * 4.0**octave * variance)
        parts += [angle.sin() * blur, angle.cos() * blur]
    return torch.cat(parts, dim=1).to(x.dtype)


def spherical(directions: Tensor, degree: int) -> Tensor:
    """Computes ``spherical_harmonics``: bands 0 to degree - 1 as polynomials."""
    direction = wide(directions)
    x, y, z = direction.unbind(1)
    constant, *others = harmonics(x, y, z, degree)
    zero = direction[:, :0].sum(1)  # gives the constant a gradient of 0
    return torch.stack([constant + zero, *others], dim=1).to(directions.dtype)


def harmonics(x: Any, y: Any, z: Any, degree: int) -> list[Any]:
    """Returns the real spherical harmonics of a direction; x, y and z may be of any type with products and differences.

    The constant of band l and order m is sqrt((2l + 1) (l - |m|)! / (4 pi (l + |m|)!)), times sqrt(2) if m is not 0,
    times the factors of the polynomial.
    """
    return [
        0.28209479177387814,
        -0.48860251190291987 * y,
        0.48860251190291987 * z,
        -0.48860251190291987 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.94617469575755997 * z * z - 0.31539156525251999,
        -1.0925484305920792 * x * z,
        0.54627421529603959 * (x * x - y * y),
        0.59004358992664352 * y * (y * y - 3 * x * x),
        2.8906114426405538 * x * y * z,
        0.45704579946446572 * y * (1 - 5 * z * z),
        0.3731763325901154 * z * (5 * z * z - 3),
        0.45704579946446572 * x * (1 - 5 * z * z),
        1.4453057213202769 * z * (x * x - y * y),
        0.59004358992664352 * x * (3 * y * y - x * x),
    ][: degree**2]


ENCODINGS = {
    "frequency": Encoding(
        frequency, lambda d, size: d * (1 + 2 * size), lambda d, size: size <= MOST_OCTAVES, octaves=1
    ),
    "integrated": Encoding(
        integrated,
        lambda d, size: d * size,
        lambda d, size: d > 0 and d % 2 == 0 and 1 <= size <= MOST_OCTAVES,
        octaves=2,
        directions=False,
    ),
    "spherical": Encoding(
        spherical, lambda d, size: size**2, lambda d, size: d == 3 and 1 <= size <= 4, positions=False
    ),
}
"""The encodings, by name in the compiled module."""
