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
from voronerf.router.axes import Axis, SampleCount
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
_JOINT = 1 << 12  # maximum number of values per cell for one joint look-up in planes


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
    """Multiplies rows [..., n * m, ..., i] by a weight [o, i]."""
    if not run.is_rows(input) or weight.dim() != 2 or run.is_rows(bias) or run.is_rows(weight):
        return NotImplemented
    dim, entries = run.axis(input)
    if dim == input.dim() - 1:
        return NotImplemented
    if input.shape[-1] != weight.shape[1]:
        raise RuntimeError(
            f"VoronoiRouter: a linear layer of the module takes {weight.shape[1]} features, got {list(input.shape)}"
        )
    rows = input.movedim(dim, 0) if dim else input
    # The input is made contiguous, because the layer saves it, and would copy a strided input again for gradients.
    flat = (rows if rows.dim() == 2 else rows.reshape(-1, rows.shape[-1])).contiguous()
    m = entries * (flat.shape[0] // rows.shape[0])
    is_joint = isinstance(weight, PerCell) and (bias is None or isinstance(bias, PerCell))
    if isinstance(weight, PerCell):
        y = _product(run, flat, m, weight.stacked, bias.stacked if isinstance(bias, PerCell) else None)
    else:
        y = F.linear(flat, weight)
    if bias is not None and not is_joint:
        y = y + (run.rows_of(bias, m) if isinstance(bias, PerCell) else bias)
    # No view if the shape is already right, because writes into a view make the backward slow.
    y = y if rows.dim() == 2 else y.reshape(*rows.shape[:-1], weight.shape[0])
    return run.mark(y.movedim(0, dim) if dim else y, Axis(dim, entries))


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


_PAIR = re.compile(r"(\w+),(\w+)->(\w+)")


@rule(torch.einsum)
def einsum(run: GroupedRun, equation: str, *operands: Any) -> Any:
    """Multiplies rows by a parameter, by equations like ``"bid,iod->bo"``, ``"bhi,hio->bho"`` or ``"bi,oi->bio"``."""
    operands = tuple(operands[0]) if isinstance(operands[0], (list, tuple)) else operands
    match = _PAIR.fullmatch(equation.replace(" ", ""))
    if match is None or len(operands) != 2:
        return NotImplemented
    (x, weight), (of_x, of_weight, out) = operands, match.groups()
    if isinstance(x, PerCell):
        x, weight, of_x, of_weight = weight, x, of_weight, of_x
    repeats = any(len(set(letters)) != len(letters) for letters in (of_x, of_weight, out))
    if not isinstance(weight, PerCell) or not run.is_rows(x) or repeats or not set(of_x) ^ set(of_weight) <= set(out):
        return NotImplemented
    dim, m = run.axis(x)
    sample, both = of_x[dim], [letter for letter in of_x if letter in of_weight]
    if sample in of_weight:
        return NotImplemented
    for letter in both:  # a dimension of size 1 is repeated
        if x.shape[of_x.index(letter)] == weight.shape[of_weight.index(letter)]:
            continue
        if x.shape[of_x.index(letter)] == 1:
            x, of_x = x.squeeze(of_x.index(letter)), of_x.replace(letter, "")
        else:
            stacked = weight.stacked.squeeze(1 + of_weight.index(letter))
            weight, of_weight = PerCell(stacked), of_weight.replace(letter, "")
    both, sizes = [letter for letter in of_x if letter in of_weight], dict(zip(of_weight, weight.shape, strict=True))
    summed = [letter for letter in both if letter not in out]
    if not summed:

        def spread(tensor: Tensor, letters: str) -> Tensor:
            tensor = tensor.permute([letters.index(letter) for letter in order if letter in letters])
            return tensor[tuple(slice(None) if letter in letters else None for letter in order)]

        order = sample + out.replace(sample, "")
        factor = PerCell(spread(weight.stacked, sample + of_weight))  # cells come first, like samples
        y = _elementwise(torch.mul, run, run.mark(spread(x, of_x), Axis(0, m)), factor)
        return run.mark(y.permute([order.index(letter) for letter in out]), Axis(out.index(sample), m))
    kept = [sample, *(letter for letter in of_x if letter not in of_weight + sample)]
    batch, new = [letter for letter in both if letter in out], [letter for letter in of_weight if letter not in of_x]
    rows = x.permute([of_x.index(letter) for letter in (*kept, *batch, *summed)]).flatten(-len(summed))
    stacked = weight.stacked.permute([0, *(1 + of_weight.index(letter) for letter in (*batch, *new, *summed))])
    stacked = stacked.reshape(len(stacked), math.prod(sizes[letter] for letter in batch), -1, rows.shape[-1])
    rows = rows.reshape(*rows.shape[: len(kept)], stacked.shape[1], rows.shape[-1])
    parts = [
        linear(run, run.mark(part, Axis(0, m)), PerCell(weights))
        for part, weights in zip(rows.unbind(-2), stacked.unbind(1), strict=True)
    ]
    y = torch.stack(parts, -2) if len(parts) > 1 else parts[0]
    y = y.reshape(*rows.shape[: len(kept)], *(sizes[letter] for letter in (*batch, *new)))
    y = y.permute([(*kept, *batch, *new).index(letter) for letter in out])
    return run.mark(y, Axis(out.index(sample), m))


@rule(*find("matmul mm bmm mv __matmul__", torch, torch.Tensor))
def matmul(run: GroupedRun, input: Tensor, other: Tensor) -> Any:
    """Multiplies rows by a parameter, or a parameter by rows; dimensions before the last two are a batch."""
    if not input.dim() or not other.dim():
        return NotImplemented
    batch = "abcdefgh"[: max(input.dim(), other.dim(), 2) - 2]

    def letters(tensor: Tensor, inner: str) -> str:
        return batch[len(batch) + 2 - max(tensor.dim(), 2) :] + inner

    a = letters(input, "xz"[-input.dim() :])
    b = letters(other, "zy"[: other.dim()])
    out = "".join(letter for letter in (*batch, "x", "y") if letter in a + b)
    return einsum(run, f"{a},{b}->{out}", input, other)


register(torch.Tensor.__rmatmul__, lambda run, other, input: matmul(run, input, other))


@rule(torch.tensordot)
def tensordot(run: GroupedRun, a: Tensor, b: Tensor, dims: Any = 2, out: Any = None) -> Any:
    """Sums over pairs of dimensions of rows and a parameter."""
    if out is not None or isinstance(dims, Tensor):
        return NotImplemented
    of_a, of_b = "abcdefgh"[: a.dim()], list("ijklmnop"[: b.dim()])
    pairs = dims if not isinstance(dims, int) else (range(a.dim() - dims, a.dim()), range(dims))
    for i, j in zip(*((each,) if isinstance(each, int) else each for each in pairs), strict=True):
        of_b[j] = of_a[i]
    summed = set(of_a) & set(of_b)
    kept = "".join(letter for letter in (*of_a, *of_b) if letter not in summed)
    return einsum(run, f"{of_a},{''.join(of_b)}->{kept}", a, b)


@rule(F.bilinear)
def bilinear(run: GroupedRun, input1: Tensor, input2: Tensor, weight: Tensor, bias: Tensor | None = None) -> Any:
    """Multiplies the outer products of rows [n * m, i] and [n * m, j] by a weight [o, i, j]."""
    if not run.is_rows(input1) or not run.is_rows(input2) or not isinstance(weight, PerCell):
        return NotImplemented
    pairs = run.mark((input1.unsqueeze(-1) * input2.unsqueeze(-2)).flatten(-2), run.axis(input1))
    return linear(run, pairs, PerCell(weight.stacked.flatten(2)), bias)


@rule(*find("addmm baddbmm", torch, torch.Tensor))
def addmm(run: GroupedRun, input: Tensor, mat1: Tensor, mat2: Tensor, *, beta: float = 1, alpha: float = 1) -> Any:
    """Multiplies rows and a parameter and adds ``input``; supports only beta = alpha = 1."""
    product = matmul(run, mat1, mat2) if beta == alpha == 1 else NotImplemented
    return product if product is NotImplemented else _elementwise(torch.add, run, product, input)


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
    """Convolves rows with kernels of size 1; the samples may be in any dimension but the channels'."""
    places, channel = weight.dim() - 2, input.dim() - weight.dim() + 1
    if not run.is_rows(input) or set(weight.shape[2:]) != {1} or groups != 1:
        return NotImplemented
    if stride not in (1, (1,) * places) or padding not in (0, (0,) * places):
        return NotImplemented
    dim, m = run.axis(input)
    if dim == channel:
        return NotImplemented
    flat = PerCell(weight.stacked.flatten(2)) if isinstance(weight, PerCell) else weight.flatten(1)
    y = linear(run, run.mark(input.movedim((dim, channel), (0, -1)), Axis(0, m)), flat, bias)
    return y if y is NotImplemented else run.mark(y.movedim((0, -1), (dim, channel)), Axis(dim, m))


# Scales and shifts ----------------------------------------------------------------------------------------------------


def _spread(run: GroupedRun, parameter: PerCell, after: int, m: int) -> Tensor | None:
    """Repeats a parameter for each row; the dimension of the rows precedes the last ``after`` dimensions.

    Returns None if the parameter already has a size other than 1 there, because it then differs between samples.
    """
    shape, stacked = parameter.shape, parameter.stacked
    before = max(len(shape) - after - 1, 0)
    if len(shape) > after:
        if shape[before] != 1:
            return None
        stacked = stacked.squeeze(1 + before)
    rows = run.rows_of(PerCell(stacked), m)
    rows = rows.reshape(-1, *shape[:before], *[1] * (after - len(shape)), *shape[len(shape) - min(after, len(shape)) :])
    return rows.movedim(0, before) if before else rows


def _elementwise(func: Any, run: GroupedRun, *args: Any, **kwargs: Any) -> Any:
    """Runs an elementwise function on rows and on parameters that broadcast to them."""
    tensors = tensors_of((args, kwargs))
    rows = [tensor for tensor in tensors if run.is_rows(tensor)]
    if not rows or (isinstance(args[0], PerCell) and writes_in_place(func)):  # no writes into a parameter
        return NotImplemented
    places = {(tensor.dim() - 1 - run.axis(tensor).dim, run.axis(tensor).m) for tensor in rows}
    if len(places) > 1:
        return NotImplemented
    ((after, m),) = places
    spread = {id(t): _spread(run, t, after, m) for t in tensors if isinstance(t, PerCell)}
    if any(parameter is None for parameter in spread.values()):
        return NotImplemented
    dtypes = [tensor.dtype for tensor in tensors if tensor.dim() > 0 and tensor.is_floating_point()]

    def expanded(value: Tensor) -> Any:
        if not isinstance(value, PerCell):
            return value
        # PyTorch ignores the dtype of a zero-dimensional tensor, so its repeated values get the other tensors' dtype.
        typed = value.dim() == 0 and dtypes
        parameter = spread[id(value)]
        return (
            parameter.to(functools.reduce(torch.promote_types, dtypes))
            if typed and parameter is not None
            else parameter
        )

    args, kwargs = map_tensors((args, kwargs), expanded)
    result = func(*args, **kwargs)
    return run.mark(result, Axis(result.dim() - 1 - after, m))


for _function in _spellings(_ELEMENTWISE):
    register(_function, functools.partial(_elementwise, _function))


@rule(*_spellings("expand broadcast_to"))
def expand(run: GroupedRun, source: Tensor, *sizes: Any) -> Any:
    """Repeats a parameter once per sample, ``p.expand(n, -1)``."""
    sizes = tuple(sizes[0]) if len(sizes) == 1 and not isinstance(sizes[0], int) else sizes
    dims = [dim for dim, size in enumerate(sizes) if isinstance(size, SampleCount)]
    if not isinstance(source, PerCell) or len(dims) != 1:
        return NotImplemented
    m = sizes[dims[0]] // run.n
    rows = _spread(run, source, len(sizes) - 1 - dims[0], m)
    return NotImplemented if rows is None else run.mark(rows.expand(sizes), Axis(dims[0], m))


@rule(torch.Tensor.expand_as)
def expand_as(run: GroupedRun, source: Tensor, other: Tensor) -> Any:
    """Repeats a parameter once for each row, ``p.expand_as(x)``."""
    if not run.is_rows(other):
        return NotImplemented
    dim = run.axis(other).dim
    return expand(run, source, *other.shape[:dim], SampleCount(other.shape[dim]), *other.shape[dim + 1 :])


@rule(torch.Tensor.data.__get__)  # type: ignore[attr-defined]
def data(run: GroupedRun, source: Tensor) -> Any:
    """Detaches a parameter, ``p.data``."""
    return PerCell(source.stacked.detach()) if isinstance(source, PerCell) else NotImplemented


@rule(torch.Tensor.repeat, torch.tile, torch.Tensor.tile)
def repeat(run: GroupedRun, source: Tensor, *sizes: Any) -> Any:
    """Repeats a parameter once per sample, ``p.repeat(n, 1)``."""
    counts = tuple(sizes[0]) if len(sizes) == 1 and not isinstance(sizes[0], int) else sizes
    dims = [dim for dim, count in enumerate(counts) if isinstance(count, SampleCount)]
    if not isinstance(source, PerCell) or len(dims) != 1:
        return NotImplemented
    m = counts[dims[0]] // run.n
    rows = _spread(run, source, len(counts) - 1 - dims[0], m)
    if rows is None:
        return NotImplemented
    return run.mark(rows.repeat([1 if isinstance(count, SampleCount) else count for count in counts]), Axis(dims[0], m))


# Norms ----------------------------------------------------------------------------------------------------------------


def _scaled(run: GroupedRun, x: Any, axis: Axis, weight: Any, bias: Any, after: int = 0) -> Any:
    """Multiplies rows by a weight and adds a bias, which have their channel before the last ``after`` dimensions."""
    x = run.mark(x, axis)
    for parameter, join in ((weight, torch.mul), (bias, torch.add)):
        if isinstance(parameter, PerCell):
            stacked = parameter.stacked.reshape(*parameter.stacked.shape, *[1] * after)
            x = _elementwise(join, run, x, PerCell(stacked))
        elif parameter is not None:
            x = join(x, parameter.reshape(*parameter.shape, *[1] * after))
    return x


def _norm(
    func: Any, run: GroupedRun, input: Tensor, normalized_shape: Any, weight: Any = None, bias: Any = None, **more: Any
) -> Any:
    """Normalises over the last dimensions without parameters, then applies weight and bias."""
    if not run.is_rows(input) or run.axis(input).dim >= input.dim() - len(normalized_shape):
        return NotImplemented
    return _scaled(run, func(input, normalized_shape, **more), run.axis(input), weight, bias)


for _function in (F.layer_norm, F.rms_norm):
    register(_function, functools.partial(_norm, EXACT.get(_function, _function)))


def _of_channels(run: GroupedRun, input: Tensor, func: Callable[[], Tensor], weight: Any, bias: Any) -> Any:
    """Normalises channels [n, c, ...] by a function, then applies weight and bias."""
    if not run.is_rows(input) or run.axis(input).dim:
        return NotImplemented
    return _scaled(run, func(), run.axis(input), weight, bias, input.dim() - 2)


@rule(F.group_norm)
def group_norm(
    run: GroupedRun, input: Tensor, groups: int, weight: Any = None, bias: Any = None, eps: Any = 1e-5
) -> Any:
    """Normalises groups of channels."""
    return _of_channels(run, input, lambda: F.group_norm(input, groups, eps=eps), weight, bias)


@rule(F.batch_norm)
def batch_norm(
    run: GroupedRun, input: Tensor, mean: Any, variance: Any, weight: Any = None, bias: Any = None, **options: Any
) -> Any:
    """Normalises channels by statistics that all cells share; not in training, which mixes samples."""
    if options.pop("training", False):
        return NotImplemented
    return _of_channels(run, input, lambda: F.batch_norm(input, mean, variance, **options), weight, bias)


@rule(F.instance_norm)
def instance_norm(run: GroupedRun, input: Tensor, *, weight: Any = None, bias: Any = None, **options: Any) -> Any:
    """Normalises channels by the statistics of each sample; not in training with running statistics."""
    if options["use_input_stats"] and options["running_mean"] is not None:
        return NotImplemented
    return _of_channels(run, input, lambda: F.instance_norm(input, **options), weight, bias)


@rule(F.prelu, torch.prelu, torch.Tensor.prelu)
def prelu(run: GroupedRun, input: Tensor, weight: Tensor) -> Any:
    """Scales negative rows by one slope, or by a slope for each channel [n, c, ...]."""
    if not isinstance(weight, PerCell) or not run.is_rows(input):
        return NotImplemented
    after = 0 if weight.numel() == 1 else max(input.dim() - 2, 0)
    slopes = PerCell(weight.stacked.reshape(*weight.stacked.shape, *[1] * after))
    return _elementwise(lambda x, slope: torch.where(x > 0, x, slope * x), run, input, slopes)


# Recurrent layers -----------------------------------------------------------------------------------------------------


def _gru(x: Tensor, h: Tensor, state: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    (r, z, n), (hr, hz, hn) = x.chunk(3, -1), h.chunk(3, -1)
    n = torch.tanh(n + torch.sigmoid(r + hr) * hn)
    return (n + torch.sigmoid(z + hz) * (state[0] - n),)


def _lstm(x: Tensor, h: Tensor, state: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    i, f, g, o = (x + h).chunk(4, -1)
    cell = torch.sigmoid(f) * state[1] + torch.sigmoid(i) * torch.tanh(g)
    return torch.sigmoid(o) * torch.tanh(cell), cell


_CELLS: dict[str, Callable[..., tuple[Tensor, ...]]] = {
    "gru": _gru,
    "lstm": _lstm,
    "rnn_tanh": lambda x, h, state: (torch.tanh(x + h),),
    "rnn_relu": lambda x, h, state: (torch.relu(x + h),),
}
"""By name, the function from x W_ih, h W_hh and the state of a recurrent cell to its next state."""


def _recurrent_cell(
    cell: Any, run: GroupedRun, x: Tensor, hx: Any, w_ih: Tensor, w_hh: Tensor, b_ih: Any = None, b_hh: Any = None
) -> Any:
    """Computes one step of a cell for rows [n * m, i]; ``hx`` is the state [n * m, h], or a pair (LSTM)."""
    state = (hx,) if isinstance(hx, Tensor) else tuple(hx)
    if not run.is_rows(x) or run.axis(x).dim or not all(map(run.is_rows, state)):
        return NotImplemented
    y = cell(linear(run, x, w_ih, b_ih), linear(run, run.mark(state[0], run.axis(x)), w_hh, b_hh), state)
    return y if len(y) > 1 else y[0]


def _recurrent(cell: Any, run: GroupedRun, x: Tensor, hx: Any, parameters: Any, *options: Any) -> Any:
    """Runs layers of a cell along sequences [n, t, i], or [t, n, i]; supports neither packing nor projections.

    ``options`` are has_biases, num_layers, dropout, training, bidirectional and batch_first.
    """
    if len(options) != 6 or isinstance(parameters, Tensor) or not run.is_rows(x) or x.dim() != 3:
        return NotImplemented  # packed sequences have (data, batch_sizes, hx, ...)
    has_biases, num_layers, dropout, training, bidirectional, batch_first = options
    directions = 1 + bidirectional
    if dropout and training and num_layers > 1:
        return NotImplemented
    states, count = (hx,) if isinstance(hx, Tensor) else tuple(hx), 4 if has_biases else 2
    if run.axis(x) != (0 if batch_first else 1, 1) or len(parameters) != count * directions * num_layers:
        return NotImplemented
    x, last = x if batch_first else x.transpose(0, 1), []
    for layer in range(num_layers):
        outputs = []
        for direction in range(directions):
            at = layer * directions + direction
            w_ih, w_hh, *biases = parameters[count * at : count * (at + 1)]
            b_ih, b_hh = biases or (None, None)
            steps = linear(run, run.mark(x, Axis(0)), w_ih, b_ih).unbind(1)
            state, along = tuple(each[at] for each in states), []
            for step in reversed(steps) if direction else steps:
                state = cell(step, linear(run, run.mark(state[0], Axis(0)), w_hh, b_hh), state)
                along.append(state[0])
            outputs.append(torch.stack(along[::-1] if direction else along, 1))
            last.append(state)
        x = torch.cat(outputs, -1) if directions > 1 else outputs[0]
    return x if batch_first else x.transpose(0, 1), *(torch.stack(each) for each in zip(*last, strict=True))


for _name, _cell in _CELLS.items():
    register(getattr(torch, _name), functools.partial(_recurrent, _cell))
    register(getattr(torch, f"{_name}_cell"), functools.partial(_recurrent_cell, _cell))


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
    """A look-up of rows in a table (a result of :class:`_Source`); indices count from the table's row ``first``."""

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
    if not isinstance(input, PerCell) or not run.is_rows(grid) or len(grid) != len(input):
        return NotImplemented
    dim, m = run.axis(grid)
    if not 0 < dim < grid.dim() - 1 or m > 1:
        return NotImplemented
    is_bilinear = options["mode"] == "bilinear" and options["padding_mode"] in ("zeros", "border") and input.dim() == 4
    is_small = grid[..., 0].numel() * input.shape[1] <= _JOINT * run.grouping.k
    if is_bilinear and is_small and input.origin[0].numel() < 1 << 31:
        cells = run.grouping.sorted_cells.reshape(-1, *[1] * (2 - dim)).expand(grid.shape[1:3])
        zeros, corners = options["padding_mode"] == "zeros", bool(options["align_corners"])
        return torch.cat([_bilinear(run, input, i, grid[i], cells, zeros, corners) for i in range(len(input))])
    occupied, planes = run.grouping.occupied, cells_of(input.stacked)
    points = grid.split([last - first for _, first, last in occupied], dim)
    sampled = [F.grid_sample(planes[cell], at, **options) for (cell, _, _), at in zip(occupied, points, strict=True)]
    return torch.cat(sampled, dim + 1) if len(sampled) > 1 else sampled[0]


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
