"""The arguments of every implementation of a network. n rows, r rays, k cells, w columns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core.compiler import constant_result
from voronerf.ops._core.encodings import ENCODINGS
from voronerf.ops._core.program import Ahead, Program, encoded_ahead


class Arguments(NamedTuple):
    """A checked program and its tensors.

    Attributes:
        program: the program.
        inputs: [n, w] each, or [r, w] with a row for each ray; of any floating dtypes.
        parameters: [k, ...] each, or [1, ...] if all cells share the parameter.
        ray_index: int32 [n], or None without rays.
        dtype: the dtype of the results: the layers' dtype, or autocast's if it is enabled; without layers, the first
            input's dtype. With float16 and bfloat16, operands of products may be rounded; all other values are float32
            at least.
        op: the name of the op for error messages.
        index_name: the name of the op's argument that is ``ray_index``.
    """

    program: Program
    inputs: Sequence[Tensor]
    parameters: Sequence[Tensor]
    ray_index: Tensor | None
    dtype: torch.dtype
    op: str
    index_name: str

    @staticmethod
    def of(
        program: Program,
        inputs: Sequence[Tensor],
        parameters: Sequence[Tensor],
        ray_index: Tensor | None,
        op: str,
        index_name: str,
    ) -> Arguments:
        """Returns the arguments of a program; float64 inputs are encoded here if the results have another dtype."""
        first, kind = program.first_layer, inputs[0].device.type
        dtype = inputs[0].dtype if first < 0 else parameters[first].dtype
        if dtype is not torch.float64:
            if first >= 0 and torch.is_autocast_enabled(kind):
                dtype = torch.get_autocast_dtype(kind)
            wide = tuple([x.dtype is torch.float64 for x in inputs])
            if True in wide:
                program, ahead = _encoded_ahead(program.text, wide)
                further = []
                for i, start, width, name, size in ahead:
                    further.append(ENCODINGS[name].formula(inputs[i][:, start : start + width], size))
                inputs = [*inputs, *further]
        return Arguments(program, inputs, parameters, ray_index, dtype, op, index_name)


@constant_result
def _encoded_ahead(text: str, wide: tuple[bool, ...]) -> tuple[Program, tuple[Ahead, ...]]:
    return encoded_ahead(Program.parse(text), wide)


def among(i: int, numbers: Sequence[int]) -> bool:
    """Returns whether a number is in a list; ``in`` fails if torch.compile makes the list's numbers symbolic."""
    return any(i == number for number in numbers)
