"""Programs on samples in the cells of a diagram. n samples, r rays, k cells, m centres of all diagrams together, g
diagrams, w columns."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.program import Names, Program
from voronerf.ops.network import OP, Cells, Network

_NAMES = Names(backends.declare("routed_program", runs=OP))


def routed_program(
    program: Program,
    inputs: Sequence[Tensor],
    parameters: Sequence[Tensor],
    *,
    ray_index: Tensor | None = None,
    centres: Tensor | None = None,
    child_offsets: Tensor | None = None,
    child: Tensor | None = None,
    depth: int = 1,
    cells: Tensor | None = None,
    coords: Tensor | None = None,
    frozen: Tensor | None = None,
    rows: Tensor | None = None,
    centre_index: Tensor | None = None,
    backend: str = "auto",
) -> tuple[list[Tensor], Tensor]:
    """Runs a program on every sample with the parameters of the cell it lies in.

    Equivalent to ``locate_cell``, ``cell_sort`` and ``grouped_program`` with the order of the samples. Results are in
    the order of the samples. Inputs and parameters have gradients of every order; the choice of the cell has none.

    Args:
        program: a program with outputs [n, w] only, without sums; its first input has a row for each sample.
        inputs: the inputs as in ``grouped_program``; the first three columns of the first input locate the samples,
            unless ``coords`` is given.
        parameters: the parameters as in ``grouped_program``; parameters that all cells share may lack the dimension of
            cells.
        ray_index: int32 [n], the ray of each sample as in ``grouped_program``; None without inputs of rays.
        centres: the centres of the tree. This argument and the following ones are as in ``routed_mlp``.
        child_offsets: int32 [g + 1], or None for a flat diagram.
        child: int32 [m], or None for a flat diagram.
        depth: the number of levels of the tree.
        cells: int32 [n], the cell of each sample, 0 to k - 1; given instead of ``centres``, ``child_offsets`` and
            ``child``.
        coords: [n, 3], the locations of the samples.
        frozen: bool [k], the frozen cells, whose samples have no gradients; or None.
        rows: int32 [1], the number of valid leading samples; None for all.
        centre_index: the index of the centres of a flat diagram by `index_centres`, or None.
        backend: "auto", "reference", "native" or "warp".

    Returns:
        [n, w] for each output, in the dtype that ``grouped_program`` would return; and cells int32 [n].

    Raises:
        ValueError: the program has sums, or its first input has one row for each ray; or ``grouped_program`` or
            ``routed_mlp`` would refuse the arguments.

    Examples:
        >>> import torch
        >>> from voronerf.ops import routed_program
        >>> from voronerf.ops._core.program import Builder
        >>> b = Builder()
        >>> program = b.program([b.linear(b.input(3), b.parameter(1, 3), 1)])  # W x
        >>> weights = torch.tensor([[[1.0, 0, 0]], [[100.0, 0, 0]]])
        >>> positions, centres = torch.tensor([[0.9, 0, 0], [0.1, 0, 0]]), torch.tensor([[0.0, 0, 0], [1.0, 0, 0]])
        >>> (out,), cells = routed_program(program, [positions], [weights], centres=centres)
        >>> out.flatten(), cells
        (tensor([90.0000,  0.1000]), tensor([1, 0], dtype=torch.int32))
    """
    where = Cells(None, None, cells, centres, child_offsets, child, depth, coords, centre_index, rows, frozen)
    results, found = Network(program, parameters, names=_NAMES)(inputs, where, ray_index=ray_index, backend=backend)
    assert found is not None
    return results, found
