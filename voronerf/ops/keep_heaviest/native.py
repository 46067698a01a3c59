"""``keep_heaviest`` of the compiled module, on the CPU."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared

_OP = declared("keep_heaviest")
_samples = _OP.inputs(native.compiled.WeighedSamples)
_kept = _OP.inputs(native.compiled.KeptSamples, points="kept_points", importance="kept_importance")


def _workspace(arguments: Any) -> Tensor:
    workspace: Tensor = arguments.added.new_empty(native.compiled.keep_heaviest_workspace(arguments.q))
    return workspace


keep_heaviest = _OP.compiled_op("keep_heaviest_native", "keep_heaviest", _samples, _kept, _workspace, devices=("cpu",))
