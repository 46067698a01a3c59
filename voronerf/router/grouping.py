"""Samples and parameters by cell: sorted rows and stacked tensors.

Letters: n samples, k cells, e entries of a table. A sorted tensor may have m entries per sample: its first dimension is
then n * m, sample after sample.
"""

from __future__ import annotations

import functools
import itertools
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from voronerf import ops
from voronerf.ops._core.memory import LARGE, on_huge_pages

SHARED = "_voronerf_shared"
"""The attribute of a submodule that holds the names of its shared parameters."""


HIDDEN = "_voronerf_hidden"
"""The attribute of a submodule that lists the unregistered submodules in its other attributes, such as lists."""
HOLDERS = "_voronerf_holders"
"""The attribute that names the attributes of a submodule in which wrapping found parameters or submodules."""
CHANGES = "_voronerf_changes"
"""The attribute that names the lists, dicts and sets of a submodule whose items ``forward`` changes."""


class Grouping:
    """n entries, each a sample in one of k cells, sorted by cell.

    Tensors that are computed at their first use are never inference tensors, since later calls may use them.

    Args:
        cells: The cell of each entry, int32 [n]; None for a single cell.
        n: The number of entries.
        k: The number of cells.
        device: The device of the samples.
        backend: The backend of the operations.
        rows: The sample of each entry, int64 [n]; samples may be missing or repeated. None: entry i is sample i.

    Attributes:
        offsets: int32 [k + 1], the first sorted row of each cell, followed by n.
    """

    def __init__(
        self, cells: Tensor | None, n: int, k: int, device: torch.device, backend: str, rows: Tensor | None = None
    ) -> None:
        self.cells, self.n, self.k, self.device, self.backend, self.rows = cells, n, k, device, backend, rows
        self.start = 0  # the first cell, if this is one of several parts
        self._order: Tensor | None = None
        if cells is None:
            self.offsets = torch.tensor([0, n], dtype=torch.int32, device=device)
        else:
            self._order, self.offsets = ops.cell_sort(cells, k, backend=backend)

    @functools.cached_property
    @torch.inference_mode(False)
    def source(self) -> Tensor | None:
        """The sample of each sorted row, int32 [n]; None if the rows are not reordered."""
        order = self._order
        return order if self.rows is None or order is None else self.rows.int().index_select(0, order)

    @functools.cached_property
    @torch.inference_mode(False)
    def _inverse(self) -> Tensor:
        """The sorted row of each entry, int32 [n]."""
        assert self._order is not None
        rows = torch.arange(self.n, dtype=torch.int32, device=self.device)
        return torch.empty_like(self._order).scatter_(0, self._order.long(), rows)

    @functools.cached_property
    @torch.inference_mode(False)
    def sorted_cells(self) -> Tensor:
        """The cell of each sorted row, int64 [n]."""
        cells = torch.arange(self.k, device=self.device)
        return cells.repeat_interleave(self.offsets.diff(), output_size=self.n)

    @functools.cached_property
    def occupied(self) -> list[tuple[int, int, int]]:
        """(cell, first row, end row) of every cell that has samples; reads the offsets on the host."""
        pairs = enumerate(itertools.pairwise(self.offsets.tolist()))
        return [(cell, first, last) for cell, (first, last) in pairs if last > first]

    def parts(self, rows: int) -> list[Grouping]:
        """Splits the sorted rows into parts of complete cells with at most ``rows`` rows; larger cells are cut."""
        if self.n <= rows:
            return [self]
        groups, start, first_row = [], 0, 0
        for cell, first, last in self.occupied:
            if last - first_row > rows and first > first_row:
                groups.append((start, cell, first_row, first))
                start, first_row = cell, first
        groups.append((start, self.k, first_row, self.n))
        parts = []
        for start, stop, first_row, end in groups:
            count = -(-(end - first_row) // rows)
            edges = [first_row + (end - first_row) * i // count for i in range(count + 1)]
            for first, last in itertools.pairwise(edges):
                part = Grouping(None, last - first, stop - start, self.device, self.backend)
                part.offsets, part.start = self.offsets[start : stop + 1].clamp(first, last) - first, start
                parts.append(part)
        return parts

    def cells_of_rows(self, m: int) -> Tensor:
        """Returns the cell of each row of tensors with m entries per sample, int64 [n * m]."""
        return self.sorted_cells if m == 1 else self.sorted_cells.repeat_interleave(m)

    def scaled_offsets(self, m: int) -> Tensor:
        """Returns the ``offsets`` for tensors with m entries per sample."""
        return self.offsets if m == 1 else self.offsets * m

    def sort(self, x: Tensor) -> Tensor:
        """Gathers samples as entries sorted by cell: [samples, ...] -> [n, ...]."""
        if self.source is None:
            return x
        return self._permute(x) if self.rows is None else x.index_select(0, self.source)

    def unsort(self, x: Tensor) -> Tensor:
        """Returns rows [n, ...], which are sorted by cell, in the order of the entries."""
        return x if self.source is None else self._permute(x, back=True)

    def _permute(self, x: Tensor, back: bool = False) -> Tensor:
        order = self._order
        if x.requires_grad and torch.is_grad_enabled():
            permuted: Tensor = _applied(_Permute, x, *((self._inverse, order) if back else (order, self._inverse)))
            return permuted
        assert order is not None
        return x.index_select(0, self._inverse if back else order)

    def expand(self, stacked: Tensor, m: int = 1) -> Tensor:
        """Returns the tensor of each row's cell: [k, ...] -> [n * m, ...]."""
        # The rows must be exact copies, but a product in TF32 would round them.
        rounds = stacked.is_cuda and torch.backends.cuda.matmul.fp32_precision == "tf32"
        if not stacked.is_floating_point() or stacked[0].numel() == 0 or rounds:
            return stacked.index_select(0, self.cells_of_rows(m))
        # A grouped layer with inputs of 1: its backward sums each cell's rows, without the scatter-add of indexing.
        ones = stacked.new_ones(self.n * m, 1)
        weight = stacked.reshape(self.k, -1, 1)
        with torch.autocast(stacked.device.type, enabled=False):
            rows = ops.grouped_linear(ones, self.scaled_offsets(m), weight, backend=self.backend)
        return rows.reshape(self.n * m, *stacked.shape[1:])


def _applied(function: type[torch.autograd.Function], *args: Any) -> Any:
    """Applies a function of autograd without PyTorch's check of its signature, which takes 50 us."""
    if torch._C._are_functorch_transforms_active():
        return function.apply(*args)
    return super(torch.autograd.Function, function).apply(*args)  # type: ignore[misc]


class _Permute(torch.autograd.Function):
    """A permutation of rows whose backward is also a gather; the backward of indexing would be a scatter-add."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor, index: Tensor, inverse: Tensor) -> Tensor:
        return x.index_select(0, index)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(inputs[1], inputs[2])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        index, inverse = ctx.saved_tensors
        if torch.is_grad_enabled():
            return _applied(_Permute, gradient, inverse, index), None, None
        return gradient.index_select(0, inverse), None, None


class Assigned(NamedTuple):
    """A cached grouping, for other methods that are called with the same positions."""

    grouping: Grouping
    positions: Tensor
    key: Any  # the diagram, its version and the kind of assignment
    methods: set[str]  # names of the methods that have used this grouping

    def serves(self, method: str, positions: Tensor, key: Any, drawn: bool) -> bool:
        """Returns whether a call can reuse the grouping, and notes the call's method.

        The key and the positions must be the same. If cells are drawn at random, each method uses the grouping only
        once; its next call draws new cells.
        """
        if key != self.key or (drawn and method in self.methods) or positions.device != self.positions.device:
            return False
        self.methods.add(method)
        return torch.equal(self.positions, positions)


# Parameters -----------------------------------------------------------------------------------------------------------


def parts_of(module: nn.Module, parts: dict[int, nn.Module] | None = None) -> dict[int, nn.Module]:
    """Returns all submodules by id, in the order of ``modules()``, which itself takes three times as long.

    Each submodule is followed by its hidden submodules (:data:`HIDDEN`).
    """
    parts = {} if parts is None else parts
    if id(module) not in parts:
        parts[id(module)] = module
        for child in module._modules.values():
            if child is not None:
                parts_of(child, parts)
        for child in vars(module).get(HIDDEN, ()):
            parts_of(child, parts)
    return parts


def owned_parameters(module: nn.Module) -> list[tuple[nn.Module, str, nn.Parameter]]:
    """Lists (owner, name, parameter) of every parameter of a module tree; a parameter with two owners appears twice."""
    return [
        (owner, name, parameter)
        for owner in parts_of(module).values()
        for name, parameter in list(owner._parameters.items())
        if parameter is not None
    ]


def cell_parameters(module: nn.Module) -> list[nn.Parameter]:
    """Lists the stacked parameters, [k, ...], without the parameters that all cells share."""
    owned = [p for owner, name, p in owned_parameters(module) if name not in vars(owner).get(SHARED, ())]
    return list({id(parameter): parameter for parameter in owned}.values())


def cells_of(stacked: Tensor) -> tuple[Tensor, ...]:
    """Splits a stacked tensor [k, ...] into the tensor of each cell."""
    large = stacked.nbytes >= LARGE and stacked.requires_grad and torch.is_grad_enabled()
    cells: tuple[Tensor, ...] = _applied(_Cells, stacked) if large else stacked.unbind(0)
    return cells


class _Cells(torch.autograd.Function):
    """A split of a stacked tensor by cell; its backward writes the gradients into one tensor on huge memory pages."""

    generate_vmap_rule = True

    @staticmethod
    def forward(stacked: Tensor) -> tuple[Tensor, ...]:
        return stacked.unbind(0)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Any) -> None:
        ctx.save_for_backward(*inputs)
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> Tensor:
        (stacked,) = ctx.saved_tensors
        if torch.is_grad_enabled() or torch._C._are_functorch_transforms_active():  # for a second differentiation
            return torch.stack([torch.zeros_like(stacked[0]) if part is None else part for part in gradients])
        result = on_huge_pages(torch.empty_like(stacked))
        for part, gradient in zip(result.unbind(0), gradients, strict=True):
            part.zero_() if gradient is None else part.copy_(gradient)
        return result
