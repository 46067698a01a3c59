"""``observe_occupancy`` of the compiled module."""

from __future__ import annotations

import torch

from voronerf.ops._core import native
from voronerf.ops._core.declare import Memory, declared
from voronerf.ops.march_rays.native import space_of

_OP = declared("observe_occupancy")
_samples = _OP.inputs(native.compiled.ObservedSamples, space=space_of)
observe_occupancy = _OP.compiled_op(
    "observe_occupancy_native",
    "observe_occupancy",
    *(_samples, "density", "occupied"),
    *(Memory(torch.int32, "m"), Memory(torch.float32, "m")),  # the samples' voxels, and the voxels' old densities
)
