"""Scores and pictures of a trained scene: PSNR, SSIM, LPIPS, panels, videos, curves.

Pictures are in ``panels``, ``plots`` and ``video``, which import matplotlib, Pillow or ffmpeg.
"""

from voronerf.app.evaluate.angles import nearest_angle
from voronerf.app.evaluate.lpips import Lpips, LpipsError, find_lpips
from voronerf.app.evaluate.metrics import psnr, ssim
from voronerf.app.evaluate.scores import ViewScore, evaluate, mean_scores

__all__ = [
    "Lpips",
    "LpipsError",
    "ViewScore",
    "evaluate",
    "find_lpips",
    "mean_scores",
    "nearest_angle",
    "psnr",
    "ssim",
]
