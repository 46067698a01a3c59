"""The rules by which PyTorch's functions run on the parameters of all cells at once.

Products use ``grouped_linear``, scales and shifts are repeated for each cell's rows, and look-ups read the cell's part
of a table. A rule returns ``NotImplemented`` for arguments that it does not support.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from voronerf.ops import grouped_linear
from voronerf.ops._core.memory import on_huge_pages
from voronerf.router.grouped import GroupedRun, PerCell, find, register, writes_in_place
from voronerf.router.grouping import cells_of
from voronerf.router.layout import map_tensors, tensors_of
from voronerf.router.norms import EXACT
from voronerf.router.transforms import transformed

_ELEMENTWISE = """
    add sub subtract rsub mul multiply div divide true_divide remainder fmod pow maximum minimum atan2 hypot lerp where
    addcmul addcdiv clamp clamp_min clamp_max gt ge lt le eq ne masked_fill logaddexp
    __add__ __radd__ __iadd__ __sub__ __rsub__ __isub__ __mul__ __rmul__ __imul__ __truediv__ __rtruediv__ __itruediv__
    __mod__ __pow__ __rpow__ __lt__ __le__ __gt__ __ge__ __eq__ __ne__
"""
_INTEGERS = (torch.int32, torch.int64)
_FEW = 1 << 12  # maximum number of values per cell for one joint look-up in planes


def rule(*functions: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Returns a decorator that registers a rule for some functions."""

    def decorate(rule: Callable[..., Any]) -> Callable[..., Any]:
        for function in functions:
            register(function, rule)
        return rule

    return decorate


def _spellings(names: str) -> frozenset[Any]:
    """Returns the functions and methods of these names, including in-place ones."""
    return find(" ".join(f"{name} {name}_" for name in names.split()), torch, torch.Tensor)


# Products -------------------------------------------------------------------------------------------------------------


@rule(F.linear)
def linear(run: GroupedRun, input: Tensor, weight: Tensor, bias: Tensor | None = None) -> Any:
    """Multiplies rows [n * m, ..., i] by a weight [o, i]."""
    if not run.is_rows(input) or input.dim() < 2 or weight.dim() != 2 or run.is_rows(bias) or run.is_rows(weight):
        return NotImplemented
    if input.shape[-1] != weight.shape[1]:
        raise RuntimeError(
            f"VoronoiRouter: a linear layer of the module takes {weight.shape[1]} features, got {list(input.shape)}"
        )
    # The input is made contiguous, because the layer saves it, and would copy a strided input again for gradients.
    flat = (input if input.dim() == 2 else input.reshape(-1, input.shape[-1])).contiguous()
    m = run.entries(input) * (flat.shape[0] // input.shape[0])
    is_joint = isinstance(weight, PerCell) and (bias is None or isinstance(bias, PerCell))
    if isinstance(weight, PerCell):
        y = _product(run, flat, m, weight.stacked, bias.stacked if isinstance(bias, PerCell) else None)
    else:
        y = F.linear(flat, weight)
    if bias is not None and not is_joint:
        y = y + (run.rows_of(bias, m) if isinstance(bias, PerCell) else bias)
    # No view if the shape is already right, because writes into a view make the backward slow.
    return y if input.dim() == 2 else y.reshape(*input.shape[:-1], weight.shape[0])


def _product(run: GroupedRun, x: Tensor, m: int, weight: Tensor, bias: Tensor | None) -> Tensor:
    """Multiplies rows [n * m, i] by weights [k, o, i] and adds biases [k, o]; complex features become real pairs."""
    offsets, backend = run.grouping.scaled_offsets(m), run.grouping.backend
    if not weight.is_complex():
        return grouped_linear(x, offsets, weight, bias, backend=backend)
    real, imaginary = weight.real, weight.imag
    weight = torch.cat([torch.cat([real, -imaginary], 2), torch.cat([imaginary, real], 2)], 1)
    bias = None if bias is None else torch.cat([bias.real, bias.imag], 1)
    with torch.autocast(x.device.type, enabled=False):  # autocast does not convert complex numbers
        y = grouped_linear(torch.cat([x.real, x.imag], 1), offsets, weight, bias, backend=backend)
    return torch.complex(*y.chunk(2, 1))


@rule(torch.matmul, torch.Tensor.matmul, torch.mm, torch.Tensor.mm, torch.Tensor.__matmul__)
def matmul(run: GroupedRun, input: Tensor, other: Tensor) -> Any:
    """Multiplies rows [n * m, ..., i] by a matrix [i, o]."""
    if not isinstance(other, PerCell) or other.dim() != 2:
        return NotImplemented
    return linear(run, input, PerCell(other.stacked.transpose(1, 2)))


register(torch.Tensor.__rmatmul__, lambda run, other, input: matmul(run, input, other))


@rule(torch.addmm, torch.Tensor.addmm)
def addmm(run: GroupedRun, input: Tensor, mat1: Tensor, mat2: Tensor, *, beta: float = 1, alpha: float = 1) -> Any:
    """Multiplies rows [n * m, i] by a matrix [i, o] and adds ``input``; supports only beta = alpha = 1."""
    product = matmul(run, mat1, mat2) if beta == alpha == 1 else NotImplemented
    return product if product is NotImplemented else _elementwise(torch.add, run, run.mark(product), input)


_PAIR = re.compile(r"(\w+),(\w+)->(\w+)")


@rule(torch.einsum)
def einsum(run: GroupedRun, equation: str, *operands: Any) -> Any:
    """Multiplies rows by a parameter; sums all or none of their common letters: ``"bid,iod->bo"``, ``"bi,oi->bio"``."""
    operands = tuple(operands[0]) if isinstance(operands[0], (list, tuple)) else operands
    match = _PAIR.fullmatch(equation.replace(" ", ""))
    if match is None or len(operands) != 2:
        return NotImplemented
    (x, weight), (of_x, of_weight, out) = operands, match.groups()
    if isinstance(x, PerCell):
        x, weight, of_x, of_weight = weight, x, of_weight, of_x
    summed = "".join(letter for letter in of_x if letter not in out)
    unshared = set(of_x) ^ set(of_weight)
    repeats = any(len(set(letters)) != len(letters) for letters in (of_x, of_weight, out))
    if not run.is_rows(x) or repeats or not unshared <= set(out) or out[0] in of_weight:
        return NotImplemented
    if not summed:

        def spread(tensor: Tensor, letters: str) -> Tensor:
            tensor = tensor.permute([letters.index(letter) for letter in out if letter in letters])
            return tensor[tuple(slice(None) if letter in letters else None for letter in out)]

        factor = PerCell(spread(weight.stacked, out[0] + of_weight))  # cells come first, like samples
        return _elementwise(torch.mul, run, run.mark(spread(x, of_x)), factor)
    if set(of_x) & set(of_weight) != set(summed):
        return NotImplemented
    kept, new = "".join(filter(of_x.count, out)), "".join(filter(of_weight.count, out))
    rows = x.permute([of_x.index(letter) for letter in kept + summed]).flatten(len(kept))
    stacked = weight.stacked.permute([0, *(1 + of_weight.index(letter) for letter in new + summed)])
    y = linear(run, run.mark(rows), PerCell(stacked.reshape(len(stacked), -1, rows.shape[-1])))
    y = y.reshape(*rows.shape[:-1], *stacked.shape[1 : 1 + len(new)])
    return y if kept + new == out else y.permute([(kept + new).index(letter) for letter in out])


@rule(F.conv1d, F.conv2d, F.conv3d)
def convolution(
    run: GroupedRun,
    input: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    stride: Any = 1,
    padding: Any = 0,
    dilation: Any = 1,
    groups: int = 1,
) -> Any:
    """Convolves rows [n * m, i, ...] with kernels of size 1.

    The input may also be [i, ...] or [1, i, ...], with the samples in one of the later dimensions.
    """
    places, channel = weight.dim() - 2, input.dim() - weight.dim() + 1
    if not run.is_rows(input) or set(weight.shape[2:]) != {1} or groups != 1:
        return NotImplemented
    if stride not in (1, (1,) * places) or padding not in (0, (0,) * places):
        return NotImplemented
    sample_dims = [d for d in range(channel + 1, input.dim()) if input.shape[d] == run.n]
    sample_dims = sample_dims if channel == 0 or input.shape[0] % run.n else [0]
    if len(sample_dims) != 1:
        return NotImplemented
    flat = PerCell(weight.stacked.flatten(2)) if isinstance(weight, PerCell) else weight.flatten(1)
    y = linear(run, run.mark(input.movedim((sample_dims[0], channel), (0, -1))), flat, bias)
    return y if y is NotImplemented else y.movedim((0, -1), (sample_dims[0], channel))


# Scales and shifts ----------------------------------------------------------------------------------------------------


def _elementwise(func: Any, run: GroupedRun, *args: Any, **kwargs: Any) -> Any:
    """Runs an elementwise function on rows [n * m, ...] and parameters that broadcast to them."""
    tensors = tensors_of((args, kwargs))
    rows = [tensor for tensor in tensors if run.is_rows(tensor)]
    if not rows or (isinstance(args[0], PerCell) and writes_in_place(func)):  # no writes into a parameter
        return NotImplemented
    dim, m = max(tensor.dim() for tensor in rows), run.entries(rows[0])
    if any(tensor.dim() != dim or run.entries(tensor) != m for tensor in rows):
        return NotImplemented
    if any(t.dim() > dim or (t.dim() == dim and t.shape[0] != 1) for t in tensors if not run.is_rows(t)):
        return NotImplemented
    dtypes = [tensor.dtype for tensor in tensors if tensor.dim() > 0 and tensor.is_floating_point()]

    def expanded(value: Tensor) -> Tensor:
        if not isinstance(value, PerCell):
            return value
        shape = value.shape[value.dim() == dim :]
        parameter = run.rows_of(value, m).reshape(-1, *[1] * (dim - 1 - len(shape)), *shape)
        # PyTorch ignores the dtype of a zero-dimensional tensor, so its repeated values get the other tensors' dtype.
        return parameter.to(functools.reduce(torch.promote_types, dtypes)) if value.dim() == 0 and dtypes else parameter

    args, kwargs = map_tensors((args, kwargs), expanded)
    return func(*args, **kwargs)


for _function in _spellings(_ELEMENTWISE):
    register(_function, functools.partial(_elementwise, _function))


@rule(*_spellings("expand broadcast_to"))
def expand(run: GroupedRun, source: Tensor, *sizes: Any) -> Any:
    """Repeats a parameter once per sample, ``p.expand(n, -1)``."""
    sizes = tuple(sizes[0]) if len(sizes) == 1 and not isinstance(sizes[0], int) else sizes
    if not isinstance(source, PerCell) or len(sizes) <= 1 or sizes[0] != run.n:
        return NotImplemented
    added = len(sizes) - source.dim()
    if added < 0 or (added == 0 and source.shape[0] != 1):
        return NotImplemented
    inner = (*[1] * (added - 1), *source.shape) if added else source.shape[1:]
    return run.rows_of(PerCell(source.stacked.reshape(-1, *inner))).expand(run.n, *sizes[1:])


@rule(torch.Tensor.expand_as)
def expand_as(run: GroupedRun, source: Tensor, other: Tensor) -> Any:
    """Repeats a parameter once for each row, ``p.expand_as(x)``."""
    return expand(run, source, *other.shape) if run.is_rows(other) else NotImplemented


@rule(torch.Tensor.data.__get__)  # type: ignore[attr-defined]
def data(run: GroupedRun, source: Tensor) -> Any:
    """Detaches a parameter, ``p.data``."""
    return PerCell(source.stacked.detach()) if isinstance(source, PerCell) else NotImplemented


@rule(torch.Tensor.repeat, torch.tile, torch.Tensor.tile)
def repeat(run: GroupedRun, source: Tensor, *sizes: Any) -> Any:
    """Repeats a parameter once per sample, ``p.repeat(n, 1)``."""
    counts = tuple(sizes[0]) if len(sizes) == 1 and not isinstance(sizes[0], int) else sizes
    rows = expand(run, source, *counts[:1], *[-1] * (len(counts) - 1))
    return rows if rows is NotImplemented else rows.repeat(1, *counts[1:])


# Norms ----------------------------------------------------------------------------------------------------------------


def _norm(
    func: Any, run: GroupedRun, input: Tensor, normalized_shape: Any, weight: Any = None, bias: Any = None, **more: Any
) -> Any:
    """Normalises over the last dimensions without parameters, then applies weight and bias."""
    if not run.is_rows(input):
        return NotImplemented
    x = func(input, normalized_shape, **more)
    for parameter, join in ((weight, torch.mul), (bias, torch.add)):
        if isinstance(parameter, PerCell):
            x = _elementwise(join, run, run.mark(x), parameter)
        elif parameter is not None:
            x = join(x, parameter)
    return x


for _function in (F.layer_norm, F.rms_norm):
    register(_function, functools.partial(_norm, EXACT.get(_function, _function)))


# Look-ups -------------------------------------------------------------------------------------------------------------


def _look_up(run: GroupedRun, table: PerCell, index: Tensor, lowest: int) -> Tensor:
    """Looks up entries [n * m, ..., *shape] of tables [e, *shape], for rows of indices [n * m, ...]."""
    entries, m = table.shape[0], run.entries(index)
    low, high = (int(bound) for bound in torch.aminmax(index)) if index.numel() else (0, 0)
    if low < lowest or high >= entries:
        raise IndexError(f"VoronoiRouter: indices of a table must lie in {lowest}..{entries - 1}, got {low}..{high}")
    index = index.long()
    if low < 0:
        index = torch.where(index < 0, index + entries, index)
    index = index + (run.grouping.cells_of_rows(m) * entries).reshape(-1, *[1] * (index.dim() - 1))
    return _gather(run, table, math.prod(table.shape[1:]), index.reshape(-1)).reshape(*index.shape, *table.shape[1:])


def _gather(run: GroupedRun, table: PerCell, c: int, index: Tensor) -> Tensor:
    """Gathers entries of c numbers, [m, c], from the tables of all cells.

    The indices [m] are entry numbers in the concatenation of these tables.

    A field reads a table many times in one forward pass: the eight corners of a voxel, for several levels. The gradient
    of each look-up has the size of the whole table, so all look-ups of one table accumulate in one buffer.
    """
    stacked, start = table.origin
    if transformed():  # torch.func would copy the buffer
        return stacked.reshape(-1, c).index_select(0, index + start * (table.numel() // c))
    key = id(stacked), c, torch.is_grad_enabled()
    if key not in run.tables:
        buffer: list[Tensor] = []
        flat = stacked.reshape(-1, c)
        source = _Source.apply(flat, buffer) if flat.requires_grad and torch.is_grad_enabled() else flat
        run.tables[key] = stacked, source, buffer  # keeps ``stacked`` alive, and so its id
    _, source, buffer = run.tables[key]
    rows: Tensor = _LookUp.apply(source, start * (table.numel() // c), index, buffer)
    return rows


class _Source(torch.autograd.Function):
    """A table [k * e, c]; its gradient is the buffer in which its look-ups accumulate their gradients."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, buffer: list[Tensor]) -> Tensor:
        ctx.buffer = buffer
        ctx.set_materialize_grads(False)
        return table.view_as(table)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor | None) -> tuple[Tensor | None, None]:
        if ctx.buffer:
            collected = ctx.buffer.pop()
            gradient = collected if gradient is None else collected + gradient
        return gradient, None


class _LookUp(torch.autograd.Function):
    """A look-up of rows of a :class:`_Source`; the indices count from the row ``first``."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, first: int, index: Tensor, buffer: list[Tensor]) -> Tensor:
        ctx.save_for_backward(table, index)
        ctx.first, ctx.buffer = first, buffer
        return _as_moved(table[first:]).index_select(0, index).view(table.dtype).reshape(-1, table.shape[1])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, None, None, None]:
        table, index = ctx.saved_tensors
        if torch.is_grad_enabled():  # a buffer would lose the gradient's gradient
            return torch.zeros_like(table).index_add(0, index + ctx.first, gradient), None, None, None
        if not ctx.buffer:
            ctx.buffer.append(on_huge_pages(torch.empty_like(table)).zero_())
        sums, rows = _as_moved(ctx.buffer[0][ctx.first :]), _as_moved(gradient.contiguous())
        if sums.is_complex():
            sums.scatter_add_(0, index, rows)
        else:
            sums.index_add_(0, index, rows)
        return None, None, None, None


def _as_moved(rows: Tensor) -> Tensor:
    """Views rows [m, 1] as [m] and, on a CPU, float32 rows [m, 2] as complex numbers, which torch moves faster."""
    paired = rows.device.type == "cpu" and rows.shape[-1] == 2 and rows.dtype == torch.float32
    return torch.view_as_complex(rows) if paired else rows[:, 0] if rows.shape[-1] == 1 else rows


@rule(F.embedding)
def embedding(run: GroupedRun, input: Tensor, weight: Tensor, *, norm_type: float = 2.0, **options: Any) -> Any:
    """Looks up rows of indices in a table [e, c]; supports no options."""
    if not isinstance(weight, PerCell) or weight.dim() != 2 or not run.is_rows(input):
        return NotImplemented
    if any(value is not None and value is not False for value in options.values()):
        return NotImplemented
    return _look_up(run, weight, input, 0)


@rule(torch.Tensor.__getitem__)
def getitem(run: GroupedRun, source: Tensor, index: Any) -> Any:
    """Looks up ``table[index]`` for a table [e, c] and rows of integers."""
    if not isinstance(source, PerCell) or not source.dim() or not run.is_rows(index):
        return NotImplemented
    return _look_up(run, source, index, -source.shape[0]) if index.dtype in _INTEGERS else NotImplemented


@rule(F.grid_sample)
def grid_sample(run: GroupedRun, input: Tensor, grid: Tensor, **options: Any) -> Any:
    """Samples each cell's p planes [p, c, h, w] or volumes [p, c, d, h, w] at rows [p, ..., 2] or [p, ..., 3].

    Large batches are sampled cell by cell. For small batches, one look-up for all cells reads and writes only the
    corners around the points.
    """
    sample_dims = [d for d in range(1, grid.dim() - 1) if grid.shape[d] == run.n]
    if not isinstance(input, PerCell) or not run.is_rows(grid) or len(sample_dims) != 1 or len(grid) != len(input):
        return NotImplemented
    is_bilinear = options["mode"] == "bilinear" and options["padding_mode"] in ("zeros", "border") and input.dim() == 4
    is_small = grid[..., 0].numel() * input.shape[1] <= _FEW * run.grouping.k
    if is_bilinear and is_small and input.origin[0].numel() < 1 << 31:
        cells = run.grouping.sorted_cells.reshape(-1, *[1] * (2 - sample_dims[0])).expand(grid.shape[1:3])
        zeros, corners = options["padding_mode"] == "zeros", bool(options["align_corners"])
        return torch.cat([_bilinear(run, input, i, grid[i], cells, zeros, corners) for i in range(len(input))])
    occupied, planes = run.grouping.occupied, cells_of(input.stacked)
    points = grid.split([last - first for _, first, last in occupied], sample_dims[0])
    sampled = [F.grid_sample(planes[cell], at, **options) for (cell, _, _), at in zip(occupied, points, strict=True)]
    return torch.cat(sampled, sample_dims[0] + 1) if len(sampled) > 1 else sampled[0]


def _bilinear(
    run: GroupedRun, planes: PerCell, i: int, grid: Tensor, cells: Tensor, zeros: bool, align_corners: bool
) -> Tensor:
    """Samples plane i of each point's cell at points [a, b, 2], like ``F.grid_sample``; returns [1, c, a, b]."""
    p, c, h, w = planes.shape
    size = grid.new_tensor([w, h]).view(2, 1, 1)
    x = grid.movedim(-1, 0).contiguous() + 1  # [2, a, b]
    x = x * (0.5 * (size - 1)) if align_corners else (x * size - 1) * 0.5
    if not zeros:  # no gradient on the border and beyond
        x = torch.where((x > 0) & (x < size - 1), x, x.detach().clamp(min=0).minimum(size - 1))
    low = x.detach().floor()
    high, corner = x - low, torch.stack([low, low + 1])
    inside = (corner >= 0) & (corner < size)
    corner, share = corner.where(inside, 0).int(), torch.stack([1 - high, high]) * inside  # [2, 2, a, b]
    along = 1 if w == 1 and align_corners else 2  # a line has two corners, both at x = 0
    index = (corner[:, None, 1] * w + corner[:along, 0]).flatten(0, 1)[:, None]
    channel = torch.arange(c, dtype=torch.int32, device=cells.device).view(-1, 1, 1)
    first = ((cells.int() * p + i) * c + channel) * (h * w)
    index = index + first  # [2 or 4, c, a, b], into the values of all planes
    corners = _gather(run, planes, 1, index.reshape(-1)).reshape(index.shape)
    return (corners * (share[:, None, 1] * share[:along, 0]).flatten(0, 1)[:, None]).sum(0)[None]
