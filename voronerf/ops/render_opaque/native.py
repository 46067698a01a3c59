"""``render_opaque`` of the compiled module.

Each thread takes one wave of samples at a time through all steps, from marching to compositing, so that each thread
stores the intermediate values of only one wave. The function is not a custom op, because custom ops cannot take a
network.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import torch

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared
from voronerf.ops.formulas import RenderedRays
from voronerf.ops.locate_cell.native import check_tree, too_shallow
from voronerf.ops.march_rays.native import INPUTS
from voronerf.ops.nearest_centre.native import check_index
from voronerf.ops.network.cells import Cells, Sorted
from voronerf.ops.network.lowering import lower
from voronerf.ops.network.native import Run, inputs_of
from voronerf.ops.render_opaque import reference

_OP = declared("render_opaque")
_rays = _OP.inputs(
    native.compiled.MarchInputs, **{**INPUTS, "uniforms": None, "seed": None, "start": None, "max_samples": "samples"}
)
_options = _OP.inputs(native.compiled.SeeOptions)
_outputs = _OP.outputs(native.compiled.SeeOutputs)


@torch.no_grad()
def render_opaque(*flat: Any) -> RenderedRays:
    """Renders every ray until it is opaque, in float32; see ``voronerf.ops.render_opaque``."""
    arguments = _OP.Inputs._make(flat)
    network, cells, none = arguments.network, arguments.cells, torch.empty(0, dtype=torch.int32, device="cpu")
    centres, index, k = cells.centres, cells.centre_index, network.count(cells)
    inputs = [arguments.origins, arguments.directions][: len(network.program.inputs)]
    tensors = (*inputs, *network.parameters, centres)
    plain = all(tensor is None or tensor.dtype == torch.float32 for tensor in tensors)
    if not plain or torch.is_autocast_enabled("cpu"):
        composed: RenderedRays = partial(reference.render_opaque, backend="native")(*arguments)
        return composed
    program, parameters, names = network.program, network.parameters, network.names
    rows = Sorted(None, None, torch.zeros(k + 1, dtype=torch.int32, device="cpu"))
    ray_index = none if network.program.rays else None
    run = Run.of(program, parameters, names, inputs, ray_index, rows, torch.float32)
    lowered = lower(run.text)
    if k == 1:
        cells, centres, index = Cells(), None, None
    if cells.child_offsets is not None:
        check_tree(cells.child_offsets, cells.child, len(centres), "render_opaque")
    if index is not None:
        check_index("render_opaque", centres, index)
    seen: RenderedRays = _OP.allocate(arguments)
    outputs, compiled = _outputs(seen), native.compiled
    sound = compiled.render_opaque(
        lowered.program,
        inputs_of(lowered, run, 0, 0),
        _rays(arguments),
        compiled.SeeCells(
            centres=centres,
            child_offsets=cells.child_offsets,
            child=cells.child,
            centre_index=index,
            m=0 if centres is None else len(centres),
            depth=cells.depth,
        ),
        _options(arguments),
        outputs if arguments.heaviest else outputs._replace(heaviest=None),
        native.cpu(),
    )
    if not sound:
        raise too_shallow(cells.depth, "render_opaque")
    return seen if arguments.heaviest else seen._replace(heaviest=arguments.far)
