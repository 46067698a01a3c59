"""The pieces of a radiance-field training, each usable alone: cameras, samplers, rendering, the loss, splits."""

from voronerf.nerf.adam import Adam
from voronerf.nerf.batches import RayBatches
from voronerf.nerf.cameras import Cameras, Rays, focus_point, orbit_cameras, turntable_cameras
from voronerf.nerf.contraction import Contraction, Perspective
from voronerf.nerf.field import DirectionPerSample, Field
from voronerf.nerf.loss import Batch, RayLoss, RenderOutput
from voronerf.nerf.marching import RayColours, render_until_opaque
from voronerf.nerf.occupancy import OccupancyGrid
from voronerf.nerf.rays import intersect_box
from voronerf.nerf.renderer import RenderedImage, Renderer, render_rays
from voronerf.nerf.samplers import SAMPLERS, Hierarchical, Occupancy, Sampler, Stratified
from voronerf.nerf.sampling import stratified_depths
from voronerf.nerf.split import PlannedSplit, SplitDone, SplitStrategy, Strategy
from voronerf.nerf.step import StepOutput, TrainingStep
from voronerf.nerf.volume import Rendered, Samples, Space

__all__ = [
    "SAMPLERS",
    "Adam",
    "Batch",
    "Cameras",
    "Contraction",
    "DirectionPerSample",
    "Field",
    "Hierarchical",
    "Occupancy",
    "OccupancyGrid",
    "Perspective",
    "PlannedSplit",
    "RayBatches",
    "RayColours",
    "RayLoss",
    "Rays",
    "RenderOutput",
    "Rendered",
    "RenderedImage",
    "Renderer",
    "Sampler",
    "Samples",
    "Space",
    "SplitDone",
    "SplitStrategy",
    "StepOutput",
    "Strategy",
    "Stratified",
    "TrainingStep",
    "focus_point",
    "intersect_box",
    "orbit_cameras",
    "render_rays",
    "render_until_opaque",
    "stratified_depths",
    "turntable_cameras",
]
