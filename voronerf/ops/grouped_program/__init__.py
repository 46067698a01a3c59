"""A small program for the rows of each cell. n rows, r rays, k cells, w columns, o outputs and i inputs of a matrix, e
entries and f features of a table."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import EVERYWHERE, FLOATS, Implementation
from voronerf.ops._core.checks import (
    FLOATING,
    INDEX,
    Default,
    Others,
    TensorRule,
    TensorRules,
    check_rules,
    check_tensor,
)
from voronerf.ops._core.program import Program
from voronerf.ops.grouped_program.arguments import ProgramArguments

_OP = backends.declare(
    "grouped_program", native=Implementation(EVERYWHERE, FLOATS), warp=Implementation(EVERYWHERE, FLOATS)
)


def grouped_program(
    inputs: Sequence[Tensor],
    parameters: Sequence[Tensor],
    offsets: Tensor,
    *,
    program: Program,
    order: Tensor | None = None,
    ray_index: Tensor | None = None,
    backend: str = "auto",
) -> list[Tensor]:
    """Runs a program on the rows of each cell, with the cell's parameters.

    A program is a list of steps: layers, activations, encodings, sums, products and moves of columns
    (:mod:`voronerf.ops._core.program`). All values of a tile of rows stay in cache. Inputs and parameters have
    gradients of every order; the gradient of a program is a program itself.

    Args:
        inputs: one floating-point tensor for each input of the program, at least one: [n, w], sorted by cell; or
            [r, w], one row for each ray, for the inputs in ``program.rays``. n and r < 2**31.
        parameters: [k, o, i] or [k, w] for each parameter of the program, or [1, ...] if all cells share it; all of one
            dtype, except the table [k, e, f] or [1, e, f] of a hash grid.
        offsets: int32 [k + 1], ascending; cell c owns rows ``offsets[c]`` to ``offsets[c + 1]``. Rows outside all cells
            give 0. Cells may be empty.
        program: the program to run.
        order: int32 [n]; sorted row i is row ``order[i]`` of inputs and results, which need not be sorted. None for
            sorted rows.
        ray_index: int32 [n], values 0 to r - 1: the ray of each row of inputs and results, before sorting by ``order``.
            None for a program without inputs of rays.
        backend: "auto", "reference", "native" or "warp". Warp runs layers and their encodings in kernels, and all
            other steps in PyTorch. A program with sums runs in PyTorch.

    Returns:
        The outputs of the program: [n, w] each, or [r, w] for the outputs in ``program.by_ray``, which are summed over
        the rows of each ray. Then the sums over the rows of a cell: [k, ...] each, or [1, e, f] for the gradient of a
        table that all cells share. The results have the dtype of the parameters (or of autocast, if it is enabled);
        without parameters, the dtype of the first input. Rows outside all cells add nothing to sums.

    Raises:
        ValueError: offsets decrease or exceed n, an order is outside 0 to n - 1, or a ray_index is outside 0 to r - 1
            (checked on the CPU only).

    Examples:
        >>> import torch
        >>> from voronerf.ops import grouped_program
        >>> from voronerf.ops._core.program import Builder
        >>> b = Builder()
        >>> x = b.input(2)
        >>> y = b.apply("exp", b.linear(x, b.parameter(1, 2), 1))  # exp(W x), W [1, 2]
        >>> program = b.program([y])
        >>> offsets = torch.tensor([0, 1, 2], dtype=torch.int32)  # two cells of one row each
        >>> weights = torch.tensor([[[1.0, 0.0]], [[0.0, 2.0]]])
        >>> (out,) = grouped_program([torch.zeros(2, 2)], [weights], offsets, program=program)
        >>> out.flatten()
        tensor([1., 1.])
    """
    cells: Others = ([_OFFSETS], [offsets])
    sorting: Others = ((), ()) if order is None else ([_ORDER], [order])
    check_program(_OP, program, inputs, parameters, ray_index, cells, sorting)
    return ProgramArguments.of(_OP, program.text, inputs, parameters, ray_index).run(offsets, order, backend=backend)


def check_program(
    op: str,
    program: Program,
    inputs: Sequence[Tensor],
    parameters: Sequence[Tensor],
    ray_index: Tensor | None,
    first: Others = ((), ()),
    last: Others = ((), ()),
) -> dict[str, int]:
    """Checks a program and its tensors, and returns the size of each letter in their shapes.

    Args:
        op: the name of the operation for error messages.
        program: the program.
        inputs: the inputs of the program.
        parameters: the parameters of the program.
        ray_index: int32 [n], or None.
        first: additional rules and their tensors, checked first.
        last: additional rules and their tensors, checked last.
    """
    if not isinstance(program, Program):
        raise TypeError(f"{op}: program must be a Program, got {type(program).__name__}")
    for name, values, wanted in (("inputs", inputs, program.inputs), ("parameters", parameters, program.parameters)):
        if not isinstance(values, Sequence):
            raise TypeError(f"{op}: {name} must be a list, got {type(values).__name__}")
        if name == "inputs" and not wanted:
            raise ValueError(f"{op}: program must have at least one input, got none")
        if len(values) != len(wanted):
            raise ValueError(f"{op}: {name} must have {len(wanted)} tensors, got {len(values)}")
    if (ray_index is not None) != (len(program.rays) > 0):
        rule = "given for a program with" if program.rays else "None for a program without"
        came = "None" if ray_index is None else "an index"
        raise ValueError(f"{op}: ray_index must be {rule} inputs of rays, got {came}")
    check_tensor(op, "inputs[0]", inputs[0])
    rays = () if ray_index is None else (ray_index,)
    tensors = [*first[1], *inputs, *parameters, *rays, *last[1]]
    layers = [p for i, p in enumerate(parameters) if not _among(i, program.tables)]
    if layers:
        check_tensor(op, "parameters", layers[0])
    dtype = layers[0].dtype if layers else None
    sizes = check_rules(op, _rows, tensors, program, dtype, tuple(first[0]), tuple(last[0]))
    if ray_index is not None and not sizes["r"] and sizes["n"]:
        at = next(i for i in range(len(inputs)) if _among(i, program.rays))
        shape = list(inputs[at].shape)
        raise ValueError(f"{op}: inputs[{at}] must hold a row for the ray_index, got {shape}")
    return sizes


_OFFSETS = TensorRule("offsets", INDEX, ("k+1",), empty="must have at least two entries")
_ORDER = TensorRule("order", INDEX, ("n",))


def _rows(
    program: Program, dtype: torch.dtype | None, first: Sequence[TensorRule], last: Sequence[TensorRule]
) -> TensorRules:
    """Returns the rules for the tensors of a program: ``first``, inputs, parameters, the ray index and ``last``.

    ``dtype`` is the dtype of all parameters except tables, or None without such parameters.
    """
    rows: list[TensorRule | Default] = [*first]
    for i, width in enumerate(program.inputs):
        rows.append(TensorRule(f"inputs[{i}]", FLOATING, ("r" if _among(i, program.rays) else "n", width)))
    for i, shape in enumerate(program.parameters):
        dtypes = FLOATING if dtype not in FLOATING or _among(i, program.tables) else (dtype,)
        rows.append(TensorRule(f"parameters[{i}]", dtypes, ("1|k", *shape)))
    if program.rays:
        rows.append(TensorRule("ray_index", INDEX, ("n",)))
    return [*rows, Default("k", 1), *last]


def _among(i: int, numbers: Sequence[int]) -> bool:
    """Returns whether a number is in a list; ``in`` fails if torch.compile makes the list's numbers symbolic."""
    return any(i == number for number in numbers)
