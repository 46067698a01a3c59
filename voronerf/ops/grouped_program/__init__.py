"""A small program for the rows of each cell. n rows, r rays, k cells, w columns, o outputs and i inputs of a matrix, e
entries and f features of a table."""

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
_TABLES = (torch.float32, torch.bfloat16, torch.float16)  # of hash grids, beside the dtype of the inputs


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
        parameters: [k, o, i] or [k, w] for each parameter of the program, or [1, ...] where all cells share it, the
            dtype of the inputs. The table [k, e, f] or [1, e, f] of a hash grid may be float32, bfloat16 or float16
            beside inputs of any dtype.
        offsets: int32 [k + 1], rising; cell c owns rows ``offsets[c]`` to ``offsets[c + 1]``. Rows outside all cells
            give 0. Cells may be empty.
        program: what to do.
        order: int32 [n]: row i that the offsets speak of is row ``order[i]`` of inputs and results, which need not be
            sorted then. None for rows that are sorted.
        ray_index: int32 [n], values 0 to r - 1: the ray of each row of inputs and results, so that ``order`` leads to
            ``ray_index[order[i]]``. None for a program without inputs of rays.
        backend: "auto", "reference" or "native".

    Returns:
        [n, w] for each output of the program, or [r, w], the sum over the rows of each ray, for those of
        ``program.by_ray``; then [k, ...] for each of its sums over the rows of a cell, or [1, e, f] for the sum of a
        table that all cells share. Rows outside all cells add nothing to sums.

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
    given = ([] if tensor is None else [tensor] for tensor in (offsets, order, ray_index))
    alike = _alike(program, inputs, parameters, *given)
    if alike not in _PASSED:
        _check(inputs, parameters, offsets, program, order, ray_index)
        if alike is not None and len(_PASSED) < 4096:
            _PASSED.add(alike)
    dtype = inputs[0].dtype
    run = backends.resolve(_OP, backend=backend, device=inputs[0].device, dtype=dtype)
    if dtype in _HALF:
        inputs = [x.float() for x in inputs]
        parameters = [p if _among(i, program.tables) else p.float() for i, p in enumerate(parameters)]
    results: list[Tensor] = run(inputs, parameters, offsets, order, ray_index, program.text)
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
    inputs: Sequence[Tensor],
    parameters: Sequence[Tensor],
    offsets: Tensor,
    program: Program,
    order: Tensor | None,
    ray_index: Tensor | None,
) -> None:
    """Raises ValueError and TypeError as :func:`grouped_program` says."""
    sizes: dict[str, int] = {}
    check_shape(_OP, "offsets", offsets, ("k+1",), sizes)
    check_dtype(_OP, "offsets", offsets, INDEX)
    if sizes["k"] < 1:
        raise ValueError(f"{_OP}: offsets must be of at least one cell, got {list(offsets.shape)}")
    named = check_tensors(_OP, inputs, parameters, program, ray_index, sizes)
    if order is not None:
        check_shape(_OP, "order", order, ("n",), sizes)
        check_dtype(_OP, "order", order, INDEX)
    named.update(offsets=offsets, order=order)
    check_same_device(_OP, **named)
    check_no_inference(_OP, **named)


def check_tensors(
    op: str,
    inputs: Sequence[Tensor],
    parameters: Sequence[Tensor],
    program: Program,
    ray_index: Tensor | None,
    sizes: dict[str, int],
) -> dict[str, Tensor | None]:
    """Checks the tensors of a program but for devices, and gives them by name; ``sizes`` holds k where it is known."""
    if not isinstance(program, Program):
        raise TypeError(f"{op}: program must be a Program, got {type(program).__name__}")
    for name, given, wanted in (("inputs", inputs, program.inputs), ("parameters", parameters, program.parameters)):
        if not isinstance(given, Sequence):
            raise TypeError(f"{op}: {name} must be a list, got {type(given).__name__}")
        if len(given) != len(wanted) or not (wanted or name == "parameters"):
            raise ValueError(f"{op}: {name} must be {len(wanted)} tensors (inputs at least one), got {len(given)}")
    for i, (x, width) in enumerate(zip(inputs, program.inputs)):
        check_shape(op, f"inputs[{i}]", x, ("r" if _among(i, program.rays) else "n", width), sizes)
        check_dtype(op, f"inputs[{i}]", x, backends.COORDINATES if i == 0 else (inputs[0].dtype,))
    for i, (p, shape) in enumerate(zip(parameters, program.parameters)):
        check_tensor(op, f"parameters[{i}]", p)
        check_shape(op, f"parameters[{i}]", p, (1 if p.shape[:1] == (1,) else "k", *shape), sizes)
        known = (inputs[0].dtype, *(_TABLES if _among(i, program.tables) else ()))
        check_dtype(op, f"parameters[{i}]", p, tuple(dict.fromkeys(known)))
    if (ray_index is not None) != (len(program.rays) > 0):
        rule = "given for a program with" if program.rays else "None for a program without"
        came = "None" if ray_index is None else "an index"
        raise ValueError(f"{op}: ray_index must be {rule} inputs of rays, got {came}")
    if ray_index is not None:
        check_shape(op, "ray_index", ray_index, ("n",), sizes)
        check_dtype(op, "ray_index", ray_index, INDEX)
        first = next(i for i in range(len(inputs)) if _among(i, program.rays))
        if not sizes["r"] and sizes["n"]:
            found = list(inputs[first].shape)
            raise ValueError(f"{op}: inputs[{first}] must hold a row for the ray_index, got {found}")
        check_count(op, f"inputs[{first}]", sizes["r"])
    check_count(op, "inputs[0]", sizes["n"])
    named: dict[str, Tensor | None] = {f"inputs[{i}]": x for i, x in enumerate(inputs)}
    named.update({f"parameters[{i}]": p for i, p in enumerate(parameters)}, ray_index=ray_index)
    return named


def _among(i: int, numbers: Sequence[int]) -> bool:
    """Whether a number is one of a program's, which torch.compile may take for sizes and not find by ``in``."""
    return any(i == number for number in numbers)
