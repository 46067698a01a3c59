"""PSNR and SSIM. Images are [..., h, w, c] in 0..1; scores are float64 scalars."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import conv2d

WINDOW, SIGMA = 11, 1.5
K1, K2 = 0.01, 0.03


def psnr(image: Tensor, truth: Tensor) -> Tensor:
    """Returns the peak signal-to-noise ratio in dB, -10 log10 of the mean squared error; infinite for equal images.

    Raises:
        ValueError: the shapes differ.

    Examples:
        >>> import torch
        >>> from voronerf.app.evaluate import psnr
        >>> truth = torch.zeros(8, 8, 3)
        >>> psnr(truth + 0.1, truth).round(decimals=4)
        tensor(20., dtype=torch.float64)
    """
    _check_same("psnr", image, truth)
    return -10 * torch.log10((image.double() - truth.double()).square().mean())


def ssim(image: Tensor, truth: Tensor) -> Tensor:
    """Returns the structural similarity (Wang et al. 2004), the mean over pixels and channels.

    The definition follows the NeRF literature (mip-NeRF's `compute_ssim`): on colours, with a Gaussian window of
    11 x 11 pixels and sigma 1.5 that lies inside the image, K1 = 0.01 and K2 = 0.03. Variances are clamped so that
    rounding does not make them negative. For an image with a side below 11 pixels, the window is the largest odd one
    that fits.

    Args:
        image: [..., h, w, c] in 0..1.
        truth: [..., h, w, c] in 0..1, the reference image.

    Raises:
        ValueError: the shapes differ.

    Examples:
        >>> import torch
        >>> from voronerf.app.evaluate import ssim
        >>> truth = torch.linspace(0, 1, 256).reshape(16, 16, 1)
        >>> ssim(truth, truth), ssim(1 - truth, truth) < 0
        (tensor(1., dtype=torch.float64), tensor(True))
    """
    _check_same("ssim", image, truth)
    height, width, channels = image.shape[-3:]

    def planes(picture: Tensor) -> Tensor:
        return picture.double().reshape(-1, height, width, channels).permute(0, 3, 1, 2).reshape(-1, 1, height, width)

    x, y = planes(image), planes(truth)
    rows, columns = _gaussian(height, x.device), _gaussian(width, x.device)

    def blurred(picture: Tensor) -> Tensor:
        return conv2d(conv2d(picture, rows[None, None, :, None]), columns[None, None, None, :])

    mean_x, mean_y = blurred(x), blurred(y)
    variance_x = (blurred(x * x) - mean_x * mean_x).clamp_min(0)
    variance_y = (blurred(y * y) - mean_y * mean_y).clamp_min(0)
    covariance = blurred(x * y) - mean_x * mean_y
    bound = (variance_x * variance_y).sqrt()
    covariance = torch.minimum(torch.maximum(covariance, -bound), bound)
    c1, c2 = K1**2, K2**2
    similarity = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    return (similarity / ((mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2))).mean()


def _gaussian(extent: int, device: torch.device) -> Tensor:
    """Returns the Gaussian window along one axis, with sum 1, at most `extent` wide."""
    size = min(WINDOW, extent if extent % 2 else extent - 1)
    offset = torch.arange(size, dtype=torch.float64, device=device) - size // 2
    weight = torch.exp(-0.5 * (offset / SIGMA) ** 2)
    return weight / weight.sum()


def _check_same(name: str, image: Tensor, truth: Tensor) -> None:
    if image.shape != truth.shape or image.dim() < 3 or 0 in image.shape:
        raise ValueError(
            f"{name}: image and truth must have the same shape [..., h, w, c] with pixels, "
            f"got {list(image.shape)} and {list(truth.shape)}"
        )
