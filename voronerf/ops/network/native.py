"""Programs in the compiled module. Every op that evaluates a network per cell runs as a program.

n rows, r rays, k cells, w columns.

The gradient of a program and its higher derivatives are programs too, which the same op runs. A program with
derivatives that the compiled module lacks runs in PyTorch.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core import backends, native
from voronerf.ops._core.compiler import constant_result
from voronerf.ops._core.custom_op import custom_op
from voronerf.ops._core.derivatives import needed_gradients
from voronerf.ops._core.program import Names, Program, among, gradient, gradient_reaches
from voronerf.ops._core.rows import new_empty, rows_of
from voronerf.ops.network.cells import Sorted
from voronerf.ops.network.lowering import Lowered, compiled_runs, lower
from voronerf.ops.network.reference import evaluate

PRODUCTS = {torch.bfloat16: "bfloat16", torch.float16: "float16"}
"""The operand type of products for each dtype of results; "float32" for other dtypes."""


class Run(NamedTuple):
    """The tensors of a program and the options with which it runs: the arguments of the custom op.

    Attributes:
        inputs: [n, w] each, or [r, w] with a row for each ray; all float32 or all bfloat16.
        parameters: [k, ...] each, or [1, ...] if all cells share the parameter; float32, except tables of hash grids.
        offsets: int32 [k + 1], the first row of each cell, and the end of the last cell.
        order: int32 [n], or None for rows that are sorted by cell.
        ray_index: int32 [n], or None without rays.
        kept: float32 [n, w] for each hash grid: the features that an earlier pass looked up, sorted by cell. Empty for
            a first pass.
        text: the text of the program.
        op: the name of the op for error messages.
        index_name: the name of the argument of the op that is ``ray_index``.
        products: the type of the operands of products: "float32", "bfloat16" or, on CUDA, "float16".
        keep: whether the features looked up in hash grids are additional results.
        gradients: the index of the first input that is a gradient, or -1. Rows whose gradients are all 0 add nothing to
            any sum, so they may be dropped.
    """

    inputs: Sequence[Tensor]
    parameters: Sequence[Tensor]
    offsets: Tensor
    order: Tensor | None
    ray_index: Tensor | None
    kept: Sequence[Tensor]
    text: str
    op: str = "network"
    index_name: str = "ray_index"
    products: str = "float32"
    keep: bool = False
    gradients: int = -1

    @staticmethod
    def of(
        program: Program,
        parameters: Sequence[Tensor],
        names: Names,
        inputs: Sequence[Tensor],
        ray_index: Tensor | None,
        rows: Sorted,
        dtype: torch.dtype,
    ) -> Run:
        """Returns the run of a program on sorted rows; casts the tensors.

        If all inputs and the results are bfloat16, they are read and written without casts. Otherwise inputs are cast
        to float32. Parameters are always cast to float32; a cell has few of them. If the results are bfloat16, products
        take bfloat16 operands on processors that multiply them faster (AVX512-BF16, AMX), and float32 operands
        elsewhere. Sums are always float32.
        """
        products = "float32"
        if dtype is not torch.float32 or program.tables:
            products = PRODUCTS.get(dtype, "float32")
            parameters = [
                p if p.dtype is torch.float32 or (among(i, program.tables) and p.dtype in _NAMES) else p.float()
                for i, p in enumerate(parameters)
            ]
        stored = dtype is torch.bfloat16 and not program.tables and all(x.dtype is dtype for x in inputs)
        if not stored:  # hash grids take positions in float32
            inputs = [x if x.dtype is torch.float32 else x.float() for x in inputs]
        text, op, index_name = program.text, names.op, names.ray_index
        return Run(inputs, parameters, rows.offsets, rows.order, ray_index, (), text, op, index_name, products)

    def results(self) -> list[Tensor]:
        """Returns the outputs and sums, with gradients of every order."""
        if not (torch.is_grad_enabled() or torch.compiler.is_dynamo_compiling()):
            direct = _direct(self, asked=True)
            if direct is not None:
                return direct
        keep = torch.is_grad_enabled() and bool(_tables(self.text))
        keep = keep and any(t.requires_grad for t in (*self.inputs, *self.parameters))
        results: list[Tensor] = run(*(self._replace(keep=True) if keep else self))
        return results[: _results(self.text)] if keep else results

    def forward(self, keep: bool) -> tuple[list[Tensor], Run]:
        """Returns the outputs and sums without an autograd graph, and the run from which :meth:`backward` starts.

        ``keep`` tells whether this run holds the features of hash grids, which the backward pass needs.
        """
        with torch.no_grad():
            results, count = run(*self._replace(keep=keep)), _results(self.text)
        return results[:count], self._replace(kept=results[count:])

    def backward(self, gradients: Sequence[Tensor | None], wanted: Sequence[bool]) -> list[Tensor | None]:
        """Returns the gradients of the inputs, then of the parameters; with gradients enabled, they have gradients.

        A gradient is None if it is unwanted, or if no arriving gradient reaches the tensor (:func:`gradient_reaches`).

        Args:
            gradients: the gradient of each result of the program, or None.
            wanted: whether to return the gradient, for each input, then for each parameter.
        """
        program, count, present = Program.parse(self.text), len(self.inputs), tuple([g is not None for g in gradients])
        results = list[Tensor | None]([None] * len(wanted))
        if not any(wanted) or not any(present):
            return results
        split, tensors = len(program.outputs), [g for g in gradients if g is not None]
        derived = _gradient(program.text, count, tuple(wanted), present)
        if not derived.places:
            return results
        of_outputs = sum(present[:split])
        inputs, parameters = [*self.inputs, *tensors[:of_outputs]], [*self.parameters, *tensors[of_outputs:]]
        kept, first = self.kept if derived.keeps else (), count if derived.sifts else -1
        _, _, offsets, order, ray_index, _, _, op, index_name, products, _, _ = self
        second = Run(  # `_replace` takes three times as long
            inputs, parameters, offsets, order, ray_index, kept, derived.text, op, index_name, products, False, first
        )
        values = second.results()
        for place, total in zip(derived.places, values, strict=True):
            if place >= count:
                p = self.parameters[place - count]
                if total.numel() != p.numel():  # all cells share the parameter
                    total = total.sum(0, keepdim=True)
                total = total.to(p.dtype) if program.tables else total  # all other parameters are float32
            results[place] = total
        return results


def network(*arguments: Any) -> list[Tensor]:
    """Runs a program on the rows of each cell; see ``voronerf.ops.network.Network``."""
    results, dtype = Run.of(*arguments).results(), arguments[-1]
    return results if dtype is torch.float32 else [out.to(dtype) for out in results]


class _Gradient(NamedTuple):
    """The gradient of a program.

    Attributes:
        text: the text of the gradient's program.
        places: for each result, the index of the tensor whose gradient it is, among the inputs, then the parameters.
        keeps: whether the gradient can use the grid features that the program kept.
        sifts: whether rows whose arriving gradients are all 0 may be dropped.
    """

    text: str
    places: tuple[int, ...]
    keeps: bool
    sifts: bool


@functools.lru_cache(maxsize=1024)
def _gradient(text: str, count: int, wanted: tuple[bool, ...], present: tuple[bool, ...]) -> _Gradient:
    program = Program.parse(text)
    split = len(program.outputs)
    reached = gradient_reaches(program, present[:split], present[split:])
    wanted = tuple([want and reaches for want, reaches in zip(wanted, reached, strict=True)])
    derived = gradient(program, wanted[:count], wanted[count:], present[:split], present[split:])
    sifts = not derived.outputs and all(i < count for i in derived.rays) and not any(present[split:])
    keeps = bool(program.grids) and compiled_runs(derived.text) and compiled_runs(text)
    keeps = keeps and lower(derived.text).lookups == lower(text).lookups
    return _Gradient(derived.text, tuple([place for place, want in enumerate(wanted) if want]), keeps, sifts)


@constant_result
def _results(text: str) -> int:
    """Returns the number of outputs and sums of the program ``text``, which precede kept grid features."""
    program = Program.parse(text)
    return len(program.outputs) + len(program.sums)


@functools.lru_cache(maxsize=1024)
def _constant_results(text: str) -> tuple[int, ...]:
    """Returns the indices of the outputs without a gradient, such as detached outputs.

    Excludes gradients that are 0, which `gradient` writes as a move of no columns: PyTorch can differentiate them.
    """
    program = Program.parse(text)
    zeros = {step.out for step in program.steps if step.op == "move" and not step.operands}
    constant = list[int]()
    for i, columns in enumerate(program.outputs):
        alone = [j == i for j in range(len(program.outputs))]
        if columns.index not in zeros and not any(gradient_reaches(program, alone, [False] * len(program.sums))):
            constant.append(i)
    return tuple(constant)


@constant_result
def _tables(text: str) -> tuple[int, ...]:
    """Returns the indices of the parameters that are tables of hash grids."""
    return Program.parse(text).tables


# The op ---------------------------------------------------------------------------------------------------------------


def _sizes(program: Program, call: Run) -> tuple[int, int]:
    """Returns the numbers of rows and rays."""
    n = rows_of(call.inputs[0] if call.ray_index is None else call.ray_index)
    return n, rows_of(call.inputs[program.rays[0]]) if program.rays else 0


def _memory(call: Run) -> list[Tensor]:
    """Allocates the outputs of a program, its sums and the kept features."""
    program, like = Program.parse(call.text), call.inputs[0]
    n, r = _sizes(program, call)
    results = [
        new_empty(like, r if i in program.by_ray else n, columns.width) for i, columns in enumerate(program.outputs)
    ]
    if program.sums:
        counts = program.cells_of_sums(call.parameters, call.offsets.shape[0] - 1)
        dtype = None if like.dtype is torch.float32 else torch.float32
        results += [new_empty(like, count, *shape, dtype=dtype) for count, shape in zip(counts, program.sums)]
    if call.keep and program.grids and compiled_runs(program.text):
        widths = lower(program.text).widths  # the same in every layout; fake tensors have no layout
        results += [new_empty(like, n, width, dtype=torch.float32) for width in widths]
    return results


def _direct(call: Run, asked: bool) -> list[Tensor] | None:
    """Returns the results of a CPU call, for which the compiled module allocates them; None if Python has to do it.

    With ``asked``, also returns None for calls that modes, transforms or profilers of torch observe.
    """
    if not compiled_runs(call.text) or native.on_cuda(call.offsets):
        return None
    results: list[Tensor] | None = lower(call.text, _cpu_layout(call.products)).call(call, asked)
    return results


@custom_op("network", _memory, counted=True)
def run(call: Run) -> list[Tensor]:
    """Runs a program: returns its outputs, its sums and, if ``keep``, the features looked up in hash grids."""
    results = _direct(call, False)
    if results is not None:
        return results
    program, results = Program.parse(call.text), _memory(call)
    if not compiled_runs(program.text):
        inputs = [x.float() for x in call.inputs]
        with torch.autocast(call.offsets.device.type, enabled=False):
            values = evaluate(inputs, call.parameters, call.offsets, call.order, call.ray_index, program)
        for to, result in zip(results, values, strict=True):
            to.copy_(result)
        return results
    split, end = len(program.outputs), len(program.outputs) + len(program.sums)
    outputs, sums, keeps = results[:split], results[split:end], results[end:]
    on_cuda = native.on_cuda(call.offsets)
    lowered = lower(program.text, _layout(call.products, call.offsets), on_cuda)
    fill = _fill_on_cuda if on_cuda else _fill
    fill(program, lowered, call, inputs_of(lowered, call, *_sizes(program, call), keeps), outputs, sums)
    return results


def inputs_of(lowered: Lowered, call: Run, n: int, r: int, keeps: Sequence[Tensor] = ()) -> tuple[Any, ...]:
    """Returns the inputs of the compiled function (`ProgramInputs` in csrc/network/program.h), for n rows and r rays.

    ``keeps`` is memory for the features that hash grids look up.
    """
    inputs, parameters, offsets, order, ray_index, kept, *_ = call
    if native.on_cuda(offsets):
        parameters = [native.aligned(p) for p in parameters]
    gradients = -1 if keeps else call.gradients  # features are kept for all rows
    tensors = lowered.call, inputs, parameters, offsets, order, ray_index, keeps or kept or None
    return *tensors, not keeps, gradients, call.op, call.index_name, n, r


def _fill(
    program: Program, lowered: Lowered, call: Run, inputs: tuple[Any, ...], outputs: list[Tensor], sums: list[Tensor]
) -> None:
    """Fills the results on the CPU."""
    written = [to.float() if i in program.by_ray else to for i, to in enumerate(outputs)]  # sums of rays are float32
    native.compiled.grouped_program(lowered.program, inputs, _results_of(written, sums), native.cpu())
    for to, result in zip(outputs, written):
        if to is not result:
            to.copy_(result)


def _fill_on_cuda(
    program: Program, lowered: Lowered, call: Run, inputs: tuple[Any, ...], outputs: list[Tensor], sums: list[Tensor]
) -> None:
    """Fills the results on CUDA. The kernels write a row for each sample; this function sums the rows of each ray."""
    offsets, index, (n, r), k = call.offsets, call.ray_index, inputs[-2:], call.offsets.shape[0] - 1
    if any(step.op == "scatter" for step in program.steps):
        native.refuse_where_deterministic(call.op, offsets)
    tf32 = call.products == "float32" and torch.backends.cuda.matmul.fp32_precision == "tf32"
    written = list(outputs)
    for i in program.by_ray:
        written[i] = torch.empty(n, outputs[i].shape[1], dtype=torch.float32, device=offsets.device)
    machine = native.compiled.Cuda(*native.stream(offsets))
    size = native.compiled.grouped_program_workspace(lowered.program, n, r, k, machine)
    workspace = torch.empty(size, dtype=torch.uint8, device=offsets.device)
    layout = _layout(call.products, offsets)
    products = "tf32" if tf32 else call.products if layout == "tiles" else "float32"
    code, results = _code(program.text, layout, offsets.device), _results_of(written, sums)
    native.compiled.grouped_program(lowered.program, code, inputs, results, products, workspace, machine)
    for i in program.by_ray:
        total = torch.zeros(r, outputs[i].shape[1], dtype=torch.float32, device=offsets.device)
        if index is not None and n and r:
            total.index_add_(0, index.clamp(0, r - 1), written[i])
        outputs[i].copy_(total)


def _results_of(outputs: list[Tensor], sums: list[Tensor]) -> native.compiled.ProgramResults:
    return native.compiled.ProgramResults(outputs, [_NAMES[to.dtype] for to in outputs], sums)


@functools.lru_cache(maxsize=1024)
def _code(text: str, layout: str, device: torch.device) -> Tensor:
    """Returns a program as kernels read it, uint8 on a device; cached."""
    program = lower(text, layout, True).program
    code = torch.empty(native.compiled.program_code_bytes(program), dtype=torch.uint8, device="cpu")
    native.compiled.program_code(program, code)
    return code.to(device)


_NAMES = {torch.float32: "float32", torch.bfloat16: "bfloat16", torch.float16: "float16"}


_LAYOUTS = {
    "avx512_bf16": {"bfloat16": "pairs", "bf16": "pairs"},
    "amx": {"bfloat16": "tiles", "bf16": "tiles", "tf32": "parts"},
}


def _layout(products: str, tensor: Tensor) -> str:
    """Returns the layout of values: "floats", or one for 16-bit products if they are requested and the device has them.

    For float32 on the CPU, ``torch.set_float32_matmul_precision`` decides. For "high", each operand is split into
    two bfloat16 parts.
    """
    if native.on_cuda(tensor):
        return "tiles" if products != "float32" and _multiplies_halves(products, tensor.device) else "floats"
    return _cpu_layout(products)


def _cpu_layout(products: str) -> str:
    layouts = _LAYOUTS.get(native.isa())
    if layouts is None:
        return "floats"
    return layouts.get(backends.cpu_precision() if products == "float32" else products, "floats")


@functools.lru_cache(maxsize=64)
def _multiplies_halves(products: str, device: torch.device) -> bool:
    """Returns whether a GPU has products of this 16-bit type."""
    machine = native.compiled.Cuda(*native.stream(torch.empty(0, device=device)))
    return native.compiled.multiplies_halves(products, machine)


def _save(ctx: Any, inputs: Sequence[Any], output: Sequence[Tensor]) -> None:
    rows, parameters, offsets, order, ray_index, earlier, *ctx.options = inputs
    text = ctx.options[0]
    kept, constant = output[_results(text) :], _constant_results(text)
    ctx.set_materialize_grads(False)
    if kept or constant:
        ctx.mark_non_differentiable(*kept, *[output[i] for i in constant])
    ctx.counts = len(rows), len(parameters), len(earlier)
    ctx.save_for_backward(*rows, *parameters, offsets, order, ray_index, *kept)


def _gradients(ctx: Any, arriving: Sequence[Tensor | None]) -> Sequence[Any]:
    inputs, parameters, kept = ctx.counts
    tensors, saved = inputs + parameters, ctx.saved_tensors
    lists = saved[:inputs], saved[inputs:tensors], *saved[tensors : tensors + 3], saved[tensors + 3 :]
    call = Run._make((*lists, *ctx.options))
    wanted = needed_gradients(ctx, saved[:tensors])
    gradients = call.backward(arriving[: _results(call.text)], wanted)
    nothing = [None] * (len(Run._fields) - 6)
    return gradients[:inputs], gradients[inputs:], None, None, None, [None] * kept, *nothing


run.register_autograd(_gradients, setup_context=_save)
