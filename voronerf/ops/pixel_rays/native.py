"""``pixel_rays`` of the compiled module. c images of h x w pixels, b rays."""

from __future__ import annotations

from typing import Any

from voronerf.ops._core import native
from voronerf.ops._core.checks import check_range
from voronerf.ops._core.declare import declared

_OP = declared("pixel_rays")
_inputs, _outputs = (
    _OP.inputs(native.compiled.PixelRaysInputs, pixels="index"),
    _OP.outputs(native.compiled.PixelRaysOutputs),
)


def _fault(arguments: Any) -> None:
    check_range("pixel_rays", "index", arguments.index, arguments.c * arguments.h * arguments.w)


pixel_rays = _OP.compiled_op("pixel_rays_native", "pixel_rays", _inputs, _outputs, fault=_fault)
