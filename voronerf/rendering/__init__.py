"""From cameras to rays, and from rays to colours. Of files, it knows those of camera paths alone."""

from voronerf.rendering.cameras import Cameras, Rays, focus_point, orbit_cameras, turntable_cameras
from voronerf.rendering.comparison import Comparison
from voronerf.rendering.contraction import Contraction, Perspective
from voronerf.rendering.field import Field
from voronerf.rendering.marching import Marched, render_marched, render_until_opaque
from voronerf.rendering.occupancy import OccupancyGrid
from voronerf.rendering.paths import CameraPath, read_camera_path, smooth_path, spiral_cameras, write_camera_path
from voronerf.rendering.rays import intersect_box
from voronerf.rendering.renderer import RenderedImage, Renderer
from voronerf.rendering.sampling import stratified_depths
from voronerf.rendering.volume import Rendered, render_rays

__all__ = [
    "CameraPath",
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
    "read_camera_path",
    "render_marched",
    "render_rays",
    "render_until_opaque",
    "smooth_path",
    "spiral_cameras",
    "stratified_depths",
    "turntable_cameras",
    "write_camera_path",
]
