"""``keep_heaviest`` of the compiled module, on the CPU."""

from __future__ import annotations

from typing import Any

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared

_OP = declared("keep_heaviest")
_samples = _OP.inputs(native.compiled.WeighedSamples)
_kept = _OP.inputs(native.compiled.KeptSamples, points="kept_points", importance="kept_importance")


@_OP.custom_op("keep_heaviest_native", devices=("cpu",))
def keep_heaviest(given: Any, _: None) -> None:
    """Keeps the heaviest samples of a batch; see ``voronerf.ops.keep_heaviest``."""
    workspace = given.added.new_empty(native.compiled.keep_heaviest_workspace(given.q))
    native.compiled.keep_heaviest(_samples(given), _kept(given), workspace, native.cpu())
