"""``render_opaque`` of the compiled module: a wave of some thousand samples goes from grid to colours in the cache.

No custom op: nothing that is traced or differentiated renders pictures.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared
from voronerf.ops.grouped_mlp.network import Given, as_network
from voronerf.ops.grouped_program.lowering import lower
from voronerf.ops.grouped_program.native import program_inputs, program_of
from voronerf.ops.locate_cell.native import check_tree, too_shallow
from voronerf.ops.march_rays.native import INPUTS
from voronerf.ops.render_opaque import reference
from voronerf.ops.render_opaque.reference import RaySums

_OP = declared("render_opaque")
_rays = _OP.inputs(
    native.compiled.MarchInputs, **{**INPUTS, "uniforms": "None", "seed": "None", "start": "None", "most": "samples"}
)
_rule, _outputs = _OP.inputs(native.compiled.SeeRule), _OP.outputs(native.compiled.SeeOutputs)


@torch.no_grad()
def render_opaque(*flat: Any) -> RaySums:
    """Every ray up to the first surface, in float32; see ``voronerf.ops.render_opaque``."""
    given = _OP.Inputs._make(flat)
    network = given.network
    weights, biases, centres, features = network["weights"], network["biases"], network["centres"], network["features"]
    floats = (*weights, *biases, centres, features, network["directions"])
    plain = all(tensor is None or tensor.dtype == torch.float32 for tensor in floats)
    if not plain or torch.is_autocast_enabled("cpu"):
        narrow = network | {name: [_narrow(part) for part in network[name]] for name in ("weights", "biases")}
        narrow["features"] = _narrow(features)
        composed: RaySums = partial(reference.render_opaque, backend="native")(*given._replace(network=narrow))
        return composed
    ray_index = given.near.new_empty(0, dtype=torch.int32)  # of samples that are not there yet
    samples = Given(given.origins, weights, biases, network["layers"], network["directions"], ray_index, features)
    taken = as_network(samples, "render_opaque")
    rows = taken.rows(_no_offsets(weights[0]))
    lowered = lower(program_of(rows, taken.how).text, False)
    child_offsets, child, depth = network["child_offsets"], network["child"], network["depth"]
    if weights[0].shape[0] == 1:
        centres = child_offsets = child = None
    if child_offsets is not None:
        check_tree(child_offsets, child, len(centres), "render_opaque")
    found: RaySums = _OP.allocate(given)
    outputs, compiled = _outputs(found), native.compiled
    sound = compiled.render_opaque(
        lowered.program,
        program_inputs(lowered, rows, 0, 0, caller="render_opaque"),
        _rays(given),
        compiled.SeeCells(
            centres=centres,
            child_offsets=child_offsets,
            child=child,
            m=0 if centres is None else len(centres),
            depth=depth,
        ),
        _rule(given),
        outputs if given.heaviest else outputs._replace(heaviest=None),
        native.cpu(),
    )
    if not sound:
        raise too_shallow(depth, "render_opaque")
    return found if given.heaviest else found._replace(heaviest=given.far)


def _narrow(tensor: Tensor | None) -> Tensor | None:
    """Not float64, in which no network of the compiled module is."""
    return tensor.float() if tensor is not None and tensor.dtype == torch.float64 else tensor


def _no_offsets(weight: Tensor) -> Tensor:
    """Of no rows, for as many cells as a weight has."""
    return torch.zeros(weight.shape[0] + 1, dtype=torch.int32)
