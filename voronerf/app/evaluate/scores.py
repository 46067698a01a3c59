"""Scores of a trained field on the test views."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from voronerf.app.evaluate.lpips import Lpips
from voronerf.app.evaluate.metrics import psnr, ssim
from voronerf.app.render.camera import render_camera
from voronerf.app.scenes import Scene
from voronerf.nerf.renderer import RenderedImage, Renderer


@dataclass(frozen=True)
class ViewScore:
    """PSNR in dB, SSIM and LPIPS (None without its weights) of one view, on the scene's background (white).

    Examples:
        >>> from voronerf.app.evaluate import ViewScore
        >>> ViewScore("r_0", psnr=30.0, ssim=0.95)
        ViewScore(name='r_0', psnr=30.0, ssim=0.95, lpips=None)
    """

    name: str
    psnr: float
    ssim: float
    lpips: float | None = None


def view_numbers(count: int, views: int | None) -> list[int]:
    """``views`` of ``count`` test views, evenly spread from the first; all of them for None."""
    if views is None or views >= count:
        return list(range(count))
    return [i * count // views for i in range(views)]


def render_view(renderer: Renderer, scene: Scene, view: int, *, heaviest: bool = True) -> RenderedImage:
    """A test view of a scene, see :func:`render_camera`."""
    return render_camera(renderer, scene, scene.test.cameras, view, heaviest=heaviest)


def evaluate(
    renderer: Renderer,
    scene: Scene,
    *,
    views: int | Sequence[int] | None = None,
    lpips: Lpips | None = None,
    stop: Callable[[], bool] | None = None,
) -> list[ViewScore]:
    """PSNR, SSIM and, where given, LPIPS of test views, until ``stop`` is true.

    ``views`` are so many, evenly spread, or these, by their numbers; None is all.

    PSNR leaves out the pixels that a mask leaves out. For SSIM and LPIPS these pixels have the colour of the truth.

    Examples:
        >>> from voronerf import NeRF
        >>> from voronerf.app.scenes import load_scene
        >>> from voronerf.app.evaluate import evaluate
        >>> from voronerf.nerf import Renderer, Stratified
        >>> scene = load_scene("builtin", downscale=20)
        >>> renderer = Renderer({"field": NeRF(width=16, depth=2)}, Stratified(8))
        >>> [score.name for score in evaluate(renderer, scene, views=2)]
        ['test_000', 'test_012']
    """
    scores = []
    chosen = views if isinstance(views, Sequence) else view_numbers(len(scene.test.names), views)
    for view in chosen:
        if stop is not None and stop():
            break
        image = render_view(renderer, scene, view, heaviest=False)
        target = scene.test.truth(view, scene.background_colour()).to(renderer.device)
        colour = image.colour.clamp(0, 1)
        kept = scene.test.mask(view)
        if kept is None:
            noise = psnr(colour, target)
        else:
            kept = kept.to(renderer.device)
            colour = torch.where(kept[..., None], colour, target)
            noise = psnr(colour[kept][None], target[kept][None])
        perceived = None if lpips is None else float(lpips(colour, target))
        name = scene.test.names[view]
        scores.append(ViewScore(name, float(noise), float(ssim(colour, target)), perceived))
    return scores


def mean_scores(scores: list[ViewScore]) -> dict[str, float | None]:
    """Means per image, as the literature's tables have them, and the PSNR of the mean squared error over all views.

    The latter, "psnr_of_mean_error", is what the paper's curves show; it is never above the mean of the PSNRs. "lpips"
    is None unless every view has one.

    Examples:
        >>> from voronerf.app.evaluate import ViewScore, mean_scores
        >>> means = mean_scores([ViewScore("r_0", 20.0, 0.9), ViewScore("r_1", 30.0, 0.95)])
        >>> means["psnr"], round(means["psnr_of_mean_error"], 2), means["lpips"]
        (25.0, 22.6, None)
    """
    perceived = [s.lpips for s in scores if s.lpips is not None]
    error = sum(10 ** (-s.psnr / 10) for s in scores) / len(scores)
    return {
        "psnr": sum(s.psnr for s in scores) / len(scores),
        "ssim": sum(s.ssim for s in scores) / len(scores),
        "lpips": sum(perceived) / len(scores) if len(perceived) == len(scores) else None,
        "psnr_of_mean_error": math.inf if error == 0 else -10 * math.log10(error),
    }
