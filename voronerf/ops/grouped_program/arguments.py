"""The arguments of every implementation of a program. n rows, r rays, k cells, w columns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.compiler import constant_result
from voronerf.ops._core.encodings import ENCODINGS
from voronerf.ops._core.program import Ahead, Program, encoded_ahead


class ProgramArguments(NamedTuple):
    """A checked program and its tensors.

    Attributes:
        text: the text of the program.
        inputs: [n, w] each, or [r, w] with a row for each ray; of any floating dtypes.
        parameters: [k, ...] each, or [1, ...] if all cells share the parameter.
        ray_index: int32 [n], or None without rays.
        dtype: the dtype of the results: the layers' dtype, or autocast's if it is enabled; without layers, the first
            input's dtype. With float16 and bfloat16, operands of products may be rounded; all other values are float32
            at least.
        caller: the name of the op for error messages.
    """

    text: str
    inputs: Sequence[Tensor]
    parameters: Sequence[Tensor]
    ray_index: Tensor | None
    dtype: torch.dtype
    caller: str

    @staticmethod
    def of(
        caller: str, text: str, inputs: Sequence[Tensor], parameters: Sequence[Tensor], ray_index: Tensor | None
    ) -> ProgramArguments:
        """Returns the arguments of a program; float64 inputs are encoded here if the results have another dtype."""
        dtype, kind = inputs[0].dtype, inputs[0].device.type
        if (first := _first_layer(text)) is not None:
            dtype = parameters[first].dtype
            if dtype is not torch.float64 and torch.is_autocast_enabled(kind):
                dtype = torch.get_autocast_dtype(kind)
        if dtype is not torch.float64:
            wide = tuple([x.dtype is torch.float64 for x in inputs])
            if any(wide):
                text, ahead = _encoded_ahead(text, wide)
                further = []
                for i, start, width, name, size in ahead:
                    further.append(ENCODINGS[name].formula(inputs[i][:, start : start + width], size))
                inputs = [*inputs, *further]
        return ProgramArguments(text, inputs, parameters, ray_index, dtype, caller)

    def run(
        self, offsets: Tensor, order: Tensor | None = None, *, backend: str, op: str = "grouped_program"
    ) -> list[Tensor]:
        """Returns the results for rows with offsets int32 [k + 1] and an order int32 [n], or None for sorted rows."""
        run = backends.resolve(op, backend=backend, device=self.inputs[0].device, dtype=self.dtype)
        results: list[Tensor] = run(self, offsets, order)
        return results


def index_name(caller: str) -> str:
    """Returns the name of the argument of ``caller`` that becomes ``ray_index``."""
    return "direction_index" if caller.endswith("_mlp") else "ray_index"


@constant_result
def _first_layer(text: str) -> int | None:
    """Returns the index of the first parameter that is no hash grid's table, or None; tables may have another dtype."""
    program = Program.parse(text)
    return next((i for i in range(len(program.parameters)) if i not in program.tables), None)


@constant_result
def _encoded_ahead(text: str, wide: tuple[bool, ...]) -> tuple[str, tuple[Ahead, ...]]:
    program, ahead = encoded_ahead(Program.parse(text), wide)
    return program.text, ahead
