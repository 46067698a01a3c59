"""Scores of a trained field on the test views."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from voronerf.app.evaluate.angles import FAR_ANGLE, nearest_angle
from voronerf.app.evaluate.lpips import Lpips
from voronerf.app.evaluate.metrics import psnr, ssim
from voronerf.app.render.camera import crop_camera, render_camera
from voronerf.app.scenes import Scene
from voronerf.nerf.cameras import Cameras
from voronerf.nerf.renderer import Renderer

#: Shows progress: takes a sequence and the task's name, and yields the items.
Track = Callable[[Sequence[Any], str], Iterable[Any]]


def in_silence(items: Sequence[Any], name: str) -> Iterable[Any]:
    """Returns the items of a sequence without showing progress."""
    return items


@dataclass(frozen=True)
class ViewScore:
    """PSNR in dB, SSIM and LPIPS (None without its weights) of one view, composited on the scene's background.

    ``angle`` is the angle in degrees between the view and the nearest training camera, see :func:`nearest_angle`.

    Examples:
        >>> from voronerf.app.evaluate import ViewScore
        >>> ViewScore("r_0", psnr=30.0, ssim=0.95)
        ViewScore(name='r_0', psnr=30.0, ssim=0.95, lpips=None, angle=None)
    """

    name: str
    psnr: float
    ssim: float
    lpips: float | None = None
    angle: float | None = None


def view_numbers(count: int, views: int | None) -> list[int]:
    """Returns the indices of ``views`` test views out of ``count``, evenly spaced from the first on; None means all."""
    if views is None or views >= count:
        return list(range(count))
    return [i * count // views for i in range(views)]


def evaluate(
    renderer: Renderer,
    scene: Scene,
    *,
    views: int | Sequence[int] | None = None,
    lpips: Lpips | None = None,
    middle: int = 1,
    stop: Callable[[], bool] | None = None,
    track: Track = in_silence,
) -> list[ViewScore]:
    """Scores test views by PSNR, SSIM and, if given, LPIPS.

    PSNR ignores masked pixels. For SSIM and LPIPS these pixels have the colour of the truth.

    Args:
        renderer: The field's renderer.
        scene: The scene with the test views.
        views: The number of views, evenly spread, or a list of their numbers; None for all.
        lpips: The LPIPS metric, or None.
        middle: The factor by which width and height are reduced: only the centre of each view is rendered and scored.
        stop: Called before each view but the first; True skips this view and the rest.
        track: Function that shows progress: takes a sequence and the task's name, and yields the items.

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
    scores: list[ViewScore] = []
    chosen = views if isinstance(views, Sequence) else view_numbers(len(scene.test.names), views)
    for view in track(chosen, "scores"):
        if scores and stop is not None and stop():
            break
        mask = scene.test.mask(view)
        camera, rows, columns = _middle_of(scene.test.cameras, view, middle, mask)
        image = render_camera(renderer, scene, camera, 0, heaviest=False)
        target = scene.test.truth(view, scene.background_colour())[rows, columns].to(renderer.device)
        colour = image.colour.clamp(0, 1)
        if mask is None:
            noise = psnr(colour, target)
        else:
            mask = mask[rows, columns].to(renderer.device)
            colour = torch.where(mask[..., None], colour, target)
            noise = psnr(colour[mask][None], target[mask][None])
        distance = None if lpips is None else float(lpips(colour, target))
        angle = nearest_angle(image, camera, 0, scene.train.cameras)
        scores.append(ViewScore(scene.test.names[view], float(noise), float(ssim(colour, target)), distance, angle))
    return scores


def _middle_of(cameras: Cameras, view: int, factor: int, mask: Tensor | None) -> tuple[Cameras, slice, slice]:
    """Returns a camera for the central part of a view, and the rows and columns of this part in the view.

    The part has the width and height of the view, both divided by `factor`. If the mask hides all of it, it lies around
    the visible pixel that is closest to the centre.
    """
    (width, height), camera = cameras.size(view), cameras[[view]]
    part = max(width // factor, 1), max(height // factor, 1)
    left, top = (width - part[0]) // 2, (height - part[1]) // 2
    if mask is not None and not mask[top : top + part[1], left : left + part[0]].any():
        pixels = mask.nonzero()
        y, x = pixels[(pixels - pixels.new_tensor([height // 2, width // 2])).square().sum(1).argmin()].tolist()
        left, top = min(max(x - part[0] // 2, 0), width - part[0]), min(max(y - part[1] // 2, 0), height - part[1])
    camera = crop_camera(camera, left, top, *part) if factor > 1 else camera
    return camera, slice(top, top + part[1]), slice(left, left + part[0])


def mean_scores(scores: list[ViewScore]) -> dict[str, float | None]:
    """Averages the scores over the views, like the tables in the literature.

    "psnr_of_mean_error" is the PSNR of the mean squared error over all views, as in the paper's curves; it is never
    above the mean of the PSNRs. "lpips" is None unless every view has one. "far_views" is the number of views more than
    `FAR_ANGLE` degrees from every training camera.

    Examples:
        >>> from voronerf.app.evaluate import ViewScore, mean_scores
        >>> means = mean_scores([ViewScore("r_0", 20.0, 0.9), ViewScore("r_1", 30.0, 0.95)])
        >>> means["psnr"], round(means["psnr_of_mean_error"], 2), means["lpips"]
        (25.0, 22.6, None)
    """
    distances = [s.lpips for s in scores if s.lpips is not None]
    error = sum(10 ** (-s.psnr / 10) for s in scores) / len(scores)
    return {
        "psnr": sum(s.psnr for s in scores) / len(scores),
        "ssim": sum(s.ssim for s in scores) / len(scores),
        "lpips": sum(distances) / len(scores) if len(distances) == len(scores) else None,
        "psnr_of_mean_error": math.inf if error == 0 else -10 * math.log10(error),
        "far_views": sum(s.angle is not None and s.angle > FAR_ANGLE for s in scores),
    }
