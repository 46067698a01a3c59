"""Programs of the compiled module: every op on networks of cells. n rows, r rays, k cells, w columns of a value.

The gradient of a program is a program, and runs by the same op; so do further derivatives. A program with higher
derivatives than the compiled module has runs in PyTorch.
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
from voronerf.ops._core.derivatives import asked_for
from voronerf.ops._core.program import Program, gradient
from voronerf.ops._core.rows import new_empty, rows_of
from voronerf.ops.grouped_program.given import Given, index_name
from voronerf.ops.grouped_program.lowering import Lowered, compiled_runs, lower
from voronerf.ops.grouped_program.reference import evaluate


class Rows(NamedTuple):
    """What a program runs on.

    Attributes:
        inputs: [n, w] each, or [r, w] with a row for each ray; float32 or bfloat16, all alike.
        parameters: [k, ...] each, or [1, ...] where all cells share it; float32, but for tables of hash grids.
        offsets: int32 [k + 1].
        order: int32 [n], or None for rows that are sorted by cell.
        ray_index: int32 [n], or None without rays.
        kept: float32 [n, w], what each hash grid was looked up to before, in the order of the cells; none for a first
            pass.
    """

    inputs: Sequence[Tensor]
    parameters: Sequence[Tensor]
    offsets: Tensor
    order: Tensor | None
    ray_index: Tensor | None
    kept: Sequence[Tensor] = ()


class How(NamedTuple):
    """How a program runs.

    Attributes:
        text: of the program.
        caller: the op that errors name.
        products: what they take: "float32", "bfloat16" or, on CUDA, "float16".
        keep: whether what hash grids are looked up to are further results, as `Rows` has it.
        gradients: the first of the inputs whose rows, where all of them are 0, add nothing to any sum; -1 for none.
    """

    text: str
    caller: str = "grouped_program"
    products: str = "float32"
    keep: bool = False
    gradients: int = -1


class Network(NamedTuple):
    """A program with its tensors as the op takes them, of the caller's.

    Samples are read and results written as they are stored where all are bfloat16; else, and parameters always, a cell
    having few of them, they are cast to float32 on the way in and back on the way out. Where the results are bfloat16,
    products take bfloat16 operands where the processor multiplies them faster (AVX512-BF16, AMX), and float32 ones
    elsewhere; sums are float32 always.

    Attributes:
        inputs: in float32, or all in the bfloat16 of the results.
        parameters: in float32, but for tables of hash grids.
        ray_index: int32 [n] where some inputs have one row for each ray, or None.
        how: it runs.
        dtype: of the results.
    """

    inputs: Sequence[Tensor]
    parameters: Sequence[Tensor]
    ray_index: Tensor | None
    how: How
    dtype: torch.dtype

    @staticmethod
    def of(given: Given) -> Network:
        """Casts the tensors that the public functions take."""
        text, inputs, parameters, index, dtype, caller = given
        tables = _tables(text)  # of which positions are read in float32
        stored = dtype is torch.bfloat16 and not tables and all(x.dtype is dtype for x in inputs)
        rows = inputs if stored else [x if x.dtype is torch.float32 else x.float() for x in inputs]
        kept = [
            p if p.dtype is torch.float32 or (any(i == table for table in tables) and p.dtype in _NAMES) else p.float()
            for i, p in enumerate(parameters)
        ]
        return Network(rows, kept, index, How(text, caller, PRODUCTS.get(dtype, "float32")), dtype)

    def rows(self, offsets: Tensor, order: Tensor | None = None) -> Rows:
        """The tensors of the program, for rows of cells by offsets [k + 1] and an order."""
        return Rows(self.inputs, self.parameters, offsets, order, self.ray_index)

    def run(self, offsets: Tensor, order: Tensor | None = None) -> list[Tensor]:
        """The results, [n, w] each and sums."""
        found = run_program(self.rows(offsets, order), self.how)
        return [out if out.dtype is self.dtype else out.to(self.dtype) for out in found]


PRODUCTS = {torch.bfloat16: "bfloat16", torch.float16: "float16"}
"""Operands of products by the dtype of the results; float32 for any other."""


def grouped_program(given: Given, offsets: Tensor, order: Tensor | None) -> list[Tensor]:
    """A program on the rows of each cell; see ``voronerf.ops.grouped_program``."""
    return Network.of(given).run(offsets, order)


def run_program(rows: Rows, how: How) -> list[Tensor]:
    """The outputs and sums of a program, with gradients of every order."""
    if torch.is_grad_enabled() and _tables(how.text):
        how = how._replace(keep=any(t.requires_grad for t in (*rows.inputs, *rows.parameters)))
    found: list[Tensor] = run(rows, how)
    return found[: _results(how.text)] if how.keep else found


@constant_result
def _results(text: str) -> int:
    """How many outputs and sums there are; behind them comes what is kept."""
    program = Program.parse(text)
    return len(program.outputs) + len(program.sums)


@constant_result
def _tables(text: str) -> tuple[int, ...]:
    """The parameters that are tables of hash grids."""
    return Program.parse(text).tables


class _Call(NamedTuple):
    """The tensors of a program, and how it runs."""

    rows: Rows
    how: How


def _sizes(program: Program, rows: Rows) -> tuple[int, int]:
    """The numbers of rows and rays."""
    n = rows_of(rows.inputs[0] if rows.ray_index is None else rows.ray_index)
    return n, rows_of(rows.inputs[program.rays[0]]) if program.rays else 0


def _memory(given: _Call) -> list[Tensor]:
    """For the outputs of a program, its sums, and what is kept."""
    rows, how = given
    program, like = Program.parse(how.text), rows.inputs[0]
    n, r = _sizes(program, rows)
    found = [
        new_empty(like, r if i in program.by_ray else n, columns.width) for i, columns in enumerate(program.outputs)
    ]
    if program.sums:
        counts = program.cells_of_sums(rows.parameters, rows.offsets.shape[0] - 1)
        dtype = None if like.dtype is torch.float32 else torch.float32
        found += [new_empty(like, count, *shape, dtype=dtype) for count, shape in zip(counts, program.sums)]
    if how.keep and program.grids and compiled_runs(program.text):
        widths = lower(program.text).widths  # of every layout: tensors without memory have no device to ask
        found += [new_empty(like, n, width, dtype=torch.float32) for width in widths]
    return found


@custom_op("grouped_program_native", _memory, counted=True)
def run(given: _Call) -> list[Tensor]:
    """A program."""
    return _made(*given)


def _made(rows: Rows, how: How) -> list[Tensor]:
    """Its results."""
    program = Program.parse(how.text)
    if not compiled_runs(program.text):
        found = _memory(_Call(rows, how))
        inputs = [x.float() for x in rows.inputs]
        made = evaluate(inputs, rows.parameters, rows.offsets, rows.order, rows.ray_index, program.text)
        for to, result in zip(found, made, strict=True):
            to.copy_(result)
        return found
    on_cuda = native.on_cuda(rows.offsets)
    lowered = lower(program.text, _layout(how.products, rows.offsets), on_cuda)
    results = None if on_cuda else lowered.call(rows, how.keep, how.gradients, how.caller, False)
    return _by_structs(program, lowered, _Call(rows, how)) if results is None else results


def _at_once(rows: Rows, how: How) -> list[Tensor] | None:
    """The results where no gradients are recorded and nothing of torch's is to see the call; else None."""
    text = how.text
    if native.on_cuda(rows.offsets) or not compiled_runs(text):
        return None
    lowered = lower(text, _layout(how.products, rows.offsets), False)
    found: list[Tensor] | None = lowered.call(rows, how.keep, how.gradients, how.caller, True)
    return found


run.at_once = _at_once


def _by_structs(program: Program, lowered: Lowered, given: _Call) -> list[Tensor]:
    """The call where it is recorded, or not of the CPU alone: with memory, and structs that Python makes."""
    (rows, how), found = given, _memory(given)
    n, r = _sizes(program, rows)
    split, end = len(program.outputs), len(program.outputs) + len(program.sums)
    outputs, sums, keeps = found[:split], found[split:end], found[end:]
    gradients = -1 if keeps else how.gradients  # what is kept is of all rows
    looked = keeps or rows.kept or None
    taken = program_inputs(lowered, rows, n, r, kept=looked, ready=not keeps, gradients=gradients, caller=how.caller)
    if native.on_cuda(rows.offsets):
        _run_on_cuda(program, lowered, rows, how, taken, outputs, sums)
        return found
    made = outputs
    if program.by_ray:  # sums of rays are float32
        made = [to.float() if i in program.by_ray else to for i, to in enumerate(outputs)]
    results = native.compiled.ProgramResults(outputs=made, output_types=[_NAMES[to.dtype] for to in made], sums=sums)
    native.compiled.grouped_program(lowered.program, taken, results, native.cpu())
    for to, result in zip(outputs, made):
        if to is not result:
            to.copy_(result)
    return found


def _run_on_cuda(
    program: Program,
    lowered: Lowered,
    rows: Rows,
    how: How,
    given: native.compiled.ProgramInputs,
    outputs: list[Tensor],
    sums: list[Tensor],
) -> None:
    """The call, and the sums over the samples of each ray, of which the kernels give the rows."""
    offsets, index = rows.offsets, rows.ray_index
    if any(step.op == "scatter" for step in program.steps):
        native.refuse_where_deterministic(how.caller, offsets)
    tf32 = how.products == "float32" and torch.backends.cuda.matmul.fp32_precision == "tf32"
    made = list(outputs)
    for i in program.by_ray:
        made[i] = torch.empty(given.n, outputs[i].shape[1], device=offsets.device)
    results = native.compiled.ProgramResults(
        outputs=made, output_types=[_NAMES[result.dtype] for result in made], sums=sums
    )
    machine = native.compiled.Cuda(*native.stream(offsets))
    size = native.compiled.grouped_program_workspace(lowered.program, given.n, given.r, given.k, machine)
    workspace = torch.empty(size, dtype=torch.uint8, device=offsets.device)
    layout = _layout(how.products, offsets)
    products = "tf32" if tf32 else how.products if layout == "tiles" else "float32"
    code = _code(program.text, layout, offsets.device)
    native.compiled.grouped_program(lowered.program, code, given, results, products, workspace, machine)
    for i in program.by_ray:
        total = torch.zeros(given.r, outputs[i].shape[1], device=offsets.device)
        if index is not None and given.n and given.r:
            total.index_add_(0, index.clamp(0, given.r - 1), made[i])
        outputs[i].copy_(total)


@functools.lru_cache(maxsize=1024)
def _code(text: str, layout: str, device: torch.device) -> Tensor:
    """The records of a program on a device, copied there once."""
    program = lower(text, layout, True).program
    code = torch.empty(native.compiled.program_code_bytes(program), dtype=torch.uint8)
    native.compiled.program_code(program, code)
    return code.to(device)


def program_inputs(
    lowered: Lowered,
    rows: Rows,
    n: int,
    r: int,
    *,
    kept: Sequence[Tensor] | None = None,
    ready: bool = False,
    gradients: int = -1,
    caller: str = "grouped_program",
) -> native.compiled.ProgramInputs:
    """The tensors of a program as the compiled module takes them.

    Args:
        lowered: the program.
        rows: the tensors.
        n: rows.
        r: rays.
        kept: what is kept of each look-up, or None.
        ready: whether it is there already.
        gradients: see `How`.
        caller: the op that errors name.
    """
    inputs, parameters, offsets, order, ray_index, _ = rows
    samples = -1 if ray_index is not None and n == r else n  # which inputs are of samples, none if that is not known
    turned = [0 if x.is_contiguous() else int(_columns_lie_together(x, samples)) for x in inputs]
    if 1 in turned:
        inputs = [x.t() if turn else x for x, turn in zip(inputs, turned)]
    kind, kinds = _NAMES[inputs[0].dtype], ["float32"] * len(parameters)
    for table in lowered.tables:
        kinds[table] = _NAMES[parameters[table].dtype]
    return native.compiled.ProgramInputs(
        inputs=inputs,
        input_types=[kind] * len(inputs),
        turned=turned,
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


def _columns_lie_together(x: Tensor, n: int) -> bool:
    """Whether rows of samples lie as PyTorch's look-ups in planes give them. Points of hash grids, which are read where
    they are, are copied."""
    planes = x.stride(0) == 1 and x.t().is_contiguous()
    return planes and x.shape[0] == n and x.shape[1] != 3 and x.dtype == torch.float32


_NAMES = {torch.float32: "float32", torch.bfloat16: "bfloat16", torch.float16: "float16"}


_LAYOUTS = {
    "avx512_bf16": {"bfloat16": "pairs", "bf16": "pairs"},
    "amx": {"bfloat16": "tiles", "bf16": "tiles", "tf32": "parts"},
}


def _layout(products: str, tensor: Tensor) -> str:
    """What values are laid out for: products of 16 bits where they are asked for, and the device has them; for float32
    on the CPU as ``torch.set_float32_matmul_precision`` says, of which "high" are products in parts."""
    if native.on_cuda(tensor):
        return "tiles" if products != "float32" and _multiplies_halves(products, tensor.device) else "floats"
    layouts = _LAYOUTS.get(native.isa())
    if layouts is None:
        return "floats"
    return layouts.get(backends.cpu_precision() if products == "float32" else products, "floats")


@functools.lru_cache(maxsize=64)
def _multiplies_halves(products: str, device: torch.device) -> bool:
    """Whether a GPU has products of this 16-bit type."""
    there = native.compiled.Cuda(*native.stream(torch.empty(0, device=device)))
    return native.compiled.multiplies_halves(products, there)


def _keep(ctx: Any, inputs: tuple[Rows, How], output: Sequence[Tensor]) -> None:
    rows, ctx.how = inputs
    ctx.count, ctx.parameters, ctx.results = len(rows.inputs), len(rows.parameters), _results(ctx.how.text)
    ctx.set_materialize_grads(False)
    ctx.kept, kept = len(rows.kept), output[ctx.results :]
    if kept:
        ctx.mark_non_differentiable(*kept)
    ctx.save_for_backward(*rows.inputs, *rows.parameters, rows.offsets, rows.order, rows.ray_index, *kept)


def _gradients(ctx: Any, arriving: Sequence[Tensor | None]) -> tuple[Any, ...]:
    found, nothing = _of_saved(ctx, arriving), cast(Any, (None,) * len(How._fields))
    of_rows: Any = (found[: ctx.count], found[ctx.count :], *nothing[:3], [None] * ctx.kept)
    return Rows._make(of_rows), How(*nothing)


def _of_saved(ctx: Any, arriving: Sequence[Tensor | None]) -> list[Tensor | None]:
    """The gradients to the inputs, then those to the parameters."""
    count, saved = ctx.count + ctx.parameters, ctx.saved_tensors
    wanted = asked_for(ctx, saved[:count])
    found: list[Tensor | None] = [None] * count
    arriving = arriving[: ctx.results]
    if any(g is not None for g in arriving) and any(wanted):
        offsets, order, ray_index, *kept = saved[count:]
        rows = Rows(saved[: ctx.count], saved[ctx.count : count], offsets, order, ray_index, kept)
        results = iter(run_gradient(rows, ctx.how, arriving, wanted))
        found = [next(results) if want else None for want in wanted]
    return found


def run_gradient(rows: Rows, how: How, arriving: Sequence[Tensor | None], wanted: Sequence[bool]) -> list[Tensor]:
    """The gradients to those inputs and parameters that are wanted.

    Args:
        rows: those of the program, with what it kept.
        how: as the program ran.
        arriving: the gradient to each of its results, None where there is none.
        wanted: of each input, then of each parameter.
    """
    program, count = Program.parse(how.text), len(rows.inputs)
    split, given = len(program.outputs), tuple([g is not None for g in arriving])
    own = _gradient(program.text, how.caller, how.products, count, tuple(wanted), given)
    inputs = [*rows.inputs, *[g for g in arriving[:split] if g is not None]]
    parameters = [*rows.parameters, *[g for g in arriving[split:] if g is not None]]
    call = Rows(inputs, parameters, rows.offsets, rows.order, rows.ray_index, rows.kept if own.keeps else ())
    # Of a pass that is differentiated again, what is looked up may be kept once more.
    found = run_program(call, own.how) if torch.is_grad_enabled() else run(call, own.how)
    results, learning = found[: own.outputs], [p for p, want in zip(rows.parameters, wanted[count:]) if want]
    for total, p in zip(found[own.outputs :], learning, strict=True):
        if p.shape[0] == 1 and total.shape[0] > 1:
            total = total.sum(0, keepdim=True)
        results.append(total if p.dtype is total.dtype else total.to(p.dtype))
    return results


class _Gradient(NamedTuple):
    """The program of gradients and how it runs, how many of its results are gradients of inputs, and whether what the
    program kept is what it looks up."""

    how: How
    outputs: int
    keeps: bool


@functools.lru_cache(maxsize=1024)
def _gradient(
    text: str, caller: str, products: str, count: int, wanted: tuple[bool, ...], given: tuple[bool, ...]
) -> _Gradient:
    program = Program.parse(text)
    split = len(program.outputs)
    own = gradient(program, wanted[:count], wanted[count:], given[:split], given[split:])
    sifts = not own.outputs and all(i < count for i in own.rays) and not any(given[split:])
    keeps = bool(program.grids) and compiled_runs(own.text) and compiled_runs(text)
    keeps = keeps and lower(own.text).lookups == lower(text).lookups
    return _Gradient(How(own.text, caller, products, False, count if sifts else -1), len(own.outputs), keeps)


class _Node(torch.autograd.Function):
    """A program in autograd, where nothing else of torch's has to see the call. A node that serves every op takes 30 us
    more, a sixth of a small network with its gradients."""

    @staticmethod
    def forward(ctx: Any, given: _Call, *tensors: Tensor | None) -> tuple[Tensor, ...]:
        found = tuple(_made(*given))
        _keep(ctx, given, found)
        return found

    @staticmethod
    def backward(ctx: Any, *arriving: Tensor | None) -> tuple[Tensor | None, ...]:
        run.refuse_batches(arriving)
        return None, *_of_saved(ctx, arriving), None, None, None


#: Without the look of ``apply`` at ``torch.func``.
_apply_node = super(torch.autograd.Function, _Node).apply


def _learning(rows: Rows, how: How) -> list[Tensor]:
    """The results where gradients are recorded, and torch has to see nothing but these."""
    inputs, parameters, offsets, order, ray_index, _ = rows
    return list(_apply_node(_Call(rows, how), *inputs, *parameters, offsets, order, ray_index))


run.register_autograd(_gradients, setup_context=_keep)
run.learning = _learning
