"""Renders a camera in a scene, or a part of its picture."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from voronerf.app.scenes import Scene
from voronerf.nerf.cameras import Cameras
from voronerf.nerf.renderer import RenderedImage, Renderer


def render_camera(
    renderer: Renderer, scene: Scene, cameras: Cameras, index: int, *, heaviest: bool = True, fill: bool = True
) -> RenderedImage:
    """Renders one of several cameras on the background of a scene, without randomness, on the renderer's device.

    In a scene without background or box, such as photographs, holes of a picture take the colours beside them; without
    ``fill`` they are black. Pixels without a ray are black too.
    """
    device = renderer.device
    image = renderer.train(False).image(
        cameras.to(device),
        index,
        near=scene.near,
        far=scene.far,
        box=None if scene.box is None else scene.box.to(device),
        background=scene.background_colour(device),
        heaviest=heaviest,
    )
    if not fill or scene.background is not None or scene.box is not None:
        return image
    filled, has_ray = fill_holes(image.colour, image.opacity), cameras.has_ray(index)
    return image._replace(colour=filled if has_ray is None else filled * has_ray[..., None].to(device))


def fill_holes(colour: Tensor, opacity: Tensor) -> Tensor:
    """Fills the transparent parts of a picture [h, w, 3] with the colours beside them.

    Each level of an image pyramid fills the transparent parts of the next finer level (Gortler et al. 1996, "The
    Lumigraph", section 3.4).

    Args:
        colour: [h, w, 3], multiplied by the opacity.
        opacity: [h, w], 0..1.
    """
    levels = [torch.cat((colour, opacity[..., None]), -1).permute(2, 0, 1)[None]]
    while max(levels[-1].shape[2:]) > 1:
        summed = avg_pool2d(levels[-1], 2, ceil_mode=True, count_include_pad=False, divisor_override=1)
        levels.append(summed / summed[:, 3:].clamp_min(1))
    filled = levels.pop()
    while levels:
        finer = levels.pop()
        behind = interpolate(filled[:, :3], finer.shape[2:], mode="bilinear", align_corners=False)
        filled = finer[:, :3] + (1 - finer[:, 3:]).clamp_min(0) * behind
    return filled[0, :3].permute(1, 2, 0)


def crop_camera(camera: Cameras, left: int, top: int, width: int, height: int) -> Cameras:
    """Returns a camera that sees a rectangle of `width` x `height` pixels of another camera."""
    moved = camera.intrinsics - camera.intrinsics.new_tensor((0, 0, left, top))
    return replace(camera, intrinsics=moved, width=width, height=height, sizes=None)
