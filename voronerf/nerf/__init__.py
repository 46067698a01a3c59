"""The parts of a radiance-field training, each usable alone: cameras, samplers, rendering, the loss, cell splits."""

from voronerf.nerf.adam import Adam
from voronerf.nerf.batches import RayBatches, RaySource
from voronerf.nerf.cameras import Cameras, Rays, focus_point, orbit_cameras, turntable_cameras
from voronerf.nerf.contraction import Contraction, Perspective
from voronerf.nerf.distributed import Ranks
from voronerf.nerf.field import DirectionPerSample, Field
from voronerf.nerf.loss import RayLoss
from voronerf.nerf.occupancy import OccupancyGrid
from voronerf.nerf.rays import intersect_box
from voronerf.nerf.renderer import RenderedImage, Renderer, render_rays
from voronerf.nerf.replay import replayed
from voronerf.nerf.samplers import SAMPLERS, Hierarchical, Occupancy, Sampler, Stratified
from voronerf.nerf.sampling import stratified_depths
from voronerf.nerf.split import PlannedSplit, SplitDone, SplitStrategy, Strategy
from voronerf.nerf.step import StepOutput, TrainingStep
from voronerf.nerf.terms import LossAlongRays, RayValues, Slopes, SmoothDepth, SparseDepth, Surface, Term
from voronerf.nerf.volume import Batch, RayColours, Rendered, RenderOutput, Samples, Space

__all__ = [
    "SAMPLERS",
    "Adam",
    "Batch",
    "Cameras",
    "Contraction",
    "DirectionPerSample",
    "Field",
    "Hierarchical",
    "LossAlongRays",
    "Occupancy",
    "OccupancyGrid",
    "Perspective",
    "PlannedSplit",
    "Ranks",
    "RayBatches",
    "RayColours",
    "RayLoss",
    "RaySource",
    "RayValues",
    "Rays",
    "RenderOutput",
    "Rendered",
    "RenderedImage",
    "Renderer",
    "Sampler",
    "Samples",
    "Slopes",
    "SmoothDepth",
    "Space",
    "SparseDepth",
    "SplitDone",
    "SplitStrategy",
    "StepOutput",
    "Strategy",
    "Stratified",
    "Surface",
    "Term",
    "TrainingStep",
    "focus_point",
    "intersect_box",
    "orbit_cameras",
    "render_rays",
    "replayed",
    "stratified_depths",
    "turntable_cameras",
]
