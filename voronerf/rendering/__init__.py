"""From cameras to rays, and from rays to colours. Of files, it knows those of camera paths alone."""

from voronerf.rendering.cameras import Cameras, Rays, focus_point, orbit_cameras, turntable_cameras
from voronerf.rendering.contraction import Contraction, Perspective
from voronerf.rendering.field import Field
from voronerf.rendering.marching import Seen, render_until_opaque
from voronerf.rendering.occupancy import OccupancyGrid
from voronerf.rendering.paths import CameraPath, read_camera_path, smooth_path, spiral_cameras, write_camera_path
from voronerf.rendering.rays import intersect_box
from voronerf.rendering.renderer import RenderedImage, Renderer, render_rays
from voronerf.rendering.samplers import SAMPLERS, Hierarchical, Occupancy, Proposal, Stratified
from voronerf.rendering.sampling import stratified_depths
from voronerf.rendering.volume import Rendered, Samples, Space

__all__ = [
    "SAMPLERS",
    "CameraPath",
    "Cameras",
    "Contraction",
    "Field",
    "Hierarchical",
    "Occupancy",
    "OccupancyGrid",
    "Perspective",
    "Proposal",
    "Rays",
    "Rendered",
    "RenderedImage",
    "Renderer",
    "Samples",
    "Seen",
    "Space",
    "Stratified",
    "focus_point",
    "intersect_box",
    "orbit_cameras",
    "read_camera_path",
    "render_rays",
    "render_until_opaque",
    "smooth_path",
    "spiral_cameras",
    "stratified_depths",
    "turntable_cameras",
    "write_camera_path",
]
