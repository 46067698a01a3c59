"""Scores and pictures of a trained scene: PSNR, SSIM, LPIPS, panels, videos, seams, slices, curves."""
