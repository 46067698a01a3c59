"""Function, docstring, memory and checks of an op, which follow from its signature."""

from __future__ import annotations

import inspect
from collections import namedtuple

import pytest
import torch

from voronerf.ops import cell_sort, composite
from voronerf.ops._core.declare import declared


def test_the_public_function_has_the_signature_and_the_docstring():
    assert list(inspect.signature(cell_sort).parameters) == ["cells", "k", "backend"]
    assert cell_sort.__module__ == "voronerf.ops.cell_sort" and cell_sort.__doc__.startswith("Returns the stable order")
    assert "    cells: int32 [n], the cell of each sample, 0 to k - 1" in cell_sort.__doc__
    assert '\n        backend: "auto", "reference", "native" or "warp".\n\n    Returns:' in cell_sort.__doc__
    assert "    background: same [c] or [r, c] or None, a colour added with" in composite.__doc__
    with pytest.raises(TypeError, match=r"cell_sort\(\) missing 1 required positional argument: 'k'"):
        cell_sort(torch.zeros(1, dtype=torch.int32))


def test_a_struct_with_other_members_is_refused_at_once():
    kind = namedtuple("CellInputs", ["cells", "n", "threads"])
    op = declared("cell_sort")
    with pytest.raises(
        NameError,
        match=r"cell_sort: CellInputs must only have members that are arguments, letters or results, got \['threads'\]",
    ):
        op.inputs(kind)
    cells = torch.zeros(5, dtype=torch.int32)
    assert op.inputs(kind, threads=lambda arguments: 2 * arguments.k)(op.Inputs(cells, 3)) == (cells, 5, 6)


def test_arguments_are_bound_as_python_binds_them():
    cells = torch.zeros(1, dtype=torch.int32)
    assert torch.equal(cell_sort(k=3, cells=cells)[1], cell_sort(cells, 3)[1])
    for args, options, message in [
        ((cells, 3), {"k": 3}, r"cell_sort\(\) got multiple values for argument 'k'"),
        ((cells,), {"count": 3}, r"cell_sort\(\) got an unexpected keyword argument 'count'"),
        ((cells, 3, "native"), {}, r"cell_sort\(\) takes 2 positional arguments but 3 were given"),
    ]:
        with pytest.raises(TypeError, match=message):
            cell_sort(*args, **options)
