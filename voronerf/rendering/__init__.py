"""From cameras to rays, and from rays to colours. This package does not read or write files."""

from voronerf.rendering.cameras import Cameras, Rays, focus_point, orbit_cameras, turntable_cameras
from voronerf.rendering.comparison import Comparison
from voronerf.rendering.contraction import Contraction, Perspective
from voronerf.rendering.field import Field
from voronerf.rendering.marching import Marched, render_marched, render_until_opaque
from voronerf.rendering.occupancy import OccupancyGrid
from voronerf.rendering.rays import intersect_box
from voronerf.rendering.renderer import RenderedImage, Renderer
from voronerf.rendering.sampling import stratified_depths
from voronerf.rendering.volume import Rendered, render_rays

__all__ = [
    "Cameras",
    "Comparison",
    "Contraction",
    "Field",
    "Marched",
    "OccupancyGrid",
    "Perspective",
    "Rays",
    "Rendered",
    "RenderedImage",
    "Renderer",
    "focus_point",
    "intersect_box",
    "orbit_cameras",
    "render_marched",
    "render_rays",
    "render_until_opaque",
    "stratified_depths",
    "turntable_cameras",
]
