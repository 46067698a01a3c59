"""A program and its tensors, as every implementation takes them. n rows, r rays, k cells, w columns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.compiler import constant_result
from voronerf.ops._core.encodings import ENCODINGS
from voronerf.ops._core.program import Ahead, Program, encoded_ahead


class Given(NamedTuple):
    """A program that has been checked, and its tensors.

    Attributes:
        text: of the program.
        inputs: [n, w] each, or [r, w] with a row for each ray; of any floating dtypes.
        parameters: [k, ...] each, or [1, ...] where all cells share it.
        ray_index: int32 [n], or None without rays.
        dtype: of the results: that of the layers, or autocast's where it is on; of a program without layers that of its
            first input. float16 and bfloat16 are what products may round to; all else is float32 at least.
        caller: the op that errors name.
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
    ) -> Given:
        """Takes a program by its text, and encodes float64 inputs where the results have another dtype."""
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
        return Given(text, inputs, parameters, ray_index, dtype, caller)

    def run(
        self, offsets: Tensor, order: Tensor | None = None, *, backend: str, op: str = "grouped_program"
    ) -> list[Tensor]:
        """The results for rows of cells by offsets int32 [k + 1], and an order int32 [n] unless they are sorted."""
        run = backends.resolve(op, backend=backend, device=self.inputs[0].device, dtype=self.dtype)
        results: list[Tensor] = run(self, offsets, order)
        return results


def index_name(caller: str) -> str:
    """The argument of an op that ``ray_index`` is."""
    return "direction_index" if caller.endswith("_mlp") else "ray_index"


@constant_result
def _first_layer(text: str) -> int | None:
    """The first parameter that is no table of a hash grid, whose dtype may be another."""
    program = Program.parse(text)
    return next((i for i in range(len(program.parameters)) if i not in program.tables), None)


@constant_result
def _encoded_ahead(text: str, wide: tuple[bool, ...]) -> tuple[str, tuple[Ahead, ...]]:
    program, ahead = encoded_ahead(Program.parse(text), wide)
    return program.text, ahead
