"""Programs in the compiled module. Every op that evaluates a network per cell runs as a program.

n rows, r rays, k cells, w columns.

The gradient of a program and its higher derivatives are programs too, which the same op runs. A program with
derivatives that the compiled module lacks runs in PyTorch.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from voronerf.ops._core import backends, native
from voronerf.ops._core.compiler import constant_result
from voronerf.ops._core.custom_op import custom_op
from voronerf.ops._core.derivatives import needed_gradients
from voronerf.ops._core.program import Program, gradient, gradient_reaches
from voronerf.ops._core.rows import new_empty, rows_of
from voronerf.ops.grouped_program.arguments import ProgramArguments, index_name
from voronerf.ops.grouped_program.lowering import Lowered, compiled_runs, lower
from voronerf.ops.grouped_program.reference import evaluate


class RunTensors(NamedTuple):
    """The tensors of a program.

    Attributes:
        inputs: [n, w] each, or [r, w] with a row for each ray; all float32 or all bfloat16.
        parameters: [k, ...] each, or [1, ...] if all cells share the parameter; float32, except tables of hash grids.
        offsets: int32 [k + 1], the first row of each cell, and the end of the last cell.
        order: int32 [n], or None for rows that are sorted by cell.
        ray_index: int32 [n], or None without rays.
        kept: float32 [n, w] for each hash grid: the features that an earlier pass looked up, sorted by cell. Empty for
            a first pass.
    """

    inputs: Sequence[Tensor]
    parameters: Sequence[Tensor]
    offsets: Tensor
    order: Tensor | None
    ray_index: Tensor | None
    kept: Sequence[Tensor] = ()


class RunOptions(NamedTuple):
    """The options with which a program runs.

    Attributes:
        text: the text of the program.
        caller: the name of the op for error messages.
        products: the type of the operands of products: "float32", "bfloat16" or, on CUDA, "float16".
        keep: whether the features looked up in hash grids are additional results, see `RunTensors`.
        gradients: the index of the first input that is a gradient, or -1. Rows whose gradients are all 0 add nothing to
            any sum, so they may be dropped.
    """

    text: str
    caller: str = "grouped_program"
    products: str = "float32"
    keep: bool = False
    gradients: int = -1


class Network(NamedTuple):
    """A program with its tensors in the dtypes of the op.

    If all inputs and the results are bfloat16, they are read and written without casts. Otherwise inputs are cast to
    float32, and results back. Parameters are always cast to float32; a cell has few of them. If the results are
    bfloat16, products take bfloat16 operands on processors that multiply them faster (AVX512-BF16, AMX), and float32
    operands elsewhere. Sums are always float32.

    Attributes:
        inputs: in float32, or all in bfloat16 like the results.
        parameters: in float32, except tables of hash grids.
        ray_index: int32 [n] if some inputs have one row for each ray, or None.
        options: the options with which the program runs.
        dtype: the dtype of the results.
    """

    inputs: Sequence[Tensor]
    parameters: Sequence[Tensor]
    ray_index: Tensor | None
    options: RunOptions
    dtype: torch.dtype

    @staticmethod
    def of(arguments: ProgramArguments) -> Network:
        """Returns the network of the arguments, with its tensors cast."""
        text, inputs, parameters, index, dtype, caller = arguments
        tables = _tables(text)  # hash grids take positions in float32
        stored = dtype is torch.bfloat16 and not tables and all(x.dtype is dtype for x in inputs)
        rows = inputs if stored else [x if x.dtype is torch.float32 else x.float() for x in inputs]
        cast_parameters = [
            p if p.dtype is torch.float32 or (any(i == table for table in tables) and p.dtype in _NAMES) else p.float()
            for i, p in enumerate(parameters)
        ]
        return Network(rows, cast_parameters, index, RunOptions(text, caller, PRODUCTS.get(dtype, "float32")), dtype)

    def rows(self, offsets: Tensor, order: Tensor | None = None) -> RunTensors:
        """Returns the tensors of the program, with the offsets [k + 1] of the cells and the order of the rows."""
        return RunTensors(self.inputs, self.parameters, offsets, order, self.ray_index)

    def run(self, offsets: Tensor, order: Tensor | None = None) -> list[Tensor]:
        """Returns the results: outputs [n, w] and sums."""
        results = run_program(self.rows(offsets, order), self.options)
        return [out if out.dtype is self.dtype else out.to(self.dtype) for out in results]


PRODUCTS = {torch.bfloat16: "bfloat16", torch.float16: "float16"}
"""The operand type of products for each dtype of results; "float32" for other dtypes."""


def grouped_program(arguments: ProgramArguments, offsets: Tensor, order: Tensor | None) -> list[Tensor]:
    """Runs a program on the rows of each cell; see ``voronerf.ops.grouped_program``."""
    return Network.of(arguments).run(offsets, order)


def run_program(rows: RunTensors, options: RunOptions) -> list[Tensor]:
    """Returns the outputs and sums of a program, with gradients of every order."""
    if torch.is_grad_enabled() and _tables(options.text):
        options = options._replace(keep=any(t.requires_grad for t in (*rows.inputs, *rows.parameters)))
    results: list[Tensor] = run(rows, options)
    return results[: _results(options.text)] if options.keep else results


@constant_result
def _results(text: str) -> int:
    """Returns the number of outputs and sums; kept features follow them in the list of results."""
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


class _Call(NamedTuple):
    """The arguments of the custom op: the tensors of a program, and its options."""

    rows: RunTensors
    options: RunOptions


def _sizes(program: Program, rows: RunTensors) -> tuple[int, int]:
    """Returns the numbers of rows and rays."""
    n = rows_of(rows.inputs[0] if rows.ray_index is None else rows.ray_index)
    return n, rows_of(rows.inputs[program.rays[0]]) if program.rays else 0


def _memory(arguments: _Call) -> list[Tensor]:
    """Allocates the outputs of a program, its sums and the kept features."""
    rows, options = arguments
    program, like = Program.parse(options.text), rows.inputs[0]
    n, r = _sizes(program, rows)
    results = [
        new_empty(like, r if i in program.by_ray else n, columns.width) for i, columns in enumerate(program.outputs)
    ]
    if program.sums:
        counts = program.cells_of_sums(rows.parameters, rows.offsets.shape[0] - 1)
        dtype = None if like.dtype is torch.float32 else torch.float32
        results += [new_empty(like, count, *shape, dtype=dtype) for count, shape in zip(counts, program.sums)]
    if options.keep and program.grids and compiled_runs(program.text):
        widths = lower(program.text).widths  # the same in every layout; fake tensors have no layout
        results += [new_empty(like, n, width, dtype=torch.float32) for width in widths]
    return results


@custom_op("grouped_program_native", _memory, counted=True)
def run(arguments: _Call) -> list[Tensor]:
    """Runs a program."""
    return _run(*arguments)


def _run(rows: RunTensors, options: RunOptions) -> list[Tensor]:
    """Returns the results of a program: outputs, sums and kept features."""
    program = Program.parse(options.text)
    if not compiled_runs(program.text):
        results = _memory(_Call(rows, options))
        inputs = [x.float() for x in rows.inputs]
        values = evaluate(inputs, rows.parameters, rows.offsets, rows.order, rows.ray_index, program.text)
        for to, result in zip(results, values, strict=True):
            to.copy_(result)
        return results
    on_cuda = native.on_cuda(rows.offsets)
    lowered = lower(program.text, _layout(options.products, rows.offsets), on_cuda)
    direct = None if on_cuda else lowered.call(rows, options.keep, options.gradients, options.caller, False)
    return _run_by_structs(program, lowered, _Call(rows, options)) if direct is None else direct


def _run_without_gradients(rows: RunTensors, options: RunOptions) -> list[Tensor] | None:
    """Returns the results of a CPU call without gradients that nothing in torch observes, or None to use the op."""
    text = options.text
    if native.on_cuda(rows.offsets) or not compiled_runs(text):
        return None
    lowered = lower(text, _layout(options.products, rows.offsets), False)
    results: list[Tensor] | None = lowered.call(rows, options.keep, options.gradients, options.caller, True)
    return results


run.without_gradients = _run_without_gradients


def _run_by_structs(program: Program, lowered: Lowered, arguments: _Call) -> list[Tensor]:
    """Returns the results of a call that is recorded or on CUDA: Python allocates the results and makes the structs."""
    (rows, options), tensors = arguments, _memory(arguments)
    n, r = _sizes(program, rows)
    split, end = len(program.outputs), len(program.outputs) + len(program.sums)
    outputs, sums, keeps = tensors[:split], tensors[split:end], tensors[end:]
    gradients = -1 if keeps else options.gradients  # features are kept for all rows
    lookups = keeps or rows.kept or None
    inputs = program_inputs(
        lowered, rows, n, r, kept=lookups, ready=not keeps, gradients=gradients, caller=options.caller
    )
    if native.on_cuda(rows.offsets):
        _run_on_cuda(program, lowered, rows, options, inputs, outputs, sums)
        return tensors
    written = outputs
    if program.by_ray:  # sums of rays are float32
        written = [to.float() if i in program.by_ray else to for i, to in enumerate(outputs)]
    results = native.compiled.ProgramResults(
        outputs=written, output_types=[_NAMES[to.dtype] for to in written], sums=sums
    )
    native.compiled.grouped_program(lowered.program, inputs, results, native.cpu())
    for to, result in zip(outputs, written):
        if to is not result:
            to.copy_(result)
    return tensors


def _run_on_cuda(
    program: Program,
    lowered: Lowered,
    rows: RunTensors,
    options: RunOptions,
    arguments: native.compiled.ProgramInputs,
    outputs: list[Tensor],
    sums: list[Tensor],
) -> None:
    """Runs a program on CUDA. The kernels write a row for each sample; this function sums the rows of each ray."""
    offsets, index = rows.offsets, rows.ray_index
    if any(step.op == "scatter" for step in program.steps):
        native.refuse_where_deterministic(options.caller, offsets)
    tf32 = options.products == "float32" and torch.backends.cuda.matmul.fp32_precision == "tf32"
    written = list(outputs)
    for i in program.by_ray:
        written[i] = torch.empty(arguments.n, outputs[i].shape[1], device=offsets.device)
    results = native.compiled.ProgramResults(
        outputs=written, output_types=[_NAMES[result.dtype] for result in written], sums=sums
    )
    machine = native.compiled.Cuda(*native.stream(offsets))
    size = native.compiled.grouped_program_workspace(lowered.program, arguments.n, arguments.r, arguments.k, machine)
    workspace = torch.empty(size, dtype=torch.uint8, device=offsets.device)
    layout = _layout(options.products, offsets)
    products = "tf32" if tf32 else options.products if layout == "tiles" else "float32"
    code = _code(program.text, layout, offsets.device)
    native.compiled.grouped_program(lowered.program, code, arguments, results, products, workspace, machine)
    for i in program.by_ray:
        total = torch.zeros(arguments.r, outputs[i].shape[1], device=offsets.device)
        if index is not None and arguments.n and arguments.r:
            total.index_add_(0, index.clamp(0, arguments.r - 1), written[i])
        outputs[i].copy_(total)


@functools.lru_cache(maxsize=1024)
def _code(text: str, layout: str, device: torch.device) -> Tensor:
    """Returns the records of a program on a device, cached."""
    program = lower(text, layout, True).program
    code = torch.empty(native.compiled.program_code_bytes(program), dtype=torch.uint8)
    native.compiled.program_code(program, code)
    return code.to(device)


def program_inputs(
    lowered: Lowered,
    rows: RunTensors,
    n: int,
    r: int,
    *,
    kept: Sequence[Tensor] | None = None,
    ready: bool = False,
    gradients: int = -1,
    caller: str = "grouped_program",
) -> native.compiled.ProgramInputs:
    """Returns the compiled module's struct of a program's tensors.

    Args:
        lowered: the program.
        rows: the tensors.
        n: the number of rows.
        r: the number of rays.
        kept: the kept features of each hash grid, or None.
        ready: whether the kept features have been written.
        gradients: see `RunOptions`.
        caller: the name of the op for error messages.
    """
    inputs, parameters, offsets, order, ray_index, _ = rows
    samples = -1 if ray_index is not None and n == r else n  # rows of per-sample inputs; -1 if n and r are equal
    transposed = [0 if x.is_contiguous() else int(_is_column_major(x, samples)) for x in inputs]
    if 1 in transposed:
        inputs = [x.t() if turn else x for x, turn in zip(inputs, transposed)]
    kind, kinds = _NAMES[inputs[0].dtype], ["float32"] * len(parameters)
    for table in lowered.tables:
        kinds[table] = _NAMES[parameters[table].dtype]
    return native.compiled.ProgramInputs(
        inputs=inputs,
        input_types=[kind] * len(inputs),
        transposed=transposed,
        parameters=[native.aligned(p) for p in parameters] if native.on_cuda(offsets) else parameters,
        parameter_types=kinds,
        strides=[size if p.shape[0] > 1 else 0 for p, size in zip(parameters, lowered.sizes)],
        offsets=offsets,
        order=order,
        ray_index=ray_index,
        n=n,
        r=r,
        k=offsets.shape[0] - 1,
        kept=kept,
        ready=ready,
        gradients=gradients,
        caller=caller,
        ray_name=index_name(caller),
    )


def _is_column_major(x: Tensor, n: int) -> bool:
    """Returns whether samples [n, w] are column-major, like PyTorch's look-ups in planes.

    Tensors [n, 3] never count as column-major: they are copied, because kernels read points of hash grids in place.
    """
    planes = x.stride(0) == 1 and x.t().is_contiguous()
    return planes and x.shape[0] == n and x.shape[1] != 3 and x.dtype == torch.float32


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
    layouts = _LAYOUTS.get(native.isa())
    if layouts is None:
        return "floats"
    return layouts.get(backends.cpu_precision() if products == "float32" else products, "floats")


@functools.lru_cache(maxsize=64)
def _multiplies_halves(products: str, device: torch.device) -> bool:
    """Returns whether a GPU has products of this 16-bit type."""
    machine = native.compiled.Cuda(*native.stream(torch.empty(0, device=device)))
    return native.compiled.multiplies_halves(products, machine)


def _setup(ctx: Any, inputs: tuple[RunTensors, RunOptions], output: Sequence[Tensor]) -> None:
    rows, ctx.options = inputs
    ctx.count, ctx.parameters, ctx.results = len(rows.inputs), len(rows.parameters), _results(ctx.options.text)
    ctx.set_materialize_grads(False)
    ctx.kept, kept = len(rows.kept), output[ctx.results :]
    constant = _constant_results(ctx.options.text)
    if kept or constant:
        ctx.mark_non_differentiable(*kept, *[output[i] for i in constant])
    ctx.save_for_backward(*rows.inputs, *rows.parameters, rows.offsets, rows.order, rows.ray_index, *kept)


def _gradients(ctx: Any, arriving: Sequence[Tensor | None]) -> tuple[Any, ...]:
    gradients, none = _saved_gradients(ctx, arriving), cast(Any, (None,) * len(RunOptions._fields))
    row_gradients: Any = (gradients[: ctx.count], gradients[ctx.count :], *none[:3], [None] * ctx.kept)
    return RunTensors._make(row_gradients), RunOptions(*none)


def _saved_gradients(ctx: Any, arriving: Sequence[Tensor | None]) -> list[Tensor | None]:
    """Returns the gradients of the inputs, then of the parameters; None for an unwanted gradient."""
    count, saved = ctx.count + ctx.parameters, ctx.saved_tensors
    wanted = needed_gradients(ctx, saved[:count])
    arriving = arriving[: ctx.results]
    if not any(g is not None for g in arriving) or not any(wanted):
        return [None] * count
    offsets, order, ray_index, *kept = saved[count:]
    rows = RunTensors(saved[: ctx.count], saved[ctx.count : count], offsets, order, ray_index, kept)
    return run_gradient(rows, ctx.options, arriving, wanted)


def run_gradient(
    rows: RunTensors, options: RunOptions, arriving: Sequence[Tensor | None], wanted: Sequence[bool]
) -> list[Tensor | None]:
    """Returns the gradients of the inputs, then of the parameters.

    A gradient is None if it is unwanted, or if no arriving gradient reaches the tensor (:func:`gradient_reaches`).

    Args:
        rows: the tensors of the program, with the kept features.
        options: the options with which the program ran.
        arriving: the gradient of each result of the program, or None.
        wanted: whether to return the gradient, for each input, then for each parameter.
    """
    program, count = Program.parse(options.text), len(rows.inputs)
    split, present = len(program.outputs), tuple([g is not None for g in arriving])
    derived = _gradient(program.text, options.caller, options.products, count, tuple(wanted), present)
    gradients: list[Tensor | None] = [None] * len(wanted)
    if not derived.places:
        return gradients
    inputs = [*rows.inputs, *[g for g in arriving[:split] if g is not None]]
    parameters = [*rows.parameters, *[g for g in arriving[split:] if g is not None]]
    call = RunTensors(inputs, parameters, rows.offsets, rows.order, rows.ray_index, rows.kept if derived.keeps else ())
    # `run_program` keeps the looked-up features again, for a pass that is differentiated further.
    values = run_program(call, derived.options) if torch.is_grad_enabled() else run(call, derived.options)
    for place, total in zip(derived.places, values, strict=True):
        if place >= count:
            p = rows.parameters[place - count]
            if p.shape[0] == 1 and total.shape[0] > 1:
                total = total.sum(0, keepdim=True)
            total = total if p.dtype is total.dtype else total.to(p.dtype)
        gradients[place] = total
    return gradients


class _Gradient(NamedTuple):
    """The gradient of a program.

    Attributes:
        options: the options of the gradient's program.
        places: the index of the tensor whose gradient each result is, among the inputs, then the parameters.
        keeps: whether it can use the features that the program kept.
    """

    options: RunOptions
    places: tuple[int, ...]
    keeps: bool


@functools.lru_cache(maxsize=1024)
def _gradient(
    text: str, caller: str, products: str, count: int, wanted: tuple[bool, ...], present: tuple[bool, ...]
) -> _Gradient:
    program = Program.parse(text)
    split = len(program.outputs)
    reached = gradient_reaches(program, present[:split], present[split:])
    wanted = tuple([want and reaches for want, reaches in zip(wanted, reached, strict=True)])
    derived = gradient(program, wanted[:count], wanted[count:], present[:split], present[split:])
    sifts = not derived.outputs and all(i < count for i in derived.rays) and not any(present[split:])
    keeps = bool(program.grids) and compiled_runs(derived.text) and compiled_runs(text)
    keeps = keeps and lower(derived.text).lookups == lower(text).lookups
    return _Gradient(
        RunOptions(derived.text, caller, products, False, count if sifts else -1),
        tuple([place for place, want in enumerate(wanted) if want]),
        keeps,
    )


class _Node(torch.autograd.Function):
    """The autograd node of a call that nothing else in torch observes.

    The general node of custom ops takes 30 us more, a sixth of the time of a small network with its gradients.
    """

    @staticmethod
    def forward(ctx: Any, arguments: _Call, *tensors: Tensor | None) -> tuple[Tensor, ...]:
        results = tuple(_run(*arguments))
        _setup(ctx, arguments, results)
        return results

    @staticmethod
    def backward(ctx: Any, *arriving: Tensor | None) -> tuple[Tensor | None, ...]:
        run.refuse_batches(arriving)
        return None, *_saved_gradients(ctx, arriving), None, None, None


#: ``apply`` without its check for ``torch.func`` transforms.
_apply_node = super(torch.autograd.Function, _Node).apply


def _run_with_gradients(rows: RunTensors, options: RunOptions) -> list[Tensor]:
    """Returns the results of a call with gradients that nothing else in torch observes."""
    inputs, parameters, offsets, order, ray_index, _ = rows
    return list(_apply_node(_Call(rows, options), *inputs, *parameters, offsets, order, ray_index))


run.register_autograd(_gradients, setup_context=_setup)
run.with_gradients = _run_with_gradients
