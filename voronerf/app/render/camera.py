"""Renders a camera in a scene."""

from __future__ import annotations

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
