"""``frequency_encode`` of the compiled module."""

from __future__ import annotations

from voronerf.ops._core.encoding_op import encoding_op
from voronerf.ops.frequency_encode import reference

frequency_encode = encoding_op(
    "frequency_encode",
    "frequency",
    reference.frequency_encode,
    lambda arguments: (arguments.x, None, arguments.d, arguments.octaves, arguments.include_input),
)
