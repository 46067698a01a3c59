"""A small program for the rows of each cell. n rows, r rays, k cells, w columns, o outputs and i inputs of a matrix, e
entries and f features of a table."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from voronerf.ops._core.program import Names, Program
from voronerf.ops.network import OP, Cells, Network

_NAMES = Names(OP)


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
    cells, network = Cells(offsets, order), Network(program, parameters, names=_NAMES)
    results, _ = network(inputs, cells, ray_index=ray_index, backend=backend)
    return results
