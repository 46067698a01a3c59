"""``integrated_encode`` of the compiled module."""

from __future__ import annotations

from voronerf.ops._core.encoding_op import encoding_op
from voronerf.ops.integrated_encode import reference

integrated_encode = encoding_op(
    "integrated_encode",
    "integrated",
    reference.integrated_encode,
    lambda arguments: (arguments.means, arguments.variances, 3, arguments.octaves, False),
)
