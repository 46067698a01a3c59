"""Tests of PSNR and SSIM against slow loops that follow their definitions, scipy, and scores of other programs."""

import itertools
import math

import numpy as np
import pytest
import torch
from helpers import refuses
from pictures_by_formula import FIGURES, pictures_by_formula
from scipy.ndimage import gaussian_filter

from voronerf.app.evaluate.metrics import psnr, ssim
from voronerf.app.evaluate.scores import ViewScore, mean_scores


def pictures(height, width):
    generator = torch.Generator().manual_seed(height)
    truth = torch.rand(height, width, 3, generator=generator) * torch.linspace(0, 1, width)[None, :, None]
    return (truth + 0.1 * torch.randn(height, width, 3, generator=generator)).clamp(0, 1), truth


def slow_ssim(image, truth, size=11):
    """Computes SSIM in a loop over windows and channels."""
    places, half = list(itertools.product(range(size), repeat=2)), size // 2
    weights = [math.exp(-((y - half) ** 2 + (x - half) ** 2) / (2 * 1.5**2)) for y, x in places]
    weights = [weight / sum(weights) for weight in weights]
    height, width, channels = image.shape
    scores, c1, c2 = [], 0.01**2, 0.03**2
    for c, top, left in itertools.product(range(channels), range(height - size + 1), range(width - size + 1)):
        a, b = ([float(p[top + y, left + x, c]) for y, x in places] for p in (image, truth))
        mean_a, mean_b = (sum(w * v for w, v in zip(weights, values)) for values in (a, b))
        var_a = sum(w * (p - mean_a) ** 2 for w, p in zip(weights, a))
        var_b = sum(w * (q - mean_b) ** 2 for w, q in zip(weights, b))
        both = sum(w * (p - mean_a) * (q - mean_b) for w, p, q in zip(weights, a, b))
        luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
        scores.append(luminance * (2 * both + c2) / (var_a + var_b + c2))
    return sum(scores) / len(scores)


@pytest.mark.parametrize(("height", "width"), [(11, 11), (14, 19)])
def test_ssim_against_slow_loop(height, width):
    image, truth = pictures(height, width)
    assert float(ssim(image, truth)) == pytest.approx(slow_ssim(image, truth), abs=1e-6)


def test_ssim_of_small_images_uses_a_smaller_window():
    image, truth = pictures(8, 8)
    assert float(ssim(image, truth)) == pytest.approx(slow_ssim(image, truth, 7), abs=1e-6)
    assert float(ssim(image[:1, :1], truth[:1, :1])) <= 1


def test_ssim_limits():
    image, truth = pictures(20, 20)
    assert float(ssim(truth, truth)) == pytest.approx(1, abs=1e-12)
    assert float(ssim(torch.zeros(12, 12, 3), torch.ones(12, 12, 3))) < 1e-3
    stacked = ssim(torch.stack((image, truth)), torch.stack((truth, truth)))
    assert float(stacked) == pytest.approx((float(ssim(image, truth)) + 1) / 2)


def test_psnr_against_slow_loop():
    image, truth = pictures(6, 7)
    squares = [(a - b) ** 2 for a, b in zip(image.flatten().tolist(), truth.flatten().tolist())]
    assert float(psnr(image, truth)) == pytest.approx(-10 * math.log10(sum(squares) / len(squares)))
    assert float(psnr(truth, truth)) == math.inf
    assert float(psnr(torch.zeros(2, 2, 3), torch.full((2, 2, 3), 0.1))) == pytest.approx(20, abs=1e-5)


@pytest.mark.parametrize("score", [psnr, ssim])
def test_shapes(score):
    rule = "same shape [..., h, w, c] with pixels, got [2, 2, 3] and [2, 3, 3]"
    refuses(rule, score, torch.zeros(2, 2, 3), torch.zeros(2, 3, 3))
    refuses("same shape", score, torch.zeros(0, 2, 3), torch.zeros(0, 2, 3))


def scipy_ssim(image, truth):
    """Computes SSIM with scipy's Gaussian filter of sigma 1.5, truncated to 11 x 11 pixels like SSIM's window."""
    scores = []
    for a, b in zip(np.moveaxis(image.astype(np.float64), -1, 0), np.moveaxis(truth.astype(np.float64), -1, 0)):
        mean_a, mean_b, aa, bb, ab = (
            gaussian_filter(plane, 1.5, truncate=3.5)[5:-5, 5:-5] for plane in (a, b, a * a, b * b, a * b)
        )
        luminance = (2 * mean_a * mean_b + 1e-4) / (mean_a**2 + mean_b**2 + 1e-4)
        contrast = (2 * (ab - mean_a * mean_b) + 9e-4) / (aa - mean_a**2 + bb - mean_b**2 + 9e-4)
        scores.append((luminance * contrast).mean())
    return float(np.mean(scores))


@pytest.mark.parametrize("figures", FIGURES, ids=lambda figures: f"{figures.height}x{figures.width}")
def test_against_other_programs(figures):
    image, truth = pictures_by_formula(figures.height, figures.width)
    scores = [float(score(torch.from_numpy(image), torch.from_numpy(truth))) for score in (psnr, ssim)]
    assert scores[0] == pytest.approx(figures.psnr, abs=1e-9)
    assert scores[1] == pytest.approx(figures.ssim, abs=1e-12)
    assert scores[1] == pytest.approx(scipy_ssim(image, truth), abs=1e-9)


def test_means_and_the_psnr_of_the_mean_error():
    scores = [ViewScore("a", 20.0, 0.5, 0.1), ViewScore("b", 30.0, 0.7, 0.3)]
    means = mean_scores(scores)
    assert means["psnr"] == pytest.approx(25) and means["ssim"] == pytest.approx(0.6)
    assert means["lpips"] == pytest.approx(0.2)
    assert means["psnr_of_mean_error"] == pytest.approx(-10 * math.log10((0.01 + 0.001) / 2))
    assert mean_scores([*scores, ViewScore("c", 25.0, 0.5)])["lpips"] is None
    assert mean_scores([ViewScore("perfect", math.inf, 1.0)])["psnr_of_mean_error"] == math.inf
    # NaN scores do not count as perfect.
    scores = [ViewScore("a", 20.0, 0.5, None), ViewScore("b", math.nan, math.nan, None)]
    assert math.isnan(mean_scores(scores)["psnr_of_mean_error"])
