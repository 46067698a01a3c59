"""Programs of the compiled module: every op on networks of cells. n rows, r rays, k cells, w columns of a value.

The gradient of a program is a program, and runs by the same op; so do further derivatives. A program with higher
derivatives than the compiled module has runs in PyTorch.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import custom_op
from voronerf.ops._core.derivatives import asked_for
from voronerf.ops._core.program import Program, gradient
from voronerf.ops.grouped_program.lowering import Lowered, compiled_runs, lower
from voronerf.ops.grouped_program.reference import grouped_program as in_torch


class Rows(NamedTuple):
    """What a program runs on.

    Attributes:
        inputs: [n, w] each, or [r, w] with a row for each ray; float32 or bfloat16, all alike.
        parameters: [k, ...] each, or [1, ...] where all cells share it; float32, but for tables of hash grids.
        offsets: int32 [k + 1].
        order: int32 [n], or None for rows that are sorted by cell.
        ray_index: int32 [n], or None without rays.
        kept: what hash grids were looked up to before, [n, w] each in the order of the cells, empty where it was not
            kept; nothing for a first pass.
    """

    inputs: Sequence[Tensor]
    parameters: Sequence[Tensor]
    offsets: Tensor
    order: Tensor | None
    ray_index: Tensor | None
    kept: Sequence[Tensor]


class How(NamedTuple):
    """How a program runs.

    Attributes:
        text: of the program.
        caller: the op that errors name.
        products: what they take: "float32", "bfloat16" or, on CUDA, "float16".
        keep: whether what hash grids are looked up to is kept, as further results.
        gradients: the first of the inputs whose rows, where all of them are 0, add nothing to any sum; -1 for none.
    """

    text: str
    caller: str = "grouped_program"
    products: str = "float32"
    keep: bool = False
    gradients: int = -1


def grouped_program(
    inputs: Sequence[Tensor],
    parameters: Sequence[Tensor],
    offsets: Tensor,
    order: Tensor | None,
    ray_index: Tensor | None,
    text: str,
) -> list[Tensor]:
    """A program on the rows of each cell; see ``voronerf.ops.grouped_program``."""
    program = Program.parse(text)
    return run_program(Rows(inputs, parameters, offsets, order, ray_index, []), How(text), program)


def run_program(rows: Rows, how: How, program: Program) -> list[Tensor]:
    """The results of a program, with gradients of every order."""
    learning = torch.is_grad_enabled() and any(t.requires_grad for t in (*rows.inputs, *rows.parameters))
    found: list[Tensor] = run(rows, how._replace(keep=bool(learning and program.grids)))
    return found[: len(program.outputs) + len(program.sums)]


@custom_op("grouped_program_native")
def run(rows: Rows, how: How) -> Iterator[list[Tensor]]:
    """The outputs of a program, its sums, and what is kept."""
    program, (inputs, parameters, offsets, order, ray_index, kept) = Program.parse(how.text), rows
    first, k, rays = inputs[0], offsets.shape[0] - 1, [inputs[i] for i in program.rays]
    n, r = (first if ray_index is None else ray_index).shape[0], rays[0].shape[0] if rays else 0
    outputs = [
        first.new_empty(r if i in program.by_ray else n, columns.width) for i, columns in enumerate(program.outputs)
    ]
    here, new = first.device, torch.empty
    tables = {step.out: parameters[int(step.numbers[1])].shape[0] for step in program.steps if step.op == "scatter"}
    sums = [
        new(tables.get(i, k), *shape, device=here, dtype=torch.float32) for i, shape in enumerate(program.sums)
    ]
    lowered = lower(how.text, _half(how.products, first)) if compiled_runs(how.text) else None
    keeping: list[Tensor] = []
    if lowered is not None and how.keep:
        keeping = [new(n, width, device=here, dtype=torch.float32) for width in lowered.widths]
    yield [*outputs, *sums, *keeping]
    if lowered is None:
        made = in_torch([x.float() for x in inputs], parameters, offsets, order, ray_index, how.text)
        for to, result in zip((*outputs, *sums), made, strict=True):
            to.copy_(result)
        return
    given = program_inputs(
        rows._replace(kept=keeping or kept), n, r, ready=bool(kept), gradients=how.gradients, caller=how.caller
    )
    results = native.compiled.ProgramResults(outputs=outputs, output_types=_types(outputs), sums=sums)
    if native.on_cuda(first):
        _run_on_cuda(how, given, results, program)
        return
    for result in (*outputs, *sums, *keeping):
        native.on_huge_pages(result)
    native.compiled.grouped_program(lowered.program, given, results, native.cpu())


def _run_on_cuda(
    how: How, given: native.compiled.ProgramInputs, results: native.compiled.ProgramResults, program: Program
) -> None:
    """The call, and the sums over the samples of each ray, whose rows the kernels give."""
    if any(step.op == "scatter" for step in program.steps):
        native.refuse_where_deterministic(how.caller, given.offsets)
    products = how.products
    if products == "float32" and torch.backends.cuda.matmul.fp32_precision == "tf32":
        products = "tf32"
    outputs = list(results.outputs)
    here, machine = given.offsets.device, native.machine(given.offsets)
    for i in program.by_ray:
        outputs[i] = torch.empty(given.n, outputs[i].shape[1], device=here)
    to = results._replace(outputs=outputs, output_types=_types(outputs))
    compiled = lower(how.text, False).program
    size = native.compiled.grouped_program_workspace(compiled, given.n, given.r, given.k, machine)
    workspace = torch.empty(size, dtype=torch.uint8, device=here)
    native.compiled.grouped_program(compiled, _code(how.text, here), given, to, products, workspace, machine)
    for i in program.by_ray:
        total = torch.zeros(given.r, outputs[i].shape[1], device=here)
        if given.n and given.r:
            total.index_add_(0, given.ray_index.clamp(0, given.r - 1), outputs[i])
        results.outputs[i].copy_(total)


@functools.lru_cache(maxsize=1024)
def _code(text: str, device: torch.device) -> Tensor:
    """The records of a program on a device, copied there once."""
    program = lower(text, False).program
    code = torch.empty(native.compiled.program_code_bytes(program), dtype=torch.uint8)
    native.compiled.program_code(program, code)
    return code.to(device)


def program_inputs(
    rows: Rows, n: int, r: int, *, ready: bool = False, gradients: int = -1, caller: str = "grouped_program"
) -> native.compiled.ProgramInputs:
    """The tensors of a program as the compiled module takes them.

    Args:
        rows: the tensors.
        n: rows.
        r: rays.
        ready: whether what is kept is there already.
        gradients: see `How`.
        caller: the op that errors name.
    """
    inputs, parameters, offsets, order, ray_index, kept = rows
    turned = [int(not x.is_contiguous() and x.t().is_contiguous() and x.dtype == torch.float32) for x in inputs]
    return native.compiled.ProgramInputs(
        inputs=[x.t() if turn else x for x, turn in zip(inputs, turned)],
        input_types=_types(inputs),
        turned=turned,
        parameters=[native.aligned(p) for p in parameters],
        parameter_types=_types(parameters),
        strides=[p[0].numel() if p.shape[0] > 1 else 0 for p in parameters],
        offsets=offsets,
        order=order,
        ray_index=ray_index,
        n=n,
        r=r,
        k=offsets.shape[0] - 1,
        kept=[x if x.numel() else None for x in kept] or None,
        ready=ready,
        gradients=gradients,
        caller=caller,
        index="ray_index" if caller == "grouped_program" else "direction_index",
    )


_NAMES = {torch.float32: "float32", torch.bfloat16: "bfloat16", torch.float16: "float16"}


def _types(tensors: Sequence[Tensor]) -> list[str]:
    return [_NAMES[tensor.dtype] for tensor in tensors]


def _half(products: str, tensor: Tensor) -> bool:
    """Whether products take pairs of bfloat16: where they are asked for, and the processor has them."""
    return products == "bfloat16" and not native.on_cuda(tensor) and native.cpu().isa == "avx512_bf16"


def _keep(ctx: Any, inputs: tuple[Rows, How], output: list[Tensor]) -> None:
    (rows, parameters, offsets, order, ray_index, _), ctx.how = inputs
    ctx.count, ctx.parameters, ctx.k = len(rows), len(parameters), offsets.shape[0] - 1
    ctx.shared = [p.shape[0] == 1 for p in parameters]
    ctx.set_materialize_grads(False)
    program = Program.parse(ctx.how.text)
    ctx.results = len(program.outputs) + len(program.sums)
    kept = output[ctx.results :]
    if kept:
        ctx.mark_non_differentiable(*kept)
    ctx.save_for_backward(*rows, *parameters, offsets, order, ray_index, *kept)


def _gradients(ctx: Any, arriving: Sequence[Tensor | None]) -> tuple[Any, ...]:
    count = ctx.count + ctx.parameters
    saved = ctx.saved_tensors
    (offsets, order, ray_index), kept = saved[count : count + 3], saved[count + 3 :]
    rows, parameters = saved[: ctx.count], saved[ctx.count : count]
    wanted = asked_for(ctx, saved[: count + 3])[:count]
    found: list[Tensor | None] = [None] * count
    arriving = arriving[: ctx.results]
    if any(g is not None for g in arriving) and any(wanted):
        call = Rows(rows, parameters, offsets, order, ray_index, kept)
        results = iter(run_gradient(call, ctx.how, arriving, wanted))
        found = [next(results) if want else None for want in wanted]
    return Rows(found[: ctx.count], found[ctx.count :], None, None, None, None), How(*[None] * 5)  # type: ignore[arg-type]


def run_gradient(
    rows: Rows, how: How, arriving: Sequence[Tensor | None], wanted: Sequence[bool]
) -> list[Tensor]:
    """The gradients to those inputs and parameters that are wanted.

    Args:
        rows: those of the program, with what it kept.
        how: as the program ran.
        arriving: the gradient to each of its results, None where there is none.
        wanted: of each input, then of each parameter.
    """
    program, count, k = Program.parse(how.text), len(rows.inputs), rows.offsets.shape[0] - 1
    split = len(program.outputs)
    given = [g is not None for g in arriving]
    own = gradient(program, tuple(wanted[:count]), tuple(wanted[count:]), tuple(given[:split]), tuple(given[split:]))
    more = [[g for g in part if g is not None] for part in (arriving[:split], arriving[split:])]
    kept: list[Tensor] = []
    if rows.kept and compiled_runs(own.text):
        before = dict(zip(lower(how.text, False).lookups, rows.kept, strict=True))
        none = rows.offsets.new_empty(0, dtype=torch.float32)
        kept = [before.get(lookup, none) for lookup in lower(own.text, False).lookups]
    rays = any(i >= count for i in own.rays)
    sifts = not own.outputs and not more[1] and not rays and all(g.dtype == torch.float32 for g in more[0])
    following = how._replace(text=own.text, keep=False, gradients=count if sifts else -1)
    inputs = [*rows.inputs, *more[0]]
    found = run(rows._replace(inputs=inputs, parameters=[*rows.parameters, *more[1]], kept=kept), following)
    of_parameters = iter([p for p, want in zip(rows.parameters, wanted[count:]) if want])
    results = found[: len(own.outputs)]
    for total, p in zip(found[len(own.outputs) :], of_parameters, strict=True):
        total = total.sum(0, keepdim=True) if p.shape[0] == 1 and total.shape[0] > 1 else total
        results.append(total.to(p.dtype))
    return results


run.register_autograd(_gradients, setup_context=_keep)
