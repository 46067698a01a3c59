"""``spherical_harmonics`` of the compiled module."""

from __future__ import annotations

from voronerf.ops._core.encoding_op import encoding_op
from voronerf.ops.spherical_harmonics import reference

spherical_harmonics = encoding_op(
    "spherical_harmonics",
    "spherical",
    reference.spherical_harmonics,
    lambda arguments: (arguments.directions, None, 3, arguments.degree, False),
)
