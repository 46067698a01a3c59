"""Programs of the compiled module: every op on networks of cells. n rows, r rays, k cells, w columns of a value.

The gradient of a program is a program, and runs by the same op; so do further derivatives. A program with higher
derivatives than the compiled module has runs in PyTorch.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from voronerf.ops._core import native
from voronerf.ops._core.custom_op import custom_op
from voronerf.ops._core.derivatives import asked_for
from voronerf.ops._core.layers import MLP
from voronerf.ops._core.program import Program, gradient
from voronerf.ops.grouped_program.lowering import compiled_runs, lower
from voronerf.ops.grouped_program.reference import grouped_program as in_torch


class Rows(NamedTuple):
    """What a program runs on.

    Attributes:
        inputs: [n, w] each, or [r, w] with a row for each ray; float32 or bfloat16, all alike.
        parameters: [k, ...] each, or [1, ...] where all cells share it; float32, but for tables of hash grids.
        offsets: int32 [k + 1].
        order: int32 [n], or None for rows that are sorted by cell.
        ray_index: int32 [n], or None without rays.
        kept: float32, what all hash grids were looked up to before, [n, w] each in the order of the cells, one behind
            the other; None for a first pass.
    """

    inputs: Sequence[Tensor]
    parameters: Sequence[Tensor]
    offsets: Tensor
    order: Tensor | None
    ray_index: Tensor | None
    kept: Tensor | None


class How(NamedTuple):
    """How a program runs.

    Attributes:
        text: of the program, or of a layer table, whose program follows from it and the shapes of the tensors: sizes
            may be symbolic under ``torch.compile``, and stand in no text.
        biased: of a table "1" for each layer that has a bias and "0" for one that has none; empty for a program.
        caller: the op that errors name.
        products: what they take: "float32", "bfloat16" or, on CUDA, "float16".
        keep: whether what hash grids are looked up to is a last result, as `Rows` has it.
        gradients: the first of the inputs whose rows, where all of them are 0, add nothing to any sum; -1 for none.
    """

    text: str
    biased: str = ""
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
    return run_program(Rows(inputs, parameters, offsets, order, ray_index, None), How(text))


def run_program(rows: Rows, how: How) -> list[Tensor]:
    """The outputs and sums of a program, with gradients of every order."""
    learning = torch.is_grad_enabled() and any(t.requires_grad for t in (*rows.inputs, *rows.parameters))
    found: list[Tensor] = run(rows, how._replace(keep=learning))
    return found[:-1] if learning else found


def program_of(rows: Rows, how: How) -> Program:
    """The program for tensors of these shapes."""
    if not how.biased:
        return Program.parse(how.text)
    p, q = int(rows.inputs[0].shape[1]), int(rows.inputs[1].shape[1]) if len(rows.inputs) > 1 else 0
    widths = tuple([int(weight.shape[1]) for weight in rows.parameters[: len(how.biased)]])
    return MLP.parse(how.text).program(
        p, q, widths, tuple([bias == "1" for bias in how.biased]), rows.ray_index is not None
    )


@custom_op("grouped_program_native")
def run(rows: Rows, how: How) -> Iterator[list[Tensor]]:
    """The outputs of a program, its sums, and what is kept."""
    program, (inputs, parameters, offsets, order, ray_index, kept) = program_of(rows, how), rows
    first, k, new = inputs[0], offsets.shape[0] - 1, torch.empty
    n = (first if ray_index is None else ray_index).shape[0]
    r = inputs[program.rays[0]].shape[0] if program.rays else 0
    counts = [r if i in program.by_ray else n for i in range(len(program.outputs))]
    outputs = [first.new_empty(count, columns.width) for count, columns in zip(counts, program.outputs)]
    float32: dict[str, Any] = {"dtype": torch.float32, "device": first.device}
    counts = program.cells_of_sums(parameters, k)
    sums = [new(count, *shape, **float32) for count, shape in zip(counts, program.sums)]
    lowered = lower(program.text, _half(how.products, first)) if compiled_runs(program.text) else None
    keeps = [new(n * sum(lowered.widths) if lowered else 0, **float32)] if how.keep else []
    yield [*outputs, *sums, *keeps]
    if lowered is None:
        made = in_torch([x.float() for x in inputs], parameters, offsets, order, ray_index, program.text)
        for to, result in zip((*outputs, *sums), made, strict=True):
            to.copy_(result)
        return
    kept = keeps[0] if keeps else kept
    parts = None if kept is None or not kept.numel() else kept.split([n * width for width in lowered.widths])
    given = program_inputs(rows, n, r, kept=parts, ready=not keeps, gradients=how.gradients, caller=how.caller)
    results = native.compiled.ProgramResults(outputs=outputs, output_types=_types(outputs), sums=sums)
    for result in (*outputs, *sums, *keeps):
        native.on_huge_pages(result)
    native.compiled.grouped_program(lowered.program, given, results, native.cpu())


def program_inputs(
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
        rows: the tensors.
        n: rows.
        r: rays.
        kept: what is kept of each look-up, or None.
        ready: whether it is there already.
        gradients: see `How`.
        caller: the op that errors name.
    """
    inputs, parameters, offsets, order, ray_index, _ = rows
    turned = [int(not x.is_contiguous() and x.dim() == 2 and _columns_lie_together(x, n)) for x in inputs]
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
        kept=kept,
        ready=ready,
        gradients=gradients,
        caller=caller,
        index="ray_index" if caller == "grouped_program" else "direction_index",
    )


def _columns_lie_together(x: Tensor, n: int) -> bool:
    """Whether rows of samples lie as PyTorch's look-ups in planes give them. Points of hash grids, which are read where
    they are, are copied."""
    return x.shape[0] == n and x.shape[1] != 3 and x.dtype == torch.float32 and x.t().is_contiguous()


_NAMES = {torch.float32: "float32", torch.bfloat16: "bfloat16", torch.float16: "float16"}


def _types(tensors: Sequence[Tensor]) -> list[str]:
    return [_NAMES[tensor.dtype] for tensor in tensors]


def _half(products: str, tensor: Tensor) -> bool:
    """Whether products take pairs of bfloat16: where they are asked for, and the processor has them."""
    return products == "bfloat16" and not native.on_cuda(tensor) and native.cpu().isa == "avx512_bf16"


def _keep(ctx: Any, inputs: tuple[Rows, How], output: list[Tensor]) -> None:
    (rows, parameters, offsets, order, ray_index, before), ctx.how = inputs
    ctx.count, ctx.parameters, kept = len(rows), len(parameters), None
    ctx.set_materialize_grads(False)
    if ctx.how.keep:
        kept = output[-1]
        ctx.mark_non_differentiable(kept)
    ctx.save_for_backward(*rows, *parameters, offsets, order, ray_index, before, kept)


def _gradients(ctx: Any, arriving: Sequence[Tensor | None]) -> tuple[Any, ...]:
    count = ctx.count + ctx.parameters
    *saved, kept = ctx.saved_tensors
    wanted = asked_for(ctx, saved)[:count]
    found: list[Tensor | None] = [None] * count
    arriving = arriving[:-1] if ctx.how.keep else arriving
    if any(g is not None for g in arriving) and any(wanted):
        rows = Rows(saved[: ctx.count], saved[ctx.count : count], *saved[count : count + 3], kept)
        results = iter(run_gradient(rows, ctx.how, arriving, wanted))
        found = [next(results) if want else None for want in wanted]
    nothing: Any = (None,) * len(How._fields)
    return Rows(found[: ctx.count], found[ctx.count :], *nothing[:4]), How(*nothing)  # type: ignore[arg-type]


def run_gradient(rows: Rows, how: How, arriving: Sequence[Tensor | None], wanted: Sequence[bool]) -> list[Tensor]:
    """The gradients to those inputs and parameters that are wanted.

    Args:
        rows: those of the program, with what it kept.
        how: as the program ran.
        arriving: the gradient to each of its results, None where there is none.
        wanted: of each input, then of each parameter.
    """
    program, count = program_of(rows, how), len(rows.inputs)
    split, given = len(program.outputs), tuple([g is not None for g in arriving])
    own = gradient(program, tuple(wanted[:count]), tuple(wanted[count:]), given[:split], given[split:])
    more = [[g for g in part if g is not None] for part in (arriving[:split], arriving[split:])]
    kept = rows.kept if program.grids and compiled_runs(own.text) and _lookups(own) == _lookups(program) else None
    rays = any(i >= count for i in own.rays)
    sifts = not own.outputs and not more[1] and not rays and all(g.dtype == torch.float32 for g in more[0])
    following = how._replace(text=own.text, biased="", keep=False, gradients=count if sifts else -1)
    call = rows._replace(inputs=[*rows.inputs, *more[0]], parameters=[*rows.parameters, *more[1]], kept=kept)
    if torch.is_grad_enabled():  # a pass of its own, whose look-ups its gradient may have
        found = run_program(call, following)
    else:
        found = run(call, following)
    results = found[: len(own.outputs)]
    learning = [p for p, want in zip(rows.parameters, wanted[count:]) if want]
    for total, p in zip(found[len(own.outputs) :], learning, strict=True):
        total = total.sum(0, keepdim=True) if p.shape[0] == 1 and total.shape[0] > 1 else total
        results.append(total.to(p.dtype))
    return results


def _lookups(program: Program) -> Any:
    return lower(program.text, False).lookups


run.register_autograd(_gradients, setup_context=_keep)
