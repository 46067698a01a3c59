"""What a PyTorch function does when it meets the parameters of all cells: the grouped form of each layer.

Products go to ``grouped_linear``; scales and shifts are repeated for each cell's rows; tables are looked up in the
cell's part. Functions of parameters alone (a norm, a transpose) run for all cells at once. Any other function that
works sample by sample runs cell by cell on contiguous rows, and never on none.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from voronerf.ops import grouped_linear
from voronerf.router.functions import ELEMENTWISE, EXPAND, MATRIX_PRODUCTS, TO, name_of
from voronerf.router.grouping import PerCell
from voronerf.router.rows import RowMode, replace, tensors_in

Rule = Callable[..., Any]


def run(mode: RowMode, func: Any, args: Any, kwargs: Any) -> Any:
    """Carries out a function of which some arguments are parameters of all cells."""
    operands = list(tensors_in((args, kwargs)))
    if func in TO and isinstance(args[0], PerCell):
        like = next((tensor for tensor in operands if not isinstance(tensor, PerCell)), None)
        if like is not None:
            args, kwargs, operands = (args[0], like.device, like.dtype), {}, [args[0]]
            func = torch.Tensor.to
    if not any(mode.is_rows(tensor) for tensor in operands):
        if func in EXPAND and (rows := _expanded_to_rows(mode, func, args, kwargs)) is not None:
            return rows
        return _for_all_cells(mode, func, args, kwargs)
    if func is torch.autograd.grad:
        raise mode.fail("it differentiates with respect to its parameters")
    rule = _RULES.get(func)
    result = None
    if func in ELEMENTWISE:
        result = _elementwise(mode, func, args, kwargs)
    elif func in MATRIX_PRODUCTS:
        result = _matmul(mode, *args, **kwargs)
    elif rule is not None:
        bound = _SIGNATURES[rule].bind(mode, *args, **kwargs)
        result = rule(*bound.args, **bound.kwargs)
        if rule is _linear and result is not None and mode.recorder is not None:
            given = bound.arguments
            mode.recorder.linear(given["input"], given["weight"], given.get("bias"), result)
    if mode.recorder is not None and (rule is not _linear or result is None):
        mode.recorder.refuse(f"parameters in {name_of(func)}")
    if result is None:
        return _cell_by_cell(mode, func, args, kwargs)
    return mode.mark(result)


def _for_all_cells(mode: RowMode, func: Any, args: Any, kwargs: Any) -> Any:
    """A function of parameters and constants alone, for all cells at once."""
    leaves: list[PerCell] = []

    def collect(value: Any) -> Any:
        if isinstance(value, PerCell):
            leaves.append(value)
        return value

    replace((args, kwargs), collect)
    name = getattr(func, "__name__", "")
    if name in ("requires_grad_", "register_hook", "retain_grad", "backward") or name.startswith("__set"):
        raise mode.fail(f"it calls {name_of(func)} on a parameter")

    def on_one(*single: Tensor) -> Any:
        numbered = iter(single)
        given = replace((args, kwargs), lambda value: next(numbered) if isinstance(value, PerCell) else value)
        return func(*given[0], **given[1])

    if func is torch._weight_norm:
        func = _weight_norm
    stacks = [leaf.stacked for leaf in leaves]
    if func is torch.Tensor.data.__get__:  # type: ignore[attr-defined]
        return PerCell(stacks[0].detach())
    try:
        result = torch.vmap(on_one, randomness="different")(*stacks)
    except Exception:
        try:
            singles = [on_one(*single) for single in zip(*[stack.unbind(0) for stack in stacks], strict=True)]
        except Exception as error:
            raise mode.fail(f"{name_of(func)} of its parameters fails: {error}") from error
        result = _stack(mode, func, singles)
    return replace(result, lambda value: PerCell(value) if isinstance(value, Tensor) else value)


def _weight_norm(v: Tensor, g: Tensor, dim: int = 0) -> Tensor:
    """``torch._weight_norm`` of functions that can be mapped over cells."""
    others = [d for d in range(v.dim()) if d != dim]
    return v * (g / torch.linalg.vector_norm(v, dim=others, keepdim=True))


def _stack(mode: RowMode, func: Any, singles: Sequence[Any]) -> Any:
    first = singles[0]
    if isinstance(first, Tensor) and all(single.shape == first.shape for single in singles):
        return torch.stack(list(singles))
    if isinstance(first, (list, tuple)):
        return tuple(_stack(mode, func, parts) for parts in zip(*singles, strict=True))
    if not isinstance(first, Tensor) and all(single == first for single in singles):
        return first
    raise mode.fail(f"{name_of(func)} reads values of its parameters, which differ between cells")


def _expanded_to_rows(mode: RowMode, func: Any, args: Any, kwargs: Any) -> Tensor | None:
    """A parameter repeated once a sample, ``p.expand(n, -1)`` or ``p.repeat(n, 1)``."""
    source, *sizes = args
    sizes = list(sizes[0]) if len(sizes) == 1 and not isinstance(sizes[0], int) else sizes
    if kwargs or not isinstance(source, PerCell) or len(sizes) <= 1 or sizes[0] != mode.n:
        return None
    shape, added = list(source.shape), len(sizes) - source.dim()
    if added not in (0, 1) or (added == 0 and shape[0] != 1):
        return None
    inner = shape if added else shape[1:]
    rows = mode.grouping.expand(PerCell(source.stacked.reshape(-1, *inner)))
    repeats = [1, *sizes[1:]] if "repeat" in getattr(func, "__name__", "") else None
    return mode.mark(rows.repeat(repeats) if repeats else rows.expand(mode.n, *sizes[1:]))


def _expand_like(mode: RowMode, parameter: PerCell, dim: int, m: int) -> Tensor | None:
    """A parameter as rows of ``dim`` dimensions, [n * m, 1..., *shape]; None if it has more itself."""
    shape = parameter.shape
    if len(shape) == dim and shape[0] == 1:
        shape = shape[1:]
    if len(shape) >= dim:
        return None
    rows = mode.grouping.expand(parameter, m)
    return rows.reshape(rows.shape[0], *[1] * (dim - 1 - len(shape)), *shape)


def _elementwise(mode: RowMode, func: Any, args: Any, kwargs: Any) -> Tensor | None:
    tensors = list(tensors_in((args, kwargs)))
    rows = [tensor for tensor in tensors if mode.is_rows(tensor)]
    others = [tensor for tensor in tensors if not mode.is_rows(tensor)]
    dim, m = max(tensor.dim() for tensor in rows), mode.rows_each(rows[0])
    if any(tensor.dim() != dim or mode.rows_each(tensor) != m for tensor in rows):
        return None
    if any(tensor.dim() > dim or (tensor.dim() == dim and tensor.shape[0] != 1) for tensor in others):
        return None
    if getattr(func, "__name__", "").rstrip("_") != getattr(func, "__name__", "") and isinstance(args[0], PerCell):
        raise mode.fail(f"{name_of(func)} writes samples into a parameter")
    wide = [tensor.dtype for tensor in tensors if tensor.dim() > 0 and tensor.is_floating_point()]

    def expanded(value: Any) -> Any:
        if not isinstance(value, PerCell):
            return value
        parameter = _expand_like(mode, value, dim, m)
        # A tensor without dimensions does not decide the dtype of a result, and its repetition must not either.
        if value.dim() == 0 and parameter is not None and wide:
            return parameter.to(functools.reduce(torch.promote_types, wide))
        return parameter

    given = replace((args, kwargs), expanded)
    result: Tensor = func(*given[0], **given[1])
    return result


def _linear(mode: RowMode, input: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor | None:
    """``F.linear`` on rows [n * m, ..., i] with a weight [o, i]."""
    if isinstance(input, PerCell) or not mode.is_rows(input) or input.dim() < 2 or weight.dim() != 2:
        return None
    if (bias is not None and mode.mark_of(bias) is not None) or mode.mark_of(weight) is not None:
        return None
    if input.shape[-1] != weight.shape[1]:
        raise RuntimeError(
            f"VoronoiRouter: a linear layer of the module takes {weight.shape[1]} features, got {list(input.shape)}"
        )
    flat = input.reshape(-1, input.shape[-1])
    m = flat.shape[0] // mode.n
    if not isinstance(weight, PerCell):
        y = F.linear(flat, weight)
    else:
        stacked = bias.stacked if isinstance(bias, PerCell) else None
        offsets = mode.grouping.scaled_offsets(m)
        y = grouped_linear(flat, offsets, weight.stacked, stacked, backend=mode.grouping.backend)
    if bias is not None and not (isinstance(weight, PerCell) and isinstance(bias, PerCell)):
        y = y + (mode.grouping.expand(bias, m) if isinstance(bias, PerCell) else bias)
    return y.reshape(*input.shape[:-1], weight.shape[0])


def _matmul(mode: RowMode, input: Tensor, other: Tensor) -> Tensor | None:
    """``x @ W`` on rows [n * m, ..., i] with [i, o], and ``W @ x`` on rows [n * m, i, c] with [o, i]."""
    if isinstance(other, PerCell):
        if other.dim() == 1 and input.dim() >= 2:
            product = _linear(mode, input, PerCell(other.stacked[:, None]))
            return None if product is None else product.squeeze(-1)
        return _linear(mode, input, PerCell(other.stacked.transpose(1, 2))) if other.dim() == 2 else None
    if isinstance(input, PerCell) and input.dim() == 2 and other.dim() >= 3:
        product = _linear(mode, mode.mark(other.transpose(-1, -2)), input) if mode.is_rows(other) else None
        return None if product is None else product.transpose(-1, -2)
    return None


def _transposed_linear(mode: RowMode, other: Tensor, input: Tensor) -> Tensor | None:
    return _matmul(mode, input, other)


def _addmm(
    mode: RowMode, input: Tensor, mat1: Tensor, mat2: Tensor, *, beta: float = 1, alpha: float = 1
) -> Tensor | None:
    if not isinstance(mat2, PerCell) or beta != 1 or alpha != 1 or mode.mark_of(input) is not None or input.dim() != 1:
        return None
    return _linear(mode, mat1, PerCell(mat2.stacked.transpose(1, 2)), input)


def _einsum(mode: RowMode, equation: str, *operands: Any) -> Tensor | None:
    """A contraction of rows with a parameter, ``"ni,oi->no"``, as a product."""
    if len(operands) == 1 and isinstance(operands[0], (list, tuple)):
        operands = tuple(operands[0])
    terms, arrow, out = equation.replace(" ", "").partition("->")
    names = terms.split(",")
    if len(names) != 2 or len(operands) != 2 or not arrow or "." in equation:
        return None
    (x, x_names), (w, w_names) = sorted(
        zip(operands, names, strict=True), key=lambda pair: isinstance(pair[0], PerCell)
    )
    if not mode.is_rows(x) or not isinstance(w, PerCell) or len(set(x_names)) < len(x_names):
        return None
    row = x_names[0]
    contracted = [name for name in x_names if name in w_names]
    kept = [name for name in x_names if name not in w_names]
    added = [name for name in w_names if name not in x_names]
    if row in w_names or len(set(w_names)) < len(w_names) or out[:1] != row or not contracted:
        return None
    if sorted(out) != sorted(kept + added):
        return None
    sizes = {**dict(zip(x_names, x.shape, strict=True)), **dict(zip(w_names, w.shape, strict=True))}
    rows = x.permute([x_names.index(name) for name in kept + contracted])
    rows = rows.reshape(*[sizes[name] for name in kept], -1)
    weight = w.stacked.permute(0, *[1 + w_names.index(name) for name in added + contracted])
    weight = weight.reshape(weight.shape[0], -1, rows.shape[-1])
    product = _linear(mode, mode.mark(rows), PerCell(weight))
    if product is None:
        return None
    product = product.reshape([sizes[name] for name in kept + added])
    return product.permute([(kept + added).index(name) for name in out])


def _layer_norm(
    mode: RowMode,
    input: Tensor,
    normalized_shape: Sequence[int],
    weight: Tensor | None = None,
    bias: Tensor | None = None,
    eps: float = 1e-5,
) -> Tensor | None:
    if not mode.is_rows(input) or len(normalized_shape) >= input.dim():
        return None
    return _scale_and_shift(mode, F.layer_norm(input, normalized_shape, None, None, eps), weight, bias)


def _rms_norm(
    mode: RowMode,
    input: Tensor,
    normalized_shape: Sequence[int],
    weight: Tensor | None = None,
    eps: float | None = None,
) -> Tensor | None:
    if not mode.is_rows(input) or len(normalized_shape) >= input.dim():
        return None
    return _scale_and_shift(mode, F.rms_norm(input, normalized_shape, None, eps), weight, None)


def _group_norm(
    mode: RowMode,
    input: Tensor,
    num_groups: int,
    weight: Tensor | None = None,
    bias: Tensor | None = None,
    eps: float = 1e-5,
) -> Tensor | None:
    if not mode.is_rows(input):
        return None
    normal = F.group_norm(input, num_groups, None, None, eps)
    trailing = [1] * (input.dim() - 2)
    weight, bias = (_with_trailing(parameter, trailing) for parameter in (weight, bias))
    return _scale_and_shift(mode, normal, weight, bias)


def _with_trailing(parameter: Tensor | None, trailing: list[int]) -> Tensor | None:
    if parameter is None:
        return None
    if isinstance(parameter, PerCell):
        return PerCell(parameter.stacked.reshape(*parameter.stacked.shape, *trailing))
    return parameter.reshape(*parameter.shape, *trailing)


def _scale_and_shift(mode: RowMode, x: Tensor, weight: Tensor | None, bias: Tensor | None) -> Tensor | None:
    m = x.shape[0] // mode.n
    for parameter, join in ((weight, torch.mul), (bias, torch.add)):
        if parameter is not None:
            rows = _expand_like(mode, parameter, x.dim(), m) if isinstance(parameter, PerCell) else parameter
            if rows is None:
                return None
            x = join(x, rows)
    return x


def _prelu(mode: RowMode, input: Tensor, weight: Tensor) -> Tensor | None:
    if not isinstance(weight, PerCell) or not mode.is_rows(input) or weight.dim() != 1:
        return None
    slope = mode.grouping.expand(weight, mode.rows_each(input))
    slope = slope.reshape(slope.shape[0], *[slope.shape[1], *[1] * (input.dim() - 2)][: input.dim() - 1])
    return torch.where(input >= 0, input, slope * input)


def _embedding(
    mode: RowMode,
    input: Tensor,
    weight: Tensor,
    padding_idx: int | None = None,
    max_norm: float | None = None,
    norm_type: float = 2.0,
    scale_grad_by_freq: bool = False,
    sparse: bool = False,
) -> Tensor | None:
    if not isinstance(weight, PerCell) or weight.dim() != 2 or not mode.is_rows(input):
        return None
    if padding_idx is not None or max_norm is not None or scale_grad_by_freq or sparse:
        return None
    entries, m = weight.shape[0], mode.rows_each(input)
    if bool(((input < 0) | (input >= entries)).any()):
        raise IndexError(
            f"VoronoiRouter: indices of an embedding must lie in 0..{entries - 1}, got {int(input.min())}.."
            f"{int(input.max())}"
        )
    cells = mode.grouping.sorted_cells
    cells = (cells if m == 1 else cells.repeat_interleave(m)).reshape(-1, *[1] * (input.dim() - 1))
    return F.embedding(input + cells * entries, weight.stacked.reshape(-1, weight.shape[1]))


def _cell_by_cell(mode: RowMode, func: Any, args: Any, kwargs: Any) -> Any:
    """A function without a grouped form, on the contiguous rows of each cell that has any."""
    if not mode.tried(func, args, kwargs, -1):
        raise mode.fail(f"{name_of(func)} does not work sample by sample")
    if mode.grouping.k > 1:
        mode.memory.say_once(name_of(func), f"VoronoiRouter: {name_of(func)} has no grouped form and runs cell by cell")
    pieces: dict[int, tuple[Tensor, ...]] = {}
    results = []
    for cell, first, last in mode.grouping.occupied():

        def of_cell(value: Any, cell: int = cell, first: int = first, last: int = last) -> Any:
            if isinstance(value, PerCell):
                # One split for all cells: its backward is one stack, where k selections would each fill a whole tensor.
                if id(value) not in pieces:
                    pieces[id(value)] = value.stacked.unbind(0)
                return pieces[id(value)][cell]
            if isinstance(value, Tensor) and mode.is_rows(value):
                m = mode.rows_each(value)
                return value[first * m : last * m]
            return value

        given = replace((args, kwargs), of_cell)
        results.append(func(*given[0], **given[1]))
    return _concatenate(mode, results)


def _concatenate(mode: RowMode, results: Sequence[Any]) -> Any:
    first = results[0]
    if isinstance(first, Tensor):
        return mode.mark(torch.cat(list(results)))
    if isinstance(first, (list, tuple)):
        parts = [_concatenate(mode, part) for part in zip(*results, strict=True)]
        return type(first)(*parts) if hasattr(first, "_fields") else type(first)(parts)
    return first


_RULES: dict[Any, Rule] = {
    F.linear: _linear,
    torch.addmm: _addmm,
    torch.Tensor.addmm: _addmm,
    torch.Tensor.__rmatmul__: _transposed_linear,
    torch.einsum: _einsum,
    F.layer_norm: _layer_norm,
    F.rms_norm: _rms_norm,
    F.group_norm: _group_norm,
    F.prelu: _prelu,
    F.embedding: _embedding,
}
_SIGNATURES = {rule: inspect.signature(rule) for rule in _RULES.values()}
