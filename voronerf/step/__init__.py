"""A training step as an object: rays in, loss and gradients out; and what becomes of the cells between steps."""

from voronerf.step.cells import Cells, SplitRule
from voronerf.step.ray_loss import Batch, Found, RayLoss
from voronerf.step.schedule import PlannedSplit
from voronerf.step.step import Step

__all__ = ["Batch", "Cells", "Found", "PlannedSplit", "RayLoss", "SplitRule", "Step"]
