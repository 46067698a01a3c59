"""``render_opaque`` of the compiled module: a wave of some thousand samples goes from grid to colours in the cache.

No custom op: nothing that is traced or differentiated renders pictures.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops.composite.native import composite
from voronerf.ops.grouped_mlp import network as grouped_mlp
from voronerf.ops.grouped_mlp.network import Given, in_float32, table_of
from voronerf.ops.locate_cell.native import check_tree, too_shallow
from voronerf.ops.march_rays.native import inputs_of, march_rays
from voronerf.ops.march_rays.reference import March
from voronerf.ops.render_opaque import reference
from voronerf.ops.render_opaque.reference import Operations, RaySums, Rule
from voronerf.ops.routed_mlp.native import routed_mlp

_APART = Operations(march_rays=lambda *given: March(*march_rays(*given)), routed_mlp=routed_mlp, composite=composite)


@torch.no_grad()
def render_opaque(rays: Any, network: Mapping[str, Any], rule: Rule) -> RaySums:
    """Every ray up to the first surface, in float32; see ``voronerf.ops.render_opaque``."""
    weights, biases, centres = network["weights"], network["biases"], network["centres"]
    floats = (*weights, *biases, centres, network["features"], network["directions"])
    plain = all(tensor is None or tensor.dtype == torch.float32 for tensor in floats)
    if not plain or torch.is_autocast_enabled("cpu"):
        return reference.render_opaque(rays, network, rule, _APART)
    features, (r,) = network["features"], rays.near.shape
    if features is not None and features.dim() == 3 and weights[0].shape[0] == 1:
        features = features[0]
    given = Given(rays.origins, weights, biases, network["layers"], network["directions"], None, features)
    taken, _ = in_float32(given, network["layers"].text, "routed_mlp")
    child_offsets, child, depth = network["child_offsets"], network["child"], network["depth"]
    if weights[0].shape[0] == 1:
        centres = child_offsets = child = None
    if child_offsets is not None:
        check_tree(child_offsets, child, len(centres), "render_opaque")
    near = rays.near
    colour, opacity, depths, light = near.new_empty(r, 3), near.new_empty(r), near.new_empty(r), near.new_empty(r)
    heaviest = near.new_empty(r) if rule.heaviest else rays.far
    compiled = native.compiled
    sound = compiled.render_opaque(
        table_of(*grouped_mlp.key_of(taken)),
        grouped_mlp.inputs_of(taken, _no_offsets(weights[0]), None, near.new_empty(0)),
        inputs_of(rays),
        compiled.SeeCells(
            centres=centres,
            child_offsets=child_offsets,
            child=child,
            m=0 if centres is None else len(centres),
            depth=depth,
        ),
        compiled.SeeRule(density_scale=rule.density_scale, opaque=rule.opaque, wave=rule.wave),
        compiled.SeeOutputs(
            colour=colour, opacity=opacity, depth=depths, light=light, heaviest=heaviest if rule.heaviest else None
        ),
        native.cpu(),
    )
    if not sound:
        raise too_shallow(depth, "render_opaque")
    return RaySums(colour, opacity, depths, light, heaviest)


def _no_offsets(weight: Tensor) -> Tensor:
    """Of no rows, for as many cells as a weight has."""
    return torch.zeros(weight.shape[0] + 1, dtype=torch.int32)
