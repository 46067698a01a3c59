"""The pieces of a radiance-field training, each usable alone: cameras, samplers, rendering, the loss, the cells."""

from voronerf.nerf.cameras import Cameras, Rays, focus_point, orbit_cameras, turntable_cameras
from voronerf.nerf.cells import Cells, SplitRule
from voronerf.nerf.contraction import Contraction, Perspective
from voronerf.nerf.field import Field
from voronerf.nerf.marching import RayColours, render_until_opaque
from voronerf.nerf.occupancy import OccupancyGrid
from voronerf.nerf.ray_loss import Batch, RayLoss, RenderOutput
from voronerf.nerf.rays import intersect_box
from voronerf.nerf.renderer import RenderedImage, Renderer, render_rays
from voronerf.nerf.samplers import SAMPLERS, Hierarchical, Occupancy, Proposal, Stratified
from voronerf.nerf.sampling import stratified_depths
from voronerf.nerf.schedule import PlannedSplit
from voronerf.nerf.step import Step
from voronerf.nerf.volume import Rendered, Samples, Space

__all__ = [
    "SAMPLERS",
    "Batch",
    "Cameras",
    "Cells",
    "Contraction",
    "Field",
    "Hierarchical",
    "Occupancy",
    "OccupancyGrid",
    "Perspective",
    "PlannedSplit",
    "Proposal",
    "RayColours",
    "RayLoss",
    "Rays",
    "RenderOutput",
    "Rendered",
    "RenderedImage",
    "Renderer",
    "Samples",
    "Space",
    "SplitRule",
    "Step",
    "Stratified",
    "focus_point",
    "intersect_box",
    "orbit_cameras",
    "render_rays",
    "render_until_opaque",
    "stratified_depths",
    "turntable_cameras",
]
