"""Spherical harmonics of directions. n directions."""

from __future__ import annotations

import torch
from torch import Tensor


def spherical_harmonics(directions: Tensor, degree: int) -> Tensor:
    """Bands 0 to degree - 1 as polynomials; see ``voronerf.ops.spherical_harmonics``."""
    wide = directions.to(torch.promote_types(directions.dtype, torch.float32))
    x, y, z = wide.unbind(1)
    # Constants: of band l and order m the square root of (2l + 1) (l - |m|)! / (4 pi (l + |m|)!), times the square root
    # of 2 where m is not 0, and the factors of the polynomial.
    bands = [
        [0.28209479177387814 + wide[:, :0].sum(1)],  # a constant, with a gradient of 0
        [-0.48860251190291987 * y, 0.48860251190291987 * z, -0.48860251190291987 * x],
        [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.94617469575755997 * z * z - 0.31539156525251999,
            -1.0925484305920792 * x * z,
            0.54627421529603959 * (x * x - y * y),
        ],
        [
            0.59004358992664352 * y * (y * y - 3 * x * x),
            2.8906114426405538 * x * y * z,
            0.45704579946446572 * y * (1 - 5 * z * z),
            0.3731763325901154 * z * (5 * z * z - 3),
            0.45704579946446572 * x * (1 - 5 * z * z),
            1.4453057213202769 * z * (x * x - y * y),
            0.59004358992664352 * x * (3 * y * y - x * x),
        ],
    ]
    return torch.stack([value for band in bands[:degree] for value in band], dim=1).to(directions.dtype)
