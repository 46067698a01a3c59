"""Lowers PyTorch functions to steps of a program.

Each function of the trace runs once on a few samples, while its ATen calls are recorded. If a tensor depends on
samples, each of its entries has a code: the numbers of its sample and of its column. Functions that only move entries
(views, ``cat``, ``permute``) run on the codes. The code of a parameter's entry is the entry's number. The computed
entries of a sample become columns of a new value of the program.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from voronerf.ops._core.modes import run_within
from voronerf.ops._core.program import PARAMETER, VALUE, Builder, Columns
from voronerf.router.axes import Axis
from voronerf.router.grouped import find
from voronerf.router.layout import map_tensors, tensors_of
from voronerf.router.waves import MOST_PARTS

_LOW = (1 << 32) - 1
_PRODUCTS = 16  # maximum number of layers of a function
_SMALL = 64  # maximum number of multiplications in a product of two matrices of samples

_MOVERS = frozenset(
    """
    view _unsafe_view reshape expand permute transpose t unsqueeze squeeze slice select cat stack split split_with_sizes
    unbind clone contiguous alias repeat flip roll lift_fresh index index_select narrow expand_copy detach unfold
    unsafe_split unsafe_split_with_sizes unsafe_chunk
    """.split()  # noqa: SIM905
)
_GREATEST = torch.finfo(torch.float32).max
_FINITE = ("clamp", -_GREATEST, _GREATEST)  # before a difference, which is NaN for equal infinities


def _finite(c: float) -> float:
    return min(max(c, -_GREATEST), _GREATEST)


_FUNCTIONS: dict[str, Callable[..., list[tuple[str, float, float]]]] = {
    **{
        name: lambda *_, name=name, **__: [(name, 0, 0)]
        for name in "relu sigmoid tanh silu exp expm1 log log1p abs floor erf atan".split()  # noqa: SIM905
    },
    "sin": lambda: [("sine", 1, 0)],
    "cos": lambda: [("sine", 1, math.pi / 2)],
    "neg": lambda: [("affine", -1, 0)],
    "exp2": lambda: [("affine", math.log(2), 0), ("exp", 0, 0)],
    "square": lambda: [("power", 2, 0)],
    "sqrt": lambda: [("power", 0.5, 0)],
    "rsqrt": lambda: [("power", -0.5, 0)],
    "reciprocal": lambda: [("power", -1, 0)],
    "pow": lambda p: [("power", p, 0)],
    "leaky_relu": lambda slope=0.01: [("leaky_relu", slope, 0)],
    "elu": lambda a=1, scale=1, by=1: [("affine", by, 0), ("elu", a, 0), ("affine", scale, 0)],
    "softplus": lambda beta=1, threshold=20: [("softplus", beta, threshold)],
    "gelu": lambda approximate="none": [("gelu" if approximate == "none" else "gelu_tanh", 0, 0)],
    "clamp": lambda low=None, high=None: [
        ("clamp", -math.inf if low is None else low, math.inf if high is None else high)
    ],
    "clamp_min": lambda low: [("clamp", low, math.inf)],
    "clamp_max": lambda high: [("clamp", -math.inf, high)],
    "hardtanh": lambda low=-1, high=1: [("hardtanh", low, high)],
    "gt": lambda c: [("affine", 1, -c), ("step", 0, 0)],
    "ge": lambda c: [_FINITE, ("affine", 1, -_finite(c)), ("at_least", 0, 0)],
    "lt": lambda c: [("affine", -1, c), ("step", 0, 0)],
    "le": lambda c: [_FINITE, ("affine", -1, _finite(c)), ("at_least", 0, 0)],
    "logical_not": lambda: [("affine", -1, 1)],
    "bitwise_not": lambda: [("affine", -1, 1)],
}
"""ATen functions of one tensor and constants, by name.

Each entry maps the constants to a list of functions of the program, (name, a, b), which are applied one after the
other; a and b are their constants.
"""
_BINARY = {
    **{name: name for name in ("add", "sub", "mul", "div")},
    **dict.fromkeys(("bitwise_and", "logical_and"), "mul"),
    **{name: name for name in ("gt", "ge", "lt", "le", "rsub")},
}
_BY_SHAPE = frozenset(
    "zeros_like ones_like full_like empty_like new_zeros new_ones new_full new_empty".split()  # noqa: SIM905
)
_EMPTY = find("empty empty_like new_empty", torch, torch.Tensor)


def _reduced(combine: Callable[[Tensor, Tensor], Tensor], x: Tensor, dims: Any = None, keep: bool = False) -> Tensor:
    """Reduces dimensions by a binary function, which repeatedly combines one half with the other."""
    dims = [dims] if isinstance(dims, int) else list(dims or ())
    if not dims:
        raise NotAStep("it mixes samples")
    for dim in dims:
        while (size := x.shape[dim]) > 1:
            half = size // 2
            combined = combine(x.narrow(dim, 0, half), x.narrow(dim, half, half))
            x = torch.cat([combined, x.narrow(dim, size - 1, 1)], dim) if size % 2 else combined
    return x if keep else x.squeeze(dims)


def _maximum(x: Tensor, y: Tensor) -> Tensor:
    # Equal operands get half of the gradient each. Their sum may overflow.
    return torch.where(x > y, x, torch.where(x < y, y, x / 2 + y / 2))


def _largest(x: Tensor, dim: Any = None, keepdim: bool = False) -> Tensor:
    """Returns the largest entries; equal ones share the gradient evenly."""
    largest, finite = _reduced(_maximum, x.detach(), dim, True), x.clamp(-_GREATEST, _GREATEST)
    zero, is_largest = finite - finite.detach(), x >= largest  # zero has the gradient of x, if x is finite
    shared = torch.where(is_largest, zero, 0.0).sum(dim, True) / is_largest.to(x.dtype).sum(dim, True)
    return largest + shared if keepdim else (largest + shared).squeeze(dim)


def _below_largest(x: Tensor, dim: int) -> Tensor:
    return x - _reduced(_maximum, x.detach(), dim, True)


def _softmax(x: Tensor, dim: int, _: bool) -> Tensor:
    y = _below_largest(x, dim).exp()
    return y / y.sum(dim, keepdim=True)


def _log_softmax(x: Tensor, dim: int, _: bool) -> Tensor:
    y = _below_largest(x, dim)
    return y - y.exp().sum(dim, keepdim=True).log()


def _mean(x: Tensor, dim: Any = None, keepdim: bool = False, **_: Any) -> Tensor:
    total = x.sum(dim, keepdim=keepdim)
    return total / (x.numel() // total.numel())


def _norm(x: Tensor, order: float = 2, dim: Any = None, keepdim: bool = False, **_: Any) -> Tensor:
    if order == 1:
        return x.abs().sum(dim, keepdim=keepdim)
    if order != 2:
        raise NotAStep(f"a norm of order {order}")
    return _root(x.square().sum(dim, keepdim=keepdim))


def _root(x: Tensor) -> Tensor:
    """Returns the square root, whose gradient at 0 is 0 instead of infinite."""
    return torch.where(x > 0, torch.where(x > 0, x, 1.0).sqrt(), 0.0)


def _variance(x: Tensor, dim: Any = None, correction: float | None = None, keepdim: bool = False) -> Tensor:
    total = (x - _mean(x, dim, True)).square().sum(dim, keepdim=keepdim)
    return total / (x.numel() // total.numel() - (1 if correction is None else correction))


def _layer_norm(x: Tensor, shape: Sequence[int], weight: Any, bias: Any, eps: float) -> tuple[Tensor, ...]:
    dims = list(range(x.dim() - len(shape), x.dim()))
    mean = _mean(x, dims, True)
    scale = (_variance(x, dims, 0, True) + eps).rsqrt()
    y = (x - mean) * scale
    y = y if weight is None else y * weight
    return y if bias is None else y + bias, mean, scale


def _group_norm(
    x: Tensor, weight: Any, bias: Any, n: int, channels: int, _: int, groups: int, eps: float
) -> tuple[Tensor, ...]:
    y, mean, scale = _layer_norm(x.reshape(n, groups, -1), [x[0].numel() // groups], None, None, eps)
    y = _per_channel(y.reshape(x.shape), weight, bias)
    return y, mean.squeeze(2), scale.squeeze(2)


def _batch_norm(
    x: Tensor, weight: Any, bias: Any, mean: Tensor, variance: Tensor, _: float, eps: float
) -> tuple[Tensor, ...]:
    """Normalises by the running statistics, as in evaluation mode."""
    y = _per_channel(_per_channel(x, None, -mean), (variance + eps).rsqrt(), None)
    return _per_channel(y, weight, bias), x.new_zeros(0), x.new_zeros(0)


def _per_channel(x: Tensor, scale: Any, shift: Any) -> Tensor:
    """Returns ``x * scale + shift`` for x [n, c, ...], with one scale and one shift for each channel, or None."""
    shape = [-1, *[1] * (x.dim() - 2)]
    x = x if scale is None else x * scale.reshape(shape)
    return x if shift is None else x + shift.reshape(shape)


def _lstm_layer(
    x: Tensor, w: Tensor, u: Tensor, b: Any, v: Any, h: Tensor, c: Tensor, back: bool, *rule: Any
) -> tuple[Tensor, ...]:
    """Writes a layer of an LSTM, x [t, n, i], as t cells; ``back``: from the last x to the first."""
    if len(x) > _PRODUCTS:
        raise NotAStep(f"an LSTM of {len(x)} steps, more than {_PRODUCTS}")
    (h,), (c,), rows, (_, _, _, _, has_biases, *_) = h, c, list(x), rule
    b, v = (b, v) if has_biases else (None, None)
    for at in reversed(range(len(x))) if back else range(len(x)):
        h, c = torch.lstm_cell(rows[at], (h, c), w, u, b, v)
        rows[at] = h
    return torch.stack(rows), h.unsqueeze(0), c.unsqueeze(0)


def _bilinear(x: Tensor, weight: Tensor, y: Tensor, *_: Any) -> Tensor:
    """Writes the sum of ``x_i W_oij y_j`` as a linear layer of the products ``x_i y_j``."""
    return F.linear((x.unsqueeze(2) * y.unsqueeze(1)).flatten(1), weight.flatten(1))


def _batch_norm_in_training(x: Tensor, weight: Any, bias: Any, *rule: Any) -> tuple[Tensor, ...]:
    """Normalises by the batch's own statistics: PyTorch writes an instance norm in this way, as a batch of one."""
    if len(rule) > 3 or len(x) > 1:  # with running statistics, or of samples
        raise NotAStep("it mixes samples")
    y, mean, scale = _layer_norm(x, x.shape[2:], None, None, rule[-1])
    return _per_channel(y, weight, bias), mean.flatten(), scale.flatten()


def _convolution(x: Tensor, weight: Tensor, bias: Any, *rule: Any) -> Tensor:
    """Writes a convolution of [n, c, ...] as a linear layer; its kernel must have size 1 or cover the whole input."""
    (stride, padding, dilation, transposed, _, groups), size, more = rule, weight.shape[2:], x.shape[2:]
    covers_all = size == more and set(dilation) == {1}
    if transposed or groups != 1 or any(padding) or not (covers_all or set(size) == {1}):
        raise NotAStep("a convolution of several places")
    if covers_all:
        return F.linear(x.flatten(1), weight.flatten(1), bias).reshape(len(x), -1, *[1] * len(size))
    if set(stride) != {1}:
        raise NotAStep("a convolution that leaves out places")
    return F.linear(x.movedim(1, -1), weight.flatten(1), bias).movedim(-1, 1)


def _written(x: Tensor, indices: Sequence[Any], value: Tensor, accumulate: bool = False) -> Tensor:
    """Writes ``x[mask] = number`` as ``torch.where``."""
    mask = indices[0]
    if len(indices) != 1 or mask.dtype != torch.bool or value.numel() != 1 or accumulate:
        raise NotAStep("a write at places that depend on values, unless x[mask] = number; write it with torch.where")
    return torch.where(mask.reshape(*mask.shape, *[1] * (x.dim() - mask.dim())), value, x)


def _products(x: Tensor, y: Tensor) -> Tensor:
    """Multiplies small matrices of samples, [n, i, j] by [n, j, k]."""
    if math.prod(x.shape[1:]) * y.shape[2] > _SMALL:
        raise NotAStep("a product of two tensors of samples")
    return (x.unsqueeze(2) * y.transpose(1, 2).unsqueeze(1)).sum(3)


def _sign(x: Tensor) -> Tensor:
    positive, negative = x > 0, x < 0
    # The last term is 0. It makes the gradient 0, as in PyTorch; with comparisons alone, the gradient would be None.
    return positive.to(x.dtype) - negative.to(x.dtype) + torch.where(positive & negative, x, 0.0)


_DECOMPOSED: dict[str, Callable[..., Any]] = {
    "maximum": _maximum,
    "minimum": lambda x, y: -_maximum(-x, -y),
    "amax": _largest,
    "amin": lambda x, *args, **kwargs: -_largest(-x, *args, **kwargs),
    "all": lambda x, dim=None, keepdim=False: _reduced(torch.bitwise_and, x, dim, keepdim),
    "any": lambda x, dim=None, keepdim=False: ~_reduced(torch.bitwise_and, ~x, dim, keepdim),
    "mean": _mean,
    "var": _variance,
    "std": lambda *args, **kwargs: _root(_variance(*args, **kwargs)),
    "linalg_vector_norm": _norm,
    "native_layer_norm": _layer_norm,
    "native_group_norm": _group_norm,
    "_native_batch_norm_legit_no_training": _batch_norm,
    "_native_batch_norm_legit": _batch_norm_in_training,
    "_prelu_kernel": lambda x, slope: torch.where(x > 0, x, slope * x),
    "mkldnn_rnn_layer": _lstm_layer,
    "_trilinear": _bilinear,  # PyTorch uses it for F.bilinear alone
    "_softmax": _softmax,
    "_log_softmax": _log_softmax,
    "mish": lambda x: x * F.softplus(x).tanh(),
    "log_sigmoid_forward": lambda x: (-F.softplus(-x), x.new_zeros(0)),
    "ceil": lambda x: -(-x).floor(),
    "sign": _sign,
    "addcmul": lambda x, y, z, value=1: x + value * (y * z),
    "addcdiv": lambda x, y, z, value=1: x + value * (y / z),
    "masked_fill": lambda x, mask, value: torch.where(mask, value, x),
    "eq": lambda x, y: (x >= y) & (x <= y),
    "ne": lambda x, y: ~((x >= y) & (x <= y)),
    "bitwise_or": lambda x, y: ~(~x & ~y),
    "logical_or": lambda x, y: ~(~x & ~y),
    "linalg_cross": lambda x, y, dim=-1: x.roll(-1, dim) * y.roll(1, dim) - x.roll(1, dim) * y.roll(-1, dim),
    "convolution": _convolution,
    "index_put": _written,
    "mv": lambda x, y: torch.mm(x, y.unsqueeze(1)).squeeze(1),
}
"""ATen functions, and the functions that replace them."""


class NotAStep(Exception):
    """An error for a function that cannot be a step of a program; the message says why."""


class Entries:
    """The origin of each entry of a tensor: a sample and a column, or an entry of a parameter.

    Attributes:
        codes: A code for each entry, in the tensor's shape, on the CPU: (sample << 32) + column for a tensor of
            samples, else the entry's number in the parameter.
        of: The parameter, which is a node of the trace or a tensor; None for a tensor of samples.
    """

    def __init__(self, codes: Tensor, of: Any = None) -> None:
        self.codes, self.of = codes, of

    @classmethod
    def whole(cls, tensor: Tensor, of: Any) -> Entries:
        """Returns the entries of a tensor that is a whole parameter."""
        return cls(torch.arange(tensor.numel(), device="cpu").reshape(tensor.shape), of)


class Lowering:
    """The steps of a trace, as one program, which :class:`Fused` then divides into subprograms.

    Attributes:
        rows: The number of samples of the trace.
        levels: For each value, the number of the subprogram that computes it.
        sources: For each input, the node of the trace whose rows it reads.
        columns: For each column number in codes, the value and the index of the column in this value.
        parameters: The source of each parameter of the program: a node or tensor, and the numbers of its entries.
    """

    def __init__(self, rows: int) -> None:
        self.rows = rows
        self.builder = Builder()
        self.levels: dict[int, int] = {}
        self.sources: dict[int, Any] = {}
        self.columns: list[tuple[int, int]] = []
        self.parameters: list[tuple[Any, Tensor]] = []
        self._parameter_numbers: dict[Any, int] = {}
        self._numbered: dict[int, int] = {}
        self._leveled = 0

    # Values -----------------------------------------------------------------------------------------------------------

    def input(self, node: Any, shape: Sequence[int], axis: Axis | None, level: int) -> Entries:
        """Adds the rows of a node as an input of the program; ``axis`` is the axis of its samples."""
        if axis is None or math.prod(shape) == 0 or (axis.dim and axis.m > 1):
            raise NotAStep(f"a tensor of shape {list(shape)} has no row for each sample")
        moved = [shape[axis.dim], *shape[: axis.dim], *shape[axis.dim + 1 :]]
        x = self.builder.input(math.prod(shape) // self.rows)
        self.sources[x.index], self.levels[x.index] = node, level
        return Entries(self._codes(x).reshape(moved).movedim(0, axis.dim))

    def _codes(self, x: Columns) -> Tensor:
        """Returns the codes of columns, [rows, w]."""
        if x.index not in self._numbered:
            self._numbered[x.index] = len(self.columns)
            self.columns += [(x.index, i) for i in range(x.start + x.width)]
        first = self._numbered[x.index] + x.start
        columns = torch.arange(first, first + x.width, device="cpu")
        return (torch.arange(self.rows, device="cpu")[:, None] << 32) + columns

    def is_by_row(self, codes: Tensor) -> bool:
        """Returns whether row i of codes [rows, w] belongs to sample i."""
        return torch.equal(codes >> 32, torch.arange(self.rows, device="cpu")[:, None].expand_as(codes))

    def level(self, value: int) -> int:
        """Returns the number of the subprogram that computes a value."""
        for step in self.builder.steps[self._leveled :]:
            self.levels.setdefault(
                step.out, max((self.levels[c.index] for c in step.operands if c.of == VALUE), default=0)
            )
        self._leveled = len(self.builder.steps)
        return self.levels[value]

    def order(self, codes: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the flat indices of each sample's entries in a tensor, [rows, w], and their column numbers, [w]."""
        rows = (codes >> 32).flatten()
        if rows.numel() % self.rows or not rows.numel():
            raise NotAStep("entries of a tensor do not belong to single samples")
        places = torch.argsort(rows, stable=True).reshape(self.rows, -1)
        numbers = codes.flatten()[places]
        if not self.is_by_row(numbers):
            raise NotAStep("entries of a tensor do not belong to single samples")
        columns = numbers & _LOW
        if not (columns == columns[:1]).all():
            raise NotAStep("the tensor's layout differs between samples")
        return places, columns[0]

    def values(self, codes: Tensor) -> set[int]:
        """Returns the values of the program to which the columns of a tensor of samples belong."""
        return {self.columns[number][0] for number in (codes & _LOW).unique().tolist()}

    def parts(self, numbers: Tensor) -> list[tuple[Columns, int]]:
        """Joins the columns with these numbers into as few pieces as possible.

        Returns a list of (piece, index of its first column in ``numbers``).
        """
        parts: list[tuple[Columns, int]] = []
        for at, number in enumerate(numbers.tolist()):
            value, column = self.columns[number]
            last = parts[-1][0] if parts else None
            if last is not None and last.index == value:
                if not last.spread and last.start + last.width == column:
                    parts[-1] = last._replace(width=last.width + 1), parts[-1][1]
                    continue
                if last.start == column and (last.spread or last.width == 1):
                    parts[-1] = last._replace(width=last.width + 1, spread=True), parts[-1][1]
                    continue
            parts.append((Columns(VALUE, value, column, 1), at))
        return parts

    def operand(self, numbers: Tensor) -> Columns:
        """Returns the columns with these numbers as an operand."""
        parts = self.parts(numbers)
        return parts[0][0] if len(parts) == 1 else self.builder.move(len(numbers), parts)

    def parameter(self, entries: Entries, matrix: bool = False) -> int:
        """Returns the index of the program's parameter with these entries, [w] or [o, i]."""
        shape = tuple(entries.codes.shape) if matrix else (entries.codes.numel(),)
        key = (id(entries.of), shape, bytes(entries.codes.contiguous().numpy()))
        if key not in self._parameter_numbers:
            self._parameter_numbers[key] = self.builder.parameter(*shape)
            self.parameters.append((entries.of, entries.codes.reshape(shape).clone()))
        return self._parameter_numbers[key]

    def vector(self, entries: Entries, codes: Tensor) -> Columns:
        """Adds the entries with these codes, [w], to the program as a parameter; returns it as an operand."""
        low, width = int(codes.min()), len(codes)
        if bool((codes == low).all()):
            one = Entries(codes[:1], entries.of)
            return Columns(PARAMETER, self.parameter(one), 0, width, width > 1)
        return Columns(PARAMETER, self.parameter(Entries(codes, entries.of)), 0, width)

    # Functions --------------------------------------------------------------------------------------------------------

    def run(
        self, function: Callable[..., Any], args: Any, kwargs: Any, entries_of: Callable[[Any], Entries | None]
    ) -> Any:
        """Runs a function; returns its result, the copied arguments, and a function that returns a tensor's entries.

        ``entries_of`` returns the entries of a tensor among the arguments. Raises :class:`NotAStep`.
        """
        device = next((t.device.type for t in tensors_of((args, kwargs))), "cpu")
        with torch.inference_mode(), torch.autocast(device, enabled=False):
            mode = _EntryMode(self)

            def copy(value: Tensor) -> Tensor:
                copied = value.detach().clone()
                copied = copied.float() if copied.dtype in (torch.float16, torch.bfloat16) else copied
                entries = entries_of(value)
                if entries is not None and 0 in entries.codes.stride():  # the copy is not expanded
                    entries = Entries(entries.codes.contiguous(), entries.of)
                mode.keep(copied, entries)
                mode.originals[id(copied)] = value
                return copied

            args, kwargs = map_tensors((args, kwargs), copy)
            result = run_within(mode, functools.partial(function, *args, **kwargs))
            if function in _EMPTY:
                result.zero_()
        return result, args, mode.of_result


class _EntryMode(TorchDispatchMode):
    """A mode that records, as steps, the ATen functions that a function calls."""

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Returns False, because the default, True, imports torch.compile at the first call, which takes a second."""
        return False

    def __init__(self, lowering: Lowering) -> None:
        super().__init__()
        self.lowering, self.b = lowering, lowering.builder
        self._entries: dict[int, tuple[Tensor, Entries | None]] = {}
        self.originals: dict[int, Tensor] = {}  # the arguments, by the id of their copies

    def keep(self, tensor: Tensor, entries: Entries | None) -> None:
        """Records the entries of a tensor; None for a constant."""
        self._entries[id(tensor)] = tensor, entries

    def entries(self, tensor: Tensor) -> Entries | None:
        """Returns the entries of a tensor; None for a constant."""
        return self._entries.get(id(tensor), (None, None))[1]

    def of_result(self, tensor: Tensor) -> Entries:
        """Returns the entries of a result; a result without samples is first expanded to a tensor of samples."""
        entries = self.entries(tensor)
        return entries if entries is not None and entries.of is None else self.of_samples(tensor, entries)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        name = func.overloadpacket.__name__
        operands = [self.entries(tensor) for tensor in tensors_of((args, kwargs))]
        if not any(operands):
            return func(*args, **kwargs)
        rows = any(e is not None and e.of is None for e in operands)
        if name not in ("linear", "rsub") and name not in _MOVERS and func._can_decompose():
            with self:
                return func.decompose(*args, **kwargs)
        inplace = name.endswith("_") and not name.startswith("_")
        base = name.rstrip("_") if inplace else name
        is_product_of_samples = base == "bmm" and all(e is not None and e.of is None for e in operands)
        decomposed = _products if is_product_of_samples else _DECOMPOSED.get(base)
        if decomposed is not None:
            with self:
                result_entries = [self.entries(tensor) for tensor in tensors_of(decomposed(*args, **kwargs))]
            result = func(*args, **kwargs)
        else:
            result = func(*args, **kwargs)
            result_entries = self._result_entries(base, func, args, kwargs, result, rows)
        for tensor, entries in zip(tensors_of(result), result_entries, strict=True):
            old_entries = self.entries(tensor)
            if inplace and old_entries is not None and entries is not None:
                old_entries.codes.copy_(entries.codes)  # this also changes the base of a view
            else:
                self.keep(tensor, entries)
        return result

    def _result_entries(
        self, name: str, func: Any, args: Any, kwargs: Any, result: Any, rows: bool
    ) -> list[Entries | None]:
        """Lists the entries of a function's results."""
        if name in _MOVERS and func.overloadpacket.__name__ == name:
            return self._moved(func, args, kwargs, rows, name)
        if not rows:
            raise NotAStep(f"{name} of parameters")
        if name == "_to_copy":
            if not result.is_floating_point() or args[0].dtype not in (result.dtype, torch.bool):
                raise NotAStep(f"a conversion from {args[0].dtype} to {result.dtype}")
            return [self._sample_entries(args[0])]
        if name in _BY_SHAPE:
            return [None]
        if name in ("copy", "fill") and result is args[0]:
            return [self._overwritten(args[0], args[1])]
        if not isinstance(result, Tensor):
            raise NotAStep(f"no kind of step computes {name}")
        if name in ("mm", "linear", "addmm", "bmm", "baddbmm"):
            return [self._product(name, args, kwargs, result)]
        numbers = [v for v in args if not isinstance(v, Tensor)]
        if name in _FUNCTIONS and isinstance(args[0], Tensor) and not any(isinstance(v, Tensor) for v in args[1:]):
            places, columns = self.lowering.order(self._sample_entries(args[0]).codes)
            return [self._chain(self.lowering.operand(columns), _FUNCTIONS[name](*numbers, **kwargs), places, result)]
        if name in _BINARY:
            return [self._binary(name, args, kwargs, result)]
        if name == "where":
            return [self._where(args, result)]
        if name == "sum":
            return [self._summed(args[0], args[1] if len(args) > 1 else kwargs.get("dim"), result)]
        raise NotAStep(f"no kind of step computes {name}")

    def _sample_entries(self, tensor: Tensor) -> Entries:
        """Returns the entries of a tensor of samples; raises NotAStep for a tensor that does not depend on samples."""
        entries = self.entries(tensor)
        if entries is None or entries.of is not None:
            raise NotAStep("a product with a tensor that does not depend on samples")
        return entries

    def _constant(self, tensor: Tensor) -> Entries:
        """Returns the entries of a constant tensor."""
        with torch.inference_mode(False):
            of = self.originals[id(tensor)] if id(tensor) in self.originals else tensor.clone()
        return Entries.whole(tensor, of)

    def _moved(self, func: Any, args: Any, kwargs: Any, rows: bool, name: str) -> list[Entries | None]:
        tensors = tensors_of((args, kwargs))
        sources = {id(e.of): e.of for t in tensors if (e := self.entries(t)) is not None}
        indexed = args[1] if name in ("index",) else [args[2]] if name == "index_select" else []
        indices = {id(t) for t in indexed if isinstance(t, Tensor)}
        of = None if rows or len(sources) > 1 else next(iter(sources.values()))

        def codes(tensor: Tensor) -> Tensor:
            entries = self.entries(tensor)
            if id(tensor) in indices:
                if entries is not None:
                    raise NotAStep("a look-up at places that depend on samples")
                return tensor
            return entries.codes if entries is not None and entries.of is of else self.of_samples(tensor, entries).codes

        if name == "detach" and of is None:
            places, numbers = self.lowering.order(codes(args[0]))
            return [self._placed(self.b.apply("stop", self.lowering.operand(numbers)), places, args[0].shape)]
        args, kwargs = map_tensors((args, kwargs), codes)
        return [Entries(t, of) for t in tensors_of(func(*args, **kwargs))]

    def of_samples(self, tensor: Tensor, entries: Entries | None) -> Entries:
        """Expands a parameter or constant, equal for all samples, to a tensor of samples; returns its entries."""
        shape, rows = tensor.shape, self.lowering.rows
        dims = [d for d, size in enumerate(shape) if size and size % rows == 0]
        if len(dims) != 1 or not tensor.numel() or not (tensor.is_floating_point() or tensor.dtype == torch.bool):
            raise NotAStep("a constant without samples")
        (at,) = dims
        by_sample = (tensor if entries is None else entries.codes).movedim(at, 0).reshape(rows, -1)
        if not (by_sample == by_sample[:1]).all():
            raise NotAStep("a constant that differs between samples")
        if entries is None and bool((by_sample == by_sample[0, 0]).all()):
            column = self.b.apply("affine", self.b.move(1, []), 0.0, float(by_sample[0, 0]))
        else:
            of, codes = (entries, by_sample[0]) if entries else ((e := self._constant(by_sample[0])), e.codes)
            column = self.lowering.vector(of, codes)
            column = self.b.rows(column.part(0, 1) if column.spread else column)
        moved = [shape[at], *shape[:at], *shape[at + 1 :]]
        numbers = self.lowering._codes(column).expand(rows, tensor.numel() // rows)
        return Entries(numbers.reshape(moved).movedim(0, at).contiguous())

    def _overwritten(self, target: Tensor, source: Any) -> Entries:
        """Returns the entries of a tensor after a write from another tensor or number."""
        target_entries = self.entries(target)
        if target_entries is None or target_entries.of is not None:
            raise NotAStep("a write into a parameter or a constant")
        value = source if isinstance(source, Tensor) else torch.full_like(target, source)
        entries = self.entries(value)
        entries = Entries(entries.codes.expand(target.shape), entries.of) if entries is not None else None
        if entries is not None and entries.of is None:
            return entries
        return self.of_samples(value.expand(target.shape), entries)

    def _placed(self, value: Columns, places: Tensor, shape: Sequence[int]) -> Entries:
        """Returns the entries of a tensor that holds a value's columns at the flat indices ``places``, [rows, w]."""
        codes = torch.empty(math.prod(shape), dtype=torch.int64, device="cpu")
        columns = self.b.rows(value)
        codes[places] = self.lowering._codes(columns).expand(places.shape) if columns.width > 0 else 0
        return Entries(codes.reshape(list(shape)))

    def _chain(self, x: Columns, functions: Any, places: Tensor, result: Tensor) -> Entries:
        if not result.is_floating_point() and result.dtype != torch.bool:
            raise NotAStep(f"a function that gives {result.dtype}")
        for name, a, b in functions:
            if not all(isinstance(v, (int, float)) for v in (a, b)):
                raise NotAStep("a function with arguments that are not numbers")
            if name == "affine" and (a, b) == (1, 0):
                continue
            x = self.b.apply(name, x, a, b)
        return self._placed(x, places, result.shape)

    def _operands(self, tensors: Sequence[Any], shape: Sequence[int]) -> tuple[list[Columns], Tensor]:
        """Broadcasts tensors to a shape, and returns them as operands of one width w.

        Also returns the flat indices, [rows, w], of each sample's entries in a tensor of this shape.
        """
        columns: list[Columns] = []
        first = next(e for t in tensors if isinstance(t, Tensor) and (e := self.entries(t)) and e.of is None)
        places, _ = self.lowering.order(first.codes.expand(list(shape)))
        for tensor in tensors:
            entries = self.entries(tensor)
            if entries is not None and entries.of is None:
                order, numbers = self.lowering.order(entries.codes.expand(list(shape)))
                if not torch.equal(order, places):
                    raise NotAStep("it mixes samples")
                columns.append(self.lowering.operand(numbers))
                continue
            if entries is None:
                entries = self._constant(tensor)
            by_sample = entries.codes.expand(list(shape)).flatten()[places]
            if not (by_sample == by_sample[:1]).all():
                raise NotAStep("a constant that differs between samples")
            columns.append(self.lowering.vector(entries, by_sample[0]))
        return columns, places

    def _binary(self, name: str, args: Any, kwargs: Any, result: Tensor) -> Entries:
        if (not result.is_floating_point() and result.dtype != torch.bool) or kwargs.get("rounding_mode"):
            raise NotAStep(f"{name} that gives {result.dtype}")
        x, y = args[:2]
        alpha = kwargs.get("alpha", args[2] if len(args) > 2 else 1)
        if name == "rsub":
            x, y, name = y, x, "sub"
        numbers = [isinstance(v, Tensor) and v.dim() == 0 and self.entries(v) is None for v in (x, y)]
        x, y = (v.item() if single else v for v, single in zip((x, y), numbers))
        kind = _BINARY[name]
        if not isinstance(x, Tensor) or not isinstance(y, Tensor):
            places, columns = self.lowering.order(self._sample_entries(x if isinstance(x, Tensor) else y).codes)
            operand = self.lowering.operand(columns)
            steps: dict[str, Any] = {
                "add": lambda: [("affine", 1, alpha * y)] if isinstance(x, Tensor) else [("affine", alpha, x)],
                "sub": lambda: [("affine", 1, -alpha * y)] if isinstance(x, Tensor) else [("affine", -alpha, x)],
                "mul": lambda: [("affine", y if isinstance(x, Tensor) else x, 0)],
                "div": lambda: (
                    [("affine", 1 / y, 0)] if isinstance(x, Tensor) else [("power", -1, 0), ("affine", x, 0)]
                ),
            }
            return self._chain(operand, steps[kind](), places, result)
        (a, b), places = self._operands((x, y), result.shape)
        if alpha != 1:
            b = self.b.apply("affine", b, alpha)
        if kind in ("gt", "ge", "lt", "le"):
            a, b = (a, b) if kind[0] == "g" else (b, a)
            if kind[1] == "e":  # as `_FINITE`
                a, b = (self.b.apply("clamp", operand, -_GREATEST, _GREATEST) for operand in (a, b))
            column = self.b.apply("step" if kind[1] == "t" else "at_least", self.b.binary("sub", a, b))
        else:
            column = self.b.binary(kind, a, b)
            if kind == "add" and result.dtype == torch.bool:  # the sum of two truths is true
                column = self.b.apply("clamp", column, 0, 1)
        return self._placed(column, places, result.shape)

    def _where(self, args: Any, result: Tensor) -> Entries:
        (condition, yes, no), places = self._operands(args, result.shape)
        inverse = self.b.apply("affine", condition, -1, 1)
        column = self.b.binary("add", self.b.binary("gate", yes, condition), self.b.binary("gate", no, inverse))
        return self._placed(column, places, result.shape)

    def _summed(self, tensor: Tensor, dims: Any, result: Tensor) -> Entries:
        """Sums over entries of a sample; first moves the terms of each sum to adjacent columns."""
        dims = [dims] if isinstance(dims, int) else dims or range(tensor.dim())
        dims = [d % tensor.dim() for d in dims]
        kept = [d for d in range(tensor.dim()) if d not in dims]
        group = math.prod(tensor.shape[d] for d in dims)
        codes = self._sample_entries(tensor).codes.permute([*kept, *dims]).reshape(-1, group)
        rows = codes[:, :1] >> 32
        if not torch.equal(codes >> 32, rows.expand_as(codes)):
            raise NotAStep("it sums over samples")
        places, _ = self.lowering.order((rows << 32)[:, 0])
        numbers = codes[places] & _LOW  # [rows, m, group]
        if not (numbers == numbers[:1]).all():
            raise NotAStep("the tensor's layout differs between samples")
        return self._placed(self.b.total(self.lowering.operand(numbers[0].flatten()), group), places, result.shape)

    def _product(self, name: str, args: Any, kwargs: Any, result: Tensor) -> Entries:
        """Multiplies rows by the cell's matrix; handles all ATen functions for such products."""
        bias = None
        if name == "linear":
            x, weight, bias = (*args, None)[:3]
        elif name in ("addmm", "baddbmm"):
            bias, x, weight = args[:3]
            if any(v != 1 for v in kwargs.values()):
                raise NotAStep("a product with factors")
        else:
            x, weight = args[:2]
        x_entries, weight_entries = self.entries(x), self.entries(weight)
        if x_entries is None and x.shape[0] == self.lowering.rows:  # for example, the zeros of an initial state
            x_entries = self.of_samples(x, None)
        if x_entries is None or x_entries.of is not None:  # W x^T
            if name != "mm" or weight_entries is None or weight_entries.of is not None:
                raise NotAStep("a product of parameters with samples")
            transposed = self._rows_times(
                weight_entries.codes.t(), self._matrix(x, x_entries), None, (result.shape[1], result.shape[0])
            )
            return Entries(transposed.codes.t().clone())
        matrix = self._matrix(weight, weight_entries)
        if name in ("mm", "addmm", "bmm", "baddbmm"):
            matrix = Entries(matrix.codes.transpose(-1, -2), matrix.of)
        bias_entries = None if bias is None else self.entries(bias) or self._matrix(bias, None)
        if bias_entries is not None and bias_entries.of is None:
            raise NotAStep("a product that is added to samples")
        if name in ("bmm", "baddbmm"):
            if bias_entries is not None or len(x) > _PRODUCTS:
                raise NotAStep("a product of many matrices")
            products = [
                self._rows_times(row, Entries(codes, matrix.of), None, result.shape[1:]).codes
                for row, codes in zip(x_entries.codes, matrix.codes, strict=True)
            ]
            return Entries(torch.stack(products))
        return self._rows_times(x_entries.codes, matrix, bias_entries, result.shape)

    def _matrix(self, tensor: Tensor, entries: Entries | None) -> Entries:
        if entries is None:
            return self._constant(tensor)
        if entries.of is None:
            raise NotAStep("a product of two tensors of samples")
        return entries

    def _rows_times(self, codes: Tensor, matrix: Entries, bias: Entries | None, shape: Sequence[int]) -> Entries:
        """Multiplies a tensor of samples, codes [..., i], by a matrix [o, i]."""
        flat = codes.reshape(-1, codes.shape[-1])
        m = len(flat) // self.lowering.rows
        rows = flat[:, :1] >> 32
        if len(flat) % self.lowering.rows or not torch.equal(flat >> 32, rows.expand_as(flat)):
            raise NotAStep("it mixes samples")
        places, _ = self.lowering.order((rows << 32)[:, 0])
        numbers = flat[places] & _LOW  # [rows, m, i]
        if m > _PRODUCTS:
            raise NotAStep(f"a layer of {m} rows of each sample, more than {_PRODUCTS}")
        if not (numbers == numbers[:1]).all():
            raise NotAStep("the tensor's layout differs between samples")
        weight, (width, _) = self.lowering.parameter(matrix, matrix=True), matrix.codes.shape
        table = torch.empty(len(flat), width, dtype=torch.int64, device="cpu")
        for i in range(m):
            add = None
            if bias is not None:
                if bias.codes.numel() not in (1, width):
                    raise NotAStep("a product that is added to a matrix")
                add = self.lowering.vector(bias, bias.codes.reshape(-1).expand(width))
            parts = self.lowering.parts(numbers[0, i])
            if len(parts) > MOST_PARTS:
                parts = [(self.b.move(flat.shape[1], parts), 0)]
            for x, at in parts:
                add = self.b.linear(x, weight, width, at, add=add)
            assert add is not None
            table[places[:, i]] = self.lowering._codes(add)
        return Entries(table.reshape(list(shape)))
