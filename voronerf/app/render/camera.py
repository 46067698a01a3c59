"""Renders a camera in a scene, or a part of its picture."""

from __future__ import annotations

from dataclasses import replace

from voronerf.app.scenes import Scene
from voronerf.nerf.cameras import Cameras
from voronerf.nerf.renderer import RenderedImage, Renderer


def render_camera(
    renderer: Renderer, scene: Scene, cameras: Cameras, index: int, *, heaviest: bool = True
) -> RenderedImage:
    """Renders one of several cameras on the background of a scene, without randomness; on the renderer's device."""
    device = renderer.device
    return renderer.train(False).image(
        cameras.to(device),
        index,
        near=scene.near,
        far=scene.far,
        box=None if scene.box is None else scene.box.to(device),
        background=scene.background_colour(device),
        heaviest=heaviest,
    )


def crop_camera(camera: Cameras, left: int, top: int, width: int, height: int) -> Cameras:
    """A camera that sees `width` x `height` pixels of another."""
    moved = camera.intrinsics - camera.intrinsics.new_tensor((0, 0, left, top))
    return replace(camera, intrinsics=moved, width=width, height=height, sizes=None)
