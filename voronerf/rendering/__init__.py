"""From cameras to rays, from rays to colours. Knows nothing of files."""

from voronerf.rendering.cameras import Cameras, Rays, focus_point, orbit_cameras, turntable_cameras
from voronerf.rendering.rays import intersect_box
from voronerf.rendering.sampling import stratified_depths
from voronerf.rendering.volume import Rendered, RenderedImage, render_image, render_rays

__all__ = [
    "Cameras",
    "Rays",
    "Rendered",
    "RenderedImage",
    "focus_point",
    "intersect_box",
    "orbit_cameras",
    "render_image",
    "render_rays",
    "stratified_depths",
    "turntable_cameras",
]
