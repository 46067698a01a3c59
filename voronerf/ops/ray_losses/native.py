"""The losses along rays of the compiled module, on the CPU."""

from __future__ import annotations

import torch

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import Op
from voronerf.ops._core.declare import Memory, declared
from voronerf.ops.ray_losses.reference import EDGE, NEARBY


def _compiled(op: str, struct: type, slopes: tuple[str, ...], rays: str, **constants: float) -> Op:
    inputs = declared(op).inputs(struct, offsets="ray_offsets", **constants)
    parameters = inputs, "loss", *slopes, Memory(torch.float32, rays)
    return declared(op).compiled_op(f"{op}_native", op, *parameters, devices=("cpu",))


_structs = native.compiled
sparse_depth_loss = _compiled("sparse_depth_loss", _structs.SparseDepthInputs, ("of_weights",), "s", nearby=NEARBY)
smooth_depth_loss = _compiled("smooth_depth_loss", _structs.SmoothDepthInputs, ("of_weights",), "r", edge=EDGE)
surface_loss = _compiled("surface_loss", _structs.SurfaceInputs, ("of_weights", "of_density"), "r")
