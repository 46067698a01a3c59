"""Runs a module's own ``forward`` once for the samples of all cells.

The rows are sorted by cell, and :class:`PerCell` tensors replace the module's parameters. :class:`GroupedRun`
intercepts every PyTorch function. A function of rows and parameters runs by a rule (:func:`register`), a function of
parameters alone is mapped over cells, and any other function runs unchanged. :class:`CallAxes` tell which axis of each
argument has the samples. Tensors that depend on the samples are marked; the marks reveal host reads of samples' values.
If a function has no rule, :class:`Ungroupable` names it, and the call becomes a loop over cells.

Letters: n samples, k cells; a tensor of rows has n * m entries in one dimension, the m entries of each sample adjacent.
"""

from __future__ import annotations

import inspect
import itertools
import linecache
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from types import FrameType
from typing import Any, NamedTuple, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.overrides import TorchFunctionMode

from voronerf.router.axes import Axis, SampleCount, axis_of, multiple
from voronerf.router.double import Double
from voronerf.router.grouping import Grouping, cell_parameters, cells_of
from voronerf.router.layout import Call, Results, map_tensors, split_rows, tensors_of
from voronerf.router.norms import EXACT

_TORCH, _HERE = (os.path.dirname(os.path.abspath(file)) + os.sep for file in (torch.__file__, __file__))
_INPLACE = {f"__i{name}__" for name in ("add", "sub", "mul", "truediv", "div", "floordiv", "mod", "pow", "and", "or")}
_MARK = "_voronerf_rows"

BatchingRule = Callable[..., Any]
_RULES: dict[Any, BatchingRule] = {}


def find(names: str, *places: Any) -> frozenset[Any]:
    """Returns the functions with these names in some modules or classes."""
    functions = (getattr(place, name, None) for place in places for name in names.split())
    return frozenset(function for function in functions if function is not None)


_VALUES = {"T", "H", "mT", "mH", "data", "grad", "real", "imag", "_base"}
METADATA = frozenset(
    getattr(torch.Tensor, name).__get__
    for name in dir(torch.Tensor)
    if type(getattr(torch.Tensor, name)).__name__ in ("getset_descriptor", "property") and name not in _VALUES
) | find(
    """
    size dim ndimension numel nelement stride is_contiguous is_floating_point is_complex element_size get_device
    storage_offset is_signed is_same_size is_inference data_ptr __len__ __hash__ __repr__ __dir__ __reduce_ex__
    is_tensor is_storage register_hook retain_grad requires_grad is_pinned
    """,
    torch,
    torch.Tensor,
)
"""The functions that read no values, only shapes, dtypes and devices."""
RANDOM = find(
    """
    rand_like randn_like randint_like bernoulli normal_ uniform_ bernoulli_ exponential_ random_ cauchy_ log_normal_
    geometric_ dropout dropout_ alpha_dropout feature_alpha_dropout rrelu rand randn randint randperm normal multinomial
    """,
    torch,
    torch.Tensor,
    torch.nn.functional,
)
"""The functions that draw random numbers."""
RECURRENT = find("lstm gru rnn_tanh rnn_relu", torch)
"""The functions of recurrent layers; their only argument of type float is the dropout between layers."""
LIKE = find("new_zeros new_ones new_full new_empty new_tensor", torch.Tensor)
"""The functions that make tensors of another tensor's dtype, and read none of its values."""
_TO = find("to type_as", torch.Tensor)


def converted(func: Any, args: Any) -> tuple[Any, Any]:
    """Replaces ``x.to(other)`` by ``x.to(device, dtype)``, which takes no other tensor; returns function, arguments."""
    if func in _TO and len(args) > 1 and isinstance(args[1], Tensor):
        return torch.Tensor.to, (args[0], args[1].device, args[1].dtype, *args[2:])
    return func, args


class Exact(TorchFunctionMode):
    """A mode that replaces functions whose higher derivatives are wrong in PyTorch.

    Attributes:
        met: Whether a replaced function was called.
    """

    def __init__(self) -> None:
        super().__init__()
        self.met = False

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.met = self.met or func in EXACT
        return EXACT.get(func, func)(*args, **(kwargs or {}))


class NoRandomness(TorchFunctionMode):
    """A mode in which random numbers are 0 and dropout does nothing, so that two calls can be compared."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return without_randomness(func, args, kwargs or {})


def is_random(func: Any, args: Any, kwargs: Any) -> bool:
    """Returns whether a function draws random numbers."""
    if func in RECURRENT:
        _, dropout, training, *_ = [value for value in args if isinstance(value, (bool, int, float))][1:]
        return bool(dropout and training)
    is_identity = func is F.dropout and not (kwargs["training"] and kwargs["p"])
    return func in RANDOM and not is_identity


def without_randomness(func: Any, args: Any, kwargs: Any) -> Any:
    """Calls a function with random numbers of 0 and without dropout."""
    if func in RECURRENT:
        return func(*(0.0 if type(value) is float else value for value in args), **kwargs)
    if func not in RANDOM:
        return func(*args, **kwargs)
    if "dropout" in getattr(func, "__name__", ""):
        return args[0] if args else kwargs["input"]
    return func(*args, **kwargs).zero_()


def register(function: Any, rule: BatchingRule) -> None:
    """Registers a rule by which a function that takes parameters runs for all cells at once.

    Without a rule, a module that uses the function runs cell by cell.

    Args:
        function: The function as PyTorch's function modes see it, such as ``torch.nn.functional.linear``, an operator
            of ``torch.ops``, or a function of your own that calls ``torch.overrides.handle_torch_function``.
        rule: ``rule(run, *args, **kwargs)`` with the :class:`GroupedRun` and the function's own arguments: tensors of
            rows are sorted by cell, and a parameter is a :class:`PerCell`, whose ``stacked`` is [k, ...]. The rule
            returns rows, or ``NotImplemented`` for arguments that it does not support.

    Examples:
        >>> import torch
        >>> from voronerf import VoronoiRouter
        >>> from voronerf.router import register
        >>> def shift(rows, offset):  # a function of yours that PyTorch's function modes see
        ...     if torch.overrides.has_torch_function((rows, offset)):
        ...         return torch.overrides.handle_torch_function(shift, (rows, offset), rows, offset)
        ...     return rows + offset.exp()
        >>> def shift_in_cells(run, rows, offset):
        ...     return rows + run.rows_of(offset).exp()
        >>> register(shift, shift_in_cells)
        >>> class Field(torch.nn.Linear):
        ...     def forward(self, x):
        ...         return shift(x @ self.weight.T, self.bias)
        >>> router = VoronoiRouter(Field(3, 2), torch.randn(4, 3), coords="first3")
        >>> router(torch.randn(64, 3)).shape
        torch.Size([64, 2])
        >>> print(router.explain())
        forward: grouped
    """
    _RULES[function] = rule


class Ungroupable(Exception):
    """An error for a module that cannot run on the samples of all cells at once; the message gives the reason.

    Attributes:
        of_batch: Whether another batch may be groupable.
        is_new: Whether the module called functions that no :class:`CallAxes` describes, so recording again may help.
    """

    def __init__(self, reason: str, of_batch: bool = False, is_new: bool = False) -> None:
        super().__init__(reason)
        self.of_batch, self.is_new = of_batch, is_new


class PerCell(torch.Tensor):
    """A stand-in for a parameter in a routed module: k tensors, one for each cell, that look like one tensor.

    It has the shape of a single cell's tensor and no storage.

    Attributes:
        stacked: The tensors of all cells, [k, ...].
        origin: The tensor of which ``stacked`` is a slice, and the first cell of the slice.
    """

    stacked: Tensor
    origin: tuple[Tensor, int]
    # The wrapper needs no override of functions, because it has the shape and the dtype of a cell's tensor.
    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @staticmethod
    def __new__(cls, stacked: Tensor, origin: tuple[Tensor, int] | None = None) -> PerCell:
        """Wraps ``stacked`` [k, ...] as a tensor [...]."""
        wrapper: PerCell = torch.Tensor._make_wrapper_subclass(
            cls, stacked.shape[1:], dtype=stacked.dtype, device=stacked.device, requires_grad=stacked.requires_grad
        )
        wrapper.stacked, wrapper.origin = stacked, origin or (stacked, 0)
        return wrapper

    @property
    def _version(self) -> int:  # type: ignore[override]
        return self.stacked._version

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:  # type: ignore[override]
        """Raises TypeError, because no rule could run instead of the function."""
        raise TypeError(
            f"VoronoiRouter: {func} got the parameters of all cells where PyTorch's function modes do not see it, as "
            "in TorchScript or outside of a routed call; call the router, or take one cell's module with cell(i)"
        )


def for_all_cells(func: Any, args: Any, kwargs: Any, fail: Callable[[str], Exception] = Ungroupable) -> Any:
    """Maps a function of parameters and constants over all cells; results are :class:`PerCell`."""
    stacks = [leaf.stacked for leaf in tensors_of((args, kwargs)) if isinstance(leaf, PerCell)]
    if func is torch.autograd.grad:
        raise fail("it differentiates with respect to parameters")
    function = _weight_norm if func is torch._weight_norm else func

    def run_cell(*single: Tensor) -> Any:
        following = iter(single)
        arguments = map_tensors((args, kwargs), lambda value: next(following) if isinstance(value, PerCell) else value)
        return function(*arguments[0], **arguments[1])

    try:
        return map_tensors(torch.vmap(run_cell, randomness="different")(*stacks), PerCell)
    except Exception as error:
        raise fail(f"{name_of(func)} of parameters fails for all cells at once: {error}") from error


def _weight_norm(v: Tensor, g: Tensor, dim: int = 0) -> Tensor:
    """Computes ``torch._weight_norm`` with functions that support vmap."""
    others = [d for d in range(v.dim()) if d != dim]
    return v * (g / torch.linalg.vector_norm(v, dim=others, keepdim=True))


def name_of(function: Any) -> str:
    """Returns a function's name for messages."""
    if isinstance(owner := getattr(function, "__self__", None), type):  # such as apply of an autograd function
        return f"{owner.__name__}.{function.__name__}"
    resolved = torch.overrides.resolve_name(function)
    return resolved or getattr(function, "__qualname__", None) or str(function)


def writes_in_place(function: Any) -> bool:
    """Returns whether a function writes to its first argument."""
    name = getattr(function, "__name__", "")
    return name == "__setitem__" or name in _INPLACE or (name.endswith("_") and not name.startswith("__"))


def user_frame() -> FrameType | None:
    """Returns the innermost stack frame of the routed module's code, or None."""
    frame, has_left_router = inspect.currentframe(), False
    while frame is not None:
        file = frame.f_code.co_filename
        is_ours = file.startswith(_HERE)
        if is_ours and has_left_router:
            return None  # this is the router that called the module
        has_left_router = has_left_router or not is_ours
        if has_left_router and not is_ours and not file.startswith(_TORCH):
            return frame
        frame = frame.f_back
    return None


def line_of(frame: FrameType | None) -> str:
    """Returns file, line and code of a frame, or an empty text."""
    return "" if frame is None else text_of_line(frame.f_code.co_filename, frame.f_lineno)


def text_of_line(file: str, number: int) -> str:
    """Returns file, number and code of a line."""
    code = linecache.getline(file, number).strip()
    return f" ({os.path.basename(file)}:{number}{f': {code}' if code else ''})"


class CallAxes(NamedTuple):
    """A recorded function call of a module, with the axis of samples of each tensor among its arguments and results.

    ``integers`` are the integers among its arguments, with 0 for an integer that counts samples. ``counts`` has the
    multiple of n of each integer, 0 if it counts no samples; empty if none does. ``varies`` tells whether another size
    or integer among the arguments depends on n.
    """

    function: Any
    axes: tuple[Axis | None, ...]
    integers: tuple[int, ...]
    counts: tuple[int, ...]
    results: tuple[Axis | None, ...]
    varies: bool


def integers_of(items: Iterable[Any]) -> list[int]:
    """Lists the integers among arguments, also in lists, tuples and dicts."""
    integers: list[int] = []
    for item in items:
        if isinstance(item, int):
            integers.append(item)
        elif type(item) in (list, tuple, torch.Size):
            integers += integers_of(item)
        elif isinstance(item, dict):
            integers += integers_of(item.values())
    return integers


def with_counts(value: Any, counts: Iterator[int]) -> Any:
    """Returns arguments in which each integer with a multiple in ``counts`` other than 0 is a :class:`SampleCount`."""
    if isinstance(value, int):
        return SampleCount(value) if next(counts) else value
    if type(value) in (list, tuple, torch.Size):
        items = [with_counts(item, counts) for item in value]
        return items if type(value) is list else tuple(items)
    if isinstance(value, dict):
        return {key: with_counts(item, counts) for key, item in value.items()}
    return value


class Recorder(TorchFunctionMode):
    """A mode that notes each PyTorch function, the shapes of its tensors, and its integers."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[Any, list[torch.Size], list[int], list[torch.Size]]] = []

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func in METADATA:
            return func(*args, **kwargs)
        shapes = [tensor.shape for tensor in tensors_of((args, kwargs))]  # before a write in place
        result, integers = func(*args, **kwargs), integers_of((*args, *kwargs.values()))
        self.calls.append((func, shapes, integers, [tensor.shape for tensor in tensors_of(result)]))
        return result


def steps_of(runs: Sequence[Recorder], n: Sequence[int]) -> list[CallAxes]:
    """Returns the function calls of a module, from its runs with the two numbers of samples ``n``.

    Raises :class:`Ungroupable` if the runs call different functions.
    """
    steps = list[CallAxes]()
    for one, other in itertools.zip_longest(*(run.calls for run in runs)):
        if one is None or other is None or one[0] != other[0] or [*map(len, one[1:])] != [*map(len, other[1:])]:
            raise Ungroupable("its forward calls other functions for another number of samples", of_batch=True)
        shapes, integers = list(zip(one[1], other[1])), list(zip(one[2], other[2]))
        axes, counts = [axis_of(*pair, n) for pair in shapes], [multiple(pair, n) for pair in integers]
        fits = all(told or a == b for told, (a, b) in zip((*axes, *counts), (*shapes, *integers)))
        results = tuple(axis_of(*pair, n) for pair in zip(one[3], other[3]))
        constants = tuple(0 if m else value for m, value in zip(counts, one[2]))
        steps.append(CallAxes(one[0], tuple(axes), constants, tuple(counts) if any(counts) else (), results, not fits))
    return steps


class GroupedRun(TorchFunctionMode):
    """A mode that is active while a module runs on the n sorted rows of all cells; rules get it as ``run``.

    Args:
        grouping: The samples by cell.
        tables: The look-up tables that the call has read, with buffers for their gradients. If the rows of the call are
            run in parts, all parts share this dict.
        steps: The module's recorded function calls; None if the caller itself marks all rows with their axis.
        quiet: Whether random numbers are 0.

    Attributes:
        failed: The reason why the results are invalid, even if the module caught the error; None if they are valid.
        widest: The size in bytes of the largest tensor of rows in the run.
    """

    def __init__(
        self,
        grouping: Grouping,
        tables: dict[Any, Any],
        steps: list[CallAxes] | None = None,
        quiet: bool = False,
    ) -> None:
        super().__init__()
        self.quiet, self.grouping, self.n, self.tables = quiet, grouping, grouping.n, tables
        self.failed: Ungroupable | None = None
        self.widest = 1
        self._token = object()
        self.counted = False  # whether the current function has a SampleCount
        self._steps = None if steps is None else iter(steps)

    # For rules --------------------------------------------------------------------------------------------------------

    def is_rows(self, value: Any) -> bool:
        """Returns whether a value is a tensor with rows of samples, or a tensor that depends on samples."""
        return isinstance(value, Tensor) and getattr(value, _MARK, (None,))[0] is self._token

    def axis(self, rows: Tensor) -> Axis:
        """Returns the axis of samples of a tensor among the arguments of a rule."""
        axis: Axis | None = getattr(rows, _MARK)[2]
        if axis is None:
            raise self.fail(f"parameters meet a tensor of shape {list(rows.shape)}, which has no row for each sample")
        return axis

    def entries(self, rows: Tensor) -> int:
        """Returns m, the number of entries per sample, of a tensor of rows [n * m, ...]."""
        axis = self.axis(rows)
        if axis.dim:
            raise self.fail(f"a tensor of shape {list(rows.shape)} has its samples in dimension {axis.dim}, not 0")
        return axis.m

    def rows_of(self, parameter: PerCell, m: int = 1) -> Tensor:
        """Returns the parameter of each row's cell, [n * m, ...]."""
        return self.grouping.expand(parameter.stacked, m)

    # Marks ------------------------------------------------------------------------------------------------------------

    def mark(self, tensor: Tensor, axis: Axis | None = None, tag: str = "") -> Tensor:
        """Marks a tensor as dependent on samples, with the axis of its samples if this is known.

        ``tag`` is "any" or "all" for the result of that reduction.
        """
        setattr(tensor, _MARK, (self._token, tag, axis))
        self.widest = max(self.widest, tensor.numel() * tensor.element_size())
        return tensor

    def fail(self, reason: str, of_batch: bool = False, is_new: bool = False) -> Ungroupable:
        """Records why the run cannot continue, and returns the error to raise; see :class:`Ungroupable`."""
        self.failed = self.failed or Ungroupable(reason + line_of(user_frame()), of_batch, is_new)
        return self.failed

    # Functions --------------------------------------------------------------------------------------------------------

    def _step(self, func: Any, args: Any, kwargs: Any) -> CallAxes | None:
        """Returns the next recorded call, or None; raises :class:`Ungroupable` if function or integers differ."""
        if self._steps is None:
            return None
        step = next(self._steps, None)
        if step is not None and step.function == func:
            integers, counts = integers_of((*args, *kwargs.values())), step.counts or (0,) * len(step.integers)
            if len(integers) == len(counts) and all(
                value == m * self.n if m else value == constant
                for value, m, constant in zip(integers, counts, step.integers)
            ):
                self.counted = bool(step.counts)
                return step
        raise self.fail("its forward calls other functions than before", of_batch=True, is_new=True)

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Runs one PyTorch function of the module."""
        kwargs = kwargs or {}
        if func in METADATA:
            return func(*args, **kwargs)
        step = self._step(func, args, kwargs)
        func, args = converted(func, args)
        if func in LIKE and type(args[0]) is PerCell:
            args = (args[0].stacked, *args[1:])
        operands = tensors_of((args, kwargs))
        if any(type(tensor) is PerCell for tensor in operands):
            return self._with_parameters(func, args, kwargs, operands, step)
        exact = EXACT.get(func, func)
        result = without_randomness(exact, args, kwargs) if self.quiet else exact(*args, **kwargs)
        marked = [] if func in LIKE else [tensor for tensor in operands if self.is_rows(tensor)]
        outputs = tensors_of(result)
        if marked:
            if writes_in_place(func):
                self.mark(operands[0])
            name = getattr(func, "__name__", "")
            for tensor in outputs:
                self.mark(tensor, tag=name if name in ("any", "all") else "")
            if not outputs:
                self._check_read(func, result, marked[0])
        elif step is not None and step.counts:  # such as torch.zeros(n, 4)
            for tensor in outputs:
                self.mark(tensor)
        return result

    def _check_read(self, func: Any, result: Any, source: Tensor) -> None:
        """Raises for a host read of samples' values, because a loop over cells reads them separately for each cell."""
        if result is None or isinstance(result, (str, torch.dtype, torch.device, torch.Size)):
            return
        # A false "any" or a true "all" of all samples holds for the samples of each cell too.
        if isinstance(result, bool) and getattr(source, _MARK)[1] == ("all" if result else "any"):
            return
        raise self.fail(f"{name_of(func)} reads values of the samples", of_batch=True)

    def _with_parameters(self, func: Any, args: Any, kwargs: Any, operands: list[Tensor], step: CallAxes | None) -> Any:
        if step is not None:
            for tensor, axis in zip(operands, step.axes, strict=False):
                if axis is not None and tensor.shape[axis.dim : axis.dim + 1] != (self.n * axis.m,):
                    raise self.fail("a tensor has other axes than before", of_batch=True, is_new=True)
                if self.is_rows(tensor):
                    self.mark(tensor, axis)
                elif axis is not None and type(tensor) is not PerCell:
                    raise self.fail(f"{name_of(func)} takes rows that were not computed by a recorded PyTorch function")
            if step.counts:
                args, kwargs = with_counts((args, kwargs), iter(step.counts))
        rule = _RULES.get(func)
        result = NotImplemented if rule is None else rule(self, *args, **kwargs)
        if result is NotImplemented:
            if any(self.is_rows(tensor) for tensor in operands) or self.counted:
                raise self.fail(
                    f"{name_of(func)} takes parameters, and has no rule for all cells at once; "
                    "voronerf.router.register adds a rule"
                )
            return for_all_cells(func, args, kwargs, self.fail)
        for tensor in tensors_of(result):
            if type(tensor) is not PerCell:
                self.mark(tensor, getattr(tensor, _MARK, (None, "", None))[2])
        return result


class Way(Protocol):
    """A method to evaluate a call for all cells: fused, grouped or cell by cell.

    Attributes:
        name: "fused", "grouped" or "cell by cell".
        why: The reason why no faster method runs, or an empty text.
    """

    name: str
    why: str

    def run(self, call: Call, grouping: Grouping) -> Results:
        """Returns the results of a call with the parameters of its module."""
        ...


@dataclass
class Grouped:
    """The grouped evaluation: the module's own ``forward`` runs once for the rows of all cells.

    On a CPU, ``forward`` runs on pieces of the rows, so that its tensors fit in the cache.
    """

    records: list[list[CallAxes]]  # recorded sequences of function calls, the last used one last
    piece: int = 1 << 16  # maximum number of rows in a piece
    name: str = "grouped"
    why: str = ""
    quiet: bool = False  # whether random numbers are 0, to compare two runs
    widest: int = 1  # size in bytes of the largest tensor of rows in the last call

    def run(self, call: Call, grouping: Grouping) -> Results:
        """Returns results in the order of the grouping; raises :class:`Ungroupable`."""
        arguments = call.arranged(grouping)
        parts = grouping.parts(self.piece) if grouping.device.type == "cpu" else [grouping]
        # Each parameter is split once for all parts, so the gradients of the pieces are concatenated once. If each part
        # took a slice, the gradient of each slice would be a zero-filled tensor of all cells. If the rows of a large
        # cell are cut into several parts, these parts use the same piece.
        sizes, pieces = {part.start: part.k for part in parts}, []
        for p in cell_parameters(call.module):
            pieces.append((p, dict(zip(sizes, p.split(list(sizes.values())) if len(sizes) > 1 else (p,), strict=True))))
        values, widest, tables, double = [], 1, dict[Any, Any](), Double(call.module)
        counts = [part.n for part in parts]
        for index, (part, rows) in enumerate(zip(parts, split_rows(arguments, counts), strict=True)):
            origin = part.start
            stand_ins = {id(p): PerCell(piece[origin], (p, origin)) for p, piece in pieces}
            for steps in reversed(self.records):
                run = GroupedRun(part, tables, steps, self.quiet)
                for tensor in rows:
                    run.mark(tensor, Axis(0))
                try:
                    value = double.run(call, rows, stand_ins, run)
                except Exception:
                    if run.failed is None:
                        raise
                if run.failed is None or not run.failed.is_new:
                    break
                rows = split_rows(call.arranged(grouping), counts)[index]  # the failed steps may have written into them
            if run.failed is not None:
                raise run.failed
            self.records = [*(other for other in self.records if other is not steps), steps]
            values.append(value)
            if any(isinstance(tensor, PerCell) for tensor in tensors_of(value)):
                raise Ungroupable("a result is made of parameters alone")
            widest = max(widest, run.widest)
        self.widest = widest
        return Results.joined(values, counts, grouping)


@dataclass
class Loop:
    """The loop: the module runs once for each cell that has samples. It defines the result of a routed call.

    ``again`` is for modules whose code runs again in the backward pass (``torch.utils.checkpoint``): every cell then
    has its own double, which keeps the cell's parameters. In other loops, if an argument requires gradients, the first
    cell runs in the mode :class:`Exact`; the other cells do so only if the first one needs it, since it takes time.
    """

    why: str = ""
    again: bool = False
    name: str = "cell by cell"

    def run(self, call: Call, grouping: Grouping) -> Results:
        """Returns results in the order of the grouping."""
        return self.on(call, grouping, grouping.occupied)

    def on(self, call: Call, grouping: Grouping, bounds: list[tuple[int, int, int]]) -> Results:
        """Runs the module once for each (cell, first row, end row) of ``bounds``."""
        module, counts = call.module, [last - first for _, first, last in bounds]
        rows, double = call.arranged(grouping), Double(module)
        pieces = {key: cells_of(parameter) for key, parameter in double.stacked.items()}
        parts, first = split_rows(rows, counts), 0
        values = [{key: piece[cell] for key, piece in pieces.items()} for cell, _, _ in bounds]
        if self.again:
            results = [Double(module).run(call, *each) for each in zip(parts, values, strict=True)]
        else:
            mode, results = None, []
            if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in rows):
                mode, first = Exact(), 1
                results = double.runs(call, parts[:1], values[:1], mode)
                mode = mode if mode.met else None
            results += double.runs(call, parts[first:], values[first:], mode)
            double.end()
        return Results.joined(results, counts, grouping)
