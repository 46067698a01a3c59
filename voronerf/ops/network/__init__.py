"""One network per cell: a program with the parameters of all cells, evaluated on the rows of each cell.

n rows, r rays, k cells, w columns, o outputs and i inputs of a matrix, e entries and f features of a table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core import backends
from voronerf.ops._core.backends import EVERYWHERE, FLOATS, Implementation
from voronerf.ops._core.checks import (
    FLOATING,
    INDEX,
    Default,
    TensorRule,
    TensorRules,
    check_flag,
    check_rules,
    check_shape,
    check_tensor,
    dtype_under_autocast,
)
from voronerf.ops._core.compiler import constant_result
from voronerf.ops._core.derivatives import add_gradients
from voronerf.ops._core.encodings import ENCODINGS
from voronerf.ops._core.program import Ahead, Names, Program, among, encoded_ahead
from voronerf.ops.network.cells import Cells

OP = backends.declare(
    "grouped_program",
    native=Implementation(EVERYWHERE, FLOATS, function="network"),
    warp=Implementation(EVERYWHERE, FLOATS, function="network"),
    reference=Implementation(function="network"),
)
"""The op whose row in the table of backends all networks share."""


_NAMES = Names()


class Network:
    """One network per cell: a program and the parameters of all cells.

    A program is a list of steps: layers, activations, encodings, sums, products and moves of columns
    (:mod:`voronerf.ops._core.program`). All values of a tile of rows stay in cache. Inputs and parameters have
    gradients of every order; the gradient of a program is a program itself.

    Args:
        program: the program to run, with at least one input.
        parameters: [k, o, i] or [k, w] for each parameter of the program, or [1, ...] or [...] if all cells share it;
            all of one dtype, except the table [k, e, f], [1, e, f] or [e, f] of a hash grid.
        names: the names in error messages.

    Attributes:
        given: the parameters, as the caller gave them.
        shared: for each parameter, whether the caller gave it without the dimension of cells.
        dtype_of_layers: the dtype of all parameters except tables; None without such parameters.

    Raises:
        TypeError: ``program`` is no Program, or ``parameters`` are no list of tensors.
        ValueError: there are not as many parameters as in the program.

    Examples:
        >>> import torch
        >>> from voronerf.ops import Cells, Network
        >>> from voronerf.ops._core.program import Builder
        >>> b = Builder()
        >>> x = b.input(2)
        >>> program = b.program([b.apply("exp", b.linear(x, b.parameter(1, 2), 1))])  # exp(W x), W [1, 2]
        >>> network = Network(program, [torch.tensor([[[1.0, 0.0]], [[0.0, 2.0]]], requires_grad=True)])
        >>> two_cells = Cells(cells=torch.tensor([0, 1], dtype=torch.int32))
        >>> (out,), tape = network.fwd([torch.zeros(2, 2)], two_cells)
        >>> out.flatten()
        tensor([1., 1.])
        >>> tape.backward([torch.ones(2, 1)])[1].shape  # of the input, then of the parameter
        torch.Size([2, 1, 2])
    """

    def __init__(self, program: Program, parameters: Sequence[Tensor], *, names: Names = _NAMES) -> None:
        if not isinstance(program, Program):
            raise TypeError(f"{names.op}: program must be a Program, got {type(program).__name__}")
        _check_list(names, "parameters", parameters, len(program.parameters))
        self.program, self.names, self.given, first = program, names, tuple(parameters), program.first_layer
        self.shared = tuple([p.dim() == len(shape) for p, shape in zip(parameters, program.parameters)])
        self.dtype_of_layers = None if first < 0 else parameters[first].dtype

    @property
    def parameters(self) -> Sequence[Tensor]:
        """The parameters, [k, ...] each, or [1, ...] for a parameter that all cells share."""
        if True not in self.shared:
            return self.given
        # New views for each call: an old view keeps the memory that `p.data = values` replaces.
        return [p.unsqueeze(0) if alone else p for p, alone in zip(self.given, self.shared)]

    def __call__(
        self, inputs: Sequence[Tensor], cells: Cells, *, ray_index: Tensor | None = None, backend: str = "auto"
    ) -> tuple[list[Tensor], Tensor | None]:
        """Evaluates every row with the parameters of its cell.

        Args:
            inputs: one floating-point tensor for each input of the program: [n, w]; or [r, w], one row for each ray,
                for the inputs in ``program.rays``. n and r < 2**31.
            cells: the cell of each row. Rows outside all cells have outputs 0; cells may be empty.
            ray_index: int32 [n], values 0 to r - 1, the ray of each row; None for a program without inputs of rays.
            backend: "auto", "reference", "native" or "warp". Warp runs layers and their encodings in kernels, and all
                other steps in PyTorch. A program with sums runs in PyTorch.

        Returns:
            The outputs of the program, in the order of the rows: [n, w] each, or [r, w] for the outputs in
            ``program.by_ray``, which are summed over the rows of each ray. Then the sums over the rows of a cell:
            [k, ...] each, or [1, e, f] for the gradient of a table that all cells share. The results have the dtype of
            the parameters (or of autocast, if it is enabled); without parameters, the dtype of the first input. Then
            the cells, int32 [n], or None for sorted rows.

        Raises:
            ValueError: offsets decrease or exceed n, a cell is outside 0 to k - 1, or an order or a ray_index is out of
                range (checked on the CPU only).
        """
        self.check(inputs, cells, ray_index)
        return self.run(inputs, cells, ray_index, backend)

    def fwd(
        self, inputs: Sequence[Tensor], cells: Cells, *, ray_index: Tensor | None = None, backend: str = "auto"
    ) -> tuple[list[Tensor], Tape]:
        """Evaluates every row; returns the results, without an autograd graph, and the tape of their gradients.

        The arguments are as in :meth:`__call__`.
        """
        self.check(inputs, cells, ray_index)
        learns = torch.is_grad_enabled()
        leaves = [*inputs, *self.given]
        wanted, dtype = [learns and tensor.requires_grad for tensor in leaves], self.dtype(inputs)
        plain = dtype is torch.float32 and all(leaf.dtype is torch.float32 for leaf in leaves)
        if plain and backends.chosen(OP, inputs[0].device, dtype, backend=backend) == "native":
            from voronerf.ops.network.native import Run

            with torch.no_grad():
                rows = cells.sort(inputs[0], self.count(cells), backend)
                run = Run.of(self.program, self.parameters, self.names, inputs, ray_index, rows, dtype)
                results, run = run.forward(any(wanted))
            return results, Tape(results, rows.cells, cells.frozen, leaves, wanted, run)
        own = [leaf.detach().requires_grad_(want) for leaf, want in zip(leaves, wanted)]  # leaves without hooks
        network = Network(self.program, own[len(inputs) :], names=self.names)
        outputs, found = network.run(own[: len(inputs)], cells._replace(frozen=None), ray_index, backend)
        return [out.detach() for out in outputs], Tape(
            outputs, found, cells.frozen, leaves, wanted, _Graph(outputs, own)
        )

    def run(
        self,
        inputs: Sequence[Tensor],
        cells: Cells,
        ray_index: Tensor | None = None,
        backend: str = "auto",
        dtype: torch.dtype | None = None,
    ) -> tuple[list[Tensor], Tensor | None]:
        """Evaluates tensors that have been checked; see :meth:`__call__`. Results have :meth:`dtype` by default."""
        dtype = dtype or self.dtype(inputs)
        run = backends.resolve(OP, backend=backend, device=inputs[0].device, dtype=dtype)
        rows = cells.sort(inputs[0], self.count(cells), backend)
        program, tensors = self.encoded(inputs, dtype)
        results: list[Tensor] = run(program, self.parameters, self.names, tensors, ray_index, rows, dtype)
        if cells.frozen is not None and rows.cells is not None:
            held = frozen_rows(cells.frozen, rows.cells)
            results = [stop_gradients(out, held) for out in results]
        return results, rows.cells

    def dtype(self, inputs: Sequence[Tensor]) -> torch.dtype:
        """Returns the dtype of the results: the layers' dtype, or autocast's; without layers, the first input's.

        With float16 and bfloat16, operands of products may be rounded; all other values are float32 at least.
        """
        dtype, first = self.dtype_of_layers, inputs[0]
        return first.dtype if dtype is None else dtype_under_autocast(dtype, first)

    def encoded(self, inputs: Sequence[Tensor], dtype: torch.dtype) -> tuple[Program, Sequence[Tensor]]:
        """Encodes float64 inputs in float64, for results of another dtype.

        Returns the program that reads the encodings, and its inputs.
        """
        if not self.program.encodes or dtype is torch.float64:
            return self.program, inputs
        wide = tuple([x.dtype is torch.float64 for x in inputs])
        if True not in wide:
            return self.program, inputs
        program, ahead = _encoded_ahead(self.program.text, wide)
        further = []
        for i, start, width, name, size in ahead:
            further.append(ENCODINGS[name].formula(inputs[i][:, start : start + width], size))
        return program, [*inputs, *further]

    def count(self, cells: Cells) -> int:
        """Returns the number of cells."""
        if cells.k is not None:
            return cells.k
        return next((p.shape[0] for p in self.parameters if p.shape[0] != 1), 1)

    def check(self, inputs: Sequence[Tensor], cells: Cells, ray_index: Tensor | None) -> None:
        """Raises the errors of a call with these arguments; reads the values of tensors on the CPU only."""
        op, program, parameters, names = self.names.op, self.program, self.given, self.names
        if not program.inputs:
            raise ValueError(f"{op}: program must have at least one input, got none")
        _check_list(names, "inputs", inputs, len(program.inputs))
        if (ray_index is not None) != (len(program.rays) > 0):
            rule = "given for a program with" if program.rays else "None for a program without"
            came = "None" if ray_index is None else "an index"
            raise ValueError(f"{op}: {names.ray_index} must be {rule} inputs of rays, got {came}")
        rules, tensors = cells.to_check(op)
        first = 1 if cells.offsets is not None else 0  # offsets tell the number of cells
        all_tensors = [*tensors[:first], *inputs, *parameters, *tensors[first:]]
        if ray_index is not None:
            all_tensors.append(ray_index)
        others = tuple(rules[:first]), tuple(rules[first:])
        facts = program, names, self.dtype_of_layers, self.shared, cells.k
        sizes = check_rules(op, _rules, all_tensors, *facts, *others)
        if ray_index is not None and not sizes["r"] and sizes["n"]:
            at = next(i for i in range(len(inputs)) if among(i, program.rays))
            shape = list(inputs[at].shape)
            raise ValueError(f"{op}: {names.of('inputs', at)} must hold a row for the {names.ray_index}, got {shape}")
        if cells.offsets is None and (program.sums or program.by_ray or among(0, program.rays)):
            raise ValueError(f"{op}: program must have outputs [n, w], and inputs[0] with one row for each sample")
        cells.check(op, inputs[0], sizes)


@constant_result
def _encoded_ahead(text: str, wide: tuple[bool, ...]) -> tuple[Program, tuple[Ahead, ...]]:
    return encoded_ahead(Program.parse(text), wide)


def _check_list(names: Names, kind: str, tensors: Any, count: int) -> None:
    if not isinstance(tensors, Sequence):
        raise TypeError(f"{names.op}: {kind} must be a list, got {type(tensors).__name__}")
    if len(tensors) != count:
        raise ValueError(f"{names.op}: {kind} must have {count} tensors, got {len(tensors)}")
    for i, tensor in enumerate(tensors):
        if not isinstance(tensor, Tensor):
            check_tensor(names.op, names.of(kind, i), tensor)


def _rules(
    program: Program,
    names: Names,
    dtype: torch.dtype | None,
    shared: Sequence[bool],
    k: int | None,
    first: Sequence[TensorRule],
    last: Sequence[TensorRule],
) -> TensorRules:
    """Returns the rules for the tensors of a network: ``first``, inputs, parameters, ``last`` and the ray index.

    ``dtype`` is the dtype of all parameters except tables, or None without such parameters. ``shared`` tells for each
    parameter whether it lacks the dimension of cells; ``k`` is the number of cells, or None if the tensors tell it.
    """
    rules: list[TensorRule | Default] = [*first, *([] if k is None else [Default("k", k)])]
    for i, width in enumerate(program.inputs):
        rules.append(TensorRule(names.of("inputs", i), FLOATING, ("r" if among(i, program.rays) else "n", width)))
    like = ""
    for i, shape in enumerate(program.parameters):
        name, table = names.of("parameters", i), among(i, program.tables)
        dtypes = FLOATING if dtype not in FLOATING or table or not like else (dtype,)
        empty = "" if shared[i] else "must hold at least one cell"
        rules.append(TensorRule(name, dtypes, shape if shared[i] else ("1|k", *shape), "" if table else like, empty))
        like = like if like or table else name
    rules += [Default("k", 1), *last]
    if program.rays:
        rules.append(TensorRule(names.ray_index, INDEX, ("n",)))
    return rules


class _Graph(NamedTuple):
    """An autograd graph, which serves as the tape of an evaluation outside of the compiled module.

    Attributes:
        outputs: the results, with gradients.
        leaves: the inputs, then the parameters.
    """

    outputs: Sequence[Tensor]
    leaves: Sequence[Tensor]

    def backward(self, gradients: Sequence[Tensor | None], wanted: Sequence[bool]) -> list[Tensor | None]:
        """Returns the gradients of the leaves; None for an unwanted gradient."""
        pairs = [(out, g.to(out.dtype)) for out, g in zip(self.outputs, gradients) if g is not None]
        pairs = [(out, g) for out, g in pairs if out.requires_grad]
        chosen = [leaf for leaf, want in zip(self.leaves, wanted) if want]
        if not pairs or not chosen:
            return [None] * len(wanted)
        outputs, arriving = zip(*pairs)
        slopes = iter(torch.autograd.grad(outputs, chosen, arriving, retain_graph=True, allow_unused=True))
        return [next(slopes) if want else None for want in wanted]


@dataclass(eq=False)
class Tape:
    """The tape of a forward pass: what its backward pass needs.

    Attributes:
        outputs: the results of the forward pass.
        cells: int32 [n], the cell of each row; None for sorted rows.
        frozen: bool [k], the frozen cells, or None.
        leaves: the inputs, then the parameters, as the caller gave them.
        wanted: for each leaf, whether it has a gradient.
        run: the evaluation, whose ``backward`` computes the gradients.

    Examples:
        >>> import torch
        >>> from voronerf import MLP, Layer
        >>> from voronerf.ops import Cells, Network
        >>> weight = torch.tensor([[[2.0]]], requires_grad=True)
        >>> table = MLP((Layer(("positions",), 1),), outputs=(0,))
        >>> network = Network(table.program(1, 0, None, (False,)), [weight])
        >>> (out,), tape = network.fwd([torch.ones(4, 1)], Cells())
        >>> loss = tape.learn(out.square().mean(), [out * (2 / 4)])
        >>> float(loss), float(weight.grad)
        (4.0, 4.0)
    """

    outputs: Sequence[Tensor]
    cells: Tensor | None
    frozen: Tensor | None
    leaves: Sequence[Tensor]
    wanted: Sequence[bool]
    run: Any

    def backward(self, gradients: Sequence[Tensor | None], wanted: Sequence[bool] | None = None) -> list[Tensor | None]:
        """Returns the gradients of the inputs, then of the parameters, without an autograd graph.

        Args:
            gradients: the gradient of a loss with respect to each result, or None.
            wanted: for each input, then for each parameter, whether to return its gradient; by default True.

        Returns:
            The gradients; None if it is unwanted, if the tensor requires no gradient or if no result depends on it.
        """
        if self.frozen is not None and self.cells is not None:  # the backward pass drops rows with a zero gradient
            held = frozen_rows(self.frozen, self.cells)
            gradients = [None if g is None else g.masked_fill(held, 0) for g in gradients]
        chosen = self.wanted if wanted is None else [a and b for a, b in zip(wanted, self.wanted, strict=True)]
        with torch.no_grad():
            slopes = self.run.backward(gradients, chosen)
            pairs = zip(slopes, self.leaves, strict=True)
            return [g if g is None or g.dim() == leaf.dim() else g.view_as(leaf) for g, leaf in pairs]

    def learn(self, loss: Tensor, gradients: Sequence[Tensor], *, defer: bool = False) -> Tensor:
        """Adds the gradients of a loss to ``.grad`` of the inputs and parameters. Call ``learn`` only once.

        Args:
            loss: [], the loss.
            gradients: the gradient of the loss with respect to each result.
            defer: whether to add the gradients only when ``backward`` of the returned loss is called.

        Returns:
            The loss [], detached unless deferred.

        Raises:
            ValueError: ``loss`` or a gradient has another shape.
        """
        check_shape("learn", "loss", loss, ())
        check_flag("learn", "defer", defer)
        for i, (gradient, out) in enumerate(zip(gradients, self.outputs, strict=True)):
            check_shape("learn", f"gradients[{i}]", gradient, out.shape)
        learning = [leaf for leaf, want in zip(self.leaves, self.wanted) if want]

        def slopes(scale: Tensor | None) -> list[Tensor | None]:
            arriving = [g.detach() if scale is None else g.detach() * scale for g in gradients]
            return [g for g, want in zip(self.backward(arriving), self.wanted) if want]

        return add_gradients(loss.detach(), learning, slopes, defer)


def frozen_rows(frozen: Tensor, cells: Tensor) -> Tensor:
    """Returns bool [n, 1], whether each row's cell is frozen; a row in no cell (-1) counts as in cell 0."""
    return frozen.index_select(0, cells.clamp(min=0))[:, None]


def stop_gradients(out: Tensor, rows: Tensor) -> Tensor:
    """Returns ``out`` with zero gradients in ``rows``, bool [n, 1]; the native backward pass drops these rows."""
    return _StopGradients.apply(out, rows) if out.requires_grad else out


class _StopGradients(torch.autograd.Function):
    @staticmethod
    def forward(out: Tensor, rows: Tensor) -> Tensor:
        return out.view_as(out)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(inputs[1])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return gradient.masked_fill(ctx.saved_tensors[0], 0), None
