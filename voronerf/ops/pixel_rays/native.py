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


@_OP.custom_op("pixel_rays_native")
def pixel_rays(given: Any, found: Any) -> None:
    """Rays, where they meet the box, and colours; see ``voronerf.ops.pixel_rays``."""
    inputs, machine = _inputs(given), native.machine(given.poses)
    # Only on the CPU the compiled function says whether all pixels are in range.
    if native.compiled.pixel_rays(inputs, _outputs(found), machine) is False:
        check_range("pixel_rays", "index", given.index, inputs.c * inputs.h * inputs.w)
