"""A small program for the rows of each cell. n rows, k cells, w columns, o outputs and i inputs of a matrix."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter

from voronerf.ops._core import backends
from voronerf.ops._core.backends import EVERYWHERE, FLOATS, Implementation
from voronerf.ops._core.checks import (
    INDEX,
    check_count,
    check_dtype,
    check_no_inference,
    check_same_device,
    check_shape,
    check_tensor,
)
from voronerf.ops._core.program import Program

_OP = backends.declare("grouped_program", native=Implementation(EVERYWHERE, FLOATS))
_HALF = (torch.float16, torch.bfloat16)  # computed in float32


def grouped_program(
    inputs: Sequence[Tensor],
    parameters: Sequence[Tensor],
    offsets: Tensor,
    *,
    program: Program,
    order: Tensor | None = None,
    backend: str = "auto",
) -> list[Tensor]:
    """Runs a program on the rows of each cell, with the cell's parameters.

    A program is a list of steps: layers, activations, sums, products, columns that are moved
    (:mod:`voronerf.ops._core.program`). All values of a tile of rows stay in cache. Gradients of every order to inputs
    and parameters; the gradient of a program is a program itself.

    Args:
        inputs: [n, w] floating point for each input of the program, sorted by cell, n < 2**31; at least one.
        parameters: [k, o, i] or [k, w] for each parameter of the program, or [1, ...] where all cells share it, the
            dtype of the inputs.
        offsets: int32 [k + 1], rising; cell c owns rows ``offsets[c]`` to ``offsets[c + 1]``. Rows outside all cells
            give 0. Cells may be empty.
        program: what to do.
        order: int32 [n]: row i that the offsets speak of is row ``order[i]`` of inputs and results, which need not be
            sorted then. None for rows that are sorted.
        backend: "auto", "reference" or "native".

    Returns:
        [n, w] for each output of the program, then [k, ...] for each of its sums over the rows of a cell.

    Raises:
        ValueError: on the CPU offsets that fall or exceed n, and an order outside 0 to n - 1.

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
    alike = _alike(program, inputs, parameters, (offsets,) if order is None else (offsets, order))
    if alike not in _PASSED:
        _check(inputs, parameters, offsets, program, order)
        if alike is not None and len(_PASSED) < 4096:
            _PASSED.add(alike)
    dtype = inputs[0].dtype
    run = backends.resolve(_OP, backend=backend, device=inputs[0].device, dtype=dtype)
    if dtype in _HALF:
        inputs, parameters = ([tensor.float() for tensor in tensors] for tensors in (inputs, parameters))
    results: list[Tensor] = run(inputs, parameters, offsets, order, program.text)
    return [tensor.to(dtype) for tensor in results] if dtype in _HALF else results


_PASSED: set[Any] = set()  # what arguments that have passed the checks are like: those of a program take 60 us


def _alike(program: Any, *lists: Sequence[Any]) -> Any:
    """What the checks ask of arguments; None where it cannot be said for all calls with arguments like these."""
    if torch.compiler.is_compiling() or not all(type(tensors) in (list, tuple) for tensors in lists):
        return None
    if not isinstance(program, Program):
        return None
    known = (Tensor, Parameter)
    if any(type(t) not in known or t.is_nested or t.is_inference() for tensors in lists for t in tensors):
        return None
    return program.text, *[tuple([(t.shape, t.dtype, t.device, t.layout) for t in tensors]) for tensors in lists]


def _check(
    inputs: Sequence[Tensor], parameters: Sequence[Tensor], offsets: Tensor, program: Program, order: Tensor | None
) -> None:
    """Raises ValueError and TypeError as :func:`grouped_program` says."""
    sizes: dict[str, int] = {}
    if not isinstance(program, Program):
        raise TypeError(f"{_OP}: program must be a Program, got {type(program).__name__}")
    for name, given, wanted in (("inputs", inputs, program.inputs), ("parameters", parameters, program.parameters)):
        if not isinstance(given, Sequence):
            raise TypeError(f"{_OP}: {name} must be a list, got {type(given).__name__}")
        if len(given) != len(wanted) or not (wanted or name == "parameters"):
            raise ValueError(f"{_OP}: {name} must be {len(wanted)} tensors (inputs at least one), got {len(given)}")
    check_shape(_OP, "offsets", offsets, ("k+1",), sizes)
    check_dtype(_OP, "offsets", offsets, INDEX)
    if sizes["k"] < 1:
        raise ValueError(f"{_OP}: offsets must be of at least one cell, got {list(offsets.shape)}")
    for i, (x, width) in enumerate(zip(inputs, program.inputs)):
        check_shape(_OP, f"inputs[{i}]", x, ("n", width), sizes)
        check_dtype(_OP, f"inputs[{i}]", x, backends.COORDINATES if i == 0 else (inputs[0].dtype,))
    for i, (p, shape) in enumerate(zip(parameters, program.parameters)):
        check_tensor(_OP, f"parameters[{i}]", p)
        check_shape(_OP, f"parameters[{i}]", p, (1 if p.shape[:1] == (1,) else "k", *shape), sizes)
        check_dtype(_OP, f"parameters[{i}]", p, (inputs[0].dtype,))
    if order is not None:
        check_shape(_OP, "order", order, ("n",), sizes)
        check_dtype(_OP, "order", order, INDEX)
    check_count(_OP, "inputs[0]", sizes["n"])
    named = {**{f"inputs[{i}]": x for i, x in enumerate(inputs)}, "offsets": offsets, "order": order}
    named.update({f"parameters[{i}]": p for i, p in enumerate(parameters)})
    check_same_device(_OP, **named)
    check_no_inference(_OP, **named)
