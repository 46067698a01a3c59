"""Pairs of images computed from formulas, and the scores that other programs give them.

PSNR and SSIM are from scikit-image 0.26.0 (Gaussian window, sigma 1.5, population covariance, data range 1). LPIPS is
from the lpips package 0.1.4 (net "alex", version 0.1, in float64) on torch 2.13.0. torchmetrics 1.9.0 agrees: PSNR to
2e-6 dB (it divides in float32), LPIPS to the last bit of float32. The SSIM of torchmetrics agrees to 1e-15 away from
the border, which it pads by reflection; its mean includes the border and is 0.9032 for 100 x 100.
"""

from typing import NamedTuple

import numpy as np


class Figures(NamedTuple):
    """The scores of one pair of images."""

    height: int
    width: int
    psnr: float
    ssim: float
    lpips: float


FIGURES = (
    Figures(31, 31, 25.431348964055775, 0.8575218533874093, 0.001245111696277594),
    Figures(48, 37, 26.621486232134348, 0.8973983166515631, 0.004180760217845657),
    Figures(100, 100, 25.497203827882558, 0.8810854004345456, 0.013704243885585944),
    Figures(64, 128, 28.582678144318567, 0.9429348304343667, 0.004077815694910024),
)


def pictures_by_formula(height, width):
    """Returns (image, truth), float32 [h, w, 3] in 0..1: waves and squares in a disc, on white."""
    y, x, c = np.meshgrid(np.arange(height), np.arange(width), np.arange(3), indexing="ij")
    truth = 0.5 + 0.3 * np.sin(0.31 * x + 0.7 * c) * np.cos(0.23 * y) + 0.2 * (((x // 9 + y // 7) % 2) - 0.5)
    image = truth + 0.08 * np.sin(1.7 * x + 2.3 * y + c) + 0.05 * np.cos(0.05 * x * y)
    white = (x - width / 2) ** 2 + (y - height / 2) ** 2 > (0.45 * min(height, width)) ** 2
    image, truth = (np.clip(np.where(white, 1.0, p), 0, 1).astype(np.float32) for p in (image, truth))
    return image, truth
