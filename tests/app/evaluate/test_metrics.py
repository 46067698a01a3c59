"""Tests of PSNR and SSIM against scores of other programs, and of SSIM against a slow loop by its definition."""

import itertools
import math

import pytest
import torch
from helpers import refuses
from pictures_by_formula import FIGURES, pictures_by_formula

from voronerf.app.evaluate.metrics import psnr, ssim
from voronerf.app.evaluate.scores import ViewScore, mean_scores


def pictures(height, width):
    generator = torch.Generator().manual_seed(height)
    truth = torch.rand(height, width, 3, generator=generator) * torch.linspace(0, 1, width)[None, :, None]
    return (truth + 0.1 * torch.randn(height, width, 3, generator=generator)).clamp(0, 1), truth


def slow_ssim(image, truth, size):
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


@pytest.mark.parametrize(("height", "width", "window"), [(11, 11, 11), (8, 8, 7)])
def test_ssim_against_slow_loop(height, width, window):
    image, truth = pictures(height, width)
    assert float(ssim(image, truth)) == pytest.approx(slow_ssim(image, truth, window), abs=1e-6)


def test_ssim_limits():
    image, truth = pictures(20, 20)
    assert float(ssim(image[:1, :1], truth[:1, :1])) <= 1
    assert float(ssim(truth, truth)) == pytest.approx(1, abs=1e-12)
    assert float(ssim(torch.zeros(12, 12, 3), torch.ones(12, 12, 3))) < 1e-3
    stacked = ssim(torch.stack((image, truth)), torch.stack((truth, truth)))
    assert float(stacked) == pytest.approx((float(ssim(image, truth)) + 1) / 2)


def test_psnr_limits():
    _, truth = pictures(6, 7)
    assert float(psnr(truth, truth)) == math.inf
    assert float(psnr(torch.zeros(2, 2, 3), torch.full((2, 2, 3), 0.1))) == pytest.approx(20, abs=1e-5)


@pytest.mark.parametrize("score", [psnr, ssim])
def test_shapes(score):
    rule = "same shape [..., h, w, c] with pixels, got [2, 2, 3] and [2, 3, 3]"
    refuses(rule, score, torch.zeros(2, 2, 3), torch.zeros(2, 3, 3))
    refuses("same shape", score, torch.zeros(0, 2, 3), torch.zeros(0, 2, 3))


@pytest.mark.parametrize("figures", FIGURES, ids=lambda figures: f"{figures.height}x{figures.width}")
def test_against_other_programs(figures):
    image, truth = pictures_by_formula(figures.height, figures.width)
    scores = [float(score(torch.from_numpy(image), torch.from_numpy(truth))) for score in (psnr, ssim)]
    assert scores[0] == pytest.approx(figures.psnr, abs=1e-9)
    assert scores[1] == pytest.approx(figures.ssim, abs=1e-12)


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
