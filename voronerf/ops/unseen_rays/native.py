"""``unseen_rays`` of the compiled module, on the CPU: no custom op, as it works in place on what no graph holds."""

from __future__ import annotations

from typing import Any

from voronerf.ops._core import native
from voronerf.ops._core.declare import declared

_OP = declared("unseen_rays")
_inputs = _OP.inputs(native.compiled.UnseenRays)


@_OP.plain
def unseen_rays(given: Any) -> None:
    """Moves the last rays; see ``voronerf.ops.unseen_rays``."""
    native.compiled.unseen_rays(_inputs(given), given.origins, given.directions, native.cpu())
