"""A small program for the rows of each cell. n rows, r rays, k cells, w columns, o outputs and i inputs of a matrix, e
entries and f features of a table."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import EVERYWHERE, FLOATS, Implementation
from voronerf.ops._core.checks import FLOATING, INDEX, Default, Others, Row, Rows, check_rows, check_tensor
from voronerf.ops._core.program import Program
from voronerf.ops.grouped_program.given import Given

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

    A program is a list of steps: layers, activations, encodings, sums, products, columns that are moved
    (:mod:`voronerf.ops._core.program`). All values of a tile of rows stay in cache. Gradients of every order to inputs
    and parameters; the gradient of a program is a program itself.

    Args:
        inputs: [n, w] floating point for each input of the program, sorted by cell, n < 2**31; at least one. [r, w],
            r < 2**31, for those of ``program.rays``, which have one row for each ray.
        parameters: [k, o, i] or [k, w] for each parameter of the program, or [1, ...] where all cells share it, all of
            one dtype. The table [k, e, f] or [1, e, f] of a hash grid may be of any.
        offsets: int32 [k + 1], rising; cell c owns rows ``offsets[c]`` to ``offsets[c + 1]``. Rows outside all cells
            give 0. Cells may be empty.
        program: what to do.
        order: int32 [n]: row i that the offsets speak of is row ``order[i]`` of inputs and results, which need not be
            sorted then. None for rows that are sorted.
        ray_index: int32 [n], values 0 to r - 1: the ray of each row of inputs and results, so that ``order`` leads to
            ``ray_index[order[i]]``. None for a program without inputs of rays.
        backend: "auto", "reference", "native" or "warp", which has kernels for layers alone: what follows them, and a
            program that is no chain of layers, runs in PyTorch there.

    Returns:
        In the dtype of the parameters (of autocast, where it is on), or without any in that of the first input: [n, w]
        for each output of the program, or [r, w], the sum over the rows of each ray, for those of ``program.by_ray``;
        then [k, ...] for each of its sums over the rows of a cell, or [1, e, f] for the sum of a table that all cells
        share. Rows outside all cells add nothing to sums.

    Raises:
        ValueError: on the CPU offsets that fall or exceed n, an order outside 0 to n - 1, and a ray_index outside 0 to
            r - 1.

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
    return Given.of(_OP, program.text, inputs, parameters, ray_index).run(offsets, order, backend=backend)


def check_program(
    op: str,
    program: Program,
    inputs: Sequence[Tensor],
    parameters: Sequence[Tensor],
    ray_index: Tensor | None,
    first: Others = ((), ()),
    last: Others = ((), ()),
) -> dict[str, int]:
    """Checks a program and its tensors, and gives what the letters of their shapes stand for.

    Args:
        op: operation named in errors.
        program: which tells how many tensors there are.
        inputs: its own.
        parameters: its own.
        ray_index: int32 [n], or None.
        first: rows of others that are checked before, and these.
        last: of others that are checked behind.
    """
    if not isinstance(program, Program):
        raise TypeError(f"{op}: program must be a Program, got {type(program).__name__}")
    for name, given, wanted in (("inputs", inputs, program.inputs), ("parameters", parameters, program.parameters)):
        if not isinstance(given, Sequence):
            raise TypeError(f"{op}: {name} must be a list, got {type(given).__name__}")
        if len(given) != len(wanted) or not (wanted or name == "parameters"):
            raise ValueError(f"{op}: {name} must be {len(wanted)} tensors (inputs at least one), got {len(given)}")
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
    sizes = check_rows(op, _rows, tensors, program, dtype, tuple(first[0]), tuple(last[0]))
    if ray_index is not None and not sizes["r"] and sizes["n"]:
        at = next(i for i in range(len(inputs)) if _among(i, program.rays))
        found = list(inputs[at].shape)
        raise ValueError(f"{op}: inputs[{at}] must hold a row for the ray_index, got {found}")
    return sizes


_OFFSETS = Row("offsets", INDEX, ("k+1",), empty="must be of at least one cell")
_ORDER = Row("order", INDEX, ("n",))


def _rows(program: Program, dtype: torch.dtype | None, first: Sequence[Row], last: Sequence[Row]) -> Rows:
    """The rules for the tensors of a program, between others: inputs, parameters, the index of rays. ``dtype``: of all
    parameters but tables, None without any."""
    rows: list[Row | Default] = [*first]
    for i, width in enumerate(program.inputs):
        rows.append(Row(f"inputs[{i}]", FLOATING, ("r" if _among(i, program.rays) else "n", width)))
    for i, shape in enumerate(program.parameters):
        known = FLOATING if dtype not in FLOATING or _among(i, program.tables) else (dtype,)
        rows.append(Row(f"parameters[{i}]", known, ("1|k", *shape)))
    if program.rays:
        rows.append(Row("ray_index", INDEX, ("n",)))
    return [*rows, Default("k", 1), *last]


def _among(i: int, numbers: Sequence[int]) -> bool:
    """Whether a number is one of a program's, which torch.compile may take for sizes and not find by ``in``."""
    return any(i == number for number in numbers)
