"""``draw_points`` of the compiled module."""

from __future__ import annotations

from voronerf.ops._core.declare import declared

draw_points = declared("draw_points").compiled_op("draw_points_native", "draw_points", "seed", "box", "count", "result")
